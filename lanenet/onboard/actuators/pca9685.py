"""Servo and speed controller on a PCA9685, the 16-channel pulse generator of most Donkeycars, over I2C.

The chip has no watchdog: it repeats the last pulses when the computer stops sending. Where that matters, give
it a ``heartbeat``, or use a board that has a watchdog (``firmware/lanenet_uno``).

Source: NXP PCA9685 data sheet, revision 4: registers in 7.3, prescaler in 7.3.5, restart in 7.3.1.1.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from lanenet.config import Rule
from lanenet.errors import HardwareError
from lanenet.onboard.actuators.heartbeat import HEADER, Heartbeat, HeartbeatSettings
from lanenet.onboard.actuators.pulses import PulseSettings, brief_lock, command_pulses, neutral_pulses
from lanenet.onboard.i2c import I2CChip
from lanenet.onboard.neutral import CONFIRMED, Neutral

MODE1, MODE2, LED0_ON_L, PRE_SCALE = 0x00, 0x01, 0x06, 0xFE
RESTART, EXTCLK, AUTO_INCREMENT, SLEEP = 0x80, 0x40, 0x20, 0x10
#: MODE2: outputs drive high and low, as servos need; not inverted, and low while OE is high.
OUTDRV, _MODE2_USED = 0x04, 0x1F
OSCILLATOR_HZ = 25e6
COUNTS = 4096
#: A chip in neutral is read this often before neutral is sent again, for what another program has written;
#: chosen: some milliseconds in all.
_WATCHED = 3
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
        #: Writes of the throttle's and of the steering's output.
        self._neutral = neutral_writes(settings)
        #: What the two outputs hold as far as this program has written them.
        self._held = list(self._neutral)
        #: Whether the chip held neutral when it was last read.
        self._is_neutral = False
        #: Counts calls of ``neutral``, so that a command that hung meanwhile does not undo it.
        self._stops = 0

    def open(self) -> None:
        """Become the chip's owner, set the rate, load neutral pulses, and only then wake the outputs.

        Raises:
            HardwareError: If bus or chip do not answer, the chip is no PCA9685, or another process owns it.
                A chip that does not answer stays attached; see :class:`Actuator`.
            MissingExtraError: If smbus2 is not installed.
        """
        self.attach()
        assert self._chip is not None
        name = self._chip.name
        try:
            self._chip.own()
            try:
                self._start(self._chip)
                wrong = self._differences(self._chip)
            except OSError as error:
                wrong = self._silence(error)
            if not wrong and self._settings.heartbeat is not None:
                self._heartbeat = Heartbeat(self._settings.heartbeat)
                self._heartbeat.open()
        except HardwareError:
            self.release()
            raise
        if wrong:
            raise HardwareError(
                f"{name}: {wrong}; is the chip there a PCA9685, and does another program use it?"
            )

    def attach(self) -> None:
        """Open a second access for neutral, beside the owner's; see :class:`Spare`.

        Raises:
            HardwareError: If the bus cannot be opened.
            MissingExtraError: If smbus2 is not installed.
        """
        chip = I2CChip(self._settings.bus, self._settings.address)
        chip.open()
        self._chip = chip

    def owner(self) -> int:
        """Return the id of the process that owns the chip; see :func:`lanenet.onboard.i2c.lock_owners`."""
        return 0 if self._chip is None else self._chip.owner()

    def send(self, steering_rad: float, throttle: float) -> None:
        """Set both outputs; see :class:`lanenet.onboard.actuators.actuator.Actuator`.

        Raises:
            HardwareError: If it is not open, a value is not finite, the chip did not answer, or anything that
                a pulse depends on is not as it was written.
        """
        settings, stops, chip = self._settings, self._stops, self._chip
        pulses = command_pulses(settings, steering_rad, throttle)
        if chip is None:
            raise HardwareError("pca9685: not open")
        with self._lock:
            try:
                # Neutral is what a spare access writes beside the owner; ``neutral`` changes it meanwhile.
                wrong = self._differences(chip, self._held)
                if not wrong and stops == self._stops:
                    self._held = [
                        _pulse_write(settings, settings.throttle_channel, pulses.throttle_us),
                        _pulse_write(settings, settings.steering_channel, pulses.steering_us),
                    ]
                    self._is_neutral = False
                    for data in reversed(self._held):
                        chip.write(data)
                if stops != self._stops:
                    for data in self._neutral:
                        chip.write(data)
            except OSError as error:
                raise HardwareError(
                    f"{chip.name}: the PCA9685 stopped answering ({error.strerror or error}); check its "
                    "cable and supply"
                ) from None
        if wrong:
            raise HardwareError(
                f"{chip.name}: {wrong}, which lanenet did not write; does another program use the chip "
                "(Donkeycar's manage.py), or has it lost its supply? End the one, check the other"
            )
        self._beat()

    def neutral(self) -> Neutral | None:
        """Stop the motor, straighten the wheels, and read both back; a chip that differs is started anew.

        Returns:
            Confirmed if both pulses, PRE_SCALE, sleep and inversion read as they were written; None if it is
            not open.
        """
        self._stops += 1
        chip = self._chip
        if chip is None:
            return None
        with brief_lock(self._lock):
            try:
                # What held neutral before still does, unless somebody else writes to the chip.
                foreign = ""
                for _ in range(_WATCHED if self._is_neutral else 0):
                    foreign = foreign or self._differences(chip)
                self._is_neutral, self._held = False, list(self._neutral)
                for data in self._neutral:
                    chip.write(data)
                if self._wrong_registers(chip) and self._wrong_registers(chip):
                    self._start(chip)
                wrong = self._differences(chip)
                self._is_neutral = not wrong
                wrong = wrong or (foreign and f"another program writes to it: {foreign}")
            except Exception as error:
                wrong = self._silence(error)
        if wrong:
            return Neutral(False, f"{chip.name}: {wrong}")
        # Else a watchdog of hardware has to switch the outputs off.
        self._beat()
        return CONFIRMED

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

    def _silence(self, error: Exception) -> str:
        reason = getattr(error, "strerror", None) or error
        return (
            f"no PCA9685 answers ({reason}); check its cable and supply, and look for it with i2cdetect -y "
            f"{self._settings.bus}"
        )

    def _beat(self) -> None:
        if self._heartbeat is not None:
            self._heartbeat.beat()

    def _start(self, chip: I2CChip) -> None:
        for data in start_writes(self._settings):
            chip.write(data)
            time.sleep(PAUSE_S)

    def _differences(self, chip: I2CChip, held: Sequence[bytes] = ()) -> str:
        """Compare all that a pulse depends on with what was written; no lock keeps other programs out.

        Args:
            chip: To be read.
            held: Writes of the two outputs that count as well as neutral.

        Returns:
            What differs, twice in a row: the bus has no checksum, and one wrong bit must not end a drive.
            Empty if nothing does.

        Raises:
            OSError: If the chip does not answer.
        """
        return self._compare(chip, held) and self._compare(chip, held)

    def _compare(self, chip: I2CChip, held: Sequence[bytes]) -> str:
        wrong = self._wrong_registers(chip)
        for allowed in zip(self._neutral, held or self._neutral, strict=True):
            output = allowed[0][0]
            data = chip.read(output, 4)
            if all(data != write[1:] for write in allowed):
                on, off = struct.unpack("<HH", data)
                high = f"{off} counts" if not on else f"{off} counts from {on} on"
                wrong.append(f"channel {(output - LED0_ON_L) // 4} holds {high}")
        return " and ".join(wrong)

    def _wrong_registers(self, chip: I2CChip) -> list[str]:
        mode1, mode2 = chip.read(MODE1, 2)
        prescale = chip.read(PRE_SCALE, 1)[0]
        if mode1 & SLEEP:
            return ["the chip sleeps, as after a restart, and sends no pulses"]
        registers = (
            ("MODE1", mode1 & (EXTCLK | AUTO_INCREMENT), AUTO_INCREMENT),
            ("MODE2", mode2 & _MODE2_USED, OUTDRV),
            ("PRE_SCALE", prescale, prescale_of(self._settings.frequency_hz)),
        )
        return [
            f"register {name} holds {found}, expected {expected}"
            for name, found, expected in registers
            if found != expected
        ]
