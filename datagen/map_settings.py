"""Settings of all mapping stages in one place."""

from __future__ import annotations

from pydantic import Field

from datagen.lanes.fit import FitSettings
from datagen.lanes.trace import TraceSettings
from datagen.slam.calibrate import GuessSettings
from datagen.slam.filter import FilterSettings
from datagen.slam.mapper import MotionSettings
from datagen.slam.places import RevisitSettings
from lanenet.config import Settings
from lanenet.perception.birdseye import PerceptionSettings

#: The resolved settings in a map's folder.
SETTINGS_NAME = "settings.yaml"


class MapSettings(Settings):
    """Everything that mapping a drive can be told; the defaults are meant to fit every drive."""

    seed: int = Field(default=0, ge=0)
    perception: PerceptionSettings = PerceptionSettings()
    guess: GuessSettings = GuessSettings()
    filter: FilterSettings = FilterSettings()
    motion: MotionSettings = MotionSettings()
    revisits: RevisitSettings = RevisitSettings()
    trace: TraceSettings = TraceSettings()
    fit: FitSettings = FitSettings()
