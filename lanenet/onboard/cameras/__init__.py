"""Sources of frames, chosen by ``kind``: cameras, and a recording in place of one."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from lanenet.onboard.cameras.live import LiveSource
from lanenet.onboard.cameras.picamera import PiCamera, PiCameraSettings
from lanenet.onboard.cameras.replay import ReplaySettings, ReplaySource
from lanenet.onboard.cameras.rpicam import Rpicam, RpicamSettings
from lanenet.onboard.cameras.v4l2 import V4L2Camera, V4L2Settings
from lanenet.onboard.devices import FrameSource

__all__ = ["SourceSettings", "open_source"]

SourceSettings = Annotated[
    PiCameraSettings | RpicamSettings | V4L2Settings | ReplaySettings, Field(discriminator="kind")
]


def open_source(settings: SourceSettings) -> FrameSource:
    """Build the source that the settings describe; the device is not touched before ``open``."""
    if isinstance(settings, ReplaySettings):
        return ReplaySource(settings)
    if isinstance(settings, PiCameraSettings):
        return LiveSource(PiCamera(settings), settings)
    if isinstance(settings, RpicamSettings):
        return LiveSource(Rpicam(settings), settings)
    return LiveSource(V4L2Camera(settings), settings)
