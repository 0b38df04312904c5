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
SKETCH = HERE.parents[1] / "firmware" / "lanenet_uno"
CORE = Path("/usr/share/arduino/hardware/arduino/avr")
THROTTLE_PIN = 10


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

    def motor(self, stopped_us):
        """When the motor was switched on (True) or into neutral, by its pulses."""
        story = []
        for t_s, pin, throttle_us, *rest in self.lines():
            # An Uno's lines are pulses of one pin each; this computer's are pairs of pulses.
            if rest and pin != THROTTLE_PIN:
                continue
            driving = throttle_us != stopped_us
            if not story or story[-1][1] != driving:
                story.append((t_s, driving))
        return story

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


def build_uno(folder: Path) -> list[Path]:
    """Compile the sketch for the ATmega328P, and a simulator; returns the command that runs both."""
    if not (CORE.is_dir() and Path("/usr/include/simavr").is_dir()):
        pytest.skip("needs the Debian packages arduino-core-avr, libsimavr-dev and libelf-dev")
    avr_gcc, avr_gxx, gcc = compiler("avr-gcc"), compiler("avr-g++"), compiler("gcc")
    flags = ["-mmcu=atmega328p", "-DF_CPU=16000000L", "-DARDUINO=10819", "-DARDUINO_ARCH_AVR", "-Os"]
    flags += [f"-I{CORE / 'cores/arduino'}", f"-I{CORE / 'variants/standard'}"]
    flags += ["-ffunction-sections", "-fdata-sections"]
    cxx = ["-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics", "-include", "Arduino.h"]

    def compile_file(tool, out, *words):
        subprocess.run([tool, *flags, *words, "-o", folder / out], check=True, timeout=60)

    strict = ["-Wall", "-Wextra", "-Werror"]
    compile_file(avr_gxx, "sketch.o", *cxx, *strict, "-x", "c++", "-c", SKETCH / "lanenet_uno.ino")
    # This compiler is too old for two constants of the core's strings, which the sketch does not use.
    sources = [p for p in (CORE / "cores/arduino").iterdir() if p.suffix in (".c", ".cpp")]
    for source in [p for p in sources if p.name != "WString.cpp"]:
        tool, words = (avr_gxx, cxx) if source.suffix == ".cpp" else (avr_gcc, [])
        compile_file(tool, f"{source.name}.o", "-w", *words, "-c", source)
    compile_file(avr_gcc, "sketch.elf", "-Wl,--gc-sections", *sorted(folder.glob("*.o")))
    simulator = folder / "avr_board"
    words = ["-O2", "-Wall", "-Werror", HERE / "boards" / "avr_board.c", "-lsimavr", "-lelf"]
    subprocess.run([gcc, *words, "-o", simulator], check=True, timeout=60)
    return [simulator, folder / "sketch.elf"]
