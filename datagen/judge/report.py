"""Tables of a contest: a row per kind of road and entrant, mean and worst over its runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from datagen.judge.run import RunResult
from datagen.judge.settings import JudgeSettings
from lanenet.data.files import write_json, write_text
from lanenet.data.tables import write_csv

FORMAT = "lanenet-judge/1"

#: Header, measure, decimals, factor; each shown as mean/worst over the runs.
_MEASURES: tuple[tuple[str, str, int, float], ...] = (
    ("departures", "departures", 1, 1.0),
    ("put back", "put_backs", 1, 1.0),
    ("offset, cm", "mean_offset_cm", 2, 1.0),
    ("furthest, cm", "worst_offset_cm", 1, 1.0),
    ("steer, rad/s", "steering_rms_rad_s", 2, 1.0),
    ("no answer, %", "unanswered", 1, 100.0),
    ("time, s", "time_s", 0, 1.0),
)
_HEADERS: tuple[str, ...] = ("completed", "clean", *(header for header, *_ in _MEASURES))


def summarise(results: Sequence[RunResult]) -> list[dict[str, Any]]:
    """Return a row per kind of road and entrant, in the order in which they first occur.

    Returns:
        ``kind``, ``entrant``, ``runs``, ``completed``, ``clean`` (completed without a departure),
        ``laps_mean``, and ``*_mean`` and ``*_worst`` of the measures of :class:`RunResult`.
    """
    groups: dict[tuple[str, str], list[RunResult]] = {}
    for result in results:
        groups.setdefault((result.kind, result.entrant), []).append(result)
    rows = []
    for (kind, entrant), runs in groups.items():
        row: dict[str, Any] = {
            "kind": kind,
            "entrant": entrant,
            "runs": len(runs),
            "completed": sum(run.completed for run in runs),
            "clean": sum(run.completed and run.departures == 0 for run in runs),
            "laps_mean": float(np.mean([run.laps for run in runs])),
        }
        for _, name, _, _ in _MEASURES:
            values = [float(getattr(run, name)) for run in runs]
            row |= {f"{name}_mean": float(np.mean(values)), f"{name}_worst": max(values)}
        rows.append(row)
    return rows


def tables(results: Sequence[RunResult]) -> dict[str, list[list[str]]]:
    """Return a table per kind of road, as text: a row per entrant, under the headers of its first row."""
    found: dict[str, list[list[str]]] = {}
    for row in summarise(results):
        cells = [row["entrant"], f"{row['completed']}/{row['runs']}", f"{row['clean']}/{row['runs']}"]
        for _, measure, decimals, factor in _MEASURES:
            values = (row[f"{measure}_mean"] * factor, row[f"{measure}_worst"] * factor)
            cells.append("/".join(f"{value:.{decimals}f}" for value in values))
        found.setdefault(row["kind"], [["", *_HEADERS]]).append(cells)
    return found


def table_title(settings: JudgeSettings, kind: str) -> str:
    """Return a line that says what was driven."""
    return (
        f"{kind}: {settings.count} roads, {settings.laps} laps at {settings.speed_cm_s:g} cm/s, "
        f"{settings.simulation.rate_hz:g} frames/s, {settings.pilot.law}, seed {settings.seed}; "
        "mean/worst over the runs"
    )


def write_report(out: Path, settings: JudgeSettings, results: Sequence[RunResult]) -> list[Path]:
    """Write ``results.json``, ``results.md`` and ``runs.csv`` (a row per run); returns their paths."""
    paths = [out / "results.json", out / "results.md", out / "runs.csv"]
    data = {
        "format": FORMAT,
        "settings": settings.model_dump(mode="json"),
        "summary": summarise(results),
        "runs": [asdict(result) for result in results],
    }
    write_json(paths[0], data)
    lines = []
    for kind, (headers, *rows) in tables(results).items():
        lines += [f"# {table_title(settings, kind)}", "", "| " + " | ".join(headers) + " |"]
        lines.append("|---|" + "---:|" * (len(headers) - 1))
        lines += [*("| " + " | ".join(row) + " |" for row in rows), ""]
    write_text(paths[1], "\n".join(lines))
    names = [field.name for field in fields(RunResult)]
    write_csv(paths[2], {name: [getattr(result, name) for result in results] for name in names})
    return paths
