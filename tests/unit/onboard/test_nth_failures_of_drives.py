"""A whole drive with its guard, with each transfer, write, sync and allocation failing in turn."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import i2c_emulator
import numpy as np
import pytest
from board_process import BoardProcess, build_host_board
from nth_failure import DISK, MEMORY, Failure, every_failure, report

from lanenet.control.controller import ControlSettings, LaneController
from lanenet.control.steering import SteeringSettings
from lanenet.data.drives import open_drive
from lanenet.data.drives.recorder import DriveRecorder, RecordingSettings
from lanenet.errors import LanenetError
from lanenet.onboard.actuators import make_actuator
from lanenet.onboard.actuators.actuator import Actuator
from lanenet.onboard.actuators.pca9685 import PCA9685Settings
from lanenet.onboard.actuators.serial_board import SerialBoardSettings
from lanenet.onboard.devices import Frame, SourceEnded
from lanenet.onboard.guard import GuardedActuator
from lanenet.onboard.guard_process import Guard
from lanenet.onboard.loop import CarParts, DriveLoop, DriveMode
from lanenet.onboard.safety import LimitSettings, SafetySettings
from lanenet.perception.estimate import LaneEstimate

FRAMES, RATE_HZ = 6, 100.0
LANE = LaneEstimate(np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0]), confidence=1.0)


class Camera:
    def __init__(self) -> None:
        self._number = -1

    def open(self) -> None:
        self._begin_s = time.monotonic()

    def read(self, timeout_s: float) -> Frame:
        self._number += 1
        if self._number == FRAMES:
            raise SourceEnded
        threading.Event().wait(max(0.0, self._begin_s + self._number / RATE_HZ - time.monotonic()))
        return Frame(np.full((24, 32, 3), self._number, np.uint8), time.monotonic(), self._number)

    def close(self) -> None:
        pass


class Eye:
    def detect(self, frame_bgr: np.ndarray) -> LaneEstimate:
        return LANE

    def reset(self) -> None:
        pass


class GuardThread:
    """The guard's program as a thread of this process, so that the same failures strike it."""

    pid = 0

    def __init__(self, line: socket.socket, pulse: int, actuator: Actuator, safety: SafetySettings) -> None:
        self._line, self._pulse, self._actuator = line, pulse, actuator
        os.set_blocking(pulse, False)
        self._guard = Guard(line, pulse, actuator, safety.watchdog_s, safety.end_after_s)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._actuator.open()
            self._actuator.neutral()
            self._line.send(b"ready\n")
            self._guard.run()
        except LanenetError as error:
            self._line.send(f"failed {error}\n".encode())
        finally:
            self._actuator.neutral()
            self._actuator.close()
            self._line.send(b'closed [true, ""]\n')
            self._line.close()
            os.close(self._pulse)

    def wait(self, timeout_s: float) -> None:
        self._thread.join(30.0)
        assert not self._thread.is_alive()

    def kill(self) -> None:
        """Expect an end: its last word may have failed, too."""
        self._thread.join(5.0)
        assert not self._thread.is_alive(), "the guard hangs"


def drive(folder: Path, settings: PCA9685Settings | SerialBoardSettings) -> None:
    """Drive a few frames, armed, recorded, and with a guard."""
    safety = SafetySettings(countdown_s=0.0, max_age_s=0.5)
    sink = GuardedActuator("", lambda: make_actuator(settings), safety.watchdog_s, safety.end_after_s)
    recorder = DriveRecorder(folder, RecordingSettings(min_free_mb=0.0, sync_s=0.02))
    started: list[Any] = []

    def popen(*_: object, pass_fds: list[int], **__: object) -> GuardThread:
        line, pulse = (os.dup(number) for number in pass_fds)
        started.append(GuardThread(socket.socket(fileno=line), pulse, make_actuator(settings), safety))
        return started[0]

    control = ControlSettings(steering=SteeringSettings(wheelbase_cm=26.0))
    parts = CarParts(Camera(), Eye(), LaneController(control), sink, recorder)
    loop = DriveLoop(parts, safety, LimitSettings(), control.speed, DriveMode(armed=True))
    with mock.patch("lanenet.onboard.guard.subprocess.Popen", popen):
        loop.run()


def check_drives(tmp_path: Path, operate: Any, kinds: list[Any], at_neutral: Any) -> list[str]:
    """Drive with each call failing; returns what failed."""
    calls = []
    number = 0

    def run() -> None:
        nonlocal number
        number += 1
        operate(tmp_path / f"drive{number}")

    for failure in every_failure(run, kinds):
        calls.append(failure.call)
        shown = f"{failure.n}: {failure.call}: {failure.error!r}"
        assert failure.error is None or isinstance(failure.error, LanenetError | MemoryError), shown
        assert at_neutral(), f"the motor is not in neutral after {shown}"
        folder = tmp_path / f"drive{number}"
        if folder.exists():
            assert not open_drive(folder).problems, shown
    assert at_neutral() and len(open_drive(tmp_path / f"drive{number}")) == FRAMES
    return calls


@pytest.mark.slow
@pytest.mark.parametrize("glitches", [1, 3])
def test_on_a_pulse_generator(tmp_path: Path, glitches: int) -> None:
    """One transfer fails, which is repeated; or three, which is a call that fails."""
    chip = i2c_emulator.Chip()
    bus = i2c_emulator.Bus(chip)

    def transfers(stack: ExitStack, failure: Failure) -> None:
        real = bus.i2c_rdwr

        def call(*messages: Any) -> None:
            if bus.glitches <= 0 and failure.reach("transfer"):
                bus.glitches = glitches
            real(*messages)

        stack.enter_context(mock.patch.object(bus, "i2c_rdwr", call))

    settings = PCA9685Settings(max_steering_rad=0.4)
    neutral_us = settings.throttle_stopped_us or 0.0

    def operate(folder: Path) -> None:
        chip.power_on()
        chip.pulses.clear()
        drive(folder, settings)

    def at_neutral() -> bool:
        bus.glitches = 0
        return chip.asleep or abs(chip.pulse_us(settings.throttle_channel) - neutral_us) < 5.0

    with pytest.MonkeyPatch.context() as patch:
        i2c_emulator.install(patch, bus)
        calls = check_drives(tmp_path, operate, [transfers, DISK, MEMORY], at_neutral)
    assert max(counts for channel, counts in chip.pulses if channel == 0) > 370, "it never drove"
    report(f"drive, PCA9685, {glitches} at once", calls)
    assert calls.count("transfer") > 15 and len(calls) - calls.count("transfer") > 25


@pytest.fixture
def board(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BoardProcess]:
    pytest.importorskip("serial", reason="pyserial is not installed")
    folder = tmp_path_factory.mktemp("board")
    board = BoardProcess([build_host_board(folder)], folder)
    yield board
    board.stop()


@pytest.mark.slow
def test_on_a_serial_board(tmp_path: Path, board: BoardProcess) -> None:
    settings = SerialBoardSettings(port=board.port, max_steering_rad=0.4)

    def at_neutral() -> bool:
        end_s = time.monotonic() + 2.0
        while time.monotonic() < end_s:
            # The board's own neutral before the first command, and the car's.
            if not board.lines() or board.pulses()[0][1] in (1500.0, 1510.0):
                return True
            threading.Event().wait(0.002)
        return False

    calls = check_drives(tmp_path, lambda folder: drive(folder, settings), [DISK, MEMORY], at_neutral)
    on_the_line = [call for call in calls if call == f"write {Path(board.port).resolve().name}"]
    report(f"drive, serial board, {len(on_the_line)} on the line", calls)
    assert len(on_the_line) > 8
