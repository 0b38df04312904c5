"""``lanenet drive`` as a whole: settings, loop, guard and driver, judged by the bytes on a serial line."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from lanenet.data.drives.folder import DriveWriter
from lanenet.onboard.actuators.serial_board import REPORT_S, VERSION, LineReader, encode
from lanenet.onboard.bench import LANE_WIDTH_CM, example_camera, example_frames

STOPPED_US, FORWARD_US = 1500, 2000
#: Neutral this long after the end of the loop; the rest is the system, which wakes processes late.
ALLOWED_S, LATE_S = 0.1, 0.15


class Board:
    """The other end of the line: notes what it is told, and has no watchdog of its own that could help."""

    def __init__(self) -> None:
        #: It reports, but hears nothing: a line that fails in one direction.
        self.deaf = False
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave
        self.told: list[tuple[float, int]] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        reader, pulses, due_s, driving, sequence = LineReader(), (STOPPED_US, STOPPED_US), 0.0, 0, 0
        os.set_blocking(self._master, False)
        while not self._over.is_set():
            try:
                data = os.read(self._master, 4096)
            except BlockingIOError:
                data = b""
                time.sleep(0.001)
            for line in [] if self.deaf else reader.feed(data):
                if line.letter == "V":
                    self._say(encode("V", VERSION))
                elif line.letter in "NS":
                    pulses = (line.numbers[0], line.numbers[1])
                    driving = int(line.letter == "S")
                    sequence = line.numbers[2] if driving else sequence
                    self.told.append((time.monotonic(), line.numbers[1]))
            now_s = time.monotonic()
            if now_s >= due_s:
                due_s = now_s + REPORT_S
                self._say(encode("A", int(1e3 * now_s) % 2**32, sequence, 0, driving, *pulses))

    def _say(self, line: bytes) -> None:
        """Send a line; as on a wire, it is lost while the other end has not read what came before."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, line)

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def wait_for(self, driving: bool, after_s: float = 0.0, timeout_s: float = 60.0) -> float:
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            for t_s, throttle_us in list(self.told):
                if t_s >= after_s and (throttle_us > STOPPED_US) == driving:
                    return t_s
            time.sleep(0.005)
        raise AssertionError(f"not {'driving' if driving else 'neutral'} within {timeout_s} s")


@pytest.fixture
def board() -> Iterator[Board]:
    pytest.importorskip("serial", reason="pyserial is not installed")
    board = Board()
    yield board
    board.close()


def start(folder: Path, board: Board) -> subprocess.Popen[bytes]:
    camera = example_camera()
    with DriveWriter(folder / "drive", camera, LANE_WIDTH_CM) as writer:
        for k, frame in enumerate(example_frames(camera, 16, np.random.default_rng(0))):
            writer.add(frame, 0.05 * k)
    config = {
        "source": {
            "kind": "replay",
            "path": str(folder / "drive"),
            "rate_hz": 30,
            "loop": True,
            "may_drive": True,
        },
        "camera": str(folder / "drive" / "camera.yaml"),
        "detector": {"kind": "lane-filter", "lane_width_cm": LANE_WIDTH_CM},
        "control": {"steering": {"look_ahead_cm": 20.0}},
        "safety": {"countdown_s": 0.5},
        "actuator": {
            "kind": "serial",
            "port": board.port,
            "throttle_stopped_us": STOPPED_US,
            "throttle_forward_us": FORWARD_US,
        },
    }
    (folder / "car.yaml").write_text(yaml.safe_dump(config))
    with (folder / "log.txt").open("wb") as log:
        words = ["drive", str(folder / "car.yaml"), "--arm"]
        return subprocess.Popen([sys.executable, "-m", "lanenet", *words], stdout=log, stderr=log)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGSTOP])
def test_the_motor_stops_whatever_ends_the_loop(tmp_path: Path, board: Board, number: signal.Signals) -> None:
    process = start(tmp_path, board)
    try:
        begun_s = board.wait_for(driving=True)
        # Nothing but neutral before the countdown was over.
        assert {us for t_s, us in board.told if t_s < begun_s} == {STOPPED_US}
        time.sleep(0.3)
        struck_s = time.monotonic()
        process.send_signal(number)
        neutral_s = board.wait_for(driving=False, after_s=struck_s)
        assert neutral_s - struck_s <= ALLOWED_S + LATE_S
        time.sleep(1.0)
        assert {us for t_s, us in board.told if t_s >= neutral_s} == {STOPPED_US}
    finally:
        process.kill()
        code = process.wait()
    log = (tmp_path / "log.txt").read_text()
    assert {signal.SIGTERM: "neutral: SIGTERM"}.get(number, "lanenet guard: neutral") in log
    assert code == (0 if number == signal.SIGTERM else -signal.SIGKILL)


@pytest.mark.slow
def test_a_drive_whose_commands_arrive_nowhere_ends_and_says_so(tmp_path: Path, board: Board) -> None:
    process = start(tmp_path, board)
    try:
        board.wait_for(driving=True)
        board.deaf = True
        assert process.wait(10.0) == 1
    finally:
        process.kill()
        process.wait()
    log = (tmp_path / "log.txt").read_text()
    assert "accepted no command" in log and board.port in log


@pytest.mark.slow
def test_when_the_guard_is_killed_the_loop_sends_neutral_at_once(tmp_path: Path, board: Board) -> None:
    process = start(tmp_path, board)
    try:
        board.wait_for(driving=True)
        guard = int(Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()[0])
        struck_s = time.monotonic()
        os.kill(guard, signal.SIGKILL)
        neutral_s = board.wait_for(driving=False, after_s=struck_s)
        assert neutral_s - struck_s <= ALLOWED_S + LATE_S
        assert process.wait(10.0) == 1
        assert {us for t_s, us in board.told if t_s >= neutral_s} == {STOPPED_US}
    finally:
        process.kill()
        process.wait()
