"""Bad input: one line that names file and key, an exit code, and nothing half-written."""

import json
import shutil

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.data.camera_file import write_camera
from lanenet.data.drives.writer import DriveWriter
from lanenet.geometry.camera import Camera, Mounting


def camera(width=64, height=48):
    K = np.array([[30.0, 0.0, (width - 1) / 2], [0.0, 30.0, (height - 1) / 2], [0.0, 0.0, 1.0]])
    return Camera("fisheye", width, height, K, np.zeros(4), Mounting(15.0, 0.4), 20.0)


@pytest.fixture
def drive(tmp_path):
    rng = np.random.default_rng(0)
    with DriveWriter(tmp_path / "drive", camera=camera(), lane_width_cm=40.0) as writer:
        for k in range(70):
            frame = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
            writer.add(frame, k * 0.05, speed_cm_s=50.0, steering_rad=0.0)
    return tmp_path / "drive"


@pytest.fixture
def tub(tmp_path):
    folder = tmp_path / "tub"
    (folder / "images").mkdir(parents=True)
    manifest = [["cam/image_array", "user/angle"], ["image_array", "float"], {}, {"created_at": 0.0}]
    catalog = {"paths": ["catalog_0.catalog"], "current_index": 0, "max_len": 1000, "deleted_indexes": []}
    lines = [json.dumps(part) for part in [*manifest, catalog]]
    (folder / "manifest.json").write_text("\n".join(lines) + "\n")
    (folder / "catalog_0.catalog").write_text("")
    return folder


def run(tmp_path, *words):
    """Run a command that must fail; returns its one line."""
    before = sorted(p for p in tmp_path.rglob("*"))
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 1, result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1 and "Traceback" not in result.output
    assert sorted(p for p in tmp_path.rglob("*")) == before, "something was written"
    return lines[0]


def config(tmp_path, **changes):
    path = tmp_path / "run.yaml"
    data = {"name": "bad", "work_dir": str(tmp_path / "work"), "checkpoints_dir": str(tmp_path / "ck")}
    path.write_text(yaml.safe_dump(data | changes))
    return path


def test_a_misspelt_key_is_named_with_the_right_one(tmp_path):
    line = run(tmp_path, "train", config(tmp_path, learn={"epoch": 3}))
    assert "run.yaml" in line and "'learn.epoch'" in line and "'epochs'" in line


def test_a_wrong_type_is_named(tmp_path):
    line = run(tmp_path, "train", config(tmp_path), "learn.batch_size=many")
    assert "run.yaml" in line and "'learn.batch_size'" in line and "'many'" in line


def test_an_override_without_value(tmp_path):
    assert "key=value" in run(tmp_path, "train", config(tmp_path), "learn.epochs")


@pytest.mark.parametrize("verb", ["map", "detect"])
def test_a_missing_drive(tmp_path, verb):
    words = {
        "map": ("--lane-width", 40, "--out", tmp_path / "m"),
        "detect": ("--detector", "lane-filter", "--out", tmp_path / "o.csv"),
    }[verb]
    assert "nowhere" in run(tmp_path, verb, tmp_path / "nowhere", *words)


def test_a_run_whose_drive_is_missing(tmp_path):
    drives = [{"path": str(tmp_path / "gone"), "lane_width_cm": 40}]
    line = run_keeping_work(tmp_path, config(tmp_path, data={"drives": drives}))
    assert "gone" in line


def run_keeping_work(tmp_path, path):
    """A run may leave its work folder, but no checkpoint."""
    result = CliRunner().invoke(app, ["train", str(path)])
    assert result.exit_code == 1 and not (tmp_path / "ck").exists()
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    return line


def test_an_empty_tub(tmp_path, tub):
    line = run(tmp_path, "map", tub, "--lane-width", 40, "--out", tmp_path / "m")
    assert "tub" in line and "no " in line


@pytest.mark.parametrize("verb", ["map", "detect"])
def test_a_corrupt_jpeg_in_the_middle(tmp_path, drive, verb):
    image = drive / "images" / "000035.jpg"
    image.write_bytes(image.read_bytes()[:200])
    words = {
        "map": ("--lane-width", 40, "--out", tmp_path / "m"),
        "detect": ("--detector", "lane-filter", "--out", tmp_path / "o.csv", "--video", tmp_path / "o.mp4"),
    }[verb]
    assert "000035.jpg" in run(tmp_path, verb, drive, *words)


def test_detect_can_go_on_past_a_corrupt_jpeg(tmp_path, drive):
    image = drive / "images" / "000035.jpg"
    image.write_bytes(image.read_bytes()[:200])
    words = ["detect", drive, "--detector", "lane-filter", "--out", tmp_path / "o.csv", "--skip-unreadable"]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0 and "000035.jpg" in result.stderr
    assert len((tmp_path / "o.csv").read_text().splitlines()) == 71


@pytest.mark.parametrize("verb", ["map", "detect"])
def test_a_camera_of_another_resolution(tmp_path, drive, verb):
    write_camera(tmp_path / "other.yaml", camera(80, 60), "made up")
    words = {
        "map": ("--lane-width", 40, "--out", tmp_path / "m"),
        "detect": ("--detector", "lane-filter", "--out", tmp_path / "o.csv"),
    }[verb]
    line = run(tmp_path, verb, drive, "--camera", tmp_path / "other.yaml", *words)
    assert "80x60" in line and "64x48" in line


def test_a_nan_in_a_table(tmp_path, drive):
    table = drive / "frames.csv"
    table.write_text(table.read_text().replace("000012.jpg,0.6,", "000012.jpg,nan,"))
    line = run(tmp_path, "map", drive, "--lane-width", 40, "--out", tmp_path / "m")
    assert "frames.csv" in line and "line 14" in line and "'t_s'" in line


def test_a_camera_file_with_a_nan(tmp_path, drive):
    path = drive / "camera.yaml"
    data = yaml.safe_load(path.read_text())
    data["mounting"]["height_cm"] = float("nan")
    path.write_text(yaml.safe_dump(data))
    line = run(tmp_path, "map", drive, "--lane-width", 40, "--out", tmp_path / "m")
    assert "camera.yaml" in line and "height_cm" in line and "NaN" in line


@pytest.mark.parametrize("text", ["5:2", "5", ":", "5:", "-3:7", "1.5:7", "\u00b2:\u00b2", "a:b"])
def test_a_range_of_frames_that_is_none(tmp_path, drive, text):
    line = run(
        tmp_path, "detect", drive, "--detector", "hough", "--out", tmp_path / "o.csv", "--frames", text
    )
    assert "FIRST:LAST" in line and text in line


def test_frames_that_the_drive_does_not_have(tmp_path, drive):
    words = ("detect", drive, "--detector", "hough", "--out", tmp_path / "o.csv", "--frames", "500:600")
    line = run(tmp_path, *words)
    assert "500" in line and "0 to 69" in line


def test_an_output_that_cannot_be_written_is_found_before_the_work(tmp_path, drive):
    (tmp_path / "folder.csv").mkdir()
    for out, what in (("folder.csv", "is a folder"), ("drive/frames.csv/o.csv", "frames.csv is a file")):
        # A drive that is not there would be found next.
        words = ("detect", tmp_path / "nowhere", "--detector", "hough", "--out", tmp_path / out)
        assert what in run(tmp_path, *words)
    words = ("detect", drive, "--detector", "hough", "--out", tmp_path / "o.csv")
    assert "is a folder" in run(tmp_path, *words, "--video", make_folder(tmp_path / "v.mp4"))


def make_folder(path):
    path.mkdir()
    return path


def test_a_map_without_its_drive(tmp_path):
    (tmp_path / "m").mkdir()
    assert "map.yaml" in run(tmp_path, "label", tmp_path / "m", "--out", tmp_path / "l.parquet")


def test_outputs_that_are_not_ours_are_kept(tmp_path, drive):
    keep = tmp_path / "keep"
    keep.mkdir()
    (keep / "thesis.txt").write_text("years of work")
    result = CliRunner().invoke(app, ["map", str(drive), "--lane-width", "40", "--out", str(keep)])
    assert result.exit_code == 1 and (keep / "thesis.txt").read_text() == "years of work"


def test_a_drive_that_shows_nothing_is_not_mapped(tmp_path, drive):
    shutil.rmtree(drive / "images")
    (drive / "images").mkdir()
    for k in range(70):
        cv2.imwrite(str(drive / "images" / f"{k:06d}.jpg"), np.full((48, 64, 3), 90, np.uint8))
    line = run(tmp_path, "map", drive, "--lane-width", 40, "--out", tmp_path / "m")
    assert "the car stands still" in line and "mapping needs a moving car" in line


STRAIGHT = {"straight": {"length_cm": 300}}


def bend(radius_cm, angle_deg, direction="left", **more):
    return {"arc": {"radius_cm": radius_cm, "angle_deg": angle_deg, "direction": direction, **more}}


#: What a road's file holds, and what the one line must name beside the file.
BAD_ROADS = {
    "a figure of eight": (
        {"pieces": [STRAIGHT, bend(80, 270), STRAIGHT, bend(80, 270, "right")]},
        ("pieces.0 (straight", "pieces.2 (straight", "meets itself"),
    ),
    "lanes that overlap": (
        {"pieces": [STRAIGHT, bend(70, 180), bend(70, 90), bend(70, 80)], "lanes": 2, "lane_width_cm": 40},
        ("pieces.", "meets itself"),
    ),
    "no radius left inside": (
        {"pieces": [STRAIGHT, bend(15, 90), STRAIGHT]},
        ("'pieces.1.arc.radius_cm'", "15"),
    ),
    "no lane": ({"lane_width_cm": 0}, ("'lane_width_cm'", "found 0")),
    "no tape": ({"line_width_cm": 0}, ("'line_width_cm'", "found 0")),
    "no dash": ({"right": {"kind": "dashed", "dash_cm": 0}}, ("'right.dash_cm'", "found 0")),
    "a misspelt key": ({"lane_wdth_cm": 40}, ("'lane_wdth_cm'", "'lane_width_cm'")),
    "an unknown key of a piece": (
        {"pieces": [STRAIGHT, bend(80, 90, colour="red")]},
        ("'pieces.1.arc.colour'", "radius_cm"),
    ),
    "an unknown piece": ({"pieces": [STRAIGHT, {"ark": {}}]}, ("'pieces.1.ark'", "'arc'")),
    "not a mapping": ([1, 2], ("mapping", "list")),
}
#: The car of the defaults turns 53.8 cm.
TOO_TIGHT = {"pieces": [STRAIGHT, bend(45, 90), {"straight": {"length_cm": 500}}]}


def road_words(tmp_path, verb, data):
    """The command by which a verb meets a road's file."""
    road, config = tmp_path / "road.yaml", tmp_path / "drive.yaml"
    road.write_text(yaml.safe_dump(data))
    config.write_text("frames: 3\ncamera: {width: 48, height: 36}\n")
    return {
        "track": ("track", road, "--out", tmp_path / "road.png"),
        "simulate": ("simulate", config, f"track.file={road}", "--out", tmp_path / "d"),
        "judge": ("judge", "--detectors", "truth", "--tracks", road, "--out", tmp_path / "j"),
    }[verb]


@pytest.mark.parametrize("verb", ["track", "simulate", "judge"])
@pytest.mark.parametrize("kind", BAD_ROADS)
def test_a_bad_road_is_refused_by_file_and_place(tmp_path, kind, verb):
    data, named = BAD_ROADS[kind]
    line = run(tmp_path, *road_words(tmp_path, verb, data))
    for word in ("road.yaml", *named):
        assert word in line


@pytest.mark.parametrize("verb", ["simulate", "judge"])
def test_a_bend_that_the_car_cannot_turn_is_refused_by_piece_and_car(tmp_path, verb):
    line = run(tmp_path, *road_words(tmp_path, verb, TOO_TIGHT))
    for word in ("road.yaml", "radius 45.0 cm", "pieces.1 (arc", "at least 53.8", "wheelbase 26 cm"):
        assert word in line


def test_a_road_that_is_too_short_for_the_drive_is_named(tmp_path):
    words = road_words(tmp_path, "simulate", {"pieces": [STRAIGHT]})
    line = run(tmp_path, *words, "frames=300")
    assert "road.yaml" in line and "length_cm 300" in line and "fewer frames" in line


def test_the_other_lane_is_checked_where_it_is_driven(tmp_path):
    # 90 cm in the driven lane are 50 cm in the oncoming one, inside of a left bend.
    words = road_words(
        tmp_path, "simulate", {**TOO_TIGHT, "pieces": [STRAIGHT, bend(90, 90), STRAIGHT], "lanes": 2}
    )
    line = run(tmp_path, *words, "driver.direction=backward")
    assert "radius 50.0 cm" in line and "road.yaml" in line
