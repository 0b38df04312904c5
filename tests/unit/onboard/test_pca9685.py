from __future__ import annotations

import fcntl
import os
import struct
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import i2c_emulator
import pytest

from lanenet.errors import HardwareError, MissingExtraError
from lanenet.onboard import i2c
from lanenet.onboard.actuators import make_actuator
from lanenet.onboard.actuators.actuator import Actuator
from lanenet.onboard.actuators.heartbeat import HeartbeatSettings
from lanenet.onboard.actuators.pca9685 import PCA9685Settings, counts_of, prescale_of
from lanenet.onboard.neutral import CONFIRMED

SETTINGS = PCA9685Settings(max_steering_rad=0.4)


@pytest.fixture
def bus(monkeypatch):
    bus = i2c_emulator.Bus(i2c_emulator.Chip())
    i2c_emulator.install(monkeypatch, bus)
    return bus


@pytest.fixture
def actuator(bus):
    actuator = make_actuator(SETTINGS)
    actuator.open()
    yield actuator
    actuator.close()


@pytest.mark.parametrize(("frequency_hz", "prescale"), [(200.0, 30), (60.0, 101), (50.0, 121)])
def test_prescale_of_the_data_sheet(frequency_hz, prescale):
    # 200 Hz gives 30 (1Eh), data sheet 7.3.5; 60 Hz gives 101, as Adafruit's driver has it.
    assert prescale_of(frequency_hz) == prescale


def test_default_pulses_are_donkeycars_counts():
    counts = [
        counts_of(us, 101)
        for us in (
            SETTINGS.steering_left_us,
            SETTINGS.steering_right_us,
            SETTINGS.throttle_forward_us,
            SETTINGS.throttle_stopped_us,
            SETTINGS.throttle_reverse_us,
        )
    ]
    assert counts == [460, 290, 500, 370, 220]


def test_wire_bytes_of_the_start(bus, actuator):
    assert isinstance(actuator, Actuator)
    assert bus.wire == [
        bytes([0x00, 0x30]),  # asleep, with auto-increment
        bytes([0x01, 0x04]),  # totem pole
        bytes([0xFE, 101]),  # 59.8 Hz
        bytes([0x06, 0, 0, 370 & 0xFF, 370 >> 8]),  # motor in neutral
        bytes([0x0A, 0, 0, 375 & 0xFF, 375 >> 8]),  # wheels straight
        bytes([0x00, 0x20]),  # awake
        bytes([0x00, 0xA0]),  # restart
        *(bytes([register]) for register in (0x00, 0xFE, 0x06, 0x0A)),  # all read back
    ]
    assert bus.chip.refused_prescale == 0 and not bus.chip.asleep
    assert 1 / bus.chip.period_s == pytest.approx(60.0, abs=0.3)
    assert bus.chip.pulses == [(0, 370), (1, 375)]


def test_emulator_keeps_the_rules_of_sleep():
    chip = i2c_emulator.Chip()
    chip.write(bytes([0x00, 0x20]))
    chip.write(bytes([0xFE, 101]))
    assert chip.refused_prescale == 1 and chip.registers[0xFE] == 30
    chip.write(bytes([0x00, 0x10]))
    chip.write(bytes([0x06, 1, 2, 3, 4]))
    assert bytes(chip.registers[6:10]) == bytes([4, 0, 0, 0x10]), "without auto-increment one register is hit"


def test_pulses_of_commands(bus, actuator):
    actuator.send(0.4, 0.5)
    assert bus.chip.pulse_us(1) == pytest.approx(SETTINGS.steering_left_us, abs=2.1)
    middle_us = 0.5 * (SETTINGS.throttle_forward_us + SETTINGS.throttle_stopped_us)
    assert bus.chip.pulse_us(0) == pytest.approx(middle_us, abs=2.1)
    actuator.send(-0.4, -1.0)
    assert (bus.chip.counts(1), bus.chip.counts(0)) == (290, 220)
    actuator.neutral()
    assert (bus.chip.counts(1), bus.chip.counts(0)) == (375, 370)


def test_neutral_stops_the_motor_first(bus, actuator):
    actuator.send(0.1, 0.5)
    del bus.wire[:]
    assert actuator.neutral() == CONFIRMED
    assert [data[0] for data in bus.wire if len(data) > 1] == [0x06, 0x0A]


def test_close_leaves_neutral_pulses(bus, actuator):
    actuator.send(0.4, 1.0)
    actuator.close()
    assert bus.closed and bus.chip.counts(0) == 370 and not bus.chip.asleep
    actuator.close()
    assert actuator.neutral() is None
    with pytest.raises(HardwareError, match="not open"):
        actuator.send(0.0, 0.0)


def test_glitch_is_tried_again(bus, actuator):
    bus.glitches = 2
    actuator.send(0.4, 1.0)
    assert (bus.chip.counts(1), bus.chip.counts(0)) == (460, 500)


def test_chip_that_lost_its_supply_is_noticed(bus, actuator):
    actuator.send(0.0, 0.1)
    bus.chip.power_on()
    with pytest.raises(HardwareError, match="sleeps, as after a restart, and sends no pulses"):
        actuator.send(0.0, 0.1)
    assert bus.chip.asleep and bus.chip.pulse_us(0) == 0.0


@pytest.mark.parametrize("register", [0x00, 0xFE, 0x06, 0x0A])
def test_one_wrong_bit_of_an_answer_ends_nothing(bus, actuator, register):
    right, asked = bus.chip.read, []

    def read(length):
        """Answer the first question after this register with one bit wrong."""
        answer = right(length)
        if bus.chip.pointer != register:
            return answer
        asked.append(register)
        return bytes([answer[0] ^ 0x10, *answer[1:]]) if len(asked) == 1 else answer

    bus.chip.read = read
    actuator.send(0.0, 0.1)
    assert len(asked) == 2, "the chip was not asked again"


def test_another_program_that_moves_the_car_is_noticed(bus, actuator):
    """Donkeycar asks for no lock: what it writes is seen at the next command."""
    actuator.send(0.1, 0.2)
    bus.chip.write(bytes([0x06, 0, 0, 500 & 0xFF, 500 >> 8]))
    with pytest.raises(HardwareError, match=r"/dev/i2c-1 at 0x40: channel 0 holds 500 counts"):
        actuator.send(0.1, 0.2)
    assert bus.chip.counts(0) == 500, "nothing is sent against another program"


def test_neutral_of_the_loops_process_is_no_other_program(bus, actuator):
    actuator.send(0.1, 0.2)
    spare = make_actuator(SETTINGS)
    spare.attach()
    spare.neutral()
    spare.release()
    assert bus.chip.counts(0) == 370
    actuator.send(0.1, 0.2)
    assert bus.chip.counts(0) > 370


@pytest.mark.parametrize(
    ("write", "wrong"),
    [
        ([0xFE, 121], "PRE_SCALE holds 121, expected 101"),
        ([0x00, 0x01], "MODE1 holds 0, expected 32"),
        ([0x01, 0x14], "MODE2 holds 20, expected 4"),
        ([0x06, 0, 0, 500 & 0xFF, 500 >> 8], "channel 0 holds 500 counts"),
        ([0x06, 9, 0, 370 & 0xFF, 370 >> 8], "channel 0 holds"),
        ([0x0A, 0, 0, 300 & 0xFF, 300 >> 8], "channel 1 holds 300 counts"),
    ],
)
def test_all_that_a_pulse_depends_on_is_compared_and_neutral_starts_the_chip_anew(
    bus, actuator, write, wrong
):
    actuator.send(0.1, 0.2)
    before_us = bus.chip.pulse_us(0)
    # As another program does it: the rate can be changed in sleep only.
    asleep = [[0x00, 0x30], write, [0x00, 0x20]] if write[0] == 0xFE else [write]
    for data in asleep:
        bus.chip.write(bytes(data))
    with pytest.raises(HardwareError, match=wrong):
        actuator.send(0.1, 0.2)
    assert actuator.neutral() == CONFIRMED
    assert bus.chip.registers[0xFE] == 101 and bus.chip.registers[0x01] == 0x04
    assert (bus.chip.counts(0), bus.chip.counts(1)) == (370, 375)
    assert bus.chip.pulse_us(0) < before_us


def test_neutral_that_the_chip_does_not_hold_is_not_confirmed(bus, actuator):
    actuator.send(0.1, 0.2)
    # It acknowledges what is written, and keeps what it has.
    bus.chip.write = lambda data: setattr(bus.chip, "pointer", data[0])
    left = actuator.neutral()
    assert left.confirmed is False and "channel 0 holds" in left.why


def test_lost_bus_is_an_error_and_neutral_is_not_confirmed(bus, actuator):
    bus.broken = True
    with pytest.raises(HardwareError, match=r"/dev/i2c-1 at 0x40: the PCA9685 stopped answering"):
        actuator.send(0.0, 0.1)
    left = actuator.neutral()
    assert left.confirmed is False and left.text.startswith(
        "neutral not confirmed (/dev/i2c-1 at 0x40: no PCA"
    )
    bus.broken = False
    assert actuator.neutral() == CONFIRMED and bus.chip.counts(0) == 370


def test_no_bus_no_chip_no_package(bus, monkeypatch):
    with pytest.raises(HardwareError, match=r"/dev/i2c-7: cannot be opened.*raspi-config"):
        make_actuator(PCA9685Settings(bus=7)).open()
    with pytest.raises(HardwareError, match=r"/dev/i2c-1 at 0x41: no PCA9685 answers.*i2cdetect -y 1"):
        lost = make_actuator(PCA9685Settings(address=0x41))
        lost.open()
    # It may answer later: until it is closed, neutral can be tried again.
    assert not bus.closed and lost.neutral().confirmed is False
    bus.address = 0x41
    assert lost.neutral() == CONFIRMED
    lost.close()
    assert bus.closed
    monkeypatch.setitem(__import__("sys").modules, "smbus2", None)
    with pytest.raises(MissingExtraError, match=r"smbus2.*lanenet\[car\]"):
        make_actuator(SETTINGS).open()


def test_another_chip_is_refused(bus):
    bus.chip.write = lambda data: setattr(bus.chip, "pointer", data[0])
    with pytest.raises(HardwareError, match=r"the chip sleeps.*is the chip there a PCA9685"):
        make_actuator(SETTINGS).open()


def test_command_that_hangs_cannot_undo_neutral(bus, actuator):
    """Another thread says neutral while a command hangs between its two outputs."""
    hang, hung = threading.Event(), threading.Event()

    def before(message):
        if message.length is None and message.data[0] == 0x0A and message.data[3:] == bytes([460 & 0xFF, 1]):
            hung.set()
            hang.wait(5.0)

    bus.before_transfer = before
    command = threading.Thread(target=actuator.send, args=(0.4, 1.0))
    command.start()
    assert hung.wait(5.0)
    start_s = time.monotonic()
    actuator.neutral()
    assert time.monotonic() - start_s < 0.2
    assert bus.chip.counts(0) == 370
    hang.set()
    command.join(5.0)
    assert bus.chip.counts(0) == 370


def hold(bus, address):
    """Another process that owns a chip on this bus, as a guard does."""
    code = f"import fcntl; fcntl.lockf({bus.fd}, fcntl.LOCK_EX, 1, {address}); print(flush=True); input()"
    words = [sys.executable, "-ISc", code]
    process = subprocess.Popen(words, pass_fds=[bus.fd], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    process.stdout.readline()
    return process


def end(process):
    process.kill()
    process.communicate()


def test_one_owner_of_bus_and_address(bus):
    other = hold(bus, 0x40)
    try:
        with pytest.raises(HardwareError, match=rf"/dev/i2c-1 at 0x40.*process {other.pid} \("):
            make_actuator(SETTINGS).open()
        assert bus.wire == [] and bus.closed, "what another process drives was touched"
        # A second access for neutral is not refused, nor is another chip on the same bus.
        spare = make_actuator(SETTINGS)
        spare.attach()
        assert spare.owner() == other.pid
        spare.release()
        bus.address = 0x41
        make_actuator(PCA9685Settings(address=0x41)).open()
    finally:
        end(other)


def test_the_owner_is_gone_with_its_process(bus, actuator):
    other = hold(bus, 0x41)
    assert i2c.lock_owners(os.fstat(bus.fd), 0x41) == [other.pid]
    assert i2c.lock_owners(os.fstat(bus.fd), 0x40) == [os.getpid()]
    end(other)
    assert i2c.lock_owners(os.fstat(bus.fd), 0x41) == []
    actuator.close()
    # The lock is that of the open file, which the emulator does not close.
    assert i2c.describe_process(other.pid) == f"process {other.pid} (gone)"


def test_the_owner_is_named_with_what_it_guards():
    words = [sys.executable, "-ISc", "print(flush=True); input()", i2c.GUARD_MODULE]
    guard = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        guard.stdout.readline()
        text = i2c.describe_process(guard.pid)
        assert text.startswith(f"process {guard.pid}, the guard of process {os.getpid()} (")
    finally:
        end(guard)


def test_a_guard_that_ends_while_it_is_described_is_no_traceback(monkeypatch):
    monkeypatch.setattr(i2c, "words_of", lambda pid: ["python", i2c.GUARD_MODULE])
    assert i2c.describe_process(2**30).startswith(f"process {2**30} (python ")


@pytest.fixture
def line(monkeypatch, tmp_path):
    """A GPIO line: what was asked of the kernel, and the levels that were set."""
    asked, levels = [], []

    def ioctl(handle, request, argument):
        if request == 0xC250B407:  # GPIO_V2_GET_LINE_IOCTL of linux/gpio.h
            asked.append(bytes(argument))
            struct.pack_into("=i", argument, 588, os.open("/dev/null", os.O_RDWR))
        elif request == 0x0702:  # I2C_TIMEOUT of linux/i2c-dev.h, in 10 ms
            assert argument == 10
        else:
            assert request == 0xC010B40F  # GPIO_V2_LINE_SET_VALUES_IOCTL
            bits, mask = struct.unpack("=QQ", argument)
            assert mask == 1
            levels.append(bits)

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    return SimpleNamespace(asked=asked, levels=levels)


def test_heart_beats_when_the_chip_took_a_command(bus, line):
    actuator = make_actuator(PCA9685Settings(heartbeat=HeartbeatSettings(line=17, chip="/dev/null")))
    actuator.open()
    # offsets[0], consumer, flags (output), num_lines of struct gpio_v2_line_request.
    [request] = line.asked
    assert struct.unpack_from("=I", request) == (17,) and request[256:263] == b"lanenet"
    assert struct.unpack_from("=Q", request, 288) == (8,) and struct.unpack_from("=I", request, 560) == (1,)
    actuator.send(0.0, 0.1)
    actuator.neutral()
    assert line.levels == [1, 0, 1, 0]
    bus.broken = True
    actuator.neutral()
    with pytest.raises(HardwareError):
        actuator.send(0.0, 0.1)
    assert line.levels == [1, 0, 1, 0]


def test_a_line_that_cannot_be_had_is_named(bus):
    settings = PCA9685Settings(heartbeat=HeartbeatSettings(line=17, chip="/nowhere"))
    with pytest.raises(HardwareError, match="/nowhere: line 17"):
        make_actuator(settings).open()
    assert bus.closed and bus.chip.counts(0) == 370


def test_messages_of_the_real_package(monkeypatch):
    """smbus2's own messages, as it would hand them to the kernel, make the same chip move."""
    smbus2 = pytest.importorskip("smbus2", reason="smbus2 is not installed")
    chip = i2c_emulator.Chip()

    class Kernel:
        def __init__(self, number):
            assert number == 1
            self.fd = os.memfd_create("i2c")

        def i2c_rdwr(self, *messages):
            for message in messages:
                assert message.addr == 0x40
                if message.flags & 1:
                    for i, byte in enumerate(chip.read(message.len)):
                        message.buf[i] = byte
                else:
                    chip.write(bytes(message))

        def close(self):
            os.close(self.fd)

    monkeypatch.setattr(smbus2, "SMBus", Kernel)
    actuator = make_actuator(SETTINGS)
    actuator.open()
    actuator.send(0.4, 0.5)
    assert chip.counts(1) == 460 and chip.counts(0) == 435
    actuator.close()
    assert chip.counts(0) == 370
