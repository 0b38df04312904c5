"""Recorded drives, whichever way they lie on disk."""

from __future__ import annotations

from pathlib import Path

from lanenet.data.drives.folder import FRAMES_FILE, open_folder, read_truth
from lanenet.data.drives.recording import Commands, Drive
from lanenet.data.drives.tub import MANIFEST_FILE, open_tub
from lanenet.data.drives.video import VIDEO_ENDINGS, open_video
from lanenet.errors import DriveFormatError

__all__ = ["Commands", "Drive", "open_drive", "read_truth"]


def open_drive(path: Path) -> Drive:
    """Open a drive: a folder with ``frames.csv``, a Donkeycar tub (version 2), or a video.

    Raises:
        DriveFormatError: If it is none of these, or cannot be read; says what was expected.
        CalibrationError: If the camera file that the drive names cannot be used.
    """
    path = Path(path)
    if path.is_dir():
        if (path / FRAMES_FILE).is_file():
            return open_folder(path)
        if (path / MANIFEST_FILE).is_file():
            return open_tub(path)
        hint = (
            "; a version 1 tub has to be converted by Donkeycar first"
            if any(path.glob("record_*.json"))
            else ""
        )
        raise DriveFormatError(
            f"{path}: not a drive: neither {FRAMES_FILE} nor a Donkeycar tub's {MANIFEST_FILE} is in it{hint}"
        )
    if not path.exists():
        raise DriveFormatError(f"{path}: no such drive")
    if path.suffix.lower() in VIDEO_ENDINGS:
        return open_video(path)
    raise DriveFormatError(
        f"{path}: not a drive: expected a folder or a video ({', '.join(VIDEO_ENDINGS)}), found "
        f"{path.suffix or 'no ending'}"
    )
