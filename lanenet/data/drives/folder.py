"""The project's own drive format: a folder with ``frames.csv``, images, drive.yaml and perhaps truth.csv."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lanenet.data.drives.reading import DRIVE_FILE, DriveFormat, RecordedFrames, read_times
from lanenet.data.drives.recording import ImageFiles
from lanenet.data.tables import ColumnSpec, is_torn, read_csv
from lanenet.geometry.lane import POINT_NAMES

FRAMES_FILE = "frames.csv"
TRUTH_FILE = "truth.csv"
#: Columns of truth.csv beside ``frame``.
TRUTH_NAMES: tuple[str, ...] = ("x_cm", "y_cm", "heading_rad", *POINT_NAMES)


def read_folder(path: Path) -> RecordedFrames:
    """Read a drive folder; images stay on disk.

    Raises:
        DriveFormatError: If ``frames.csv`` cannot be used.
    """
    table = path / FRAMES_FILE
    columns, commands = read_times(table, file=ColumnSpec("text"))
    frames = columns["frame"]
    images = ImageFiles([path / name for name in columns["file"].tolist()])
    missing = [i for i, image in enumerate(images.paths) if not image.is_file()]
    problems: list[str] = []
    if is_torn(table):
        problems.append(f"{table}: its last line is cut off and left out")
    if missing:
        problems.append(
            f"{table}: {len(missing)} of {len(frames)} images are missing (first: frame "
            f"{frames[missing[0]]}, {columns['file'][missing[0]]})"
        )
    return RecordedFrames(frames, columns["t_s"], commands, images, tuple(problems))


FORMAT = DriveFormat(
    described=f"a drive folder ({FRAMES_FILE})",
    recognises=lambda path: (path / FRAMES_FILE).is_file(),
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
    file = path if path.name == TRUTH_FILE else path / TRUTH_FILE
    if not file.exists():
        return None
    specs = {"frame": ColumnSpec("int", low=0.0, increasing=True)}
    specs |= {name: ColumnSpec(allow_empty=name in POINT_NAMES) for name in TRUTH_NAMES}
    return read_csv(file, specs)
