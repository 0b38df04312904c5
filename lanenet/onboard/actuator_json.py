"""The actuator of the guard's process, from settings that came as text."""

from __future__ import annotations

from pydantic import TypeAdapter

from lanenet.onboard.actuators import ActuatorSettings, make_actuator
from lanenet.onboard.hardware import Actuator

#: What :class:`lanenet.onboard.guard.GuardedActuator` is told to call. A module of its own, because the guard
#: loads nothing that it does not need.
FACTORY = "lanenet.onboard.actuator_json:actuator_from_json"


def actuator_from_json(text: str) -> Actuator:
    """Build an actuator of its settings as JSON; the device is not touched.

    Raises:
        ConfigError: If the settings name a file that cannot be used.
    """
    adapter: TypeAdapter[ActuatorSettings] = TypeAdapter(ActuatorSettings)
    return make_actuator(adapter.validate_json(text))
