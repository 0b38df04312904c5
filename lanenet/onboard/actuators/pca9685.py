"""Servo and speed controller on a PCA9685, the 16-channel pulse generator of most Donkeycars, over I2C.

The chip has no watchdog: it repeats the last pulses when the computer stops sending. Where that matters, give
it a ``heartbeat``, or use a board that has a watchdog (``firmware/lanenet_uno``).

Source: NXP PCA9685 data sheet, revision 4: registers in 7.3, prescaler in 7.3.5, restart in 7.3.1.1.
"""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from lanenet.config import Rule
from lanenet.errors import HardwareError
from lanenet.onboard.actuators.heartbeat import HEADER, Heartbeat, HeartbeatSettings
from lanenet.onboard.actuators.pulses import PulseSettings, brief_lock, command_pulses, neutral_pulses
from lanenet.onboard.i2c import I2CChip

MODE1, MODE2, LED0_ON_L, PRE_SCALE = 0x00, 0x01, 0x06, 0xFE
RESTART, AUTO_INCREMENT, SLEEP = 0x80, 0x20, 0x10
#: MODE2: outputs drive high and low, as servos need, and change at the I2C stop.
OUTDRV = 0x04
OSCILLATOR_HZ = 25e6
COUNTS = 4096
#: After every write of the start; the oscillator needs 0.5 ms to start after sleep.
PAUSE_S = 0.001
#: GPIO lines of the two I2C buses on a Raspberry Pi's header.
_I2C_LINES = {0: (0, 1), 1: (2, 3)}
_PULSES = (
    "steering_left_us", "steering_right_us", "throttle_forward_us", "throttle_stopped_us",
    "throttle_reverse_us",
)  # fmt: skip
#: What a ``myconfig.py`` may set.
_FROM_MYCONFIG = frozenset({*_PULSES, "bus", "address", "steering_channel", "throttle_channel"})

_log = logging.getLogger(__name__)


def _shorter_than_the_period(pulse: str) -> Rule:
    return Rule(
        (pulse, "frequency_hz"),
        lambda s: counts_of(getattr(s, pulse), prescale_of(s.frequency_hz)) < COUNTS,
        lambda s: f"expected a pulse shorter than the period of {_period_us(s.frequency_hz):.0f} us",
    )


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
        heartbeat: A GPIO line with a pulse for every command that the chip took, for a watchdog of hardware
            at its OE pin; None if there is none.
    """

    rules: ClassVar[tuple[Rule, ...]] = (
        *PulseSettings.rules,
        Rule(
            ("steering_channel", "throttle_channel"),
            lambda s: s.steering_channel != s.throttle_channel,
            lambda _: "expected two channels: the motor must not get the pulses of the steering",
        ),
        *map(_shorter_than_the_period, _PULSES),
        Rule(
            ("heartbeat.line", "heartbeat.chip", "bus"),
            lambda s: s.heartbeat.chip != HEADER or s.heartbeat.line not in _I2C_LINES.get(s.bus, ()),
            lambda _: "expected a line that is not one of this I2C bus, which would end with the first pulse",
        ),
    )

    kind: Literal["pca9685"] = "pca9685"
    myconfig: Path | None = None
    bus: int = Field(default=1, ge=0)
    address: int = Field(default=0x40, ge=0x03, le=0x77)
    frequency_hz: float = Field(default=60.0, ge=24.0, le=400.0)
    steering_channel: int = Field(default=1, ge=0, le=15)
    throttle_channel: int = Field(default=0, ge=0, le=15)
    heartbeat: HeartbeatSettings | None = None

    def open_keys(self) -> frozenset[str]:
        """Return what ``myconfig`` may still set."""
        return frozenset() if self.myconfig is None else _FROM_MYCONFIG - self.model_fields_set


def prescale_of(frequency_hz: float) -> int:
    """Return the PRE_SCALE register for a rate: round(25 MHz / (4096 * rate)) - 1, data sheet eq. 1."""
    return round(OSCILLATOR_HZ / (COUNTS * frequency_hz)) - 1


def counts_of(pulse_us: float, prescale: int) -> int:
    """Return the length of a pulse in counts of the chip, 4096 of which make one period."""
    return round(pulse_us * 1e-6 * OSCILLATOR_HZ / (prescale + 1))


def _period_us(frequency_hz: float) -> float:
    """Return the chip's period at the nearest rate that it can."""
    return 1e6 * COUNTS * (prescale_of(frequency_hz) + 1) / OSCILLATOR_HZ


def neutral_writes(settings: PCA9685Settings) -> list[bytes]:
    """Return what stops the motor of a chip that runs, then straightens the wheels."""
    pulses = neutral_pulses(settings)
    return [
        _pulse_write(settings, settings.throttle_channel, pulses.throttle_us),
        _pulse_write(settings, settings.steering_channel, pulses.steering_us),
    ]


def start_writes(settings: PCA9685Settings) -> list[bytes]:
    """Return what brings a chip into neutral from any state, with ``PAUSE_S`` after each.

    The prescaler can be written only in sleep. Pulses are loaded before the chip wakes, so that the speed
    controller's first pulse is neutral. Outputs that were running before the sleep start again with the
    last bit.
    """
    return [
        bytes([MODE1, AUTO_INCREMENT | SLEEP]),
        bytes([MODE2, OUTDRV]),
        bytes([PRE_SCALE, prescale_of(settings.frequency_hz)]),
        *neutral_writes(settings),
        bytes([MODE1, AUTO_INCREMENT]),
        bytes([MODE1, AUTO_INCREMENT | RESTART]),
    ]


def _pulse_write(settings: PCA9685Settings, channel: int, pulse_us: float) -> bytes:
    """Set an output high at count 0 and low at the pulse's end: ON_L, ON_H, OFF_L, OFF_H."""
    off = counts_of(pulse_us, prescale_of(settings.frequency_hz))
    return bytes([LED0_ON_L + 4 * channel, 0, 0, off & 0xFF, off >> 8])


class PCA9685:
    """Steering servo and motor on two outputs of a PCA9685; an ``Actuator`` and a ``Spare``."""

    def __init__(self, settings: PCA9685Settings) -> None:
        self._settings = settings
        self._chip: I2CChip | None = None
        self._heartbeat: Heartbeat | None = None
        self._lock = threading.Lock()
        self._neutral = neutral_writes(settings)
        #: What the throttle's output holds as far as this program has written it.
        self._throttle = self._neutral[0]
        #: Counts calls of ``neutral``, so that a command that hung meanwhile does not undo it.
        self._stops = 0

    def open(self) -> None:
        """Become the chip's owner, set the rate, load neutral pulses, and only then wake the outputs.

        Raises:
            HardwareError: If bus or chip do not answer, the chip is no PCA9685, or another process owns it.
            MissingExtraError: If smbus2 is not installed.
        """
        self._connect(owner=True)

    def attach(self) -> None:
        """Open a second access for neutral, beside the owner's; see :class:`Spare`.

        Raises:
            HardwareError: If the bus cannot be opened.
            MissingExtraError: If smbus2 is not installed.
        """
        chip = I2CChip(self._settings.bus, self._settings.address)
        chip.open()
        self._chip = chip

    def force_neutral(self) -> None:
        """Open a second access and put the chip into neutral from any state, whoever owns it.

        Raises:
            HardwareError: If bus or chip do not answer, or the chip is no PCA9685.
            MissingExtraError: If smbus2 is not installed.
        """
        self._connect(owner=False)

    def owner(self) -> int:
        """Return the id of the process that owns the chip; see :func:`lanenet.onboard.i2c.lock_owners`."""
        return 0 if self._chip is None else self._chip.owner()

    def _connect(self, *, owner: bool) -> None:
        self.attach()
        assert self._chip is not None
        try:
            if owner:
                self._chip.own()
            if not owner and self._is_running(self._chip):
                # Its owner must not find it asleep, and the pulses have no gap.
                for data in self._neutral:
                    self._chip.write(data)
            else:
                self._start()
            if self._settings.heartbeat is not None and owner:
                self._heartbeat = Heartbeat(self._settings.heartbeat)
                self._heartbeat.open()
        except OSError as error:
            name = self._chip.name
            self.release()
            raise HardwareError(
                f"{name}: no PCA9685 answers ({error.strerror or error}); look for it with i2cdetect -y "
                f"{self._settings.bus}"
            ) from None
        except HardwareError:
            self.release()
            raise

    def _start(self) -> None:
        assert self._chip is not None
        prescale = prescale_of(self._settings.frequency_hz)
        for data in start_writes(self._settings):
            self._chip.write(data)
            time.sleep(PAUSE_S)
        found = self._chip.read(PRE_SCALE, 1)[0]
        if found != prescale:
            raise HardwareError(
                f"{self._chip.name}: register PRE_SCALE holds {found}, expected {prescale}; is the chip "
                "there a PCA9685, and does another program use it?"
            )

    def send(self, steering_rad: float, throttle: float) -> None:
        """Set both outputs; see :class:`lanenet.onboard.actuators.actuator.Actuator`.

        Raises:
            HardwareError: If it is not open, a value is not finite, the chip did not answer or has restarted,
                or another program has changed the throttle.
        """
        settings, stops, chip = self._settings, self._stops, self._chip
        pulses = command_pulses(settings, steering_rad, throttle)
        if chip is None:
            raise HardwareError("pca9685: not open")
        with self._lock:
            try:
                asleep = self._is_asleep(chip)
                foreign = None if asleep else self._foreign_counts(chip)
                if not asleep and foreign is None:
                    chip.write(_pulse_write(settings, settings.steering_channel, pulses.steering_us))
                    if stops == self._stops:
                        self._throttle = _pulse_write(settings, settings.throttle_channel, pulses.throttle_us)
                        chip.write(self._throttle)
            except OSError as error:
                raise HardwareError(
                    f"{chip.name}: the PCA9685 stopped answering ({error.strerror or error}); check its "
                    "cable and supply"
                ) from None
        if asleep:
            raise HardwareError(
                f"{chip.name}: the PCA9685 has restarted and sends no pulses; check its supply"
            )
        if foreign is not None:
            raise HardwareError(
                f"{chip.name}: channel {settings.throttle_channel} holds {foreign} counts, which lanenet did "
                "not write; does another program move the car as well (Donkeycar's manage.py)? End it first"
            )
        self._beat()

    def neutral(self) -> None:
        """Stop the motor, then straighten the wheels; never raises."""
        self._stops += 1
        if self._chip is None:
            return
        with brief_lock(self._lock):
            try:
                self._throttle = self._neutral[0]
                for data in self._neutral:
                    self._chip.write(data)
            except Exception as error:
                _log.error("pca9685: neutral could not be sent: %s", error)
                return
        self._beat()

    def close(self) -> None:
        """Go to neutral and release the bus; the chip keeps sending neutral pulses."""
        self.neutral()
        self.release()

    def release(self) -> None:
        """Release the bus and leave the chip as it is; harmless if it is not open."""
        chip, self._chip = self._chip, None
        heartbeat, self._heartbeat = self._heartbeat, None
        if heartbeat is not None:
            heartbeat.close()
        if chip is not None:
            chip.close()

    def _beat(self) -> None:
        if self._heartbeat is not None:
            self._heartbeat.beat()

    def _is_running(self, chip: I2CChip) -> bool:
        mode, prescale = chip.read(MODE1, 1)[0], chip.read(PRE_SCALE, 1)[0]
        awake = mode & (SLEEP | AUTO_INCREMENT) == AUTO_INCREMENT
        return awake and prescale == prescale_of(self._settings.frequency_hz)

    def _is_asleep(self, chip: I2CChip) -> bool:
        """Tell whether the chip has restarted: after a moment without supply it answers, but sleeps."""
        # Read twice: the bus has no checksum, and one wrong bit must not end a drive.
        return all(chip.read(MODE1, 1)[0] & SLEEP for _ in range(2))

    def _foreign_counts(self, chip: I2CChip) -> int | None:
        """Return what another program has made of the throttle; None if it is as it was left, or neutral.

        No lock keeps out a program that does not ask for it.
        """
        for _ in range(2):
            off = chip.read(self._throttle[0] + 2, 2)
            if off in (self._throttle[3:], self._neutral[0][3:]):
                return None
        return off[0] | off[1] << 8
