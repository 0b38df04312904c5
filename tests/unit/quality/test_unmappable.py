"""Drives of which no map can be made end with what was found, what is needed and what to drive instead."""

from __future__ import annotations

import html
import math
import re
from pathlib import Path

import numpy as np
import pytest

from datagen.calibrate_drive import calibrate_drive
from datagen.check import check_lines_seen
from datagen.pipeline import MapRequest, map_drive
from datagen.prepare import check_edges, check_moving
from datagen.quality.residuals import Residuals
from datagen.settings import MapSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.files import check_replaceable
from lanenet.data.maps.folder import read_map
from lanenet.errors import (
    CalibrationError,
    DriveFormatError,
    LanenetError,
    MapFormatError,
    TrackingLostError,
)
from lanenet.perception.edges.canny import EdgeSettings

CAMERA = {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0}
SETTINGS = MapSettings(find_bumper=False)
INSTEAD, BETWEEN = "drive two laps of a closed track", "drive between two lines that the camera sees"


def simulated(folder: Path, frames: int, **lines: str) -> Path:
    track = {"interruptions_per_m": 0.0} | {side: {"kind": kind} for side, kind in lines.items()}
    settings = {"seed": 1, "frames": frames, "camera": CAMERA, "track": track}
    return simulate_drive(SimulationSettings.model_validate(settings), folder)


def written(folder: Path, frames: list[np.ndarray]) -> Path:
    with DriveWriter(folder) as writer:
        for k, frame in enumerate(frames):
            writer.add(frame, 0.05 * k, speed_cm_s=20.0)
    return folder


def refusal(drive: Path, out: Path, lane_width_cm: float = 40.0, remedy: str = INSTEAD) -> str:
    """Message of a drive that is not mapped; nothing may be left behind but its report."""
    with pytest.raises(TrackingLostError) as caught:
        map_drive(MapRequest(drive, lane_width_cm), SETTINGS, out)
    assert {path.name for path in out.iterdir()} == {"report.html", "refused.yaml"}
    assert not list(out.parent.glob(".*"))
    message = str(caught.value)
    assert str(drive) in message and remedy in message and str(out / "report.html") in message
    page = (out / "report.html").read_text(encoding="utf-8")
    assert message.split(": ", 1)[1].split(";")[0][1:] in html.unescape(page)
    assert f"What to do:</strong> {remedy.capitalize()}" in page
    hough = f"lanenet detect {drive} --detector hough --out {out}-hough.csv"
    assert any(hough in line for line in caught.value.hints) and hough in re.sub(
        "<[^>]+>", "", html.unescape(page)
    )
    # Raw frames, and the same with their edges.
    assert page.count("data:image/jpeg") >= 16
    with pytest.raises(MapFormatError, match=r"refused.*report\.html"):
        read_map(out)
    return message


@pytest.fixture(scope="module")
def both_lines(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("both") / "drive", 80, left="solid", right="solid")


def test_twenty_frames(tmp_path):
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (60, 80, 3), dtype=np.uint8) for _ in range(20)]
    assert "20 frames" in refusal(written(tmp_path / "drive", frames), tmp_path / "map")


@pytest.mark.parametrize("noise", [0.0, 2.0, 8.0])
def test_standing_still(tmp_path, both_lines, noise):
    """The same image over and over, with the sensor's noise, and a lamp that flickers."""
    rng = np.random.default_rng(0)
    still = open_drive(both_lines).image(20).astype(float)
    frames = [
        np.clip(still + rng.normal(0.0, noise, still.shape) + rng.uniform(-3.0, 3.0), 0, 255).astype(np.uint8)
        for _ in range(70)
    ]
    assert "stands still" in refusal(written(tmp_path / "drive", frames), tmp_path / "map")


def test_no_camera_is_found_from_a_drive_that_stands_still(tmp_path, both_lines):
    """A few frames differ from their neighbours, as with a lamp that is switched."""
    rng = np.random.default_rng(0)
    still = open_drive(both_lines).image(20).astype(float)
    brighter = 20.0 * (np.arange(210) % 9 == 0)
    frames = [
        np.clip(still + rng.normal(0.0, 4.0, still.shape) + b, 0, 255).astype(np.uint8) for b in brighter
    ]
    drive = written(tmp_path / "drive", frames)
    with pytest.raises(CalibrationError, match=rf"{drive}: the car stands still.*\. {INSTEAD.capitalize()}"):
        calibrate_drive(drive, 40.0, None, None, SETTINGS)


def test_a_camera_file_that_is_not_there_is_no_fault_of_the_drive(tmp_path):
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (60, 80, 3), dtype=np.uint8) for _ in range(20)]
    drive, camera = written(tmp_path / "drive", frames), tmp_path / "absent.yaml"
    with pytest.raises(CalibrationError, match=rf"^{camera}: no such file$"):
        map_drive(MapRequest(drive, 40.0, camera_path=camera), SETTINGS, tmp_path / "map")
    assert not (tmp_path / "map").exists()


def older_map(folder: Path, verdict: str) -> Path:
    folder.mkdir()
    (folder / "map.yaml").write_text(f"format: lanenet-map/1\nverdict: {verdict}\n")
    return folder


def test_an_older_map_is_kept_and_named_where_the_new_one_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (60, 80, 3), dtype=np.uint8) for _ in range(20)]
    drive, out = written(tmp_path / "drive", frames), older_map(tmp_path / "map", "usable")
    with pytest.raises(TrackingLostError, match=rf"20 frames.*map at {out} is an older one.*verdict: usable"):
        map_drive(MapRequest(drive, 40.0), SETTINGS, out)
    assert "usable" in (out / "map.yaml").read_text()
    assert {path.name for path in out.iterdir()} == {"map.yaml", "report-refused.html"}


def test_the_report_of_a_refusal_makes_room_for_the_next_and_for_a_map(tmp_path):
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (60, 80, 3), dtype=np.uint8) for _ in range(20)]
    refusal(written(tmp_path / "drive", frames), tmp_path / "map")
    assert "19 frames" in refusal(written(tmp_path / "other", frames[1:]), tmp_path / "map")
    check_replaceable(tmp_path / "map", "map")
    with pytest.raises(LanenetError, match=r"no drive\.yaml"):
        check_replaceable(tmp_path / "map", "drive")


def test_a_recording_of_damaged_images_has_a_report_and_none_at_all_has_none(tmp_path):
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (60, 80, 3), dtype=np.uint8) for _ in range(20)]
    drive, out = written(tmp_path / "drive", frames), tmp_path / "map"
    for k in (3, 7, 11):
        (drive / "images" / f"{k:06d}.jpg").write_bytes(b"")
    with pytest.raises(DriveFormatError, match=rf"000003\.jpg.*{out / 'report.html'}"):
        map_drive(MapRequest(drive, 40.0), SETTINGS, out)
    assert "000003.jpg" in (out / "report.html").read_text(encoding="utf-8")
    with pytest.raises(DriveFormatError, match="nowhere"):
        map_drive(MapRequest(tmp_path / "nowhere", 40.0), SETTINGS, tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_where_no_map_can_be_written_none_is_made(tmp_path):
    """Said before the drive is opened."""
    foreign = tmp_path / "notes"
    foreign.mkdir()
    (foreign / "x.txt").write_text("x")
    with pytest.raises(LanenetError, match=r"notes: the folder is not empty and holds no map.yaml"):
        map_drive(MapRequest(tmp_path / "nowhere", 40.0), SETTINGS, foreign)
    with pytest.raises(LanenetError, match=r"x.txt: is a file, expected a folder"):
        map_drive(MapRequest(tmp_path / "nowhere", 40.0), SETTINGS, foreign / "x.txt")


def test_what_a_killed_run_left_goes_also_where_the_new_one_fails(tmp_path):
    left, other = older_map(tmp_path / ".map.0123abcd.tmp", "good"), older_map(tmp_path / "other", "good")
    with pytest.raises(DriveFormatError, match="nowhere"):
        map_drive(MapRequest(tmp_path / "nowhere", 40.0), SETTINGS, tmp_path / "map")
    assert not left.exists() and other.exists()


def test_a_moving_car_does_not_stand_still(both_lines):
    check_moving(open_drive(both_lines))


def test_real_drives_move_and_have_edges(shared_data):
    for name in ("donkey_circuit", "garage_tape", "usi_mat"):
        drive = open_drive(shared_data / name)
        check_moving(drive)
        check_edges(drive, EdgeSettings())


def test_a_bare_floor_has_no_edges(tmp_path):
    ramp = np.tile(np.linspace(60, 75, 80).astype(np.uint8)[None, :, None], (60, 1, 3))
    frames = [np.roll(ramp, k, axis=1) // 2 + k % 40 for k in range(70)]
    drive = open_drive(written(tmp_path / "drive", [f.astype(np.uint8) for f in frames]))
    with pytest.raises(TrackingLostError, match=r"edge points.*expected 20"):
        check_edges(drive, EdgeSettings())


def test_one_line_only(tmp_path):
    drive = simulated(tmp_path / "drive", 80, left="none", right="solid")
    message = refusal(drive, tmp_path / "map", remedy=BETWEEN)
    assert "one line only" in message and "right one along 9" in message


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "frames"), [(7, 300), (9, 200)])
def test_one_line_beside_which_a_streak_or_bare_floor_is_traced(tmp_path, seed, frames):
    """Held-out frames show where a second line was traced that is none."""
    settings = {"seed": seed, "frames": frames, "track": {"left": {"kind": "none"}}}
    drive = simulate_drive(SimulationSettings.model_validate(settings), tmp_path / "drive")
    assert "one line only" in refusal(drive, tmp_path / "map", remedy=BETWEEN)


def border(met: float, spread_px: float, seed: int) -> np.ndarray:
    """Residuals at places on a line, of which a share met edges this far off."""
    rng, n = np.random.default_rng(seed), 2000
    return np.where(rng.random(n) < met, rng.uniform(-spread_px, spread_px, n), np.nan)


def seen(residuals: Residuals, *args) -> None:
    """Nothing is withheld."""
    check_lines_seen(residuals, residuals, *args)


GOOD, NONE = border(0.97, 0.3, 0), np.full(10, np.nan)


def test_a_line_that_meets_edges_by_chance_is_none(both_lines):
    drive = open_drive(both_lines)
    seen(Residuals(GOOD, GOOD, NONE), drive, 40.0, None)
    # A worn line is found along little of its length, but where it is.
    worn = border(0.1, 1.0, 1)
    seen(Residuals(worn, GOOD, NONE), drive, 40.0, None)
    # But not where the middle of the lane, on a mottled floor, meets as many.
    with pytest.raises(TrackingLostError, match=r"one line only .*of the left line"):
        seen(Residuals(worn, GOOD, border(0.08, 3.0, 2)), drive, 40.0, None)
    # A map that is bent is looked at, and rejected.
    seen(Residuals(border(0.9, 4.0, 1), GOOD, NONE), drive, 40.0, None)
    met_by_chance = border(0.25, 4.0, 1)
    with pytest.raises(
        TrackingLostError, match=r"one line only .* 2\d % of the left line.* 2\.\d px.*of the left line"
    ):
        seen(Residuals(met_by_chance, GOOD, NONE), drive, 40.0, None)
    with pytest.raises(TrackingLostError, match=r"no lane: .*of the left and the right line"):
        seen(Residuals(met_by_chance, border(0.3, 4.0, 2), NONE), drive, 40.0, None)
    with pytest.raises(TrackingLostError, match=r"no lane: .*along 1. %"):
        seen(Residuals(border(0.15, 4.0, 1), border(0.15, 4.0, 2), NONE), drive, 40.0, None)


def test_what_is_withheld_of_a_line_tells_whether_it_is_one(both_lines):
    drive = open_drive(both_lines)
    false, kept = border(0.2, 4.0, 1), border(0.55, 3.0, 2)
    with pytest.raises(TrackingLostError, match="one line only"):
        check_lines_seen(Residuals(false, GOOD, NONE), Residuals(kept, GOOD, NONE), drive, 40.0, None)
    # A worn line on a mottled floor, of which the bare parts are withheld.
    worn, floor = border(0.17, 0.3, 1), border(0.11, 3.0, 3)
    kept = Residuals(border(0.25, 0.3, 2), GOOD, border(0.07, 3.0, 3))
    check_lines_seen(Residuals(worn, GOOD, floor), kept, drive, 40.0, None)


def test_a_line_that_meets_edges_by_chance_where_a_lane_of_another_width_is(both_lines):
    with pytest.raises(CalibrationError, match=r"no two lines 20 cm apart .* 40 cm apart"):
        seen(Residuals(border(0.25, 4.0, 1), GOOD, NONE), open_drive(both_lines), 20.0, 40.2)


def test_no_line_at_all(tmp_path):
    drive = simulated(tmp_path / "drive", 80, left="none", right="none")
    message = refusal(drive, tmp_path / "map", remedy=BETWEEN)
    assert re.search("no lane|no line|no pair of lines|no two lines", message)


@pytest.mark.parametrize("given_cm", [20.0, pytest.param(80.0, marks=pytest.mark.slow)])
def test_a_lane_width_wrong_by_two_is_found_where_the_camera_is_known(tmp_path, both_lines, given_cm):
    with pytest.raises(
        CalibrationError, match=rf"{given_cm:g} cm apart .* (39|40|41) cm apart .*camera's height"
    ):
        map_drive(MapRequest(both_lines, given_cm), SETTINGS, tmp_path / "map")
    page = (tmp_path / "map" / "report.html").read_text(encoding="utf-8")
    assert "with this camera.</p>" in page and "What to do:</strong> Check the lane width and the" in page
