"""All runs of a contest: over processes, and taken up again where they were stopped.

Finished runs on disk: a JSON file with the result, and a CSV file with the trajectory.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.judge.run import TRUE_POINTS, TRUTH, Entrant, RunResult, Trajectory, drive_run
from datagen.judge.settings import JudgeSettings, road_names, road_simulation
from datagen.world.simulate import prepare_process
from datagen.world.world import SimulationSettings, draw_track
from lanenet.data.files import write_json
from lanenet.data.tables import ColumnSpec, read_csv, write_csv
from lanenet.errors import ConfigError, LanenetError

_NUMBERS = ("t_s", "x_cm", "y_cm", "s_cm", "offset_cm", "steering_rad")
_FLAGS = ("answered", "over", "put_back")


def write_run(path: Path, key: str, result: RunResult, trajectory: Trajectory) -> None:
    """Write a finished run.

    Args:
        path: The JSON file; the trajectory lies beside it.
        key: Stands for all that the run depends on.
        result: The run.
        trajectory: The run frame by frame.
    """
    columns: dict[str, Any] = {"t_s": trajectory.t_s}
    columns |= {"x_cm": trajectory.xy_cm[:, 0], "y_cm": trajectory.xy_cm[:, 1]}
    columns |= {name: getattr(trajectory, name) for name in (*_NUMBERS[3:], *_FLAGS)}
    write_csv(path.with_suffix(".csv"), columns)
    # Last: a run without it is driven again.
    write_json(path, {"key": key, **asdict(result)})


def read_run(path: Path, key: str) -> RunResult | None:
    """Read a finished run; None if there is none, or it was driven under other settings."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data.pop("key") != key or not path.with_suffix(".csv").is_file():
            return None
        return RunResult(**data)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):  # not there, or not what was written
        return None


def read_trajectory(path: Path) -> Trajectory:
    """Read the trajectory beside a run's JSON file.

    Raises:
        DriveFormatError: If it cannot be read.
    """
    specs = {name: ColumnSpec() for name in _NUMBERS} | {name: ColumnSpec("int") for name in _FLAGS}
    columns = read_csv(path.with_suffix(".csv"), specs)
    return Trajectory(
        xy_cm=np.stack([columns["x_cm"], columns["y_cm"]], axis=1),
        **{name: columns[name] for name in ("t_s", "s_cm", "offset_cm", "steering_rad")},
        **{name: columns[name] == 1 for name in _FLAGS},
    )


_VERSION = 2  # of the runs; raise it when the same settings give other results


@dataclass(frozen=True)
class Job:
    """One run to be driven.

    Attributes:
        settings: The contest.
        simulation: The road's world.
        entrant: Who drives.
        kind: Kind of road.
        number: Number of the road.
        path: JSON file of its result.
    """

    settings: JudgeSettings
    simulation: SimulationSettings
    entrant: Entrant
    kind: str
    number: int
    path: Path

    @property
    def key(self) -> str:
        """Stands for all that the run depends on; how many other runs there are is not part of it."""
        contest = self.settings.model_dump(mode="json", exclude={"seed", "count", "tracks", "simulation"})
        parts = [_VERSION, contest, self.simulation.model_dump(mode="json")]
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

    Each run is written to ``out/runs`` when it is finished; a run that lies there, driven under the same
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
        LanenetError: What the first failing run raised, or if a process ends before its time.
    """
    jobs = contest_jobs(settings, entrants, out)
    results = {job.path: result for job in jobs if (result := read_run(job.path, job.key)) is not None}
    open_jobs = [job for job in jobs if job.path not in results]

    def count(path: Path | None = None, result: RunResult | None = None) -> None:
        if path is not None and result is not None:
            results[path] = result
        if progress is not None:
            progress(len(results), len(jobs))

    count()
    if workers <= 1 or len(open_jobs) <= 1:
        for job in open_jobs:
            count(job.path, run_job(job))
    else:
        _run_in_pool(open_jobs, workers, count)
    return [results[job.path] for job in jobs]


def contest_jobs(settings: JudgeSettings, entrants: Sequence[Entrant], out: Path) -> list[Job]:
    """Return all runs of a contest; each road is tried out, so that bad settings are refused at once.

    Raises:
        ConfigError: If two entrants have one name, one has neither eyes nor the truth, or there is no such
            road.
    """
    names = [entrant.name for entrant in entrants]
    if len(set(names)) < len(names):
        raise ConfigError(f"detectors: {', '.join(names)}: each may be named once")
    blind = [e.name for e in entrants if e.build is None and e.name not in (TRUTH, TRUE_POINTS)]
    if blind:
        raise ConfigError(f"detectors: {blind[0]!r}: without a detector, expected {TRUTH} or {TRUE_POINTS}")
    jobs = []
    for index, (kind, number) in enumerate(road_names(settings)):
        simulation = road_simulation(settings, index)
        if number == 0:
            draw_track(simulation)
        for entrant in entrants:
            path = out / "runs" / f"{kind}_{number:02d}_{entrant.name}.json"
            jobs.append(Job(settings, simulation, entrant, kind, number, path))
    return jobs


def run_job(job: Job) -> RunResult:
    """Drive one run and write it; runs in a process of its own, or in this one."""
    result, trajectory = drive_run(job.settings, job.simulation, job.entrant, job.kind, job.number)
    write_run(job.path, job.key, result, trajectory)
    return result


def _run_in_pool(jobs: Sequence[Job], workers: int, count: Callable[[Path, RunResult], None]) -> None:
    # Spawned, because forking a process that has started OpenCV's or onnxruntime's threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(jobs)), context, prepare_process) as pool:
        futures = {pool.submit(run_job, job): job for job in jobs}
        try:
            for future in as_completed(futures):
                count(futures[future].path, future.result())
        except BrokenProcessPool:
            raise LanenetError(
                "a process of the contest ended; finished runs are kept, the same command goes on from there"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)
