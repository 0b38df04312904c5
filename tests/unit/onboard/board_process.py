"""A board on a pseudo-terminal: the firmware's own code, compiled for this computer or for an Uno."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
import tty
from pathlib import Path

import pytest

HERE = Path(__file__).parent
SKETCH = HERE.parents[2] / "firmware" / "lanenet_uno"


class BoardProcess:
    """A board on a pseudo-terminal; notes when its pulses changed."""

    def __init__(self, command, tmp_path):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self.log = tmp_path / "pulses"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(command, stdin=self.master, stdout=self.master, stderr=log)

    def lines(self):
        return [
            [float(v) for v in line.split()]
            for line in self.log.read_text().splitlines(True)
            if line[-1] == "\n"
        ]

    def pulses(self):
        """The newest pair of pulses and when it began."""
        t_s, steering_us, throttle_us = self.lines()[-1]
        return (steering_us, throttle_us), t_s

    def wait_for(self, pulses, timeout_s=2.0):
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            if self.lines() and self.pulses()[0] == pulses:
                return self.pulses()[1]
            time.sleep(0.002)
        raise AssertionError(f"expected {pulses}, the board puts out {self.lines()[-5:]}")

    def stop(self):
        self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)


def compiler(name):
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"no {name} on this machine, which compiles the firmware")
    return path


def build_host_board(folder: Path) -> Path:
    """Compile the protocol for this computer."""
    out = folder / "host_board"
    words = [
        "-std=c++11",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-O1",
        "-I",
        SKETCH,
        HERE / "boards" / "host_board.cpp",
    ]
    subprocess.run([compiler("g++"), *words, "-o", out], check=True, timeout=60)
    return out
