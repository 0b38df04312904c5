"""Bad command lines: one line that names option and file, an exit code, and nothing half-written."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from commands import refused
from drives import edit, write_drive, write_tub, write_video
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.data.camera_file import write_camera
from lanenet.data.drives.folder import DriveWriter
from lanenet.geometry.camera import Camera, Mounting


def camera(width: int = 64, height: int = 48) -> Camera:
    K = np.array([[30.0, 0.0, (width - 1) / 2], [0.0, 30.0, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera("fisheye", width, height, K, np.zeros(4), Mounting(15.0, 0.4), 20.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a drive of 70 frames."""
    rng = np.random.default_rng(0)
    with DriveWriter(tmp_path / "drive", camera=camera(), lane_width_cm=40.0) as writer:
        for k in range(70):
            frame = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
            writer.add(frame, k * 0.05, speed_cm_s=50.0, steering_rad=0.0)
    return tmp_path


def cut_image(folder: Path, number: int = 35) -> None:
    image = folder / "drive" / "images" / f"{number:06d}.jpg"
    image.write_bytes(image.read_bytes()[:200])


def cut_images(folder: Path) -> None:
    """More than a drive is mapped without."""
    for number in range(35, 45):
        cut_image(folder, number)


def nan_in_the_table(folder: Path) -> None:
    edit(folder / "drive" / "frames.csv", "000012.jpg,0.6,", "000012.jpg,nan,")


def nan_in_the_camera(folder: Path) -> None:
    path = folder / "drive" / "camera.yaml"
    data = yaml.safe_load(path.read_text())
    data["mounting"]["height_cm"] = float("nan")
    path.write_text(yaml.safe_dump(data))


def still_images(folder: Path) -> None:
    images = folder / "drive" / "images"
    shutil.rmtree(images)
    images.mkdir()
    for k in range(70):
        cv2.imwrite(str(images / f"{k:06d}.jpg"), np.full((48, 64, 3), 90, np.uint8))


def other_camera(folder: Path) -> None:
    write_camera(folder / "other.yaml", camera(80, 60), "made up")


def empty_tub(folder: Path) -> None:
    (write_tub(folder / "tub", [{}]) / "catalog_0.catalog").write_text("")


def folders(*names: str) -> Callable[[Path], None]:
    return lambda folder: [(folder / name).mkdir() for name in names] and None


MAP = ("--lane-width", "40", "--out", "@m")
FILTER = ("--detector", "lane-filter", "--out", "@o.csv")
HOUGH = ("--detector", "hough", "--out", "@o.csv")
SMALL = Path(__file__).parents[2] / "checkpoints" / "small"
#: What is done to the folder, the command (``@`` stands for the folder), and what its line has to name.
BAD: dict[str, tuple[Callable[[Path], None] | None, tuple[str, ...], tuple[str, ...]]] = {
    "map: no drive": (None, ("map", "@nowhere", *MAP), ("nowhere",)),
    "detect: no drive": (None, ("detect", "@nowhere", *FILTER), ("nowhere",)),
    "map: an empty tub": (empty_tub, ("map", "@tub", *MAP), ("tub", "no ")),
    "map: corrupt images": (cut_images, ("map", "@drive", *MAP), ("000035.jpg",)),
    "detect: a corrupt image": (
        cut_image,
        ("detect", "@drive", *FILTER, "--video", "@o.mp4"),
        ("000035.jpg",),
    ),
    "map: another camera": (
        other_camera,
        ("map", "@drive", "--camera", "@other.yaml", *MAP),
        ("80x60", "64x48"),
    ),
    "detect: another camera": (
        other_camera,
        ("detect", "@drive", "--camera", "@other.yaml", *FILTER),
        ("other.yaml", "80x60", "64x48", "lanenet map", "--camera MAP"),
    ),
    # Not the way out for a camera of another size.
    "detect: another camera of a model": (
        other_camera,
        ("detect", "@drive", "--camera", "@other.yaml", "--model", f"{SMALL}", "--out", "@o.csv"),
        ("80x60", "64x48", "expected the camera that took them"),
    ),
    "detect: no detector": (
        None,
        ("detect", "@drive", "--out", "@o.csv"),
        ("--model checkpoints/general", "--detector lane-filter, hough or painter"),
    ),
    "detect: a model for a detector that takes none": (
        None,
        ("detect", "@drive", *HOUGH, "--model", f"{SMALL}"),
        ("detector hough: takes no model", "leave out --detector"),
    ),
    "map: a nan in the table": (
        nan_in_the_table,
        ("map", "@drive", *MAP),
        ("frames.csv", "line 14", "'t_s'"),
    ),
    "map: a nan in the camera": (
        nan_in_the_camera,
        ("map", "@drive", *MAP),
        ("camera.yaml", "height_cm", "NaN"),
    ),
    **{
        f"detect: frames {text}": (
            None,
            ("detect", "@drive", *HOUGH, "--frames", text),
            ("FIRST:LAST", text),
        )
        for text in ("5:2", "5", ":", "5:", "-3:7", "1.5:7", "\u00b2:\u00b2", "a:b")
    },
    "detect: frames beyond the end": (
        None,
        ("detect", "@drive", *HOUGH, "--frames", "500:600"),
        ("500", "0 to 69"),
    ),
    # Found before the drive is, which is not there.
    "detect: the output is a folder": (
        folders("folder.csv"),
        ("detect", "@nowhere", "--detector", "hough", "--out", "@folder.csv"),
        ("folder.csv", "is a folder"),
    ),
    "detect: the output lies below a file": (
        None,
        ("detect", "@nowhere", "--detector", "hough", "--out", "@drive/frames.csv/o.csv"),
        ("frames.csv is a file",),
    ),
    "detect: the video is a folder": (
        folders("v.mp4"),
        ("detect", "@drive", *HOUGH, "--video", "@v.mp4"),
        ("v.mp4", "is a folder"),
    ),
    "map: the folder above the tub": (
        empty_tub,
        ("map", "@", *MAP),
        ("not a drive", "drives in it: type ", "/drive", "/tub"),
    ),
    "detect: the folder of a car": (
        lambda folder: write_tub(folder / "car" / "data", [{}]),
        ("detect", "@car", *HOUGH),
        ("found none of them", "a drive in it: type ", "car/data"),
    ),
    "map: the images of a drive": (
        None,
        ("map", "@drive/images", *MAP),
        ("not a drive", "the drive is the folder above it: type ", "/drive"),
    ),
    "map: three frames": (
        lambda folder: write_drive(folder / "short", 3),
        ("map", "@short", *MAP),
        ("found 3 frames", "expected 60", "two laps"),
    ),
    "detect: the table of a video": (
        lambda folder: (
            write_video(folder / "clip.avi"),
            (folder / "clip.csv").write_text("frame,t_s\n0,0\n"),
        ),
        ("detect", "@clip.avi", "--detector", "hough", "--out", "@clip.csv"),
        ("is a file of", "choose another name", "clip_out.csv"),
    ),
    "label: no map": (folders("m"), ("label", "@m", "--out", "@l.parquet"), ("map.yaml",)),
    "map: a drive that shows nothing": (
        still_images,
        ("map", "@drive", *MAP),
        ("the car stands still", "mapping needs a moving car"),
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_command_is_refused(folder: Path, what: str) -> None:
    prepare, words, named = BAD[what]
    if prepare is not None:
        prepare(folder)
    # The report of a drive that was refused.
    words = tuple(word.replace("@", f"{folder}/") for word in words)
    line = refused(folder, *words, writes="m" if words[0] == "map" else "")
    for text in named:
        assert text in line, line


def test_detect_can_go_on_past_a_corrupt_image(folder: Path) -> None:
    cut_image(folder)
    out = folder / "o.csv"
    words = ["detect", folder / "drive", "--detector", "lane-filter", "--out", out, "--skip-unreadable"]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0 and "000035.jpg" in result.stderr
    assert len(out.read_text().splitlines()) == 71


def test_outputs_of_others_are_kept(folder: Path) -> None:
    keep = folder / "keep"
    keep.mkdir()
    (keep / "thesis.txt").write_text("years of work")
    refused(folder, "map", folder / "drive", "--lane-width", "40", "--out", keep)
    assert (keep / "thesis.txt").read_text() == "years of work"
