"""What a live filter takes in and gives out, a frame at a time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from datagen.slam.filter import Estimate
from lanenet.config import Settings
from lanenet.data.drive import Drive
from lanenet.data.recording import Commands
from lanenet.errors import DriveFormatError

#: Frames in which a speed can be found.
LEAST_START = 60


class StartSettings(Settings):
    """What is known of the car, or is to be found while it sets out.

    Attributes:
        frames: Frames in which the usual speed and how the car answers to the steering are found.
        factor: Gain of a recorded speed; the usual way per frame, [cm], where none is recorded. None finds it
            from the first frames, whose poses come when the last of them has been seen.
    """

    frames: int = Field(default=300, ge=LEAST_START)
    factor: float | None = Field(default=None, gt=0.0)


@dataclass(frozen=True, eq=False)
class Moment:
    """What a car knows at one moment, from a recording or from its camera.

    Attributes:
        frame: Frame number.
        t_s: Time of the frame, rising from moment to moment.
        image: The frame; None where it could not be read.
        commands: What the car is told to do, in one row.
        starts: Whether the frame is known not to follow the one before.
    """

    frame: int
    t_s: float
    image: UInt8[np.ndarray, "h w 3"] | None
    commands: Commands
    starts: bool = False


@dataclass(frozen=True, eq=False)
class LivePose:
    """Pose of a frame, as known when it had been seen.

    Attributes:
        frame: Frame number.
        t_s: Its time.
        segment: Stretch without an interruption, from 0; each has a map of its own.
        estimate: Pose and how sure it is; ``match`` is NaN where the frame was not matched.
        points_cm: Edge points of the frame, frame car; none where the car stands.
    """

    frame: int
    t_s: float
    segment: int
    estimate: Estimate
    points_cm: Float[np.ndarray, "m 2"]


def moments_of(drive: Drive) -> Iterator[Moment]:
    """Replay a recorded drive; a frame that cannot be read comes without its image."""
    for k in range(len(drive)):
        image: UInt8[np.ndarray, "h w 3"] | None
        try:
            image = drive.image(k)
        except DriveFormatError:
            image = None
        commands = drive.commands.subset(np.array([k]))
        yield Moment(int(drive.frames[k]), float(drive.t_s[k]), image, commands, bool(drive.breaks[k]))
