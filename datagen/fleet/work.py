"""The work on one drive, on whatever machine: map it, label it, put both into the storage."""

from __future__ import annotations

import errno
import platform
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import Float, UInt8

from datagen.fleet.meter import Meter
from datagen.fleet.source import checksum, on_this_machine
from datagen.fleet.storage import RESULT_NAME, Storage, local_path
from datagen.fleet.task import LABELS, MAPS, FleetDrive, FleetSettings
from datagen.made import key_of
from datagen.pipeline import MapRequest, label_map, map_drive
from datagen.quality.pictures import draw_map
from lanenet.config import read_yaml
from lanenet.data.drives import Drive, open_drive
from lanenet.data.drives.recording import MAX_PAUSE_S
from lanenet.data.files import write_bytes, write_json, write_text
from lanenet.data.maps.folder import DriveMap, read_edges, verdict_of
from lanenet.data.maps.mapped_drive import open_mapped_drive
from lanenet.data.tables import ParquetTable
from lanenet.errors import CalibrationError, DriveFormatError, LanenetError, MapFormatError, TrackingLostError
from lanenet.geometry.birdseye import GENERAL_WINDOW
from lanenet.processes import use_one_thread
from lanenet.reading import read_image

LABELS_NAME, THUMBNAIL_NAME = "labels.parquet", "thumbnail.jpg"
#: Why a drive has no labels: its map is rejected; or it gives no map, or its map no labels.
REJECTED, REFUSED = "reject", "refused"
_FORMAT = "lanenet-fleet-result/1"
#: Longer side of a thumbnail, [px], and its JPEG quality. Chosen: a track is recognised, in about 15 kB.
_THUMBNAIL_PX, _QUALITY = 360, 80
#: What a disk answers that takes no more.
_FULL = (errno.ENOSPC, errno.EDQUOT)
#: What is wrong with a drive, and will be when it is tried again.
_REFUSALS = (TrackingLostError, CalibrationError, DriveFormatError)


@dataclass(frozen=True)
class Job:
    """What a worker needs to label a drive.

    Attributes:
        drive: The drive.
        settings: What it is made with.
        out: Path or URL of the storage.
        made_by: The :func:`version` of the program that wants it.
        labels: Whether labels are wanted beside the map.
    """

    drive: FleetDrive
    settings: FleetSettings
    out: str
    made_by: str
    labels: bool = True


@dataclass(frozen=True)
class Outcome:
    """How the work on a drive ended.

    Attributes:
        verdict: Of the map, if the work was done; else ``reject``, ``refused`` or, if it failed, empty.
        reason: Why it was not.
        disk_full: Whether it failed for want of room, as the next one would.
    """

    verdict: str
    reason: str = ""
    disk_full: bool = False


def version() -> str:
    """Return what has to be the same on all machines, so that their results are."""
    return f"lanenet {metadata.version('lanenet')} ({key_of()})"


def label_drive(job: Job) -> Outcome:
    """Map and label a drive, as far as that has not been done.

    A drive that cannot be mapped has a result, too. What else goes wrong is said, and left to the next run.
    """
    return attempted(job.made_by, lambda: _label_drive(job))


def attempted(made_by: str, work: Callable[[], Outcome]) -> Outcome:
    """Work in one thread; what goes wrong is said.

    Args:
        made_by: The :func:`version` of the program that wants it.
        work: What to do.
    """
    use_one_thread()
    try:
        if made_by != version():
            raise LanenetError(f"{platform.node()} has {version()}, the run needs {made_by}")
        return work()
    except MemoryError:
        return Outcome("", "out of memory")
    except Exception as error:
        full = any(getattr(cause, "errno", None) in _FULL for cause in _causes(error))
        named = str(error) if isinstance(error, LanenetError) else f"{type(error).__name__}: {error}"
        return Outcome("", f"a disk of {platform.node()} is full: {named}" if full else named, full)


def _label_drive(job: Job) -> Outcome:
    storage, drive, settings = Storage(job.out), job.drive, job.settings
    map_key, labels_key = drive.map_key(settings), drive.labels_key(settings)
    with on_this_machine(drive.source) as path:
        mapped = storage.result(MAPS, map_key)
        if mapped is None:
            with storage.new(MAPS, map_key) as folder:
                mapped = _map(job, path, folder)
                _check_unchanged(drive, path)
        if mapped["verdict"] in (REJECTED, REFUSED):
            return Outcome(mapped["verdict"], mapped["reason"])
        if not job.labels:
            return Outcome(mapped["verdict"])
        labelled = storage.result(LABELS, labels_key)
        if labelled is None:
            with storage.fetched(MAPS, map_key) as map_folder, storage.new(LABELS, labels_key) as folder:
                labelled = _label(job, path, map_folder, folder)
                _check_unchanged(drive, path)
    return Outcome(labelled["verdict"] or mapped["verdict"], labelled["reason"])


def _check_unchanged(drive: FleetDrive, path: Path) -> None:
    """Refuse to keep what was made from other files than the key says, as of a drive that is being copied."""
    if checksum(str(path)) != drive.checksum:
        raise LanenetError(f"{drive.source}: its files have changed since the run began")


def _map(job: Job, path: Path, folder: Path) -> dict[str, Any]:
    """Map a drive into a folder; returns what its marker says."""
    with ExitStack() as stack:
        camera = job.drive.camera
        here = None if camera is None else stack.enter_context(on_this_machine(camera))
        return _map_with(job, path, folder, here)


def _map_with(job: Job, path: Path, folder: Path, camera: Path | None) -> dict[str, Any]:
    drive, settings = job.drive, job.settings
    meter, found = Meter(), {"verdict": REFUSED, "reason": "", "reasons": [], "frames": 0, "driven_s": 0.0}
    try:
        recording = open_drive(path)
        if drive.lane_width_cm is None:
            raise LanenetError(f"{drive.source}: could not be read when the run began")
        found |= {"frames": len(recording), "driven_s": round(driven_s(recording), 3)}
        found |= {"width": recording.width, "height": recording.height}
        request = MapRequest(
            path,
            drive.lane_width_cm,
            camera,
            wheelbase_cm=drive.wheelbase_cm,
            camera_height_cm=drive.camera_height_cm,
            tape_width_cm=drive.tape_width_cm,
        )
        report = map_drive(request, settings.map, folder, pictures=settings.pictures)
    except _REFUSALS as error:
        found["reason"] = str(error).removeprefix(f"{path}: ")
    else:
        verdict = verdict_of(folder)
        rejected = verdict.grade == REJECTED
        found |= {"verdict": verdict.grade, "reason": verdict.sentence if rejected else ""}
        found["reasons"] = list(report.figures["verdict"]["reasons"])
        name_source(folder / "map.yaml", drive.source)
        _draw_thumbnail(folder, path)
    return mark(folder, {**vars(drive), **found}, meter)


def _label(job: Job, path: Path, map_folder: Path, folder: Path) -> dict[str, Any]:
    """Label a mapped drive into a folder; returns what its marker says."""
    settings, meter = job.settings, Meter()
    found: dict[str, Any] = {"verdict": "", "reason": "", "frames_labelled": 0}
    try:
        report = label_map(
            map_folder,
            folder / LABELS_NAME,
            colour_weight=settings.colour_weight,
            window=GENERAL_WINDOW,
            pictures=settings.pictures,
            drive=path,
            name=job.drive.name,
        )
    except TrackingLostError as error:
        found |= {"verdict": REFUSED, "reason": str(error).removeprefix(f"{map_folder}: ")}
    else:
        found["frames_labelled"] = report.figures["frames_labelled"]
        found["residual_cm"] = report.figures["residual_cm"]["median"]
    return mark(folder, {**vars(job.drive), **found}, meter)


def mark(folder: Path, found: dict[str, Any], meter: Meter) -> dict[str, Any]:
    """Write the marker of a result, which alone knows when and where it was made."""
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    made = {"by": version(), "on": platform.node(), "at": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
    marker = {
        "format": _FORMAT,
        **found,
        "bytes": size,
        "took": meter.taken(),
        "made": made,
    }
    write_json(folder / RESULT_NAME, marker)
    return marker


def driven_s(drive: Drive) -> float:
    """Return how long a drive lasted, without its breaks, [s]."""
    steps_s = np.diff(drive.driven_s)[~drive.breaks[1:]]
    return float(steps_s[steps_s <= MAX_PAUSE_S].sum())


def name_source(file: Path, source: str) -> None:
    """Let a map name its drive by the place where it lies for all, not by where this machine had it."""
    if local_path(source) is None:
        plain = {**read_yaml(file), "drive": source}
        write_text(file, yaml.safe_dump(plain, sort_keys=False))


def _draw_thumbnail(folder: Path, drive: Path) -> None:
    """Draw a map from its files, and a small picture of it."""
    if not (folder / "map.png").is_file():
        mapped = open_mapped_drive(folder, drive)
        draw_map(folder / "map.png", mapped.drive_map, _clouds(folder, mapped.drive_map), mapped.starts)
    shrink_picture(folder)


def shrink_picture(folder: Path) -> None:
    """Make a thumbnail of the picture of a map, or of maps that were joined."""
    write_bytes(folder / THUMBNAIL_NAME, _small_jpeg(read_image(folder / "map.png", MapFormatError)))


def _clouds(folder: Path, drive_map: DriveMap) -> list[Float[np.ndarray, "_ 2"]]:
    """Return the edge points of each frame, those of the first segment first, as they lie in the file."""
    frames = drive_map.frames[np.argsort(drive_map.segment, kind="stable")]
    place = {int(frame): k for k, frame in enumerate(frames)}
    of_point = ParquetTable(folder / "edges.parquet").ints("frame")
    counts = np.bincount([place[int(frame)] for frame in of_point], minlength=len(frames))
    return np.split(read_edges(folder), np.cumsum(counts)[:-1])


def _small_jpeg(image: UInt8[np.ndarray, "h w 3"]) -> bytes:
    factor = min(1.0, _THUMBNAIL_PX / max(image.shape))
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
