"""Bad drives: folders, tubs, videos and photos. Each row names what the error has to name."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from bad_input import Bad, each
from drives import edit, frame_image, record, write_drive, write_tub, write_video

from lanenet.data.drives import open_drive, read_truth
from lanenet.data.drives.folder import TRUTH_NAMES, DriveWriter
from lanenet.data.drives.sources import open_source, read_mask
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError

Open = Callable[[Path], Any]


def folder(*edits: tuple[str, str, str], size: int = 5, then: Open = open_drive) -> Open:
    """A drive folder with some texts replaced in its files, opened."""

    def act(tmp_path: Path) -> Any:
        path = write_drive(tmp_path / "lap", size)
        for name, old, new in edits:
            edit(path / name, old, new)
        return then(path)

    return act


def frames(old: str, new: str) -> Open:
    return folder(("frames.csv", old, new))


def without(*names: str, size: int = 2) -> Open:
    """A drive folder without some of its files, opened."""

    def act(tmp_path: Path) -> Any:
        path = write_drive(tmp_path / "lap", size)
        for name in names:
            for file in path.glob(name):
                file.unlink()
        return open_drive(path)

    return act


def holding(name: str, content: str | bytes, opened: str = ".", then: Open = open_drive) -> Open:
    """A folder that holds one file, opened as a whole or by the name of the file."""

    def act(tmp_path: Path) -> Any:
        data = content.encode() if isinstance(content, str) else content
        (tmp_path / name).write_bytes(data)
        return then(tmp_path / opened)

    return act


def tub(rows: list[Any], empty: bool = False) -> Open:
    def act(tmp_path: Path) -> Any:
        path = write_tub(tmp_path / "tub", rows)
        if empty:
            (path / "catalog_0.catalog").write_text("")
        return open_drive(path)

    return act


def missing(then: Open) -> Open:
    return lambda tmp_path: then(tmp_path / "nowhere")


def standing(folder: Path) -> Path:
    path = write_drive(folder / "lap", 5)
    edit(path / "frames.csv", "jpg,0.15", "jpg,0.1")
    edit(path / "frames.csv", "jpg,0.2", "jpg,0.1")
    return path


def pose_unknown(tmp_path: Path) -> Any:
    row = {name: float(j) for j, name in enumerate(TRUTH_NAMES)}
    with DriveWriter(tmp_path / "sim") as writer:
        writer.add(frame_image(0), 0.0, truth=row)
    edit(tmp_path / "sim" / "truth.csv", "0,0,1,2,", "0,,1,2,")
    return read_truth(tmp_path / "sim")


def rows_beyond_the_video(tmp_path: Path) -> Any:
    write_video(tmp_path / "lap.avi")
    (tmp_path / "lap.csv").write_text("frame,t_s\n500,0.1\n")
    return open_drive(tmp_path / "lap.avi")


def first_image(path: Path) -> Any:
    return open_source(path).image(0)


def pipe(name: str) -> Open:
    """A drive folder in which a pipe stands for one of its files, opened; its first image is read."""

    def act(tmp_path: Path) -> Any:
        path = write_drive(tmp_path / "lap", 1)
        (path / name).unlink()
        os.mkfifo(path / name)
        return open_drive(path)

    return act


def piped(folder: Path) -> Path:
    os.mkfifo(folder / "truth.csv")
    return folder


def linked(name: str, target: str) -> Open:
    """A drive folder in which a link stands for one of its files or folders, opened."""

    def act(tmp_path: Path) -> Any:
        path = write_drive(tmp_path / "lap", 2)
        (path / name).rename(tmp_path / "elsewhere")
        (path / name).symlink_to(target.format(tmp_path))
        return open_drive(path)

    return act


def png(width: int, height: int) -> bytes:
    """The beginning of an image that would be this large."""
    return b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", width, height) + b"\x08\x02\0\0\0" + b"IEND"


ROW = "1,images/000001.jpg,0.05,60,0.01"
LOST = ("no usable frames",)
D, C, E = DriveFormatError, CalibrationError, ConfigError

BAD = [
    Bad("no drive", holding("notes", "x"), D, ("frames.csv", "manifest.json", ".mp4")),
    Bad("no such drive", missing(open_drive), D, ("nowhere", "no such")),
    Bad("another ending", holding("a.txt", "x", "a.txt"), D, ("a.txt", ".mp4")),
    Bad("a tub of version 1", holding("record_0.json", "{}"), D, ("version 1 tub",)),
    # frames.csv
    Bad("a command is nan", frames(ROW, ROW[:-4] + "nan"), D, ("frames.csv", "line 3", "'steering_rad'")),
    Bad("a command is empty", frames(ROW, ROW.replace("60", "")), D, ("line 3", "'speed_cm_s'")),
    Bad("steering in degrees", frames(ROW, ROW[:-4] + "17"), D, ("line 3", "'steering_rad'", "17")),
    Bad(
        "time stands again and again",
        lambda folder: open_drive(standing(folder)),
        D,
        ("frames.csv", "'t_s'", "do not increase 2 times, first at frame 3"),
    ),
    Bad("a frame twice", frames("4,images/000004.jpg", "3,images/000004.jpg"), D, ("line 6", "'frame'")),
    Bad("a misspelt column", frames("steering_rad", "steering_deg"), D, ("'steering_deg'", "'steering_rad'")),
    Bad("no column of times", frames("t_s", "time"), D, ("frames.csv", "'t_s'", "missing")),
    Bad("no rows", holding("frames.csv", "frame,file,t_s\n"), D, ("frames.csv", "no frames")),
    Bad("no image", without("images/*"), D, ("lap", "2 frames", "000000.jpg")),
    Bad("an image of no name", frames("images/000001.jpg", "a\0b"), D, ("frames.csv",)),
    Bad("an image by a link", linked("images/000001.jpg", "{}/elsewhere"), D, ("frame 1", "000001.jpg")),
    Bad("images by a link", linked("images", "{}/elsewhere"), D, ("frame 0", "images/000000.jpg")),
    Bad("an image that is a pipe", pipe("images/000000.jpg"), D, ("000000.jpg",)),
    Bad("a truth that is a pipe", lambda f: read_truth(piped(f)), D, ("truth.csv", "a pipe")),
    Bad("a table of pipes", pipe("frames.csv"), D, ("lap",)),
    Bad("a speed beyond all cars", frames(",60,", ",1e300,"), D, ("line 2", "'speed_cm_s'")),
    Bad("a time beyond all clocks", frames("0.05", "1e300"), D, ("line 3", "'t_s'")),
    # drive.yaml and its camera
    Bad(
        "another version",
        folder(("drive.yaml", "lanenet-drive/1", "lanenet-drive/9")),
        D,
        ("drive.yaml", "'format'", "'lanenet-drive/9'"),
    ),
    Bad(
        "a misspelt key",
        folder(("drive.yaml", "lane_width_cm", "lane_with_cm")),
        D,
        ("drive.yaml", "'lane_with_cm'", "'lane_width_cm'"),
    ),
    Bad(
        "a negative lane width",
        folder(("drive.yaml", "lane_width_cm: 40.0", "lane_width_cm: -40.0")),
        D,
        ("drive.yaml", "'lane_width_cm'", "-40"),
    ),
    Bad("another size", folder(("camera.yaml", "width: 64", "width: 640")), D, ("64x48", "640x48")),
    Bad("no camera file", without("camera.yaml"), C, ("camera.yaml", "no such file")),
    Bad(
        "a camera file above",
        folder(("drive.yaml", "camera.yaml", "../camera.yaml")),
        D,
        ("drive.yaml", "'camera'", "../camera.yaml"),
    ),
    Bad("a drive.yaml that is a pipe", pipe("drive.yaml"), D, ("drive.yaml", "a pipe")),
    # truth.csv
    Bad("an unknown pose", pose_unknown, D, ("truth.csv", "line 2", "'x_cm'")),
    # tubs
    Bad("no catalog", tub([]), D, ("manifest.json", "no catalog")),
    Bad("an empty catalog", tub([record(0)], empty=True), D, LOST),
    Bad("only broken rows", tub(["broken"]), D, (*LOST, "catalog_0.catalog", "1 rows")),
    Bad("a manifest that is not json", holding("manifest.json", "not json"), D, ("manifest.json",)),
    Bad(
        "a manifest without paths",
        holding("manifest.json", "[]\n[]\n{}\n{}\n"),
        D,
        ("manifest.json", "'paths'", "found 4"),
    ),
    Bad(
        "deleted rows as a text",
        holding("manifest.json", '[]\n[]\n{}\n{}\n{"paths": ["a"], "deleted_indexes": "none"}'),
        D,
        ("manifest.json", "'deleted_indexes'"),
    ),
    Bad("a manifest nested deeply", holding("manifest.json", "[" * 100_000), D, ("manifest.json",)),
    Bad(
        "types that are lists", holding("manifest.json", '[[1]]\n[[1]]\n{"paths": []}'), D, ("manifest.json",)
    ),
    Bad("an index beyond all counting", tub([record(10**30)]), D, LOST),
    Bad("a row nested deeply", tub(["[" * 100_000]), D, LOST),
    Bad("a row of 2 MB", tub([record(0, filler="x" * 2_000_000)]), D, (*LOST, "1 rows")),
    # videos
    Bad("a playlist", holding("lap.mp4", b"#EXTM3U\n/etc/passwd\n", "lap.mp4"), D, ("lap.mp4", "#EXTM3U")),
    Bad("no video", holding("lap.mp4", b"not a video at all" * 50, "lap.mp4"), D, ("lap.mp4", "OpenCV")),
    Bad("rows beyond the video", rows_beyond_the_video, D, ("lap.csv", "40 frames")),
    # photos
    Bad("no source", missing(open_source), D, ("nowhere", "no such")),
    Bad("a folder without photos", holding("notes", "x", then=open_source), D, ("frames.csv", ".jpg")),
    Bad("a table as a source", holding("t.xyz", "1", "t.xyz", open_source), D, ("t.xyz", ".mp4", ".jpg")),
    Bad(
        "a photo beyond all memory",
        holding("b.png", png(60_000, 60_000), then=first_image),
        D,
        ("60000x60000",),
    ),
    Bad(
        "a mask beyond all memory",
        holding("m.png", png(60_000, 60_000), "m.png", read_mask),
        E,
        ("60000x60000",),
    ),
    Bad("a mask that is a device", lambda _: read_mask(Path("/dev/zero.png")), E, ("/dev/zero.png",)),
    Bad("a broken photo", holding("b.jpg", b"no jpeg", then=first_image), D, ("b.jpg",)),
]


@each(BAD)
def test_a_bad_drive_is_refused(tmp_path: Path, bad: Bad) -> None:
    bad.check(tmp_path)


def test_a_table_needs_distinct_rows() -> None:
    with pytest.raises(AssertionError, match="one name"):
        each([BAD[0], BAD[0]])


def test_a_drive_may_use_its_own_folders(tmp_path: Path) -> None:
    """Names below the folder, links within it, and a link to the drive itself."""
    path = write_drive(tmp_path / "lap", 2)
    (path / "more" / "deep").mkdir(parents=True)
    (path / "images" / "000001.jpg").rename(path / "more" / "deep" / "b.jpg")
    edit(path / "frames.csv", "images/000001.jpg", "./more/deep/b.jpg")
    (path / "images" / "000000.jpg").rename(path / "more" / "a.jpg")
    (path / "images" / "000000.jpg").symlink_to("../more/a.jpg")
    (tmp_path / "link").symlink_to(path)
    drive = open_drive(tmp_path / "link")
    assert not drive.problems and drive.image(1).shape == drive.image(0).shape


def test_a_row_may_be_long_and_begin_with_a_space(tmp_path: Path) -> None:
    long = record(1, **{"lidar/scan": [1.25] * 10_000})
    path = write_tub(tmp_path / "tub", [record(0), long])
    edit(path / "catalog_0.catalog", json.dumps(long), f"  {json.dumps(long)}")
    assert open_drive(path).frames.tolist() == [0, 1]


def test_a_tub_may_keep_its_catalogs_in_a_folder(tmp_path: Path) -> None:
    path = write_tub(tmp_path / "tub", [record(0), record(1)])
    (path / "data").mkdir()
    (path / "catalog_0.catalog").rename(path / "data" / "catalog_0.catalog")
    edit(path / "manifest.json", '"catalog_0.catalog"', '"data/catalog_0.catalog"')
    assert len(open_drive(path)) == 2


@pytest.mark.parametrize("value", [-7, 1e308, 10**400], ids=["-7", "1e308", "10**400"])
def test_a_command_that_no_car_has_is_left_out_and_counted(tmp_path: Path, value: float) -> None:
    rows = [record(k, **({"user/angle": value} if k == 1 else {})) for k in range(3)]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.commands.angle is not None
    assert [angle == -0.25 for angle in drive.commands.angle] == [True, False, True]
    assert any("frame 1" in problem and "angle" in problem for problem in drive.problems)


def test_a_joystick_at_its_stop_is_at_its_stop(tmp_path: Path) -> None:
    rows = [record(k, **{"user/angle": -32768 / 32767}) for k in range(3)]
    assert open_drive(write_tub(tmp_path / "tub", rows)).commands.angle.tolist() == [-1.0] * 3
