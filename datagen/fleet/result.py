"""What became of the drives of a run, and the list of them beside their results."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from datagen.fleet.storage import Storage
from datagen.fleet.task import LABELS, MAPS, FleetDrive
from datagen.fleet.work import LABELS_NAME, REFUSED, REJECTED
from lanenet.data.files import json_text

INDEX_NAME = "drives.json"
_INDEX_FORMAT = "lanenet-fleet/1"
#: Of a drive that has no result: it failed; the run ended before it was begun; it is there twice.
FAILED, LEFT, DUPLICATE = "failed", "left", "duplicate"


@dataclass(frozen=True)
class Labelled:
    """What became of a drive.

    Attributes:
        drive: The drive.
        verdict: ``good`` or ``usable`` if it has labels; ``reject``, ``refused``, ``failed``, ``left`` or
            ``duplicate``.
        reason: Why it has none.
        new: Whether something was done for it in this run.
        map_key: Of its map, in the storage.
        labels_key: Of its labels.
        mapped: What the marker of the map says; None without one.
        labelled: What the marker of the labels says; None without one.
    """

    drive: FleetDrive
    verdict: str
    reason: str
    new: bool
    map_key: str
    labels_key: str
    mapped: dict[str, Any] | None = None
    labelled: dict[str, Any] | None = None

    @property
    def has_labels(self) -> bool:
        """Whether there is a label set of it."""
        return self.verdict not in (REJECTED, REFUSED, FAILED, LEFT, DUPLICATE)


@dataclass(frozen=True)
class FleetResult:
    """What became of all drives of a run, in their order, and whether a full disk ended it."""

    drives: tuple[Labelled, ...]
    disk_full: str = ""

    def of(self, *verdicts: str) -> list[Labelled]:
        """Return the drives with one of the verdicts."""
        return [drive for drive in self.drives if drive.verdict in verdicts]

    @property
    def with_labels(self) -> list[Labelled]:
        """The drives that have labels."""
        return [drive for drive in self.drives if drive.has_labels]


def standing(mapped: dict[str, Any] | None, labelled: dict[str, Any] | None) -> tuple[str, str]:
    """Return verdict and reason of a drive by what is finished of it."""
    if mapped is not None and mapped["verdict"] in (REJECTED, REFUSED):
        return str(mapped["verdict"]), str(mapped["reason"])
    if mapped is None or labelled is None:
        return LEFT, "the run ended before"
    return str(labelled["verdict"] or mapped["verdict"]), str(labelled["reason"])


def write_index(result: FleetResult, storage: Storage) -> None:
    """List the drives, and the paths of their results, for programs."""
    storage.write(INDEX_NAME, json_text(_index(result)).encode())


def _index(result: FleetResult) -> dict[str, Any]:
    return {
        "format": _INDEX_FORMAT,
        "drives": [
            {
                **vars(found.drive),
                "verdict": found.verdict,
                "reason": found.reason,
                "map": None if found.mapped is None else f"{MAPS}/{found.map_key}",
                "labels": f"{LABELS}/{found.labels_key}/{LABELS_NAME}" if found.has_labels else None,
            }
            for found in result.drives
        ],
    }
