"""A PCA9685 on an I2C bus, byte by byte as its data sheet has it; stands in for the package smbus2."""

from __future__ import annotations

import errno
import os
import types

MODE1, MODE2, PRE_SCALE = 0x00, 0x01, 0xFE
LED0_ON_L, LAST_LED, ALL_LED_ON_L = 0x06, 0x45, 0xFA
RESTART, AUTO_INCREMENT, SLEEP, ALLCALL = 0x80, 0x20, 0x10, 0x01


class Message:
    def __init__(self, address, data, length):
        self.address, self.data, self.length = address, data, length

    @staticmethod
    def write(address, data):
        return Message(address, bytes(data), None)

    @staticmethod
    def read(address, length):
        return Message(address, b"", length)

    def __iter__(self):
        return iter(self.data)


class Chip:
    """A chip, and what it has put out."""

    def __init__(self):
        self.power_on()
        #: Pulses that left the chip: (channel, counts) from the moment it was awake.
        self.pulses = []
        self.refused_prescale = 0

    def power_on(self):
        """Set the registers as they are after power-on: asleep, every output fully off, 200 Hz."""
        self.registers = bytearray(256)
        self.registers[MODE1] = SLEEP | ALLCALL
        self.registers[MODE2] = 0x04
        self.registers[PRE_SCALE] = 30
        for channel in range(16):
            self.registers[LED0_ON_L + 4 * channel + 3] = 0x10
        self.pointer = 0

    def write(self, data):
        self.pointer, *values = data
        before = {c: self.counts(c) for c in range(16)}
        slept = self.asleep
        for value in values:
            self._set(self.pointer, value)
            if self.registers[MODE1] & AUTO_INCREMENT:
                self.pointer = (self.pointer + 1) % 256
        if not self.asleep:
            for channel in range(16):
                counts = self.counts(channel)
                if counts and (slept or counts != before[channel]):
                    self.pulses.append((channel, counts))

    def read(self, length):
        return bytes(self.registers[self.pointer + i] for i in range(length))

    def _set(self, register, value):
        if register == PRE_SCALE:
            if not self.asleep:
                self.refused_prescale += 1
                return
            value = max(value, 3)
        if register == MODE1:
            # Writing 1 to RESTART clears it; it never reads as what was written.
            value &= ~RESTART & 0xFF
        self.registers[register] = value

    @property
    def asleep(self):
        return bool(self.registers[MODE1] & SLEEP)

    @property
    def period_s(self):
        return 4096 * (self.registers[PRE_SCALE] + 1) / 25e6

    def counts(self, channel):
        on_l, on_h, off_l, off_h = self.registers[LED0_ON_L + 4 * channel : LED0_ON_L + 4 * channel + 4]
        if off_h & 0x10:
            return 0
        return (off_l | (off_h & 0x0F) << 8) - (on_l | (on_h & 0x0F) << 8)

    def pulse_us(self, channel):
        return 0.0 if self.asleep else 1e6 * self.period_s * self.counts(channel) / 4096


class Bus:
    """A bus with one chip: transfers fail while ``broken``, and the next ``glitches`` of them do, too."""

    def __init__(self, chip, address=0x40):
        self.chip, self.address = chip, address
        self.wire = []
        self.broken = self.closed = False
        self.glitches = 0
        self.before_transfer = None
        #: The device, for locks.
        self.fd = os.memfd_create("i2c")

    def i2c_rdwr(self, *messages):
        for message in messages:
            if self.before_transfer is not None:
                self.before_transfer(message)
            self.glitches -= 1
            if self.broken or message.address != self.address or self.glitches >= 0:
                raise OSError(errno.EREMOTEIO, "Remote I/O error")
            if message.length is None:
                self.wire.append(message.data)
                self.chip.write(message.data)
            else:
                message.data = self.chip.read(message.length)

    def close(self):
        self.closed = True

    def __del__(self):
        os.close(self.fd)


def install(monkeypatch, bus, number=1):
    """Let ``import smbus2`` find the emulator."""
    module = types.ModuleType("smbus2")

    def open_bus(wanted):
        if wanted != number:
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", f"/dev/i2c-{wanted}")
        return bus

    module.SMBus, module.i2c_msg = open_bus, Message
    monkeypatch.setitem(__import__("sys").modules, "smbus2", module)
