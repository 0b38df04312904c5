"""A stage of a run: drives are mapped and labelled, or only mapped, as far as that has not been done."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from datagen.fleet.engine import Engine, Task
from datagen.fleet.memory import memory_bytes
from datagen.fleet.result import DUPLICATE, FAILED, LEFT, Labelled, standing
from datagen.fleet.source import checksum
from datagen.fleet.storage import Storage
from datagen.fleet.task import LABELS, MAPS, FleetDrive, FleetSettings
from datagen.fleet.work import REFUSED, REJECTED, Job, Outcome, label_drive, version
from lanenet.errors import LanenetError


@dataclass(frozen=True)
class Counts:
    """How many drives of a run are done, refused (or their maps rejected), failed, and in all."""

    done: int
    refused: int
    failed: int
    total: int

    @property
    def ended(self) -> int:
        """Drives that are not left to be done."""
        return self.done + self.refused + self.failed


#: Called whenever a drive has ended.
Progress = Callable[[Counts], None]


@dataclass(frozen=True)
class Finished:
    """How the drives of a stage stand, and which disk was full, if one ended it."""

    drives: list[Labelled]
    disk_full: str = ""


@dataclass(frozen=True)
class Stage:
    """Work on drives, each as far as it has not been done.

    Attributes:
        drives: Drives with their checksums.
        settings: What they are made with.
        storage: Where results are kept.
        labels: Whether drives are to be labelled, and not only mapped.
    """

    drives: Sequence[FleetDrive]
    settings: FleetSettings
    storage: Storage
    labels: bool = True

    @cached_property
    def unusable(self) -> dict[int, str]:
        """Why the work on drives cannot begin, by their places."""
        reasons = {k: _why_not(drive, self.settings) for k, drive in enumerate(self.drives)}
        return {k: reason for k, reason in reasons.items() if reason}

    @cached_property
    def keys(self) -> dict[str, list[str]]:
        """The keys of all maps and of all labels; those of unusable drives are of nothing."""
        maps, labels = FleetDrive.map_key, FleetDrive.labels_key
        return {
            kind: [
                f"unusable-{k}" if k in self.unusable else key(drive, self.settings)
                for k, drive in enumerate(self.drives)
            ]
            for kind, key in ((MAPS, maps), (LABELS, labels))
        }

    def results(self, kind: str) -> list[dict[str, Any] | None]:
        """Return what the markers of a kind say; None for what is not finished."""
        finished = self.storage.finished(kind)
        found = self.storage.results(kind, finished.intersection(self.keys[kind]))
        return [found.get(key) for key in self.keys[kind]]

    def refused_keys(self) -> set[str]:
        """Return the keys of the maps and labels that say that their drive was refused."""
        return {
            key
            for kind, keys in self.keys.items()
            for key, result in zip(keys, self.results(kind), strict=True)
            if result is not None and result["verdict"] == REFUSED
        }

    def sweep(self, also: Iterable[str] = ()) -> None:
        """Remove what lost workers left, and these results."""
        for kind in (MAPS, LABELS):
            self.storage.sweep(kind, also)

    def look(self, ended: Mapping[int, Outcome] | None = None) -> list[Labelled]:
        """Return how each drive stands.

        Args:
            ended: How the tasks ended that were run.
        """
        maps, labels = self.results(MAPS), self.results(LABELS)
        found = []
        for k, drive in enumerate(self.drives):
            first = self.keys[MAPS].index(self.keys[MAPS][k])
            outcome = None if ended is None else ended.get(k)
            if k in self.unusable:
                verdict, reason = FAILED, self.unusable[k]
            elif first != k:
                verdict, reason = DUPLICATE, f"is the same recording as {self.drives[first].name}"
            elif outcome is not None and not outcome.verdict:
                verdict, reason = FAILED, outcome.reason
            else:
                verdict, reason = standing(maps[k], labels[k] if self.labels else maps[k])
                if verdict == LEFT and outcome is not None:
                    verdict = FAILED
                    reason = f"its worker finished it, but not in the {self.storage.url} of this machine"
            keys = self.keys[MAPS][k], self.keys[LABELS][k]
            found.append(Labelled(drive, verdict, reason, outcome is not None, *keys, maps[k], labels[k]))
        return found

    def finish(self, engine: Engine, progress: Progress | None = None) -> Finished:
        """Do what is missing, and say how each drive stands.

        Args:
            engine: What spreads the tasks.
            progress: Called whenever a drive has ended.
        """
        found = self.look()
        missing = [k for k, drive in enumerate(found) if drive.verdict == LEFT]
        if not missing:
            return Finished(found)
        try:
            ended, disk_full = self._work(missing, found, engine, progress)
        finally:
            self.sweep()
        return Finished(self.look(ended), disk_full)

    def _work(
        self,
        missing: Sequence[int],
        found: Sequence[Labelled],
        engine: Engine,
        progress: Progress | None,
    ) -> tuple[dict[int, Outcome], str]:
        """Do what is missing; returns how the tasks ended, and which disk was full."""
        verdicts = {k: drive.verdict for k, drive in enumerate(found) if drive.verdict != DUPLICATE}
        total, ended = len(verdicts), dict[int, Outcome]()
        tasks = [self._task(k) for k in missing]
        with closing(engine.run(label_drive, tasks)) as running:
            _tell(progress, verdicts.values(), total)
            for end in running:
                k = missing[end.number]
                ended[k] = Outcome("", end.error) if end.error else end.result
                verdicts[k] = ended[k].verdict or FAILED
                _tell(progress, verdicts.values(), total)
                if ended[k].disk_full:
                    return ended, ended[k].reason
        return ended, ""

    def _task(self, k: int) -> Task:
        drive = self.drives[k]
        job = Job(drive, self.settings, self.storage.url, version(), self.labels)
        return Task(drive.name, job, memory_bytes(drive.source))


def _why_not(drive: FleetDrive, settings: FleetSettings) -> str:
    """Say why the work on a drive cannot begin; nothing if it can."""
    try:
        if not drive.checksum:
            checksum(drive.source)
            return f"{drive.source}: could not be read when the run began"
        drive.labels_key(settings)
    except (LanenetError, OSError) as error:
        return str(error)
    return ""


def _tell(progress: Progress | None, verdicts: Iterable[str], total: int) -> None:
    if progress is not None:
        count = Counter(verdicts)
        refused, failed = count[REJECTED] + count[REFUSED], count[FAILED]
        progress(Counts(count.total() - count[LEFT] - refused - failed, refused, failed, total))
