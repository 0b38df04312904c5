from __future__ import annotations

import json
import logging
import os
import signal
import socket

import i2c_emulator

from lanenet.errors import HardwareError
from lanenet.onboard import guard_process
from lanenet.onboard.actuators import first_writes
from lanenet.onboard.actuators.pca9685 import PCA9685Settings
from lanenet.onboard.i2c import lock_owners


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
