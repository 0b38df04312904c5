from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from lanenet.data.drives.folder import DriveWriter
from lanenet.errors import HardwareError
from lanenet.onboard.cameras import open_source
from lanenet.onboard.cameras.replay import ReplaySettings
from lanenet.onboard.devices import FrameSource, SourceEnded

STEP_S = 0.04


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    with DriveWriter(tmp_path / "drive") as writer:
        for i in range(8):
            writer.add(np.full((24, 32, 3), 20 * i, np.uint8), 5.0 + STEP_S * i, throttle=0.2, angle=0.0)
    return tmp_path / "drive"


def values(source, count, timeout_s=1.0):
    frames = [source.read(timeout_s) for _ in range(count)]
    return [round(int(f.image_bgr[5, 5, 0]) / 20) for f in frames]


def test_fast_shows_every_frame_once(drive):
    source = open_source(ReplaySettings(path=drive, pace="fast"))
    assert isinstance(source, FrameSource)
    source.open()
    assert values(source, 8) == list(range(8))
    with pytest.raises(SourceEnded, match="all 8 frames"):
        source.read(0.0)
    source.close()
    with pytest.raises(HardwareError, match="not open"):
        source.read(0.0)


def test_loop_starts_again_and_counts_on(drive):
    source = open_source(ReplaySettings(path=drive, pace="fast", loop=True))
    source.open()
    frames = [source.read(0.0) for _ in range(20)]
    assert [f.number for f in frames] == list(range(20))
    assert [round(int(f.image_bgr[0, 0, 0]) / 20) for f in frames] == [i % 8 for i in range(20)]


def test_real_pace_keeps_the_recorded_times(drive):
    source = open_source(ReplaySettings(path=drive))
    start_s = time.monotonic()
    source.open()
    frames = [source.read(1.0) for _ in range(8)]
    assert [f.number for f in frames] == list(range(8))
    assert 7 * STEP_S <= time.monotonic() - start_s < 1.0
    steps = np.diff([f.t_s for f in frames])
    assert steps == pytest.approx([STEP_S] * 7, abs=1e-6)
    with pytest.raises(SourceEnded):
        source.read(1.0)


def test_real_pace_drops_what_comes_too_late(drive):
    source = open_source(ReplaySettings(path=drive, loop=True))
    source.open()
    source.read(1.0)
    time.sleep(2.5 * STEP_S)
    frame = source.read(1.0)
    assert frame.number in (2, 3)
    assert time.monotonic() - frame.t_s < 1.5 * STEP_S


def test_frame_that_is_not_due_is_none(drive):
    source = open_source(ReplaySettings(path=drive, rate_hz=2.0))
    source.open()
    assert source.read(0.0).number == 0
    start_s = time.monotonic()
    assert source.read(0.05) is None
    assert 0.04 < time.monotonic() - start_s < 0.4


def test_pause_of_the_recording_is_not_waited_for(tmp_path):
    with DriveWriter(tmp_path / "drive") as writer:
        for t_s in (0.0, 0.02, 0.04, 30.0, 30.02):
            writer.add(np.zeros((24, 32, 3), np.uint8), t_s, throttle=0.2, angle=0.0)
    source = open_source(ReplaySettings(path=tmp_path / "drive"))
    source.open()
    assert [source.read(0.5).number for _ in range(5)] == [0, 1, 2, 3, 4]


def test_unreadable_frame_is_left_out(drive, caplog):
    images = sorted(p for p in drive.rglob("*") if p.suffix in (".jpg", ".png"))
    images[3].write_bytes(b"")
    source = open_source(ReplaySettings(path=drive, pace="fast"))
    source.open()
    assert values(source, 7) == [0, 1, 2, 4, 5, 6, 7]
    assert images[3].name in caplog.text


def test_drive_whose_frames_all_vanish(drive):
    source = open_source(ReplaySettings(path=drive, pace="fast", loop=True))
    source.open()
    for path in drive.rglob("*.jpg"):
        path.unlink()
    with pytest.raises(HardwareError, match="none of the frames can be read"):
        source.read(0.1)


def test_video(tmp_path):
    path = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    for i in range(5):
        writer.write(np.full((48, 64, 3), 40 * i, np.uint8))
    writer.release()
    source = open_source(ReplaySettings(path=path, pace="fast"))
    source.open()
    assert [round(int(source.read(0.0).image_bgr[9, 9, 1]) / 40) for _ in range(5)] == list(range(5))


def test_missing_drive_is_named(tmp_path):
    with pytest.raises(HardwareError, match=r"replay: .*nothing: no such drive"):
        open_source(ReplaySettings(path=tmp_path / "nothing")).open()


def test_real_tub(shared_data):
    source = open_source(ReplaySettings(path=shared_data / "donkey_circuit", pace="fast"))
    source.open()
    frame = source.read(0.0)
    assert frame.image_bgr.shape == (120, 160, 3) and frame.image_bgr.std() > 10
