from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import record, write_tub

from lanenet.data.drives import open_drive
from lanenet.errors import DriveFormatError


def test_a_clean_tub(tmp_path: Path) -> None:
    drive = open_drive(write_tub(tmp_path / "tub", [record(k) for k in range(7)], [2, 3], per_catalog=4))
    assert (drive.name, len(drive), drive.width, drive.height) == ("tub", 7, 16, 12)
    assert drive.problems == ()
    assert drive.times_trusted
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(7))
    assert np.flatnonzero(drive.deleted).tolist() == [2, 3]
    assert drive.commands.angle is not None
    assert drive.commands.throttle is not None
    # Donkeycar's sign stays: -1 is full left.
    assert drive.commands.angle.tolist() == [-0.25] * 7
    np.testing.assert_allclose(drive.commands.throttle, 0.01 * np.arange(7))
    assert drive.commands.steering_rad is None
    assert not drive.breaks.any()
    assert drive.image(6).shape == (12, 16, 3)


def test_broken_rows_are_counted_and_named(tmp_path: Path) -> None:
    rows: list[dict[str, Any] | str] = [record(k) for k in range(10)]
    rows[2] = '{"_index": 2, "cam/image_ar'
    rows[3] = "\0\0\0\0"
    rows[4] = json.dumps({"_index": 4, "user/angle": 0.0})
    rows[5] = json.dumps(record(5, **{"_index": "five"}))
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.frames.tolist() == [0, 1, 6, 7, 8, 9]
    assert not drive.breaks.any()
    assert len(drive.problems) == 1
    assert "catalog_0.catalog: 4 rows are not JSON" in drive.problems[0]
    assert "first: row 3" in drive.problems[0]


def test_rows_that_repeat_or_go_back_are_left_out(tmp_path: Path) -> None:
    rows: list[dict[str, Any] | str] = [record(k) for k in (0, 1, 1, 0, 2, 3)]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.frames.tolist() == [0, 1, 2, 3]
    assert "2 rows repeat an index or an image, or go back" in drive.problems[0]


def test_an_overwritten_image_belongs_to_the_last_row_that_names_it(tmp_path: Path) -> None:
    """After a power cut, Donkeycar counts on from an old index."""
    rows: list[dict[str, Any] | str] = [record(k, **{"user/angle": -0.5}) for k in range(10)]
    late = {"_session_id": "24-01-01_1", "user/angle": 0.5}
    rows += [record(k, _timestamp_ms=1700000060000 + 50 * k, **late) for k in range(5, 15)]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.frames.tolist() == list(range(15))
    assert drive.commands.angle is not None and drive.commands.angle.tolist() == [-0.5] * 5 + [0.5] * 10
    assert np.flatnonzero(drive.breaks).tolist() == [5]
    assert "5 rows repeat" in drive.problems[0]


@pytest.mark.parametrize(
    "indexes", [[0, 2, 4, 6] * 2, [*range(0, 40, 2), *range(1, 40, 2)], [0, 5, 10] * 10, [0] * 8]
)
def test_rows_that_are_counted_anew_in_any_steps_stay(tmp_path: Path, indexes: list[int]) -> None:
    rows: list[dict[str, Any] | str] = [
        record(k, _index=index, **{"cam/image_array": f"{k}.jpg"}) for k, index in enumerate(indexes)
    ]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    np.testing.assert_allclose(drive.commands.throttle, 0.01 * np.arange(len(indexes)))
    assert "'_index' begins anew" in drive.problems[0]


@pytest.mark.parametrize("before", ["/home/pi/tub{}/images/", "C:\\car\\tub{}\\images\\"])
def test_images_of_two_tubs_under_one_name_belong_to_no_row(tmp_path: Path, before: str) -> None:
    path = write_tub(tmp_path / "tub", [record(k) for k in range(6)])
    named = [
        record(k, **{"cam/image_array": before.format(k // 4) + f"{k % 4}_cam_image_array_.jpg"})
        for k in range(6)
    ]
    (path / "catalog_0.catalog").write_text("\n".join(map(json.dumps, named)))
    drive = open_drive(path)
    assert drive.frames.tolist() == [2, 3]
    assert "4 of 6 rows name images in several folders" in drive.problems[0]


def test_missing_images_are_counted_and_named(tmp_path: Path) -> None:
    path = write_tub(tmp_path / "tub", [record(k) for k in range(6)])
    for k in (0, 4):
        (path / "images" / f"{k}_cam_image_array_.jpg").unlink()
    drive = open_drive(path)
    assert drive.frames.tolist() == [1, 2, 3, 5]
    assert not drive.breaks.any()
    assert "2 of 6 images are missing (first: frame 0, 0_cam_image_array_.jpg)" in drive.problems[0]


def test_a_corrupt_image_is_named(tmp_path: Path) -> None:
    path = write_tub(tmp_path / "tub", [record(k) for k in range(3)])
    (path / "images" / "1_cam_image_array_.jpg").write_bytes(b"\xff\xd8\xff\xdacut")
    with pytest.raises(DriveFormatError, match=r"frame 1: .*1_cam_image_array_\.jpg: not a readable image"):
        open_drive(path).image(1)


def test_rows_without_an_angle_stay_and_are_counted(tmp_path: Path) -> None:
    rows: list[dict[str, Any] | str] = [record(k) for k in range(4)]
    rows[1] = record(1, **{"user/angle": None})
    rows[3] = record(3, **{"user/angle": float("nan")})
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.commands.angle is not None
    np.testing.assert_array_equal(drive.commands.angle, [-0.25, np.nan, -0.25, np.nan])
    assert "2 of 4 rows have no angle (first: frame 1)" in drive.problems[0]


def test_the_pilots_commands_count_when_the_pilot_drove(tmp_path: Path) -> None:
    pilot = {"pilot/angle": 0.5, "pilot/throttle": 0.9}
    rows: list[dict[str, Any] | str] = [
        record(k, **{"user/mode": mode, **pilot}) for k, mode in enumerate(["user", "local_angle", "local"])
    ]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.commands.angle is not None
    assert drive.commands.throttle is not None
    assert drive.commands.angle.tolist() == [-0.25, 0.5, 0.5]
    np.testing.assert_allclose(drive.commands.throttle, [0.0, 0.01, 0.9])


def test_what_moved_the_car_counts_in_tubs_of_the_template_cv_control(tmp_path: Path) -> None:
    """It writes neither the person's nor the pilot's commands, and no mode."""
    rows: list[dict[str, Any] | str] = [
        {key: value for key, value in record(k).items() if not key.startswith("user/")}
        | {"steering": -0.1 * k, "throttle": 0.2}
        for k in range(3)
    ]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.commands.angle is not None
    assert drive.commands.throttle is not None
    np.testing.assert_allclose(drive.commands.angle, [0.0, -0.1, -0.2])
    np.testing.assert_allclose(drive.commands.throttle, 0.2)
    assert not drive.problems


def test_useless_timestamps_are_replaced_and_said_so(tmp_path: Path) -> None:
    rows: list[dict[str, Any] | str] = [record(k, _timestamp_ms=3 * k) for k in range(2, 8)]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert not drive.times_trusted
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(6))
    assert "100 % of the steps" in drive.problems[0]


@pytest.mark.parametrize(
    ("stamps", "reason"),
    [
        ([0, 50, 40, 90, 80, 130], "do not increase 2 times, first at frame 2"),
        ([0, 50, 51, 101, 102, 152, 202, 252], "29 % of the steps"),
        ([0, 50, None, 150], "1 rows have none"),
    ],
)
def test_irregular_timestamps_are_not_trusted(tmp_path: Path, stamps: list[int | None], reason: str) -> None:
    rows: list[dict[str, Any] | str] = [record(k, _timestamp_ms=stamp) for k, stamp in enumerate(stamps)]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert not drive.times_trusted
    assert reason in drive.problems[0]
    assert (np.diff(drive.t_s) > 0.0).all()


def test_long_steps_are_gaps_of_the_recording(tmp_path: Path) -> None:
    """Recorded only while the throttle is pressed: half of the steps leave out five frames."""
    stamps = np.cumsum(np.tile([50, 300], 20))
    rows: list[dict[str, Any] | str] = [record(k, _timestamp_ms=int(t)) for k, t in enumerate(stamps)]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.times_trusted and not drive.problems
    np.testing.assert_allclose(np.diff(drive.t_s), np.diff(stamps) / 1000.0)


@pytest.mark.parametrize("back_ms", [0, 10, 86_400_000])
def test_a_clock_that_was_set_back_once_goes_on(tmp_path: Path, back_ms: int) -> None:
    stamps = 1_700_000_000_000 + 50 * np.arange(20)
    stamps[7:] -= back_ms + 50
    rows: list[dict[str, Any] | str] = [record(k, _timestamp_ms=int(t)) for k, t in enumerate(stamps)]
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.times_trusted and "frame 7" in drive.problems[0]
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(20))


def test_a_new_session_and_a_pause_are_breaks(tmp_path: Path) -> None:
    rows: list[dict[str, Any] | str] = [record(k) for k in range(9)]
    for k in range(3, 9):
        rows[k] = record(k, _session_id="24-01-01_1")
    for k in range(7, 9):
        rows[k] = record(k, _session_id="24-01-01_1", _timestamp_ms=1700000000000 + 50 * k + 2000)
    drive = open_drive(write_tub(tmp_path / "tub", rows))
    assert drive.times_trusted
    assert np.flatnonzero(drive.breaks).tolist() == [3, 7]


def test_shadow_files_of_a_mac_are_not_read(tmp_path: Path) -> None:
    path = write_tub(tmp_path / "tub", [record(k) for k in range(3)])
    (path / "._catalog_0.catalog").write_bytes(b"\0\5\x16\7Mac OS X\xff\xfe")
    manifest = (path / "manifest.json").read_text()
    names = '["catalog_0.catalog"]'
    (path / "manifest.json").write_text(
        manifest.replace(names, '["._catalog_0.catalog", "catalog_0.catalog"]')
    )
    drive = open_drive(path)
    assert len(drive) == 3
    assert drive.problems == ()


def test_a_lost_catalog_is_a_problem_only_if_others_are_there(tmp_path: Path) -> None:
    path = write_tub(tmp_path / "tub", [record(k) for k in range(8)], per_catalog=4)
    (path / "catalog_0.catalog").unlink()
    drive = open_drive(path)
    assert drive.frames.tolist() == [4, 5, 6, 7]
    assert drive.t_s[0] == 0.0
    assert "catalogs listed but not there: catalog_0.catalog" in drive.problems[0]
    (path / "catalog_1.catalog").unlink()
    with pytest.raises(DriveFormatError, match=r"catalog_0\.catalog, catalog_1\.catalog are not there"):
        open_drive(path)


def test_a_drive_yaml_in_the_tub_is_used(tmp_path: Path) -> None:
    path = write_tub(tmp_path / "tub", [record(k) for k in range(3)])
    (path / "drive.yaml").write_text("format: lanenet-drive/1\nlane_width_cm: 59\nmax_steering_rad: 0.4\n")
    drive = open_drive(path)
    assert (drive.lane_width_cm, drive.max_steering_rad) == (59.0, 0.4)


@pytest.mark.parametrize(
    ("name", "n", "n_deleted", "first", "trusted"),
    [
        ("donkey_circuit", 1000, 0, 0, False),
        ("usi_mat", 2000, 518, 0, True),
        ("garage_tape", 1500, 0, 2000, True),
    ],
)
def test_real_tubs(shared_data: Path, name: str, n: int, n_deleted: int, first: int, trusted: bool) -> None:
    drive = open_drive(shared_data / name)
    assert (len(drive), int(drive.deleted.sum()), int(drive.frames[0])) == (n, n_deleted, first)
    assert (drive.width, drive.height) == (160, 120)
    assert drive.times_trusted is trusted
    assert np.median(np.diff(drive.t_s)) == pytest.approx(0.05, abs=0.002)
    assert drive.commands.angle is not None
    assert np.abs(drive.commands.angle).max() <= 1.0
    assert np.isfinite(drive.commands.angle).all()
    for i in (0, n // 2, n - 1):
        assert drive.image(i).std() > 5.0


def test_a_path_beside_the_tub_is_answered_with_the_tub(tmp_path):
    write_tub(tmp_path / "tubs" / "mine", [record(k) for k in range(3)])
    with pytest.raises(DriveFormatError, match=r"folder above it: type .*mine"):
        open_drive(tmp_path / "tubs" / "mine" / "images")
    with pytest.raises(DriveFormatError, match=r"a drive in it: type .*mine"):
        open_drive(tmp_path / "tubs")
    # A Donkeycar's folder is two above its tubs.
    with pytest.raises(DriveFormatError, match=r"a drive in it: type .*mine"):
        open_drive(tmp_path)
    for k in range(4):
        write_tub(tmp_path / "tubs" / f"new {k}", [record(0)])
    with pytest.raises(
        DriveFormatError, match=r"drives in it: type .*mine, '.*new 0', '.*new 1' or another$"
    ):
        open_drive(tmp_path)
