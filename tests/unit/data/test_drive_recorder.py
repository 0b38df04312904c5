from __future__ import annotations

import errno
import logging
import os
import shutil
import threading
import time
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from lanenet.data.drives import open_drive
from lanenet.data.drives import recorder as drive_recorder
from lanenet.data.drives.folder import FRAMES_FILE
from lanenet.data.drives.recorder import DriveRecorder, RecordingSettings, new_drive_folder
from lanenet.errors import DriveFormatError, LanenetError
from lanenet.geometry.camera import Camera, Mounting

CAMERA = Camera(
    "pinhole",
    32,
    24,
    np.array([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]]),
    np.zeros(4),
    Mounting(20.0),
    26.0,
)


def picture(k: int) -> np.ndarray:
    return np.full((24, 32, 3), 5 * k % 250, np.uint8)


def settings(**changes: float) -> RecordingSettings:
    return RecordingSettings(**{"min_free_mb": 0.0, "sync_s": 0.05, "queue_frames": 200, **changes})


def record(path: Path, count: int, **changes: float) -> DriveRecorder:
    recorder = DriveRecorder(path, settings(**changes), CAMERA, 40.0, 0.45)
    for k in range(count):
        recorder.add(picture(k), 5000.0 + 0.05 * k, steering_rad=0.01 * k, throttle=0.2)
    recorder.close()
    return recorder


def test_a_recording_is_a_drive(tmp_path: Path) -> None:
    recorder = record(tmp_path / "one", 20)
    assert (recorder.recorded, recorder.dropped, recorder.problem) == (20, 0, "")
    drive = open_drive(tmp_path / "one")
    assert drive.problems == () and not drive.breaks.any()
    np.testing.assert_array_equal(drive.frames, np.arange(20))
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(20), atol=1e-6)
    np.testing.assert_allclose(drive.commands.steering_rad, 0.01 * np.arange(20))
    np.testing.assert_allclose(drive.commands.throttle, 0.2)
    assert drive.commands.speed_cm_s is None
    assert drive.camera is not None and drive.camera.hash == CAMERA.hash
    assert (drive.lane_width_cm, drive.max_steering_rad) == (40.0, 0.45)
    assert np.abs(drive.image(7).astype(int) - picture(7)).max() <= 2


def test_without_commands_there_are_no_columns_for_them(tmp_path: Path) -> None:
    recorder = DriveRecorder(tmp_path / "pushed", settings())
    recorder.add(picture(0), 1.0)
    recorder.close()
    assert (tmp_path / "pushed" / FRAMES_FILE).read_text() == "frame,t_s,file\n0,0.000000,images/000000.jpg\n"


def test_the_folder_is_a_drive_after_its_first_frame(tmp_path: Path) -> None:
    recorder = DriveRecorder(tmp_path / "one", settings(sync_s=1.0))
    recorder.add(picture(0), 1.0)
    end_s = time.monotonic() + 10.0
    while recorder.recorded == 0 and time.monotonic() < end_s:
        time.sleep(0.01)
    assert len(open_drive(tmp_path / "one")) == 1
    recorder.close()


def test_the_folders_name_is_forced_onto_the_card_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forced: list[Path] = []
    monkeypatch.setattr(drive_recorder, "sync_path", forced.append)
    record(tmp_path / "drives" / "one", 3)
    images = [path for path in forced if path.suffix == ".jpg"]
    assert images == [tmp_path / "drives" / "one" / "images" / f"00000{k}.jpg" for k in range(3)]
    # A new name lies in the folder above it.
    assert forced.count(tmp_path / "drives") == forced.count(tmp_path) == 1


def test_whatever_fails_the_recording_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    recorder = DriveRecorder(tmp_path / "one", settings())
    monkeypatch.setattr(drive_recorder, "image_name", lambda number: 1 / 0)
    with caplog.at_level(logging.WARNING):
        for k in range(3):
            recorder.add(picture(k), 0.05 * k)
        recorder.close()
    assert recorder.problem == "division by zero" and (recorder.recorded, recorder.dropped) == (0, 3)
    assert any("recording stopped after 0 frames: division by zero" in r.message for r in caplog.records)


def test_wherever_the_table_is_cut_the_drive_opens(tmp_path: Path) -> None:
    record(tmp_path / "whole", 4)
    table = (tmp_path / "whole" / FRAMES_FILE).read_bytes()
    second_row = table.index(b"\n1,")
    for length in range(second_row, len(table)):
        cut = tmp_path / "cut"
        shutil.copytree(tmp_path / "whole", cut)
        (cut / FRAMES_FILE).write_bytes(table[:length])
        drive = open_drive(cut)
        complete = table[:length].count(b"\n") - 1
        # A cut line is left out, or its image is missing, or only its line end is.
        assert complete <= len(drive) <= complete + 1
        if len(drive) == complete + 1 and not drive.problems:
            assert table[length : length + 1] == b"\n"
        shutil.rmtree(cut)


def test_zeros_of_a_power_cut_are_left_out(tmp_path: Path) -> None:
    record(tmp_path / "one", 4)
    with (tmp_path / "one" / FRAMES_FILE).open("ab") as stream:
        stream.write(bytes(100))
    drive = open_drive(tmp_path / "one")
    assert len(drive) == 4 and "last line is cut off" in drive.problems[0]
    # In the middle of the table they are an error as before.
    table = tmp_path / "one" / FRAMES_FILE
    table.write_bytes(table.read_bytes().rstrip(b"\0") + b"\0\0\n9,1.0,0,0,x.jpg\n")
    with pytest.raises(DriveFormatError, match=r"frames\.csv: line 6"):
        open_drive(tmp_path / "one")


def test_a_slow_card_holds_nobody_and_leaves_gaps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    holding, held = threading.Event(), threading.Event()

    def hold(_: object) -> None:
        holding.set()
        held.wait(10.0)

    monkeypatch.setattr(drive_recorder, "sync_path", hold)
    recorder = DriveRecorder(tmp_path / "one", settings(queue_frames=3))
    with caplog.at_level(logging.WARNING):
        recorder.add(picture(0), 0.0)
        assert holding.wait(10.0)
        longest_s = 0.0
        for k in range(1, 50):
            begin_s = time.monotonic()
            recorder.add(picture(k), 0.05 * k)
            longest_s = max(longest_s, time.monotonic() - begin_s)
        assert longest_s < 5.0  # the card holds for ten
        held.set()
        time.sleep(0.3)
        recorder.add(picture(50), 2.5)
        recorder.close()
    assert recorder.dropped >= 50 - 3 - 2 and recorder.recorded + recorder.dropped == 51
    drive = open_drive(tmp_path / "one")
    assert len(drive) == recorder.recorded and drive.frames[-1] == 50
    assert drive.breaks[-1], "what was left out has to show"
    assert sum("card is too slow" in r.message for r in caplog.records) == 1


def test_a_full_card_stops_the_recording_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    recorder = DriveRecorder(tmp_path / "one", settings())
    recorder.add(picture(0), 0.0)
    while recorder.recorded == 0:
        time.sleep(0.01)

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with caplog.at_level(logging.WARNING):
        monkeypatch.setattr(os, "write", full)
        for k in range(1, 30):
            recorder.add(picture(k), 0.05 * k)
            time.sleep(0.01)
        recorder.close()
        monkeypatch.undo()
    assert "No space left" in recorder.problem and recorder.recorded == 1 and recorder.dropped == 29
    assert any("driving goes on" in r.message and "No space left" in r.message for r in caplog.records)
    drive = open_drive(tmp_path / "one")
    assert len(drive) == 1 and drive.problems == ()
    # Images without a row are not left behind.
    assert [p.name for p in (tmp_path / "one" / "images").iterdir()] == ["000000.jpg"]


def test_a_row_that_fits_in_half_is_taken_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = DriveRecorder(tmp_path / "one", settings())
    recorder.add(picture(0), 0.0)
    while recorder.recorded == 0:
        time.sleep(0.01)
    before = (tmp_path / "one" / FRAMES_FILE).read_bytes()
    real = os.write
    monkeypatch.setattr(os, "write", lambda handle, data: real(handle, data[: len(data) // 2]))
    recorder.add(picture(1), 0.05)
    recorder.close()
    assert "full" in recorder.problem
    assert (tmp_path / "one" / FRAMES_FILE).read_bytes() == before


def test_little_room_is_left_for_others(tmp_path: Path) -> None:
    recorder = record(tmp_path / "one", 5, min_free_mb=1e12)
    assert "MB left, expected" in recorder.problem and (recorder.recorded, recorder.dropped) == (0, 5)


def test_frames_that_would_spoil_the_drive_are_left_out(tmp_path: Path) -> None:
    recorder = DriveRecorder(tmp_path / "one", settings())
    for t_s, image in ((0.0, picture(0)), (0.1, picture(1)), (0.1, picture(2)), (0.05, picture(3))):
        recorder.add(image, t_s, throttle=0.1)
    recorder.add(np.zeros((12, 16, 3), np.uint8), 0.2, throttle=0.1)
    recorder.add(picture(5), 0.3, throttle=float("nan"))
    recorder.add(picture(6), 0.4, throttle=0.1)
    recorder.close()
    drive = open_drive(tmp_path / "one")
    assert drive.frames.tolist() == [0, 1, 6] and recorder.dropped == 4 and drive.problems == ()


def test_every_drive_has_a_folder_of_its_own(tmp_path: Path) -> None:
    now = datetime(2024, 5, 6, 7, 8, 9)
    first = new_drive_folder(tmp_path, now)
    assert first.name == "drive-20240506-070809"
    record(first, 1)
    assert new_drive_folder(tmp_path, now).name == "drive-20240506-070809-2"
    with pytest.raises(LanenetError, match="cannot be recorded there"):
        DriveRecorder(first, settings())


def test_times_go_on_without_commands(tmp_path: Path) -> None:
    recorder = DriveRecorder(tmp_path / "pushed", settings())
    for k in range(3):
        recorder.add(picture(k), 7.0 + 0.1 * k)
    recorder.close()
    np.testing.assert_allclose(open_drive(tmp_path / "pushed").t_s, [0.0, 0.1, 0.2], atol=1e-6)


def test_a_drive_without_a_frame_leaves_no_folder(tmp_path: Path) -> None:
    DriveRecorder(tmp_path / "nothing", settings()).close()
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_was_killed_before_its_first_frame_goes(tmp_path: Path) -> None:
    """And no other: one that still runs, one with frames, photos, or what another program has locked."""
    frames, dead, tub, photos, running = (f"drive-{k}" for k in range(5))
    record(tmp_path / frames, 1)
    shutil.copytree(tmp_path / frames, tmp_path / dead)
    (tmp_path / dead / FRAMES_FILE).unlink()
    shutil.copytree(tmp_path / dead, tmp_path / tub)
    (tmp_path / tub / "manifest.json").touch()
    shutil.copytree(tmp_path / dead, tmp_path / photos)
    (tmp_path / photos / "images" / "mine.jpg").touch()
    shutil.copytree(tmp_path / dead, tmp_path / "other")
    for name in (dead, frames, "drive-gone", tub, photos, "other"):
        (tmp_path / f".{name}.lock").touch()
    kept = sorted([frames, tub, photos, running, "other", ".other.lock"])
    runs = DriveRecorder(tmp_path / running, settings())
    assert names(tmp_path) == sorted([*kept, f".{running}.lock"])
    DriveRecorder(tmp_path / "drive-9", settings()).close()
    assert names(tmp_path) == sorted([*kept, f".{running}.lock"])
    runs.add(picture(0), 0.0)
    runs.close()
    assert names(tmp_path) == kept


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())
