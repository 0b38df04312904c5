"""Stands in for Adafruit_PCA9685 and Adafruit_GPIO in a Donkeycar without hardware: notes what it is told.

A copy lies under both names in the car's folder. Every change of a pulse is a line of ``pulses.txt``: time,
channel, counts of 4096.
"""

import time


class I2C:
    """What donkeycar imports to choose the bus."""


class PCA9685:
    """The chip: keeps its pulses until they are set anew, as the real one does."""

    def __init__(self, address: int) -> None:
        self.counts: dict[int, int] = {}
        self.notes = open("pulses.txt", "a", buffering=1)  # noqa: SIM115

    def set_pwm_freq(self, freq_hz: float) -> None:
        self.freq_hz = freq_hz

    def set_pwm(self, channel: int, on: int, off: int) -> None:
        if self.counts.get(channel) != off:
            self.counts[channel] = off
            self.notes.write(f"{time.time():.4f} {channel} {off}\n")
        # Donkeycar's threads write without a pause; on a bus of 100 kHz a pulse takes 0.5 ms.
        time.sleep(0.0005)
