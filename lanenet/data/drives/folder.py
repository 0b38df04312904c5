"""The project's own drive format, read and written: ``frames.csv``, images, drive.yaml, perhaps truth.csv."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path, PurePath
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.config import check_settings
from lanenet.data.camera_file import write_camera
from lanenet.data.drives.recording import (
    COMMAND_NAMES,
    DRIVE_FILE,
    DRIVE_FORMAT,
    DriveFile,
    DriveFormat,
    ImageFiles,
    RecordedFrames,
    named_file,
    read_times,
    write_drive_file,
)
from lanenet.data.files import atomic_folder
from lanenet.data.tables import MAX_PLACE, ColumnSpec, is_torn, read_csv, write_csv
from lanenet.errors import DriveFormatError, LanenetError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import POINT_NAMES
from lanenet.outputs import is_locked_here, lock_output, remove
from lanenet.reading import FolderFiles, is_regular

FRAMES_FILE = "frames.csv"
TRUTH_FILE = "truth.csv"
#: The folder of a drive that the car records begins with it.
RECORDING_NAME = "drive-"
#: Columns of truth.csv beside ``frame``.
TRUTH_NAMES: tuple[str, ...] = ("x_cm", "y_cm", "heading_rad", *POINT_NAMES)


def read_folder(path: Path) -> RecordedFrames:
    """Read a drive folder; images stay on disk.

    Raises:
        DriveFormatError: If ``frames.csv`` cannot be used, or names a file outside the folder.
    """
    inside = FolderFiles(path)
    table = inside.file(FRAMES_FILE, path, DriveFormatError)
    columns, commands, problems = read_times(table, file=ColumnSpec("text"))
    frames, names = columns["frame"], columns["file"].tolist()
    files = [
        named_file(inside, name, f"{table}: frame {number}, column 'file'", "images")
        for number, name in zip(frames, names, strict=True)
    ]
    missing = [i for i, file in enumerate(files) if file is None]
    # One that is not there says so when it is read.
    images = ImageFiles(
        [file or path / "images" / PurePath(name).name for file, name in zip(files, names, strict=True)]
    )
    if is_torn(table):
        problems.append(f"{table}: its last line is cut off and left out")
    if missing:
        problems.append(
            f"{table}: {len(missing)} of {len(frames)} images are missing (first: frame "
            f"{frames[missing[0]]}, {names[missing[0]]})"
        )
    return RecordedFrames(frames, columns["t_s"], commands, images, tuple(problems))


FORMAT = DriveFormat(
    kind="folder",
    described=f"a drive folder ({FRAMES_FILE})",
    recognises=lambda path: is_regular(path / FRAMES_FILE),
    read=read_folder,
    # The last two are the simulator's. Not the camera: calibration may write it.
    files=(FRAMES_FILE, DRIVE_FILE, TRUTH_FILE, "track.json", "simulation.yaml"),
)


def read_truth(path: Path) -> dict[str, np.ndarray] | None:
    """Read the ground truth of a drive folder.

    Args:
        path: The drive folder, or the ``truth.csv`` in it.

    Returns:
        ``frame`` (int64), ``x_cm``, ``y_cm`` and ``heading_rad`` of the rear axle in frame map, and the six
        label columns, NaN where there is no line. None if the drive has no truth.

    Raises:
        DriveFormatError: If ``truth.csv`` cannot be used; names line and column.
    """
    path = Path(path)
    folder = path.parent if path.name == TRUTH_FILE else path
    file = FolderFiles(folder).file(TRUTH_FILE, folder, DriveFormatError)
    if not os.path.lexists(file):
        return None
    specs = {"frame": ColumnSpec("int", low=0.0, increasing=True)}
    specs |= {
        name: ColumnSpec(allow_empty=name in POINT_NAMES, low=-MAX_PLACE, high=MAX_PLACE)
        for name in TRUTH_NAMES
    }
    return read_csv(file, specs)


def clear_dead_recordings(parent: Path) -> None:
    """Remove what recordings left that were killed: their locks, and their folders if they hold no frame."""
    # By the names of recordings: other programs have locks, too.
    for lock in sorted(parent.glob(f".{RECORDING_NAME}*.lock")):
        path = parent / lock.name[1:].removesuffix(".lock")
        if is_locked_here(path):
            continue
        with suppress(LanenetError), lock_output(path):
            # Only what a recorder makes before the rows of its first frame: a tub may have a drive.yaml, too.
            made = {DRIVE_FILE, "camera.yaml", "images"}
            found = {file.name for file in path.glob("*") if file.name[0] != "."}
            if found <= made and len(list(path.glob("images/*"))) <= 1:
                remove(path)


class DriveWriter:
    """Writes a drive; the folder appears when the ``with`` block ends without an error, else not at all.

    To keep what was written before an error, catch the error inside the block.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera | None = None,
        lane_width_cm: float | None = None,
        notes: str = "",
        jpeg_quality: int = 92,
        max_steering_rad: float | None = None,
        camera_method: str = "",
    ) -> None:
        """Prepare a drive; nothing is written yet.

        Args:
            path: Folder to write; an earlier drive there is replaced at the end.
            camera: Stored beside the images as ``camera.yaml``.
            lane_width_cm: Distance between the middles of the driven lane's lines.
            notes: Free text.
            jpeg_quality: 1 to 100.
            max_steering_rad: Steering angle at Donkeycar's angle -1.
            camera_method: How the camera was found, for its file.
        """
        self.path = Path(path)
        self._camera = camera
        self._camera_method = camera_method
        self._jpeg_quality = jpeg_quality
        data = {
            "format": DRIVE_FORMAT,
            "camera": None if camera is None else "camera.yaml",
            "lane_width_cm": lane_width_cm,
            "max_steering_rad": max_steering_rad,
            "notes": notes,
        }
        self._file = check_settings(DriveFile, data, str(path))
        self._stack = ExitStack()
        self._folder: Path | None = None
        self._rows: list[dict[str, float]] = []
        self._truth: list[dict[str, float]] = []
        self._size: tuple[int, int] | None = None

    @property
    def folder(self) -> Path:
        """Temporary folder of the drive until it is complete; further files may be written into it."""
        if self._folder is None:
            raise DriveFormatError(f"{self.path}: the drive is not open for writing (use a with block)")
        return self._folder

    def __len__(self) -> int:
        return len(self._rows)

    def __enter__(self) -> DriveWriter:
        with ExitStack() as stack:
            folder = stack.enter_context(atomic_folder(self.path, "drive", _check_drive))
            (folder / "images").mkdir()
            self._folder, self._stack = folder, stack.pop_all()
        return self

    def add(
        self,
        frame_bgr: UInt8[np.ndarray, "h w 3"],
        t_s: float,
        truth: Mapping[str, float] | None = None,
        **commands: float,
    ) -> None:
        """Append a frame.

        Args:
            frame_bgr: The image; all have the same size.
            t_s: Its time, later than the one before.
            truth: Rear-axle pose in the map and the six labels (:data:`TRUTH_NAMES`; labels may be NaN), for
                every frame or for none.
            **commands: Commanded values by the names of :class:`.recording.Commands`; the same names for
                every frame.

        Raises:
            DriveFormatError: If a value is missing, unknown or not finite, time does not increase, or the
                image has another size; names the frame.
        """
        number = len(self._rows)
        where = f"{self.path}: frame {number}"
        unknown = [name for name in commands if name not in COMMAND_NAMES]
        if unknown:
            raise DriveFormatError(
                f"{where}: unknown command {unknown[0]!r}, known: {', '.join(COMMAND_NAMES)}"
            )
        row = {"t_s": float(t_s), **{name: float(value) for name, value in commands.items()}}
        size = (frame_bgr.shape[1], frame_bgr.shape[0])
        if self._rows:
            _check_like_first(where, row, self._rows[0], "commands")
            if size != self._size:
                raise DriveFormatError(f"{where}: image of {size[0]}x{size[1]} px, expected {self._size}")
            if not row["t_s"] > self._rows[-1]["t_s"]:
                raise DriveFormatError(
                    f"{where}: t_s {t_s:g} after {self._rows[-1]['t_s']:g} has to increase"
                )
            if (truth is None) != (not self._truth):
                raise DriveFormatError(f"{where}: truth has to be given for every frame or for none")
        elif self._camera is not None and size != (self._camera.width, self._camera.height):
            raise DriveFormatError(
                f"{where}: image of {size[0]}x{size[1]} px, but the camera has "
                f"{self._camera.width}x{self._camera.height}"
            )
        _check_finite(where, row)
        if truth is not None:
            known = {name: float(value) for name, value in truth.items()}
            _check_like_first(where, known, dict.fromkeys(TRUTH_NAMES, 0.0), "truth")
            _check_finite(where, {name: v for name, v in known.items() if name not in POINT_NAMES or v == v})
            self._truth.append(known)
        ok, data = cv2.imencode(".jpg", frame_bgr, [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality])
        if not ok:
            raise DriveFormatError(f"{where}: the image cannot be encoded as JPEG")
        (self.folder / image_name(number)).write_bytes(data.tobytes())
        self._size = size
        self._rows.append(row)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            try:
                self._finish()
            except BaseException as problem:
                self._stack.__exit__(type(problem), problem, problem.__traceback__)
                raise
        self._stack.__exit__(kind, error, trace)
        self._folder = None

    def _finish(self) -> None:
        if not self._rows:
            raise DriveFormatError(f"{self.path}: no frame was added, nothing is written")
        frame = np.arange(len(self._rows))
        names = {"frame": frame, "file": [image_name(int(k)) for k in frame]}
        numbers = {name: np.array([row[name] for row in self._rows]) for name in self._rows[0]}
        write_csv(self.folder / FRAMES_FILE, {**names, **numbers})
        if self._truth:
            truth = {name: np.array([row[name] for row in self._truth]) for name in TRUTH_NAMES}
            write_csv(self.folder / TRUTH_FILE, {"frame": frame, **truth}, allow_empty=POINT_NAMES)
        if self._camera is not None:
            write_camera(self.folder / "camera.yaml", self._camera, self._camera_method)
        write_drive_file(self.folder, self._file)


def _check_drive(folder: Path) -> None:
    """Refuse a drive that lacks images."""
    problems = read_folder(folder).problems
    if problems:
        raise DriveFormatError("; ".join(problems))


def image_name(number: int) -> str:
    """Return the name of a frame's image, relative to the drive's folder."""
    return f"images/{number:06d}.jpg"


def _check_like_first(where: str, row: dict[str, float], first: dict[str, float], what: str) -> None:
    if row.keys() != first.keys():
        different = sorted(row.keys() ^ first.keys())
        raise DriveFormatError(
            f"{where}: {what}: {', '.join(different)} given for some frames only, or unknown"
        )


def _check_finite(where: str, row: dict[str, float]) -> None:
    for name, value in row.items():
        if not np.isfinite(value):
            raise DriveFormatError(f"{where}: {name} is {value}")
