"""Work on several mapped drives at once, as on the camera of a car or on the maps of a track."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass

from datagen.fleet.engine import Engine, Task
from datagen.fleet.memory import memory_together
from datagen.fleet.source import on_this_machine
from datagen.fleet.storage import Storage
from datagen.fleet.task import MAPS, FleetDrive
from datagen.fleet.work import REFUSED, Outcome
from datagen.tracks.visit import Visit, read_visit


@dataclass(frozen=True)
class SeveralJob:
    """What a worker needs for work on several drives.

    Attributes:
        name: Of the car or the track.
        drives: Drives, with the keys of their maps.
        out: Path or URL of the storage.
        key: Of the result.
        made_by: The :func:`datagen.fleet.work.version` of the program that wants it.
    """

    name: str
    drives: tuple[tuple[FleetDrive, str], ...]
    out: str
    key: str
    made_by: str


def finish(
    jobs: Sequence[SeveralJob],
    kind: str,
    work: Callable[[SeveralJob], Outcome],
    storage: Storage,
    engine: Engine,
    what: str = "",
    refused_again: bool = False,
) -> tuple[dict[str, str], str]:
    """Do the jobs that have no result.

    Args:
        jobs: What is wanted.
        kind: Of the results.
        work: Does a job; a function of a module, since workers call it.
        storage: Where results are kept.
        engine: What spreads the work.
        what: Goes before the names of the jobs, in those of the tasks.
        refused_again: Do those again, too, whose result is a refusal.

    Returns:
        Why jobs failed, by the keys of their results, and which disk was full.
    """
    if refused_again:
        results = storage.results(kind, storage.finished(kind).intersection(job.key for job in jobs))
        storage.sweep(kind, [key for key, result in results.items() if result["verdict"] == REFUSED])
    missing = [job for job in jobs if storage.result(kind, job.key) is None]
    failed, disk_full = dict[str, str](), ""
    if not missing:
        return failed, disk_full
    # All drives are in memory together.
    tasks = [
        Task(what + job.name, job, memory_together(drive.source for drive, _ in job.drives))
        for job in missing
    ]
    with closing(engine.run(work, tasks)) as running:
        for end in running:
            outcome = Outcome("", end.error) if end.error else end.result
            if not outcome.verdict:
                failed[missing[end.number].key] = outcome.reason
            if outcome.disk_full:
                disk_full = outcome.reason
                break
    return failed, disk_full


@contextmanager
def visits_of(job: SeveralJob, storage: Storage) -> Iterator[dict[str, Visit]]:
    """Read the maps and drives of a job, by the names of the drives; while it is worked on, they are here."""
    with ExitStack() as stack:
        yield {
            drive.name: read_visit(
                stack.enter_context(storage.fetched(MAPS, key)),
                stack.enter_context(on_this_machine(drive.source)),
            )
            for drive, key in job.drives
        }
