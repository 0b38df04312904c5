"""The report page of a contest: who stayed in the lane, and the roads on which that was hardest."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from datagen.judge.contest import contest_jobs, read_trajectory
from datagen.judge.report import colour_of, draw_runs, run_text, table_title, tables
from datagen.judge.run import TRUE_POINTS, TRUTH, Entrant, RunResult
from datagen.judge.settings import JudgeSettings
from datagen.world.world import draw_track
from lanenet.data.files import write_text
from lanenet.errors import counted
from lanenet.page import (
    PAGE_NAME,
    Picture,
    Row,
    colour_key,
    details,
    note,
    page_of,
    photo,
    section,
    subsection,
    table,
)

#: Roads on the page, and runs in its list. Chosen: what a person looks at.
_ROADS, _RUNS = 4, 100


def write_page(
    out: Path, settings: JudgeSettings, entrants: Sequence[Entrant], results: Sequence[RunResult]
) -> Path:
    """Write the report of a contest beside its tables; returns its path.

    Args:
        out: Folder of the contest, with its finished runs.
        settings: The contest.
        entrants: Who drove.
        results: What :func:`datagen.judge.contest.judge` returned.
    """
    own = [result for result in results if result.entrant == subject(results)]
    jobs = contest_jobs(settings, entrants, out)
    pictures = []
    for place in sorted(range(len(own)), key=lambda k: _hardness(own[k]), reverse=True)[:_ROADS]:
        chosen = slice(place * len(entrants), (place + 1) * len(entrants))
        runs = [
            (result, read_trajectory(job.path))
            for job, result in zip(jobs[chosen], results[chosen], strict=True)
        ]
        said = "; ".join(f"{result.entrant}: {run_text(result)}" for result, _ in runs)
        track = draw_track(jobs[chosen.start].road.simulation)
        pictures.append(Picture(draw_runs(track, runs), f"{own[place].road}. {said}."))
    write_text(out / PAGE_NAME, contest_page(settings, results, pictures))
    return out / PAGE_NAME


def contest_page(settings: JudgeSettings, results: Sequence[RunResult], pictures: Sequence[Picture]) -> str:
    """Return the page as HTML.

    Args:
        settings: The contest.
        results: By road, and by entrant in the order of their colours.
        pictures: The hardest roads with the driven paths.
    """
    names = list(dict.fromkeys(result.entrant for result in results))
    unclean = [result for result in results if not _clean(result)]
    by_kind = tables(results)
    body = [
        table(entrant_rows(results)),
        note(
            f"{counted(settings.laps, 'lap')} at {settings.speed_cm_s:g} cm/s on each road. Clean: driven "
            "to the end, and no wheel went over a line."
        ),
        section("The roads that were hardest"),
        note(
            "From above, the driven paths by colour. Dot: a wheel goes over a line; cross: the car is put "
            "back on the road; arrow: the start. Where a path is hidden, another one lies on it."
        ),
        colour_key([(colour_of(index), name) for index, name in enumerate(names)]),
        *map(photo, pictures),
        section("More"),
        details(
            "Runs that left the lane",
            table(run_rows(unclean), texts=2) if unclean else note("None."),
            note(f"and {len(unclean) - _RUNS} more in runs.csv") if len(unclean) > _RUNS else "",
        ),
        details(
            "All measures",
            *(
                subsection(table_title(settings, kind)) + table(list(zip(*rows, strict=True)))
                for kind, rows in by_kind.items()
            ),
        ),
    ]
    return page_of(f"Closed loop: {', '.join(by_kind)}", "", contest_sentence(results), body)


def subject(results: Sequence[RunResult]) -> str:
    """Return the entrant that a contest is about: the first that has to see the road."""
    names = list(dict.fromkeys(result.entrant for result in results))
    return next((name for name in names if name not in (TRUTH, TRUE_POINTS)), names[0])


def contest_sentence(results: Sequence[RunResult]) -> str:
    """Say how the entrant that a contest is about did, beside the scripted driver who knows the road."""
    name = subject(results)
    own = [result for result in results if result.entrant == name]
    driver = [result for result in results if result.entrant == TRUTH and name != TRUTH]
    beside = f" (the scripted driver on {sum(map(_clean, driver))})" if driver else ""
    said = f"{name} stays in its lane on {sum(map(_clean, own))} of {counted(len(own), 'road')}{beside}"
    worst = max(own, key=_hardness)
    furthest = f"{worst.worst_offset_cm:.1f} cm from the middle of the lane"
    departures, unfinished = sum(run.departures for run in own), sum(not run.completed for run in own)
    if departures:
        said += f"; it goes over a line {counted(departures, 'time')}, most on {worst.road}, up to {furthest}"
    else:
        said += f"; it is never further than {max(run.worst_offset_cm for run in own):.1f} cm from the middle"
    return f"{said}; {counted(unfinished, 'run')} not completed" if unfinished else said


def entrant_rows(results: Sequence[RunResult]) -> list[Row]:
    """A row for each entrant, over all roads."""
    rows: list[Row] = [("", "clean", "departures", "put back", "furthest, cm")]
    for name in dict.fromkeys(result.entrant for result in results):
        own = [result for result in results if result.entrant == name]
        rows.append(
            (
                name,
                f"{sum(map(_clean, own))}/{len(own)}",
                str(sum(run.departures for run in own)),
                str(sum(run.put_backs for run in own)),
                f"{max(run.worst_offset_cm for run in own):.1f}",
            )
        )
    return rows


def run_rows(results: Sequence[RunResult]) -> list[Row]:
    """A row for each run, the worst first."""
    rows: list[Row] = [("road", "entrant", "departures", "put back", "furthest, cm", "ended")]
    for run in sorted(results, key=_hardness, reverse=True)[:_RUNS]:
        counts = (str(run.departures), str(run.put_backs), f"{run.worst_offset_cm:.1f}")
        rows.append((run.road, run.entrant, *counts, run.ended))
    return rows


def _clean(result: RunResult) -> bool:
    return result.completed and result.departures == 0


def _hardness(result: RunResult) -> tuple[bool, int, float]:
    return not result.completed, result.departures, result.worst_offset_cm
