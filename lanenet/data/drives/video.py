"""A drive as a video, with an optional CSV of the same name beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lanenet.data.drives.recording import DRIVE_FILE, Commands, DriveFormat, RecordedFrames, read_times
from lanenet.data.drives.video_frames import VideoImages, undecodable
from lanenet.data.tables import is_answers
from lanenet.errors import DriveFormatError
from lanenet.reading import is_regular

VIDEO_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".mjpeg", ".mjpg")

#: Where the file has neither times nor a rate: that of a Donkeycar.
_DEFAULT_FPS = 20.0
#: Longest by shortest step of a rate that varies. Chosen: the clocks of phones shake by a tenth of a step,
#: and in the dark they halve the rate.
_VARIES = 1.8


def read_video(path: Path) -> RecordedFrames:
    """Read a video; ``<name>.csv`` beside it may give times and commands of its frames, counted from 0.

    A detector's answers of that name are not the recording's, and are passed over.

    Raises:
        DriveFormatError: If the video or its CSV cannot be read, or it has no frame.
    """
    images = VideoImages(path)
    problems: list[str] = []
    n = images.count
    if n == 0:
        raise DriveFormatError(f"{path}: {undecodable(path, images.codec)}")
    if n < images.listed_frames:
        problems.append(f"{path}: the video is cut off: {n} of {images.listed_frames} frames can be decoded")
    table = path.with_suffix(".csv")
    if table.is_file() and not is_answers(table):
        columns, commands, more = read_times(table)
        problems += more
        frames, t_s, trusted = columns["frame"], columns["t_s"], True
        inside = np.flatnonzero(frames < n)
        if len(inside) == 0:
            raise DriveFormatError(f"{table}: no row belongs to one of the video's {n} frames")
        if len(inside) < len(frames):
            problems.append(
                f"{table}: {len(frames) - len(inside)} rows lie beyond the video's {n} frames (first: frame "
                f"{frames[len(inside)]})"
            )
            frames, t_s, commands = frames[inside], t_s[inside], commands.subset(inside)
    else:
        fps, trusted = images.fps, images.fps > 0.0
        if not trusted:
            problems.append(
                f"{path}: the video has no times; taking {_DEFAULT_FPS:.0f} frames/s, expected {table.name} "
                "beside it with the columns frame and t_s"
            )
        frames = np.arange(n)
        if trusted and images.t_ms is None and n > 1:
            trusted = False
            problems.append(
                f"{path}: the times of its frames do not increase; taking {fps:g} frames/s as its header says"
            )
        if trusted and images.t_ms is not None:
            t_s = 0.001 * (images.t_ms - images.t_ms[0])
            steps_ms = np.diff(images.t_ms)
            if steps_ms.max() >= _VARIES * steps_ms.min():
                problems.append(
                    f"{path}: the frame rate varies, steps of {steps_ms.min():.0f} to "
                    f"{steps_ms.max():.0f} ms; the time of each frame is taken"
                )
        else:
            t_s = frames / (fps or _DEFAULT_FPS)
        commands = Commands()
    return RecordedFrames(frames, t_s, commands, images, tuple(problems), rows=frames, times_trusted=trusted)


FORMAT = DriveFormat(
    kind="video",
    described=f"a video ({', '.join(VIDEO_ENDINGS)})",
    recognises=lambda path: is_regular(path) and path.suffix.lower() in VIDEO_ENDINGS,
    read=read_video,
    files=("{stem}.csv", f"{{stem}}.{DRIVE_FILE}"),
)
