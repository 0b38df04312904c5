"""The Python side of the serial line against the firmware's own code, through a pseudo-terminal."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import termios
import threading
import time
import tty
from collections import deque
from itertools import groupby

import numpy as np
import pytest
from board_process import HERE, SKETCH, BoardProcess, build_host_board, build_uno, compiler
from hypothesis import given
from hypothesis import strategies as st

from lanenet.errors import HardwareError, MissingExtraError
from lanenet.onboard.actuators import make_actuator, serial_board
from lanenet.onboard.actuators.actuator import Actuator
from lanenet.onboard.actuators.serial_board import (
    COMMAND_S,
    MAX_LINE,
    VERSION,
    Line,
    LineReader,
    SerialBoardSettings,
    crc8,
    decode,
    encode,
)

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
    assert encode("N", 1500, 1500) == b"N1500,1500*5D\n"
    assert decode(b"N1500,1500*5D") == Line("N", (1500, 1500))
    assert decode(b"V*A5\r") == Line("V", ())


@pytest.mark.parametrize("line", [b"", b"N", b"*", b"N1500,1500*5C", b"N1500,1600*5D", b"N1500,1500", b"*00"])
def test_bad_lines_are_dropped(line):
    assert decode(line) is None


@given(st.binary(max_size=8), st.integers(0, 12), st.integers(0, 7))
def test_one_wrong_bit_is_noticed(noise, position, bit):
    line = bytearray(encode("N", 1432, 1577)[:-1])
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


def test_the_longest_lines_fit() -> None:
    assert len(encode("A", 2**32 - 1, 65535, 65535, 1, 2500, 2500)) <= MAX_LINE
    assert len(encode("S", 2500, 2500, 65535, 2**32 - 1)) <= MAX_LINE


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
    assert actuator.refused_lines == 0


def test_boards_watchdog_stops_within_its_time(board, actuator):
    keep_sending(actuator, 0.3, 0.0, 1.0)
    last_s = time.monotonic()
    # How soon is measured by `make neutral`: a loaded machine wakes either process late.
    assert board.wait_for(NEUTRAL) - last_s < 10.0 * COMMAND_S


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
    assert board.wait_for(NEUTRAL) - said_s < 10.0 * COMMAND_S
    with pytest.raises(HardwareError, match="not open"):
        actuator.send(0.0, 0.0)


def board_ms(actuator):
    """The board's clock by its newest report."""
    actuator.neutral()
    return actuator._report.time_ms


def test_board_refuses_what_is_damaged(board, actuator):
    board.wait_for(NEUTRAL)
    count, now_ms = len(board.lines()), board_ms(actuator)
    bad = [
        b"S1900,2000,1,1*00\n",
        b"S1900,2000,1,1\n",
        encode("S", 1900),
        encode("S", 1900, 2000),
        encode("S", 1900, 2000, 1, now_ms, 1),
        encode("S", 100, 2000, 1, now_ms),
        encode("S", 1900, 60000, 1, now_ms),
        encode("S", 1900, 2000, 65536, now_ms),
        encode("S", 1900, 2000, 1, now_ms + 2**32),
        encode("S", 1900, 2000, 1, 9999999999),
        encode("X", 1900, 2000),
        b"9" * 300 + b"\n",
        b"\n\n",
    ]
    with open(board.port, "wb", buffering=0) as wire:
        for line in bad:
            wire.write(line)
    wait_until(lambda: (actuator.neutral(), actuator.refused_lines == 12)[1])
    assert len(board.lines()) == count, "a damaged line moved a servo"


def wait_until(true, timeout_s=5.0):
    end_s = time.monotonic() + timeout_s
    while not true():
        assert time.monotonic() < end_s, "waited in vain"
        time.sleep(0.002)


def test_old_commands_are_refused(board, actuator):
    actuator.neutral()
    board.wait_for(NEUTRAL)
    count = len(board.lines())
    # The board reads nothing for a while; everything that is sent to it waits.
    os.kill(board.process.pid, signal.SIGSTOP)
    for _ in range(100):
        actuator._command(1900, 2000)
    time.sleep(COMMAND_S)
    os.kill(board.process.pid, signal.SIGCONT)
    wait_until(lambda: (actuator.neutral(), actuator.refused_lines == 100)[1])
    assert len(board.lines()) == count, "an old command moved a servo"
    keep_sending(actuator, 0.05, 0.4, 1.0)
    board.wait_for((1900, 2000))


def test_line_that_fails_towards_the_board_is_noticed(board, actuator, monkeypatch):
    keep_sending(actuator, 0.05, 0.0, 1.0)
    monkeypatch.setattr(actuator._port, "write", len)
    with pytest.raises(HardwareError, match=r"accepted no command for 0\.3\d s.*refused 0 lines"):
        keep_sending(actuator, 2.0, 0.0, 1.0)
    board.wait_for(NEUTRAL)


@pytest.mark.parametrize("direction", ["to the board", "to the computer"])
def test_line_that_loses_every_third_is_told_once(board, actuator, monkeypatch, caplog, direction):
    monkeypatch.setattr(serial_board, "_COUNTED", 6)
    port, count = actuator._port, iter(range(10**6))

    def damaged(data: bytes) -> bytes:
        return data if next(count) % 3 else data.replace(b"*", b"+")

    if direction == "to the board":
        write = port.write
        monkeypatch.setattr(port, "write", lambda data: write(damaged(data)))
    else:
        feed = actuator._reader.feed
        lines = lambda data: b"".join(map(damaged, data.splitlines(keepends=True)))  # noqa: E731
        monkeypatch.setattr(actuator._reader, "feed", lambda data: feed(lines(data)))
    keep_sending(actuator, 0.6, 0.0, 0.2)
    assert caplog.text.count("check the cable") == 1 and board.port in caplog.text


def test_line_that_fails_towards_the_computer_stops_the_motor(board, actuator, monkeypatch):
    keep_sending(actuator, 0.05, 0.0, 1.0)
    board.wait_for((1500, 2000))
    monkeypatch.setattr(actuator, "_receive", lambda: None)
    begun_s = time.monotonic()
    with pytest.raises(HardwareError, match=r"silent for 0\.3\d s"):
        keep_sending(actuator, 2.0, 0.0, 1.0)
    assert board.wait_for(NEUTRAL) - begun_s < COMMAND_S + 0.15


def test_port_keeps_the_uno_running_when_it_is_closed(board, actuator):
    assert not termios.tcgetattr(actuator._port.fd)[2] & termios.HUPCL


@pytest.fixture(scope="session")
def board_library(tmp_path_factory):
    out = tmp_path_factory.mktemp("board") / "board.so"
    words = ["-shared", "-fPIC", "-std=c++11", "-O1", "-I", SKETCH, HERE / "boards" / "board_library.cpp"]
    subprocess.run([compiler("g++"), *words, "-o", out], check=True, timeout=60)
    library = ctypes.CDLL(str(out))
    library.MakeBoard.restype = ctypes.c_void_p
    library.Take.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_uint32, ctypes.c_char_p]
    library.Turn.argtypes = [ctypes.c_void_p, ctypes.c_uint32, ctypes.c_char_p]
    library.DeleteBoard.argtypes = [ctypes.c_void_p]
    return library


class SimulatedLine:
    """One direction of a line: 3 ms late; a bad one stops, loses and damages, but keeps the order."""

    def __init__(self, rng, bad):
        self.rng, self.bad, self.way, self.free_ms = rng, bad, deque(), 0

    def put(self, data, now_ms):
        if self.bad:
            if self.rng.random() < 0.02:
                self.free_ms = now_ms + self.rng.integers(20, 400)
            if self.rng.random() < 0.05:
                data = data[: self.rng.integers(len(data))]
            elif self.rng.random() < 0.05:
                data = data.replace(b"1", b"2")
        self.free_ms = max(self.free_ms, now_ms + 3)
        self.way.append((self.free_ms, data))

    def get(self, now_ms):
        out = b""
        while self.way and self.way[0][0] <= now_ms:
            out += self.way.popleft()[1]
        return out


class SimulatedPort:
    def __init__(self, simulation):
        self.simulation = simulation

    def write(self, data):
        self.simulation.down.put(data, self.simulation.now_ms)

    def read(self, _size):
        return self.simulation.up.get(self.simulation.now_ms)


class Simulation:
    """Computer, bad line and board on one clock of whole milliseconds, without waiting."""

    def __init__(self, library, seed, bad):
        self.rng = np.random.default_rng(seed)
        self.library, self.now_ms, self.bad = library, 0, bad
        self.down, self.up = SimulatedLine(self.rng, bad), SimulatedLine(self.rng, bad)
        self.buffer = ctypes.create_string_buffer(1024)
        # The board's clock wraps within the first two seconds.
        self.board, self.board_ms = library.MakeBoard(), int(2**32 - self.rng.integers(1, 2000))
        settings = SerialBoardSettings(silence_s=1e9, throttle_stopped_us=1500, throttle_forward_us=2000)
        self.host = make_actuator(settings)
        self.host._port = SimulatedPort(self)
        self.host.neutral()

    def restart(self):
        self.library.DeleteBoard(self.board)
        self.board, self.board_ms = self.library.MakeBoard(), 0
        self.up.put(encode("B", VERSION), self.now_ms)

    def step(self):
        """Advance by a millisecond; returns the throttle's pulse."""
        self.now_ms += 1
        self.board_ms = (self.board_ms + 1) % 2**32
        data = self.down.get(self.now_ms)
        self.library.Take(self.board, data, len(data), self.board_ms, self.buffer)
        throttle_us = self.library.Turn(self.board, self.board_ms, self.buffer)
        if self.buffer.value:
            self.up.put(self.buffer.value, self.now_ms)
        return throttle_us


def test_board_waits_for_its_neutral(board_library):
    board, reply = board_library.MakeBoard(), ctypes.create_string_buffer(100)

    def tell(line, now_ms):
        board_library.Take(board, line, len(line), now_ms, reply)
        return board_library.Turn(board, now_ms, reply)

    command = encode("S", 1900, 2000, 1, 5)
    assert tell(command, 6) == 1500
    # The death of its sender has cut a line short.
    assert tell(command[:6] + b"\n" + encode("N", 1510, 1490), 7) == 1490
    assert tell(command, 8) == 2000
    assert tell(b"", 84) == 2000 and tell(b"", 85) == 1490
    board_library.DeleteBoard(board)


@pytest.mark.parametrize("seed", range(4))
def test_no_command_is_obeyed_for_longer_than_it_is_good(board_library, seed):
    simulation = Simulation(board_library, seed, bad=True)
    made_ms, driven, restarts = {}, 0, 0
    for now_ms in range(6000):
        if simulation.rng.random() < 0.03:
            throttle_us = 1600 + len(made_ms) % 400
            try:
                simulation.host.send(0.0, (throttle_us - 1500) / 500)
                made_ms[throttle_us] = now_ms
            except HardwareError:
                simulation.host._restarted = False
                simulation.host.neutral()
        if simulation.rng.random() < 0.001:
            simulation.restart()
            restarts += 1
        throttle_us = simulation.step()
        if throttle_us != 1500:
            driven += 1
            assert now_ms - made_ms[throttle_us] <= 1e3 * COMMAND_S
    assert driven > 500 and restarts > 1


def test_on_a_good_line_every_command_is_obeyed_without_a_gap(board_library):
    simulation = Simulation(board_library, 0, bad=False)
    pulses = []
    for now_ms in range(3000):
        if now_ms % 40 == 20:
            simulation.host.send(0.0, 1.0)
        pulses.append(simulation.step())
    assert set(pulses[100:]) == {2000}
    simulation.host._receive()
    assert simulation.host.refused_lines == 0 and simulation.host._unaccepted_s is None


def test_lost_board_is_noticed(board, actuator):
    actuator.send(0.0, 0.1)
    board.process.kill()
    with pytest.raises(HardwareError, match=r"silent for 0\.\d+ s|is gone"):
        keep_sending(actuator, 2.0, 0.0, 0.1)
    actuator.neutral()


def test_a_second_owner_is_refused_and_names_the_first(board, actuator):
    with pytest.raises(HardwareError, match=rf"process {os.getpid()} .*lanenet stop"):
        make_actuator(SerialBoardSettings(port=board.port)).open()


def test_restarted_board_is_noticed(board, actuator):
    actuator.send(0.0, 0.1)
    os.write(board.master, encode("B", VERSION))
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


@pytest.mark.parametrize("letter", ["V", "B"])
def test_sketch_of_another_version(silent_port, letter):
    pytest.importorskip("serial", reason="pyserial is not installed")
    port, master = silent_port
    threading.Timer(0.05, os.write, (master, encode(letter, 1))).start()
    with pytest.raises(HardwareError, match=r"version 1 of the protocol, expected 2.*firmware/lanenet_uno"):
        make_actuator(SerialBoardSettings(port=port, start_s=1.0)).open()


def test_neutral_is_the_first_that_a_board_hears(silent_port):
    pytest.importorskip("serial", reason="pyserial is not installed")
    port, master = silent_port
    with pytest.raises(HardwareError):
        make_actuator(SerialBoardSettings(port=port, start_s=0.02, **PULSES)).open()
    assert os.read(master, 100).startswith(b"\n" + encode("N", *NEUTRAL))


def test_without_the_package(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "serial", None)
    with pytest.raises(MissingExtraError, match=r"serial.*lanenet\[car\]"):
        make_actuator(SerialBoardSettings()).open()


@pytest.fixture(scope="session")
def uno(tmp_path_factory):
    pytest.importorskip("serial", reason="pyserial is not installed")
    return build_uno(tmp_path_factory.mktemp("uno"))


@pytest.fixture
def uno_board(uno, tmp_path):
    board = BoardProcess(uno, tmp_path)
    yield board
    board.stop()


@pytest.mark.slow
def test_sketch_leaves_room_on_an_uno(uno, record_property):
    words = [compiler("avr-size"), uno[1]]
    table = subprocess.run(words, check=True, capture_output=True, text=True).stdout
    text, data, bss = (int(word) for word in table.splitlines()[1].split()[:3])
    record_property("flash_bytes", text + data)
    record_property("ram_bytes", data + bss)
    # Without the boot loader the chip has 32256 bytes of flash; half of the RAM is for the stack.
    assert text + data < 32256 and data + bss < 1024


@pytest.mark.slow
def test_whole_sketch_on_a_simulated_uno(uno_board):
    """The width of the pulses on pins 9 and 10."""
    actuator = make_actuator(SerialBoardSettings(port=uno_board.port, **PULSES))
    actuator.open()
    keep_sending(actuator, 0.3, 0.4, 0.5)
    driving = uno_board.lines()[-2:]
    time.sleep(0.2)
    stopped = uno_board.lines()[-2:]
    actuator.close()
    assert [pulse[1:3] for pulse in driving] in ([[9, 1900.0], [10, 1740.0]], [[10, 1740.0], [9, 1900.0]])
    assert sorted(pulse[1:3] for pulse in stopped) == [[9, 1500.0], [10, 1480.0]]
    assert all(pulse[3] == pytest.approx(20000.0, abs=2.0) for pulse in driving + stopped)


@pytest.mark.slow
def test_sketch_that_hangs_is_restarted_in_neutral(uno_board):
    actuator = make_actuator(SerialBoardSettings(port=uno_board.port, **PULSES))
    actuator.open()
    keep_sending(actuator, 0.2, 0.4, 1.0)
    hung_s = time.monotonic()
    uno_board.process.send_signal(signal.SIGUSR1)
    with pytest.raises(HardwareError, match="restarted"):
        keep_sending(actuator, 1.0, 0.4, 1.0)
    actuator.neutral()
    wait_until(lambda: (actuator.neutral(), uno_board.lines()[-1][0] > hung_s + 0.5)[1])
    actuator.close()
    motor = [width_us for t_s, pin, width_us, _ in uno_board.lines() if pin == 10 and t_s > hung_s]
    # A pulse begins every 20 ms; the watchdog's time is 64 ms. The sketch starts once, with 1500 us.
    assert motor.count(2000) <= 5
    assert [width_us for width_us, _ in groupby(motor)] in ([2000, 1500, 1480], [2000, 1480])
