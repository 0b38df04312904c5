"""Actuators, chosen by ``kind``: steering servo and motor."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from lanenet.config import Settings, check_settings
from lanenet.onboard.actuators.actuator import Actuator
from lanenet.onboard.actuators.myconfig import with_myconfig
from lanenet.onboard.actuators.pca9685 import PAUSE_S, PCA9685, PCA9685Settings, start_writes
from lanenet.onboard.actuators.recorder import Recorder, RecorderSettings
from lanenet.onboard.actuators.serial_board import SerialBoard, SerialBoardSettings

__all__ = ["ActuatorSettings", "actuator_from_json", "check_actuator", "first_writes", "make_actuator"]

ActuatorSettings = Annotated[
    PCA9685Settings | SerialBoardSettings | RecorderSettings, Field(discriminator="kind")
]


class _Car(Settings):
    """The part of a car's file that says how to stop it."""

    actuator: ActuatorSettings


def check_actuator(data: Any, where: str) -> ActuatorSettings:
    """Check the section ``actuator`` of a car's file.

    Raises:
        ConfigError: Naming the file, the key, what was found and what was expected.
    """
    return check_settings(_Car, {"actuator": data}, where).actuator


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


def actuator_from_json(text: str) -> Actuator:
    """Build an actuator from its settings as JSON; the device is not touched.

    Raises:
        ConfigError: As :func:`make_actuator`.
    """
    adapter: TypeAdapter[ActuatorSettings] = TypeAdapter(ActuatorSettings)
    return make_actuator(adapter.validate_json(text))


def first_writes(settings: ActuatorSettings) -> dict[str, Any] | None:
    """Return what puts an actuator into neutral, prepared for a guard that has imported nothing yet.

    Returns:
        Bus, address, writes as hexadecimal text and the pause after each, [s]; None where the driver has to
        be there first.

    Raises:
        ConfigError: As :func:`make_actuator`.
    """
    if not isinstance(settings, PCA9685Settings):
        return None
    settings = with_myconfig(settings)
    writes = [data.hex() for data in start_writes(settings)]
    return {"bus": settings.bus, "address": settings.address, "writes": writes, "pause_s": PAUSE_S}
