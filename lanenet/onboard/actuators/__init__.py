"""Actuators, chosen by ``kind``: steering servo and motor."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from lanenet.onboard.actuators.myconfig import with_myconfig
from lanenet.onboard.actuators.pca9685 import PCA9685, PCA9685Settings
from lanenet.onboard.actuators.recorder import Recorder, RecorderSettings
from lanenet.onboard.actuators.serial_board import SerialBoard, SerialBoardSettings
from lanenet.onboard.devices import Actuator

__all__ = ["ActuatorSettings", "make_actuator"]

ActuatorSettings = Annotated[
    PCA9685Settings | SerialBoardSettings | RecorderSettings, Field(discriminator="kind")
]


def make_actuator(settings: ActuatorSettings) -> Actuator:
    """Build the actuator that the settings describe; the device is not touched before ``open``.

    Raises:
        ConfigError: If a ``myconfig.py`` that they name cannot be used.
    """
    if isinstance(settings, PCA9685Settings):
        return PCA9685(with_myconfig(settings))
    if isinstance(settings, SerialBoardSettings):
        return SerialBoard(settings)
    return Recorder(settings)
