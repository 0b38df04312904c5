"""Real drives beside synthetic ones: a table, a JSON file, and the synthetic drives that are most alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from datagen.reality.measure import HEIGHT_CM, MeasuredDrive
from datagen.reality.statistics import BANDS, STATISTICS
from lanenet.data.files import write_json, write_text

FORMAT = "lanenet-reality/1"
#: Quantiles over the synthetic drives between which a real drive counts as inside.
SPREAD: tuple[float, float, float] = (0.025, 0.5, 0.975)


@dataclass(frozen=True)
class Row:
    """One statistic.

    Attributes:
        name: See :data:`datagen.reality.statistics.STATISTICS`.
        low: 2.5 % of the synthetic drives lie below.
        median: Of the synthetic drives.
        high: 2.5 % lie above.
        real: Value of each real drive.
        below: Share of the synthetic drives below each of them.
    """

    name: str
    low: float
    median: float
    high: float
    real: tuple[float, ...]
    below: tuple[float, ...]

    @property
    def label(self) -> str:
        """Name and unit, for people."""
        unit = STATISTICS[self.name][0]
        return self.name.removesuffix("_px").replace("_", " ") + (f", {unit}" if unit else "")

    @property
    def inside(self) -> tuple[bool, ...]:
        """Whether each real drive lies within the synthetic spread; NaN does not."""
        return tuple(self.low <= value <= self.high for value in self.real)


def compare(real: Sequence[MeasuredDrive], synthetic: Sequence[MeasuredDrive]) -> list[Row]:
    """Return a row per statistic.

    A synthetic drive without edge points is left out of the statistics that need one.

    Args:
        real: Real drives.
        synthetic: Synthetic drives, at least one.
    """
    rows = []
    for name in STATISTICS:
        values = np.array([drive.statistics[name] for drive in synthetic])
        values = values[np.isfinite(values)]
        spread = np.quantile(values, SPREAD) if values.size else np.full(3, np.nan)
        found = tuple(drive.statistics[name] for drive in real)
        below = tuple(float(np.mean(values < value)) if values.size else float("nan") for value in found)
        low, median, high = map(float, spread)
        rows.append(Row(name, low, median, high, found, below))
    return rows


def nearest_synthetic(
    real: MeasuredDrive, synthetic: Sequence[MeasuredDrive], count: int
) -> list[MeasuredDrive]:
    """Return the synthetic drives most like a real one, by the mean square of standardised differences."""
    table = np.array([_values(drive) for drive in synthetic])
    deviation = np.nanstd(table, axis=0)
    off = (table - _values(real)) / np.where(deviation > 0.0, deviation, 1.0)
    distance = np.sqrt(np.nan_to_num(off**2, nan=9.0).mean(axis=1))
    return [synthetic[i] for i in np.argsort(distance, kind="stable")[:count]]


def table(rows: Sequence[Row], names: Sequence[str]) -> list[list[str]]:
    """Return the table as text, its headers first; a real drive's value outside is marked ``out``."""
    headers = ["statistic", "2.5 %", "median", "97.5 %", *names]
    lines = [headers]
    for row in rows:
        cells = [_figure(value) for value in (row.low, row.median, row.high)]
        for value, inside in zip(row.real, row.inside, strict=True):
            cells.append(_figure(value) + ("" if inside else " out"))
        lines.append([row.label, *cells])
    return lines


def summary(rows: Sequence[Row], names: Sequence[str]) -> list[str]:
    """Say for each real drive in how many statistics it lies inside, and where it does not."""
    lines = []
    for k, name in enumerate(names):
        out = [row.name for row in rows if not row.inside[k]]
        outside = f"; outside: {', '.join(out)}" if out else ""
        lines.append(f"{name}: {len(rows) - len(out)} of {len(rows)} statistics inside{outside}")
    return lines


def write_report(
    out: Path, settings: dict[str, Any], real: Sequence[MeasuredDrive], synthetic: Sequence[MeasuredDrive]
) -> list[Path]:
    """Write ``reality.md`` and ``reality.json``; returns their paths.

    Args:
        out: Folder.
        settings: How the drives were made and measured, for the JSON file.
        real: Real drives.
        synthetic: Synthetic drives.
    """
    rows, names = compare(real, synthetic), [drive.name for drive in real]
    headers, *lines = table(rows, names)
    bands = ", ".join(f"{low:g} to {high:g}" for low, high in pairwise(BANDS))
    text = [
        f"# {len(real)} real drives beside {len(synthetic)} synthetic ones",
        "",
        "Each number is of a whole drive; the first three columns are over the synthetic drives. All cameras "
        f"are taken to be {HEIGHT_CM:g} cm high, distances are from below the camera; near, middle and far "
        f"are {bands} camera heights.",
        "",
        "| " + " | ".join(headers) + " |",
        "|---|" + "---:|" * (len(headers) - 1),
        *("| " + " | ".join(line) + " |" for line in lines),
        "",
        *(f"- {line}" for line in summary(rows, names)),
        "",
        "What each statistic means:",
        "",
        *(f"- `{name}`: {meaning}" for name, (_, meaning) in STATISTICS.items()),
        "",
    ]
    data = {
        "format": FORMAT,
        "settings": settings,
        "spread": SPREAD,
        "camera_height_cm": HEIGHT_CM,
        "statistics": [
            {
                **{name: getattr(row, name) for name in ("name", "low", "median", "high")},
                "unit": STATISTICS[row.name][0],
                "meaning": STATISTICS[row.name][1],
                "real": dict(zip(names, row.real, strict=True)),
                "share_below": dict(zip(names, row.below, strict=True)),
                "inside": dict(zip(names, row.inside, strict=True)),
            }
            for row in rows
        ],
        "drives": [
            {"name": drive.name, "kind": kind, "statistics": drive.statistics}
            for kind, drives in (("real", real), ("synthetic", synthetic))
            for drive in drives
        ],
    }
    paths = [out / "reality.md", out / "reality.json"]
    write_text(paths[0], "\n".join(text))
    write_json(paths[1], data)
    return paths


def _values(drive: MeasuredDrive) -> Float[np.ndarray, "k"]:
    return np.array([drive.statistics[name] for name in STATISTICS])


def _figure(value: float) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.1f}" if abs(value) >= 10.0 else f"{value:.2f}"
