"""Records a drive on the car: a folder that is readable at any moment, even after a power cut.

A thread writes, so that a slow card does not hold up the drive loop. Every :attr:`RecordingSettings.sync_s`
the images are synced to the card, then their rows are appended to ``frames.csv`` and synced: no row exists
without its image. The file name is the last field of a row, so that a row that was cut off is recognised
(:func:`lanenet.data.tables.is_torn`).

    card too slow    the queue is full: frames are left out and counted; their numbers are missing
    card full        recording stops with a line in the log, and the car drives on
    power cut        the last second is lost; the drive can be opened
"""

from __future__ import annotations

import logging
import os
import queue
import shutil
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.data.camera_file import write_camera
from lanenet.data.drives.folder import FRAMES_FILE, RECORDING_NAME, clear_dead_recordings, image_name
from lanenet.data.drives.recording import DRIVE_FORMAT, DriveFile, write_drive_file
from lanenet.data.files import write_text
from lanenet.errors import DriveFormatError, LanenetError, counted
from lanenet.geometry.camera import Camera
from lanenet.outputs import lock_output, remove, sync_path

log = logging.getLogger(__name__)

#: The log mentions one in so many left-out frames; chosen: about every five seconds.
_MENTION_EVERY = 100
#: Closing waits this long for the card; chosen: SD cards may stall for seconds.
_CLOSE_S = 10.0


class RecordingSettings(Settings):
    """What is recorded, and when recording yields to driving.

    Attributes:
        folder: Parent of the drives; each gets its own folder, named after the time.
        jpeg_quality: 1 to 100.
        queue_frames: Frames that may wait for the card; more are left out. The default is half a second at
            30 frames/s, since waiting frames are lost in a power cut.
        sync_s: How often frames are synced to the card. With the queue, a power cut costs about a second.
        min_free_mb: Recording stops when less than this is free; the default leaves room for logs.
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
    """Return a folder that does not exist yet, named after the time.

    A Raspberry Pi without a network does not know the time, so two drives may start at the same one.
    """
    name = RECORDING_NAME + now.strftime("%Y%m%d-%H%M%S")
    path, again = parent / name, 1
    while path.exists():
        again += 1
        path = parent / f"{name}-{again}"
    return path


class DriveRecorder:
    """Records one drive; :meth:`add` never blocks and never raises.

    Attributes:
        path: The drive's folder.
        recorded: Frames that are synced to the card.
        dropped: Frames left out because the card was slow or recording had stopped.
        problem: Why recording stopped; empty while it runs.
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
        """Make the drive's folder and start the writing thread.

        Args:
            path: Folder of the drive; must not exist.
            settings: Quality, queue and limits.
            camera: Stored beside the images.
            lane_width_cm: Distance between the middles of the driven lane's lines.
            max_steering_rad: Largest steering angle of the car.
            notes: Free text.

        Raises:
            LanenetError: If the folder exists or cannot be written.
        """
        self.path, self._settings = path, settings
        self.recorded = self.dropped = 0
        self.problem = ""
        clear_dead_recordings(path.parent)
        self._lock = ExitStack()
        self._lock.enter_context(lock_output(path))
        try:
            path.mkdir()
        except OSError as error:
            self._lock.close()
            raise LanenetError(f"{path}: the drive cannot be recorded there ({error})") from None
        file = DriveFile.model_construct(
            format=DRIVE_FORMAT,
            camera=None if camera is None else "camera.yaml",
            lane_width_cm=lane_width_cm,
            max_steering_rad=max_steering_rad,
            notes=notes,
        )
        try:
            (path / "images").mkdir()
            if camera is not None:
                write_camera(path / "camera.yaml", camera, "copied from the car")
            write_drive_file(path, file)
        except BaseException as error:
            remove(path)
            self._lock.close()
            if isinstance(error, OSError):
                raise LanenetError(f"{path}: the drive cannot be recorded there ({error})") from None
            raise
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
        """Queue a frame; the image must not be changed afterwards.

        Args:
            frame_bgr: The image.
            t_s: Its time; the first frame of the recording gets 0.
            **commands: Commanded values by the names of :class:`.recording.Commands`.
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
        """Sync the waiting frames; gives up on a card that hangs, and removes a drive without frames."""
        self._ending.set()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self._stop(f"the card did not answer for {_CLOSE_S:.0f} s")
        elif self.recorded == 0:
            remove(self.path)
        self._lock.close()

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
                # The first frame is synced at once: from then on the folder is a drive.
                if self._rows and (ended or self.recorded == 0 or time.monotonic() >= due_s):
                    self._commit()
                    due_s = time.monotonic() + self._settings.sync_s
            except Exception as error:
                # Any error: a thread that dies silently would look like a slow card.
                self._stop(str(error) or type(error).__name__)
                self._discard()
                # The frame in hand has no row yet.
                self.dropped += item is not None
                return
            if ended:
                return

    def _store(self, item: _Item) -> None:
        """Write one image; its row waits until the image is synced."""
        first = not self._size
        if first:
            self._names = list(item.commands)
            self._size, self._first_s = item.image_bgr.shape, item.t_s
        t_s = item.t_s - self._first_s
        # A time that does not increase, or another image size, would make the whole drive unreadable.
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
            # Sync the names of the drive's folder and of its parent too: both may be new.
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
        after = counted(self.recorded, "frame")
        log.warning("recording stopped after %s: %s; driving goes on", after, why)

    def _discard(self) -> None:
        """Remove images without a row, and count the frames that wait."""
        for image in self._images:
            try:
                image.unlink(missing_ok=True)
            except OSError:
                break
        self.dropped += len(self._rows) + self._queue.qsize()
        self._rows, self._images = [], []
