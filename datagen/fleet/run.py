"""Label all drives of a list: what is new is done, by an engine, and what is finished is used."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from datagen.fleet.engine import Engine, Task
from datagen.fleet.memory import memory_bytes
from datagen.fleet.page import write_page
from datagen.fleet.result import DUPLICATE, FAILED, LEFT, FleetResult, Labelled, standing, write_index
from datagen.fleet.source import checksum, drive_files
from datagen.fleet.storage import Storage
from datagen.fleet.task import LABELS, MAPS, FleetDrive, FleetSettings
from datagen.fleet.work import REFUSED, REJECTED, Job, Outcome, label_drive, version
from datagen.made import key_of
from lanenet.data.files import json_text
from lanenet.errors import LanenetError
from lanenet.outputs import lock_output

#: The checksums of the drives' files, beside the results.
CHECKSUMS_NAME = "checksums.json"


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


def with_checksums(drives: Iterable[FleetDrive], storage: Storage) -> list[FleetDrive]:
    """Return the drives with the checksums of their files; without one if they are not there or unreadable.

    Files that have the size and time of an earlier run are not read again.
    """
    known: dict[str, list[str]] = json.loads(storage.read(CHECKSUMS_NAME) or b"{}")
    found: dict[str, list[str]] = {}
    checked = []
    for drive in drives:
        before = known.get(drive.source, ["", ""])
        try:
            stamp = key_of(drive_files(drive.source))
            found[drive.source] = before if before[0] == stamp else [stamp, checksum(drive.source)]
        except (LanenetError, OSError):  # the run says why, and does the others
            checked.append(replace(drive, checksum=""))
            continue
        checked.append(replace(drive, checksum=found[drive.source][1]))
    if any(known.get(source) != pair for source, pair in found.items()):
        storage.write(CHECKSUMS_NAME, json_text({**known, **found}).encode())
    return checked


def label_all(
    drives: Sequence[FleetDrive],
    settings: FleetSettings,
    storage: Storage,
    engine: Engine,
    progress: Progress | None = None,
    refused_again: bool = False,
) -> FleetResult:
    """Map and label drives, as far as that has not been done with the same settings.

    A drive is one task. Drives that are gone, that cannot be mapped or whose camera cannot be read, tasks
    that fail and workers that are lost stop nothing; a full disk ends the run. What is finished is kept in
    any case, also at Ctrl-C.

    Args:
        drives: Drives with their checksums.
        settings: What they are made with.
        storage: Where results are kept; no other run may write there.
        engine: What spreads the tasks.
        progress: Called whenever a drive has ended.
        refused_again: Try drives again that were refused before.

    Raises:
        LanenetError: If another run writes there, or the engine cannot be started.
    """
    with ExitStack() as stack:
        if storage.folder is not None:
            stack.enter_context(lock_output(storage.folder))
        run = _Run(drives, settings, storage)
        run.sweep(run.refused_keys() if refused_again else set())
        found = run.look()
        missing = [k for k, drive in enumerate(found) if drive.verdict == LEFT]
        ended: dict[int, Outcome] = {}
        disk_full = ""
        if missing:
            try:
                ended, disk_full = run.work(missing, found, engine, progress)
            finally:
                run.sweep()
            found = run.look(ended)
        result = FleetResult(tuple(found), disk_full)
        write_index(result, storage)
        write_page(result, storage)
        return result


@dataclass(frozen=True)
class _Run:
    """The drives of a run and their storage."""

    drives: Sequence[FleetDrive]
    settings: FleetSettings
    storage: Storage

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
                verdict, reason = standing(maps[k], labels[k])
                if verdict == LEFT and outcome is not None:
                    verdict = FAILED
                    reason = f"its worker finished it, but not in the {self.storage.url} of this machine"
            keys = self.keys[MAPS][k], self.keys[LABELS][k]
            found.append(Labelled(drive, verdict, reason, outcome is not None, *keys, maps[k], labels[k]))
        return found

    def work(
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
        job = Job(drive, self.settings, self.storage.url, version())
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
