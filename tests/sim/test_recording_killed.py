from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lanenet.data.drives import open_drive
from lanenet.onboard.bench import example_camera, example_frames

RATE_HZ = 60.0
#: A drive that records until it is killed; tells the number of each frame that it has handed over.
PROGRAM = """
import sys, time
from pathlib import Path
import cv2
from lanenet.data.drives.recorder import DriveRecorder, RecordingSettings
frames = [cv2.imread(str(p)) for p in sorted(Path(sys.argv[2]).glob("*.png"))]
recorder = DriveRecorder(Path(sys.argv[1]), RecordingSettings(queue_frames=30))
told = open(sys.argv[3], "w", buffering=1)
begin_s = time.monotonic()
for k in range(100000):
    time.sleep(max(0.0, begin_s + k / float(sys.argv[4]) - time.monotonic()))
    now_s = time.monotonic()
    recorder.add(frames[k % len(frames)], now_s, throttle=0.2)
    if recorder.recorded:
        told.write(f"{now_s - begin_s:.6f} {recorder.dropped}\\n")
"""


def kill_a_recording(folder: Path, pictures: Path, after_s: float) -> None:
    """Record, kill after a while, and look at what is left."""
    told = folder.with_suffix(".txt")
    arguments = [str(folder), str(pictures), str(told), str(RATE_HZ)]
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, *arguments])
    try:
        end_s = time.monotonic() + 60.0
        while not (told.exists() and told.read_text().count("\n") > 0):
            assert process.poll() is None and time.monotonic() < end_s, "the recording did not begin"
            time.sleep(0.02)
        time.sleep(after_s)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    lines = told.read_text().splitlines()
    last_s = float(lines[-1].split()[0])
    drive = open_drive(folder)
    assert drive.problems == ()
    for i in (0, len(drive) // 2, len(drive) - 1):
        assert drive.image(i).shape == (240, 320, 3)
    assert last_s - float(drive.t_s[-1]) <= 1.0, "more than the last second is lost"
    assert (np.diff(drive.t_s) > 0.0).all()


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    import cv2

    folder = tmp_path / "pictures"
    folder.mkdir()
    for k, frame in enumerate(example_frames(example_camera(), 4, np.random.default_rng(0))):
        cv2.imwrite(str(folder / f"{k}.png"), frame)
    return folder


@pytest.mark.parametrize("kills", [5, pytest.param(50, marks=pytest.mark.slow)])
def test_whenever_it_is_killed_the_drive_opens(tmp_path: Path, pictures: Path, kills: int) -> None:
    rng = np.random.default_rng(kills)
    for k in range(kills):
        kill_a_recording(tmp_path / f"drive{k}", pictures, float(rng.uniform(0.0, 1.5)))
        shutil.rmtree(tmp_path / f"drive{k}")
