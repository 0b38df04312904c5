"""Sources of frames, chosen by ``kind``: cameras, and a recording in place of one."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from lanenet.onboard.cameras.picamera import PiCameraSettings
from lanenet.onboard.cameras.replay import ReplaySettings
from lanenet.onboard.cameras.rpicam import RpicamSettings
from lanenet.onboard.cameras.v4l2 import V4L2Settings
from lanenet.onboard.devices import FrameSource

__all__ = ["SourceSettings", "open_source"]

#: A new source is a module and its settings here; ``make_source`` of the settings builds it.
SourceSettings = Annotated[
    PiCameraSettings | RpicamSettings | V4L2Settings | ReplaySettings, Field(discriminator="kind")
]


def open_source(settings: SourceSettings) -> FrameSource:
    """Build the source that the settings describe; the device is not touched before ``open``."""
    return settings.make_source()
