"""All runs of a contest, driven by several processes; finished runs are kept and not driven again.

A finished run on disk is a JSON file with the result and a CSV file with the trajectory.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from datagen.judge.run import TRUE_POINTS, TRUTH, Entrant, RunResult, Trajectory, drive_run
from datagen.judge.settings import JudgeSettings, Road, contest_roads
from datagen.world.world import draw_track
from lanenet.data.files import write_json
from lanenet.data.tables import ColumnSpec, read_csv, write_csv
from lanenet.errors import ConfigError, DriveFormatError, LanenetError
from lanenet.processes import run_jobs
from lanenet.reading import is_regular, read_json

#: Of the runs; raise it when the same settings give other results.
_VERSION = 2
#: Settings that a run does not depend on, or that stand in its road.
_NOT_OF_ONE_RUN = {"seed", "count", "counts", "tracks", "simulation", "track_width_cm"}
_NUMBERS = ("s_cm", "offset_cm", "steering_rad")
_FLAGS = ("answered", "over", "put_back")


@dataclass(frozen=True)
class Job:
    """One run to be driven.

    Attributes:
        settings: The contest.
        road: The road and its car.
        entrant: Who drives.
        path: JSON file of its result.
    """

    settings: JudgeSettings
    road: Road
    entrant: Entrant
    path: Path

    @property
    def key(self) -> str:
        """Hash of all that the run depends on, which does not include how many other runs there are."""
        contest = self.settings.model_dump(mode="json", exclude=_NOT_OF_ONE_RUN)
        parts = [_VERSION, contest, self.road.simulation.model_dump(mode="json"), self.road.track_width_cm]
        text = json.dumps([*parts, self.entrant.name, self.entrant.identity], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def judge(
    settings: JudgeSettings,
    entrants: Sequence[Entrant],
    out: Path,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[RunResult]:
    """Let every entrant drive every road.

    Each run is written to ``out/runs`` when it is finished; a run that is there, driven under the same
    settings, is not driven again.

    Args:
        settings: The contest; the same settings give the same results, by any number of processes.
        entrants: Who drives.
        out: Folder of the contest.
        workers: Processes.
        progress: Called with (runs done, runs).

    Returns:
        Results by road, and by entrant in the order given.

    Raises:
        ConfigError: If two entrants have one name, or there is no such road.
        LanenetError: What the first failing run raised, or if a process dies.
    """
    jobs = contest_jobs(settings, entrants, out)
    results = {job.path: result for job in jobs if (result := read_run(job.path, job.key)) is not None}
    missing = [(job.path.stem, job) for job in jobs if job.path not in results]
    kept = len(results)

    def show(done: int, _: int) -> None:
        if progress is not None:
            progress(kept + done, len(jobs))

    show(0, 0)
    driven = run_jobs(run_job, missing, workers, show)
    results |= {job.path: result for (_, job), result in zip(missing, driven, strict=True)}
    return [results[job.path] for job in jobs]


def contest_jobs(settings: JudgeSettings, entrants: Sequence[Entrant], out: Path) -> list[Job]:
    """Return all runs of a contest; a road of each kind is drawn, so that bad settings are refused at once.

    Raises:
        ConfigError: If two entrants have one name, one has neither a detector nor the truth, or there is no
            such road.
    """
    names = [entrant.name for entrant in entrants]
    if len(set(names)) < len(names):
        raise ConfigError(f"detectors: {', '.join(names)}: each may be named once")
    blind = [e.name for e in entrants if e.build is None and e.name not in (TRUTH, TRUE_POINTS)]
    if blind:
        raise ConfigError(f"detectors: {blind[0]!r}: without a detector, expected {TRUTH} or {TRUE_POINTS}")
    jobs = []
    for road in contest_roads(settings):
        if road.number == 0:
            draw_track(road.simulation)
        for entrant in entrants:
            path = out / "runs" / f"{road.kind}_{road.number:02d}_{entrant.name}.json"
            jobs.append(Job(settings, road, entrant, path))
    return jobs


def run_job(job: Job) -> RunResult:
    """Drive one run and write it; in any process."""
    result, trajectory = drive_run(job.settings, job.road, job.entrant)
    write_run(job.path, job.key, result, trajectory)
    return result


def write_run(path: Path, key: str, result: RunResult, trajectory: Trajectory) -> None:
    """Write a finished run.

    Args:
        path: The JSON file; the trajectory goes beside it.
        key: See :attr:`Job.key`.
        result: The run.
        trajectory: The run frame by frame.
    """
    x_cm, y_cm = trajectory.xy_cm.T
    columns = {name: getattr(trajectory, name) for name in (*_NUMBERS, *_FLAGS)}
    write_csv(path.with_suffix(".csv"), {"t_s": trajectory.t_s, "x_cm": x_cm, "y_cm": y_cm, **columns})
    # Last: a run without it is driven again.
    write_json(path, {"key": key, **asdict(result)})


def read_run(path: Path, key: str) -> RunResult | None:
    """Read a finished run; None if there is none, or it was driven under other settings."""
    try:
        data = read_json(path, DriveFormatError)
        if data.pop("key") != key or not is_regular(path.with_suffix(".csv")):
            return None
        # As JSON: strictly, a dictionary is no result.
        return TypeAdapter(RunResult).validate_json(json.dumps(data), strict=True)
    # Missing, or not what was written; pydantic's error is a ValueError.
    except (LanenetError, ValueError, KeyError, TypeError, AttributeError):
        return None


def read_trajectory(path: Path) -> Trajectory:
    """Read the trajectory beside a run's JSON file.

    Raises:
        DriveFormatError: If it cannot be read.
    """
    specs = {name: ColumnSpec() for name in ("t_s", "x_cm", "y_cm", *_NUMBERS)}
    columns = read_csv(path.with_suffix(".csv"), specs | {name: ColumnSpec("int") for name in _FLAGS})
    return Trajectory(
        xy_cm=np.stack([columns["x_cm"], columns["y_cm"]], axis=1),
        **{name: columns[name] for name in ("t_s", *_NUMBERS)},
        **{name: columns[name] == 1 for name in _FLAGS},
    )
