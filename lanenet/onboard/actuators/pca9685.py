"""Servo and speed controller on a PCA9685, the 16-channel pulse generator of most Donkeycars, over I2C.

The chip has no watchdog: it repeats the last pulses when the computer stops sending. Where that matters, use
a board that has one (``firmware/lanenet_uno``).

Source: NXP PCA9685 data sheet, revision 4: registers in 7.3, prescaler in 7.3.5, restart in 7.3.1.1.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from lanenet.data.files import require
from lanenet.errors import HardwareError
from lanenet.onboard.actuators.pulses import PulseSettings, brief_lock, command_pulses, neutral_pulses

MODE1, MODE2, LED0_ON_L, PRE_SCALE = 0x00, 0x01, 0x06, 0xFE
RESTART, AUTO_INCREMENT, SLEEP = 0x80, 0x20, 0x10
#: MODE2: outputs drive high and low, as servos need, and change at the I2C stop.
OUTDRV = 0x04
OSCILLATOR_HZ = 25e6
COUNTS = 4096
#: The oscillator needs 0.5 ms to start after sleep.
_OSCILLATOR_START_S = 0.001
#: Motors disturb the bus now and then; a transfer without acknowledgement is repeated.
_TRIES = 3

_log = logging.getLogger(__name__)


class PCA9685Settings(PulseSettings):
    """Settings of :class:`PCA9685`.

    Attributes:
        kind: Chooses this actuator.
        myconfig: A Donkeycar's ``myconfig.py``, which sets what these settings leave out; it is parsed, never
            run.
        bus: Number of the I2C bus; 1 is on the header of a Raspberry Pi.
        address: Of the chip; 0x40 (64) unless its jumpers are soldered.
        frequency_hz: Pulses per second; the chip takes the nearest rate it can.
        steering_channel: Output of the steering servo.
        throttle_channel: Output of the speed controller.
    """

    kind: Literal["pca9685"] = "pca9685"
    myconfig: Path | None = None
    bus: int = Field(default=1, ge=0)
    address: int = Field(default=0x40, ge=0x03, le=0x77)
    frequency_hz: float = Field(default=60.0, ge=24.0, le=400.0)
    steering_channel: int = Field(default=1, ge=0, le=15)
    throttle_channel: int = Field(default=0, ge=0, le=15)


def prescale_of(frequency_hz: float) -> int:
    """Return the PRE_SCALE register for a rate: round(25 MHz / (4096 * rate)) - 1, data sheet eq. 1."""
    return round(OSCILLATOR_HZ / (COUNTS * frequency_hz)) - 1


def counts_of(pulse_us: float, prescale: int) -> int:
    """Return the length of a pulse in counts of the chip, 4096 of which make one period."""
    return round(pulse_us * 1e-6 * OSCILLATOR_HZ / (prescale + 1))


class PCA9685:
    """Steering servo and motor on two outputs of a PCA9685; an ``Actuator``."""

    def __init__(self, settings: PCA9685Settings) -> None:
        self._settings = settings
        self._prescale = prescale_of(settings.frequency_hz)
        self._bus: Any = None
        self._message: Any = None
        self._lock = threading.Lock()
        #: Counts calls of ``neutral``, so that a command that hung meanwhile does not undo it.
        self._stops = 0

    def open(self) -> None:
        """Set the rate, load neutral pulses, and only then wake the outputs.

        Raises:
            HardwareError: If bus or chip do not answer, or the chip is no PCA9685.
            MissingExtraError: If smbus2 is not installed.
        """
        smbus2 = require("smbus2", "car")
        path = f"/dev/i2c-{self._settings.bus}"
        try:
            self._bus = smbus2.SMBus(self._settings.bus)
        except OSError as error:
            raise HardwareError(
                f"{path}: cannot be opened ({error.strerror or error}); switch I2C on (sudo raspi-config, "
                "Interface Options) and join its group (sudo usermod -aG i2c $USER)"
            ) from None
        self._message = smbus2.i2c_msg
        try:
            self._start()
        except OSError as error:
            self._release()
            raise HardwareError(
                f"{path}: no PCA9685 answers at address 0x{self._settings.address:02x} "
                f"({error.strerror or error}); look for it with i2cdetect -y {self._settings.bus}"
            ) from None
        except HardwareError:
            self._release()
            raise

    def _start(self) -> None:
        # The prescaler can be written only in sleep. Pulses are loaded before the chip wakes, so that the
        # speed controller's first pulse is neutral.
        self._write(MODE1, AUTO_INCREMENT | SLEEP)
        self._write(MODE2, OUTDRV)
        self._write(PRE_SCALE, self._prescale)
        self._write_neutral()
        self._write(MODE1, AUTO_INCREMENT)
        time.sleep(_OSCILLATOR_START_S)
        # Outputs that were running before the sleep start again with this bit.
        self._write(MODE1, AUTO_INCREMENT | RESTART)
        found = self._read(PRE_SCALE)
        if found != self._prescale:
            raise HardwareError(
                f"/dev/i2c-{self._settings.bus}: register PRE_SCALE at address "
                f"0x{self._settings.address:02x} holds {found}, expected {self._prescale}; is the chip there "
                "a PCA9685, and does another program use it?"
            )

    def send(self, steering_rad: float, throttle: float) -> None:
        """Set both outputs; see :class:`lanenet.onboard.devices.Actuator`.

        Raises:
            HardwareError: If it is not open, a value is not finite, or the chip did not answer or has
                restarted.
        """
        stops = self._stops
        pulses = command_pulses(self._settings, steering_rad, throttle)
        if self._bus is None:
            raise HardwareError("pca9685: not open")
        with self._lock:
            try:
                self._write_channel(self._settings.steering_channel, pulses.steering_us)
                if stops == self._stops:
                    self._write_channel(self._settings.throttle_channel, pulses.throttle_us)
                asleep = self._is_asleep()
            except OSError as error:
                raise HardwareError(
                    f"/dev/i2c-{self._settings.bus}: the PCA9685 at 0x{self._settings.address:02x} stopped "
                    f"answering ({error.strerror or error}); check its cable and supply"
                ) from None
        if asleep:
            raise HardwareError(
                f"/dev/i2c-{self._settings.bus}: the PCA9685 at 0x{self._settings.address:02x} has restarted "
                "and sends no pulses; check its supply"
            )

    def neutral(self) -> None:
        """Stop the motor, then straighten the wheels; never raises."""
        self._stops += 1
        if self._bus is None:
            return
        with brief_lock(self._lock):
            try:
                self._write_neutral()
            except Exception as error:
                _log.error("pca9685: neutral could not be sent: %s", error)

    def close(self) -> None:
        """Go to neutral and release the bus; the chip keeps sending neutral pulses."""
        self.neutral()
        self._release()

    def _release(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()

    def _write_neutral(self) -> None:
        pulses = neutral_pulses(self._settings)
        self._write_channel(self._settings.throttle_channel, pulses.throttle_us)
        self._write_channel(self._settings.steering_channel, pulses.steering_us)

    def _write_channel(self, channel: int, pulse_us: float) -> None:
        """Set an output high at count 0 and low at the pulse's end: ON_L, ON_H, OFF_L, OFF_H."""
        off = counts_of(pulse_us, self._prescale)
        self._write(LED0_ON_L + 4 * channel, 0, 0, off & 0xFF, off >> 8)

    def _is_asleep(self) -> bool:
        """Tell whether the chip has restarted: after a moment without supply it answers, but sleeps."""
        # Read twice: the bus has no checksum, and one wrong bit must not end a drive.
        return all(self._read(MODE1) & SLEEP for _ in range(2))

    def _write(self, register: int, *values: int) -> None:
        self._transfer(self._message.write(self._settings.address, [register, *values]))

    def _read(self, register: int) -> int:
        answer = self._message.read(self._settings.address, 1)
        self._transfer(self._message.write(self._settings.address, [register]), answer)
        return int(next(iter(answer)))

    def _transfer(self, *messages: Any) -> None:
        for left in reversed(range(_TRIES)):
            try:
                self._bus.i2c_rdwr(*messages)
                return
            except OSError:
                if not left:
                    raise
