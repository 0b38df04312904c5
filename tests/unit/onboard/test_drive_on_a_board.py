"""The whole car: `lanenet drive --arm`, its guard, the serial line and the firmware's watchdog."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from board_process import BoardProcess, build_host_board

from lanenet.data.camera_file import read_camera
from lanenet.data.drives.folder import DriveWriter
from lanenet.onboard.bench import example_frames

ROOT = Path(__file__).resolve().parents[3]
CHECKPOINT = ROOT / "checkpoints" / "small"
NEUTRAL = (1530.0, 1510.0)


@pytest.fixture
def board(tmp_path):
    pytest.importorskip("serial", reason="pyserial is not installed")
    board = BoardProcess([build_host_board(tmp_path)], tmp_path)
    yield board
    board.stop()


@pytest.fixture
def car(board, tmp_path):
    """A car that sees a painted lane again and again."""
    frames = example_frames(read_camera(CHECKPOINT / "camera.yaml"), 40, np.random.default_rng(1))
    with DriveWriter(tmp_path / "drive") as writer:
        for i, frame in enumerate(frames):
            writer.add(frame, 0.04 * i)
    data = {
        "source": {"kind": "replay", "path": str(tmp_path / "drive"), "loop": True, "may_drive": True},
        "camera": str(CHECKPOINT / "camera.yaml"),
        "detector": {"kind": "network", "model": str(CHECKPOINT / "model.onnx")},
        "control": {"steering": {"look_ahead_cm": 15.0}},
        "safety": {"countdown_s": 0.2, "max_age_s": 0.3},
        "actuator": {"kind": "serial", "port": board.port},
    }
    (tmp_path / "car.yaml").write_text(yaml.safe_dump(data))
    words = [sys.executable, "-m", "lanenet", "drive", tmp_path / "car.yaml", "--arm"]
    with (tmp_path / "log").open("w") as log:
        process = subprocess.Popen(words, stdout=log, stderr=log, cwd=ROOT)
    yield process
    process.kill()
    process.wait()


def wait_until_it_drives(board, car, timeout_s=60.0):
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        assert car.poll() is None, (board.log.parent / "log").read_text()[-800:]
        # Each frame shows another bend, so the wheels do not rest.
        if len(board.lines()) > 8 and board.pulses()[0][1] > NEUTRAL[1] + 20:
            return
        time.sleep(0.005)
    raise AssertionError(f"the car did not start: {(board.log.parent / 'log').read_text()[-800:]}")


@pytest.mark.slow
def test_boards_watchdog_outlives_the_loop_and_its_guard(board, car):
    wait_until_it_drives(board, car)
    children = Path(f"/proc/{car.pid}/task/{car.pid}/children").read_text().split()
    assert children, "the guard is a process of its own"
    os.kill(car.pid, signal.SIGSTOP)
    for child in children:
        os.kill(int(child), signal.SIGKILL)
    car.kill()
    killed_s = time.monotonic()
    assert board.wait_for(NEUTRAL) - killed_s < 0.15


@pytest.mark.slow
def test_signal_ends_in_neutral(board, car):
    wait_until_it_drives(board, car)
    said_s = time.monotonic()
    car.send_signal(signal.SIGTERM)
    assert board.wait_for(NEUTRAL) - said_s < 0.15
    assert car.wait(10.0) == 0
    assert board.pulses()[0] == NEUTRAL
