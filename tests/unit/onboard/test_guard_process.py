from __future__ import annotations

import json
import logging
import os
import signal
import socket
import sys

import i2c_emulator
import pytest

from lanenet.errors import HardwareError
from lanenet.onboard import guard_process
from lanenet.onboard.actuators import first_writes, make_actuator
from lanenet.onboard.actuators.pca9685 import PCA9685Settings
from lanenet.onboard.guard import GuardedActuator
from lanenet.onboard.i2c import lock_owners
from lanenet.onboard.neutral import CONFIRMED


def test_a_guard_that_dies_while_it_starts_leaves_no_motor_running(monkeypatch):
    bus = i2c_emulator.Bus(i2c_emulator.Chip())
    i2c_emulator.install(monkeypatch, bus)
    settings = PCA9685Settings()
    before = make_actuator(settings)
    before.open()
    before.send(0.0, 1.0)
    before.release()
    sink = GuardedActuator("{}", lambda: make_actuator(settings), 0.1, 1.0, (sys.executable, "-ISc", ""))
    with pytest.raises(HardwareError, match="died while it started"):
        sink.open()
    assert sink.close() == CONFIRMED and bus.chip.counts(0) == 370


def test_first_neutral_is_before_the_imports(monkeypatch):
    bus = i2c_emulator.Bus(i2c_emulator.Chip())
    i2c_emulator.install(monkeypatch, bus)
    seen = []

    def build(text):
        """Stands where the guard imports its driver."""
        seen.append((text, bus.chip.asleep, bus.chip.counts(0), lock_owners(os.fstat(bus.fd), 0x40)))
        raise HardwareError("this is far enough")

    ours, theirs = socket.socketpair()
    with ours:
        monkeypatch.setattr(signal, "signal", lambda *_: None)
        monkeypatch.setattr(logging, "basicConfig", lambda **_: None)
        heard, pulse = os.pipe()
        first = json.dumps(first_writes(PCA9685Settings()))
        assert guard_process.main([str(theirs.detach()), str(pulse), "{}", first, "0.1", "1"], build) == 1
        os.close(heard)
    assert seen == [("{}", False, 370, [os.getpid()])]
