"""The Python side of the serial line against the firmware's own code, through a pseudo-terminal."""

from __future__ import annotations

import os
import subprocess
import threading
import time
import tty
from pathlib import Path

import pytest
from board_process import HERE, SKETCH, BoardProcess, build_host_board, compiler
from hypothesis import given
from hypothesis import strategies as st

from lanenet.errors import HardwareError, MissingExtraError
from lanenet.onboard.actuators import make_actuator
from lanenet.onboard.actuators.serial_board import (
    MAX_LINE,
    Line,
    LineReader,
    SerialBoardSettings,
    crc8,
    decode,
    encode,
)
from lanenet.onboard.devices import Actuator

CORE = Path("/usr/share/arduino/hardware/arduino/avr")
PULSES = {
    "max_steering_rad": 0.4,
    "steering_left_us": 1900,
    "steering_right_us": 1100,
    "throttle_forward_us": 2000,
    "throttle_stopped_us": 1480,
    "throttle_reverse_us": 1000,
}
NEUTRAL = (1500, 1480)


def test_checksum_of_the_catalogue():
    # Check value of CRC-8/SMBUS: Greg Cook's catalogue of parametrised CRC algorithms.
    assert crc8(b"123456789") == 0xF4


def test_known_line():
    assert encode("S", 1500, 1500) == b"S1500,1500*49\n"
    assert decode(b"S1500,1500*49") == Line("S", (1500, 1500))
    assert decode(b"V*A5\r") == Line("V", ())


@pytest.mark.parametrize("line", [b"", b"S", b"*", b"S1500,1500*48", b"S1500,1600*49", b"S1500,1500", b"*00"])
def test_bad_lines_are_dropped(line):
    assert decode(line) is None


@given(st.binary(max_size=8), st.integers(0, 12), st.integers(0, 7))
def test_one_wrong_bit_is_noticed(noise, position, bit):
    line = bytearray(encode("S", 1432, 1577)[:-1])
    line[position] ^= 1 << bit
    assert decode(bytes(line)) is None


@given(st.lists(st.integers(1, 5), max_size=30))
def test_lines_are_put_together_wherever_they_were_cut(cuts):
    data = b"noise\n" + encode("A", 1, 2, 3, 4, 5) + encode("V", 1) + b"half"
    reader, lines, at = LineReader(), [], 0
    for cut in [*cuts, len(data)]:
        lines += reader.feed(data[at : at + cut])
        at += cut
    assert lines == [Line("A", (1, 2, 3, 4, 5)), Line("V", (1,))]


def test_endless_noise_does_not_pile_up():
    reader = LineReader()
    for _ in range(100):
        assert reader.feed(b"x" * 1000) == []
    assert len(reader._rest) <= MAX_LINE


@pytest.fixture(scope="session")
def host_board(tmp_path_factory):
    return build_host_board(tmp_path_factory.mktemp("board"))


@pytest.fixture
def board(host_board, tmp_path):
    pytest.importorskip("serial", reason="pyserial is not installed")
    board = BoardProcess([host_board], tmp_path)
    yield board
    board.stop()


@pytest.fixture
def actuator(board):
    actuator = make_actuator(SerialBoardSettings(port=board.port, **PULSES))
    actuator.open()
    yield actuator
    actuator.close()


def keep_sending(actuator, seconds, *command):
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        actuator.send(*command)
        time.sleep(0.02)


def test_board_takes_over_neutral_and_commands(board, actuator):
    assert isinstance(actuator, Actuator)
    board.wait_for(NEUTRAL)
    actuator.send(0.4, 0.5)
    board.wait_for((1900, 1740))
    actuator.send(-0.1, -1.0)
    board.wait_for((1400, 1000))
    actuator.neutral()
    board.wait_for(NEUTRAL)
    assert actuator.rejected_lines == 0


def test_boards_watchdog_stops_within_its_time(board, actuator):
    keep_sending(actuator, 0.3, 0.0, 1.0)
    last_s = time.monotonic()
    stopped_s = board.wait_for(NEUTRAL)
    # The loaded test machine may wake either process late, hence the room above 100 ms.
    assert 0.06 < stopped_s - last_s < 0.25


def test_kept_alive_the_board_goes_on(board, actuator):
    keep_sending(actuator, 0.05, 0.2, 0.3)
    board.wait_for((1700, 1636))
    count = len(board.lines())
    keep_sending(actuator, 0.6, 0.2, 0.3)
    assert len(board.lines()) == count


def test_close_leaves_neutral(board, actuator):
    keep_sending(actuator, 0.1, 0.4, 1.0)
    said_s = time.monotonic()
    actuator.close()
    assert board.wait_for(NEUTRAL) - said_s < 0.09, "neutral was said, not waited for"
    with pytest.raises(HardwareError, match="not open"):
        actuator.send(0.0, 0.0)


def test_board_drops_what_is_damaged(board, actuator):
    board.wait_for(NEUTRAL)
    count = len(board.lines())
    bad = [
        b"S1900,2000*00\n",
        b"S1900,2000\n",
        encode("S", 1900)[:-1] + b"\n",
        encode("S", 1900, 2000, 1),
        encode("S", 100, 2000),
        encode("S", 1900, 60000),
        encode("S", 1900, 99999),
        encode("X", 1900, 2000),
        b"9" * 300 + b"\n",
        b"\n\n",
    ]
    with open(board.port, "wb", buffering=0) as wire:
        for line in bad:
            wire.write(line)
    actuator.neutral()
    time.sleep(0.15)
    actuator.send(0.0, 0.0)
    assert len(board.lines()) == count, "a damaged line moved a servo"
    assert actuator.rejected_lines == 9


def test_board_waits_for_its_neutral(board):
    with open(board.port, "wb", buffering=0) as wire:
        wire.write(encode("S", 1900, 2000))
        time.sleep(0.1)
        assert board.pulses()[0] == (1500, 1500)
        wire.write(encode("N", 1510, 1490) + encode("S", 1900, 2000))
        board.wait_for((1900, 2000))
        board.wait_for((1510, 1490))


def test_lost_board_is_noticed(board, actuator):
    actuator.send(0.0, 0.1)
    board.process.kill()
    with pytest.raises(HardwareError, match=r"silent for 0\.\d+ s|is gone"):
        keep_sending(actuator, 2.0, 0.0, 0.1)
    actuator.neutral()


def test_restarted_board_is_noticed(board, actuator):
    actuator.send(0.0, 0.1)
    os.write(board.master, encode("V", 1))
    with pytest.raises(HardwareError, match="restarted"):
        keep_sending(actuator, 1.0, 0.0, 0.1)


@pytest.fixture
def silent_port():
    master, slave = os.openpty()
    tty.setraw(slave)
    yield os.ttyname(slave), master
    os.close(master)
    os.close(slave)


def test_silent_board_and_missing_port(silent_port, tmp_path):
    pytest.importorskip("serial", reason="pyserial is not installed")
    with pytest.raises(HardwareError, match=r"no answer within 0\.3 s; is the sketch"):
        make_actuator(SerialBoardSettings(port=silent_port[0], start_s=0.3)).open()
    with pytest.raises(HardwareError, match=r"cannot be opened.*dialout"):
        make_actuator(SerialBoardSettings(port=str(tmp_path / "ttyACM0"))).open()


def test_sketch_of_another_version(silent_port):
    pytest.importorskip("serial", reason="pyserial is not installed")
    port, master = silent_port
    threading.Timer(0.05, os.write, (master, encode("V", 2))).start()
    with pytest.raises(HardwareError, match="version 2 of the protocol, expected 1"):
        make_actuator(SerialBoardSettings(port=port, start_s=1.0)).open()


def test_without_the_package(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "serial", None)
    with pytest.raises(MissingExtraError, match=r"serial.*lanenet\[car\]"):
        make_actuator(SerialBoardSettings()).open()


@pytest.mark.slow
def test_whole_sketch_on_a_simulated_uno(tmp_path):
    """Compiled for the ATmega328P and run in simavr: the width of the pulses on pins 9 and 10."""
    pytest.importorskip("serial", reason="pyserial is not installed")
    if not (CORE.is_dir() and Path("/usr/include/simavr").is_dir()):
        pytest.skip("needs the Debian packages arduino-core-avr and libsimavr-dev")
    avr_gcc, avr_gxx, gcc = compiler("avr-gcc"), compiler("avr-g++"), compiler("gcc")
    flags = ["-mmcu=atmega328p", "-DF_CPU=16000000L", "-DARDUINO=10819", "-DARDUINO_ARCH_AVR", "-Os"]
    flags += [f"-I{CORE / 'cores/arduino'}", f"-I{CORE / 'variants/standard'}"]
    flags += ["-ffunction-sections", "-fdata-sections"]
    cxx = ["-std=gnu++11", "-fno-exceptions", "-fno-threadsafe-statics", "-include", "Arduino.h"]

    def compile_file(tool, out, *words):
        subprocess.run([tool, *flags, *words, "-o", tmp_path / out], check=True, timeout=60)

    strict = ["-Wall", "-Wextra", "-Werror"]
    compile_file(avr_gxx, "sketch.o", *cxx, *strict, "-x", "c++", "-c", SKETCH / "lanenet_uno.ino")
    # This compiler is too old for two constants of the core's strings, which the sketch does not use.
    sources = [p for p in (CORE / "cores/arduino").iterdir() if p.suffix in (".c", ".cpp")]
    for source in [p for p in sources if p.name != "WString.cpp"]:
        tool, words = (avr_gxx, cxx) if source.suffix == ".cpp" else (avr_gcc, [])
        compile_file(tool, f"{source.name}.o", "-w", *words, "-c", source)
    compile_file(avr_gcc, "sketch.elf", "-Wl,--gc-sections", *sorted(tmp_path.glob("*.o")))
    simulator = tmp_path / "avr_board"
    words = ["-O2", "-Wall", "-Werror", HERE / "boards" / "avr_board.c", "-lsimavr", "-lelf"]
    subprocess.run([gcc, *words, "-o", simulator], check=True, timeout=60)

    board = BoardProcess([simulator, tmp_path / "sketch.elf"], tmp_path)
    try:
        actuator = make_actuator(SerialBoardSettings(port=board.port, **PULSES))
        actuator.open()
        keep_sending(actuator, 0.3, 0.4, 0.5)
        driving = board.lines()[-2:]
        time.sleep(0.2)
        stopped = board.lines()[-2:]
        actuator.close()
    finally:
        board.stop()
    assert [pulse[1:3] for pulse in driving] in ([[9, 1900.0], [10, 1740.0]], [[10, 1740.0], [9, 1900.0]])
    assert sorted(pulse[1:3] for pulse in stopped) == [[9, 1500.0], [10, 1480.0]]
    assert all(pulse[3] == pytest.approx(20000.0, abs=2.0) for pulse in driving + stopped)
