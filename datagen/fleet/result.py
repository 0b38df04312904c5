"""What became of the drives of a run, and the list of them beside their results."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from datagen.fleet.storage import Storage
from datagen.fleet.task import LABELS, MAPS, TRACKS, FleetDrive
from datagen.fleet.work import LABELS_NAME, REFUSED, REJECTED
from lanenet.data.files import json_text
from lanenet.geometry.camera import Camera

#: The list of a run's drives, beside the results.
INDEX_NAME = "drives.json"
INDEX_FORMAT = "lanenet-fleet/1"
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
class CarFound:
    """What became of the camera of a car.

    Attributes:
        name: Of the car.
        drives: Names of its drives.
        key: Of the camera, in the storage; empty if there is none.
        from_maps: Keys of the maps that it was found from.
        from_drives: Names of their drives.
        own: Why drives keep the camera that they gave by themselves, by their names.
        reason: Why there is none.
        camera: The camera; None without one.
        sigma: Standard deviation of each of its numbers, focal length relative.
    """

    name: str
    drives: tuple[str, ...]
    key: str = ""
    from_maps: tuple[str, ...] = ()
    from_drives: tuple[str, ...] = ()
    own: dict[str, str] = field(default_factory=dict)
    reason: str = ""
    camera: Camera | None = None
    sigma: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class TrackFound:
    """What became of the maps of a track.

    Attributes:
        name: Of the track.
        count: Its drives with maps.
        key: Of the joined maps, in the storage.
        asked: Names of the drives whose maps were to be joined.
        joined: Names of those whose were.
        left_out: Why others were not, by their names.
        lane_cm: Width of the lane; None if nothing was joined.
        relaid: Places where lines were laid anew, a sentence each.
        reason: Why nothing was joined.
    """

    name: str
    count: int
    key: str
    asked: tuple[str, ...]
    joined: tuple[str, ...] = ()
    left_out: dict[str, str] = field(default_factory=dict)
    lane_cm: float | None = None
    relaid: tuple[str, ...] = ()
    reason: str = ""


@dataclass(frozen=True)
class FleetResult:
    """What became of all drives of a run, in their order, of their cars and tracks.

    Attributes:
        drives: The drives.
        disk_full: Which disk ended the run, being full.
        cars: Cars with several drives.
        tracks: Tracks with several drives.
        uncompared: Which maps could not be compared with others, and why.
    """

    drives: tuple[Labelled, ...]
    disk_full: str = ""
    cars: tuple[CarFound, ...] = ()
    tracks: tuple[TrackFound, ...] = ()
    uncompared: tuple[str, ...] = ()

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
    joined = {name: f"{TRACKS}/{track.key}/{name}" for track in result.tracks for name in track.joined}
    return {
        "format": INDEX_FORMAT,
        "drives": [
            {
                **vars(found.drive),
                "verdict": found.verdict,
                "reason": found.reason,
                "map": None if found.mapped is None else f"{MAPS}/{found.map_key}",
                "labels": f"{LABELS}/{found.labels_key}/{LABELS_NAME}" if found.has_labels else None,
                "joined": joined.get(found.drive.name),
            }
            for found in result.drives
        ],
    }
