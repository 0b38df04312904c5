"""Files that are no drive as they are, and the command that makes one of each."""

from __future__ import annotations

import shlex
from pathlib import Path

_RAW_VIDEO = (".h264", ".264", ".h265", ".265", ".hevc", ".avc")
_OTHER_VIDEO = (".ts", ".mts", ".m2ts", ".3gp", ".wmv", ".flv", ".ogv", ".asf", ".y4m")
#: Photos that OpenCV does not read in all its versions; the first are those of iPhones.
_OTHER_PHOTOS = (".heic", ".heif", ".avif", ".jxl", ".gif", ".dng", ".cr2", ".nef", ".arw")
#: By ending: what such a file is, and the command that makes of it what is read; ``{file}`` is its path,
#: ``{new}`` its name without the ending, in the folder where one is.
_NEXT_STEPS: dict[tuple[str, ...], tuple[str, str]] = {
    (".bag.active", ".bag.orig.active"): (
        "a recording of ROS 1 that was not finished",
        "rosbag reindex {file}; mv {file} {new}.bag; rosbags-convert --src {new}.bag --dst {new}",
    ),
    (".bag",): (
        "a bag of ROS 1, which has to be converted first",
        "rosbags-convert --src {file} --dst {new}",
    ),
    (".db3-wal", ".db3-shm"): ("a part of the bag {new}.db3", "give that file, with this one beside it"),
    (".zstd", ".zst"): ("packed, which has to be undone first", "zstd -d {file} -o {new}"),
    (".tar.gz", ".tgz", ".tar", ".tar.xz", ".tar.bz2"): ("an archive", "tar -xf {file}"),
    (".zip",): ("an archive", "unzip {file} -d {new}"),
    (".7z",): ("an archive", "7z x {file}"),
    (".gz",): ("packed, which has to be undone first", "gunzip -k {file}"),
    (".xz",): ("packed, which has to be undone first", "unxz -k {file}"),
    (".bz2",): ("packed, which has to be undone first", "bunzip2 -k {file}"),
    (".lz4",): ("packed, which has to be undone first", "lz4 -d {file} {new}"),
    _OTHER_VIDEO: ("a video in another container", "ffmpeg -i {file} -c:v libx264 {new}.mp4"),
    _OTHER_PHOTOS: ("a photo in another format", "magick {file} {new}.jpg"),
}


def next_step(path: Path) -> str | None:
    """Say what a file is, by its name, and how it becomes one that is read; None if that is not known."""
    name = path.name.lower()
    if name.endswith(_RAW_VIDEO):
        return raw_stream(path)
    for endings, (what, command) in _NEXT_STEPS.items():
        if ending := next((ending for ending in endings if name.endswith(ending)), ""):
            names = {"file": shlex.quote(str(path)), "new": shlex.quote(path.name[: -len(ending)])}
            return f"{what.format(**names)}: {command.format(**names)}"
    return None


def raw_stream(path: Path) -> str:
    """Say what a raw H.264 or H.265 file is, and how it becomes a video with times."""
    new = f"{path.stem}.mp4" if path.suffix.lower() != ".mp4" else f"{path.stem}_timed.mp4"
    return (
        "a raw stream of H.264 or H.265, which has no times; put it into a container with the rate at which "
        f"it was recorded: ffmpeg -r RATE -i {shlex.quote(str(path))} -c copy {shlex.quote(new)}"
    )
