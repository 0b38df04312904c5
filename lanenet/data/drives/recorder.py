"""Records a drive on the car: a folder that can be read at any moment, power cut included.

A thread writes, so that a slow card holds the drive loop no longer than it takes to put a frame into a queue.
Every :attr:`RecordingSettings.sync_s` the images are forced onto the card, then their rows are added to
``frames.csv`` and forced as well: a row whose image is not there does not exist. The row's last field is the
file name, so that a line that was cut off shows (:func:`lanenet.data.tables.is_torn`).

    card too slow    the queue is full: frames are left out and counted; their numbers are missing
    card full        recording stops with a line in the log, and the car drives on
    power cut        what came in the last second is lost, the drive opens
"""

from __future__ import annotations

import logging
import os
import queue
import shutil
import threading
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
import yaml
from jaxtyping import UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.data.camera_file import write_camera
from lanenet.data.drives.folder import DRIVE_FILE, DRIVE_FORMAT, FRAMES_FILE
from lanenet.data.drives.writer import image_name
from lanenet.data.files import sync_path, write_text
from lanenet.errors import DriveFormatError, LanenetError
from lanenet.geometry.camera import Camera

log = logging.getLogger(__name__)

#: How often left-out frames are mentioned in the log.
_MENTION_EVERY = 100
#: Closing waits this long for a card.
_CLOSE_S = 10.0


class RecordingSettings(Settings):
    """What is recorded, and when recording gives way.

    Attributes:
        folder: Parent of the drives; each gets a folder of its own, named after the time.
        jpeg_quality: 1 to 100.
        queue_frames: Frames that may wait for the card; more are left out. Half a second's worth, since what
            waits is lost in a power cut.
        sync_s: How often frames are forced onto the card.
        min_free_mb: Recording stops when less than this is free.
    """

    folder: Path = Path("drives")
    jpeg_quality: int = Field(default=92, ge=1, le=100)
    queue_frames: int = Field(default=15, ge=1)
    sync_s: float = Field(default=0.4, gt=0.0, le=1.0)
    min_free_mb: float = Field(default=200.0, ge=0.0)


@dataclass(frozen=True, eq=False)
class _Item:
    number: int
    image_bgr: UInt8[np.ndarray, "h w 3"]
    t_s: float
    commands: dict[str, float]


def new_drive_folder(parent: Path, now: datetime) -> Path:
    """Return a name for a drive that begins now and that no drive has yet.

    A Raspberry Pi without a network does not know the time and may begin twice at the same one.
    """
    name = now.strftime("drive-%Y%m%d-%H%M%S")
    path, again = parent / name, 1
    while path.exists():
        again += 1
        path = parent / f"{name}-{again}"
    return path


class DriveRecorder:
    """Records one drive; :meth:`add` never blocks and never raises.

    Attributes:
        path: The drive's folder.
        recorded: Frames that are safe on the card.
        dropped: Frames left out because the card was slow, or after recording had stopped.
        problem: Why recording stopped; empty while it goes on.
    """

    def __init__(
        self,
        path: Path,
        settings: RecordingSettings,
        camera: Camera | None = None,
        lane_width_cm: float | None = None,
        max_steering_rad: float | None = None,
        notes: str = "",
    ) -> None:
        """Make the drive's folder and start the thread that writes.

        Args:
            path: Folder of the drive, which must not exist.
            settings: Quality, queue and limits.
            camera: Stored beside the images.
            lane_width_cm: Distance between the middles of the driven lane's lines.
            max_steering_rad: The car's lock.
            notes: Anything worth knowing.

        Raises:
            LanenetError: If the folder exists or cannot be written.
        """
        self.path, self._settings = path, settings
        self.recorded = self.dropped = 0
        self.problem = ""
        data = {
            "format": DRIVE_FORMAT,
            "camera": None if camera is None else "camera.yaml",
            "lane_width_cm": lane_width_cm,
            "max_steering_rad": max_steering_rad,
            "notes": notes,
        }
        try:
            (path / "images").mkdir(parents=True)
        except OSError as error:
            raise LanenetError(f"{path}: the drive cannot be recorded there ({error})") from None
        if camera is not None:
            write_camera(path / "camera.yaml", camera, "copied from the car")
        kept = {key: value for key, value in data.items() if value not in (None, "")}
        write_text(path / DRIVE_FILE, yaml.safe_dump(kept, sort_keys=False, allow_unicode=True))
        self._queue: queue.Queue[_Item] = queue.Queue(settings.queue_frames)
        self._ending = threading.Event()
        self._number = 0
        # Only the writer's thread touches these.
        self._rows: list[str] = []
        self._images: list[Path] = []
        self._names: list[str] = []
        self._first_s = self._last_s = 0.0
        self._size: tuple[int, ...] = ()
        self._thread = threading.Thread(target=self._write, name="drive recorder", daemon=True)
        self._thread.start()

    def add(self, frame_bgr: UInt8[np.ndarray, "h w 3"], t_s: float, **commands: float) -> None:
        """Hand over a frame, which nobody may write to any more.

        Args:
            frame_bgr: The image.
            t_s: Its time; the recording begins at 0.
            **commands: What the car was told, by the names of :class:`.recording.Commands`.
        """
        item = _Item(self._number, frame_bgr, t_s, commands)
        self._number += 1
        if self.problem or self._ending.is_set():
            self.dropped += 1
            return
        try:
            self._queue.put_nowait(item)
        except queue.Full:
            if self.dropped % _MENTION_EVERY == 0:
                log.warning("recording: the card is too slow, frame %d is left out", item.number)
            self.dropped += 1

    def close(self) -> None:
        """Force what waits onto the card; gives up on a card that hangs. A drive without a frame goes."""
        self._ending.set()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self._stop(f"the card did not answer for {_CLOSE_S:.0f} s")
        elif self.recorded == 0:
            shutil.rmtree(self.path, ignore_errors=True)

    def _write(self) -> None:
        due_s = time.monotonic()
        while not self.problem:
            try:
                item = self._queue.get(timeout=0.5 * self._settings.sync_s)
            except queue.Empty:
                item = None
            ended = item is None and self._ending.is_set()
            try:
                if item is not None:
                    self._store(item)
                    item = None
                # The first frame is forced at once: from then on the folder is a drive.
                if self._rows and (ended or self.recorded == 0 or time.monotonic() >= due_s):
                    self._commit()
                    due_s = time.monotonic() + self._settings.sync_s
            except Exception as error:
                # Whatever it is, a thread that dies in silence would look like a slow card.
                self._stop(str(error) or type(error).__name__)
                self._discard()
                # The one in hand has no row yet.
                self.dropped += item is not None
                return
            if ended:
                return

    def _store(self, item: _Item) -> None:
        """Write one image; its row waits until the image is safe."""
        first = not self._size
        if first:
            self._names = list(item.commands)
            self._size, self._first_s = item.image_bgr.shape, item.t_s
        t_s = item.t_s - self._first_s
        # A clock that stands, or an image of another size, would make the whole drive unreadable.
        if not first and (not t_s > self._last_s or item.image_bgr.shape != self._size):
            self.dropped += 1
            return
        values = [t_s, *(item.commands.get(name, np.nan) for name in self._names)]
        if not np.isfinite(values).all():
            self.dropped += 1
            return
        quality = [cv2.IMWRITE_JPEG_QUALITY, self._settings.jpeg_quality]
        ok, data = cv2.imencode(".jpg", item.image_bgr, quality)
        if not ok:
            raise DriveFormatError(f"frame {item.number} cannot be encoded as JPEG")
        name = image_name(item.number)
        self._images.append(self.path / name)
        (self.path / name).write_bytes(data.tobytes())
        numbers = ",".join(f"{value:.6f}" for value in values)
        self._rows.append(f"{item.number},{numbers},{name}\n")
        self._last_s = t_s

    def _commit(self) -> None:
        free_mb = shutil.disk_usage(self.path).free / 1e6
        if free_mb < self._settings.min_free_mb:
            raise OSError(f"only {free_mb:.0f} MB left, expected {self._settings.min_free_mb:g} or more")
        for image in self._images:
            sync_path(image)
        sync_path(self.path / "images")
        table = self.path / FRAMES_FILE
        if not table.exists():
            header = ",".join(["frame", "t_s", *self._names, "file"])
            write_text(table, f"{header}\n{''.join(self._rows)}")
            # The folder's own name is as safe as what is in it; its parent may be as new.
            sync_path(self.path.parent)
            sync_path(self.path.parent.parent)
        else:
            self._append(table, "".join(self._rows).encode())
        self.recorded += len(self._rows)
        self._rows, self._images = [], []

    def _append(self, table: Path, data: bytes) -> None:
        handle = os.open(table, os.O_WRONLY | os.O_APPEND)
        try:
            size = os.fstat(handle).st_size
            try:
                written = os.write(handle, data)
                if written < len(data):
                    raise OSError("the card is full")
                os.fsync(handle)
            except OSError:
                os.ftruncate(handle, size)
                raise
        finally:
            os.close(handle)

    def _stop(self, why: str) -> None:
        self.problem = why
        log.warning("recording stopped after %d frames: %s; driving goes on", self.recorded, why)

    def _discard(self) -> None:
        """Remove images that have no row, and count what waits."""
        for image in self._images:
            try:
                image.unlink(missing_ok=True)
            except OSError:
                break
        self.dropped += len(self._rows) + self._queue.qsize()
        self._rows, self._images = [], []
