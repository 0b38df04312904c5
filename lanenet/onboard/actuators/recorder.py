"""An actuator without a car: it keeps the commands."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from lanenet.config import Settings
from lanenet.onboard.neutral import CONFIRMED, Neutral


class RecorderSettings(Settings):
    """Settings of :class:`Recorder`.

    Attributes:
        kind: Chooses this actuator.
        keep: Number of newest commands that are kept.
    """

    kind: Literal["recorder"] = "recorder"
    keep: int = Field(default=1000, ge=1)


@dataclass(frozen=True)
class SentCommand:
    """One command.

    Attributes:
        t_s: When it came, on the clock of :func:`time.monotonic`.
        steering_rad: Positive left.
        throttle: -1 to 1.
    """

    t_s: float
    steering_rad: float
    throttle: float


class Recorder:
    """Keeps the newest commands; for replays and tests.

    Attributes:
        commands: Oldest first; ``neutral`` and ``close`` count as a command of 0 and 0.
        is_open: Between ``open`` and ``close``.
    """

    def __init__(self, settings: RecorderSettings) -> None:
        self.commands: deque[SentCommand] = deque(maxlen=settings.keep)
        self.is_open = False

    def open(self) -> None:
        """Start; see :class:`lanenet.onboard.actuators.actuator.Actuator`."""
        self.is_open = True
        self.neutral()

    def send(self, steering_rad: float, throttle: float) -> None:
        """Keep a command."""
        self.commands.append(SentCommand(time.monotonic(), steering_rad, throttle))

    def neutral(self) -> Neutral:
        """Keep a command of 0 and 0; confirmed, since there is no motor."""
        self.send(0.0, 0.0)
        return CONFIRMED

    def close(self) -> None:
        """Keep a command of 0 and 0, once."""
        if self.is_open:
            self.neutral()
        self.is_open = False
