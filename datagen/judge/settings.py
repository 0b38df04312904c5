"""Settings of a contest: what is driven, how far and how fast, and when a car is lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from datagen.world.car.driver import DriverSettings, PilotSettings
from datagen.world.road.track_settings import TrackSettings, load_track_settings, preset, preset_names
from datagen.world.world import SimulationSettings
from lanenet.config import Settings
from lanenet.errors import ConfigError, did_you_mean

_FILE_ENDINGS = (".yaml", ".yml")
_DRAWN = ("random", "open")
#: Of seeds; the drives of a training run take 0 to 2, so that no road of a contest was trained on.
_STREAM = 3


class JudgeSettings(Settings):
    """A contest.

    Attributes:
        seed: Every road's seed follows from this and its number; all detectors drive the same roads, with the
            same appearance and the same errors of the car.
        tracks: ``random`` (loops), ``open`` (roads with two ends), names of presets, or track files.
        count: Roads of each kind; a track file is one road in this many appearances.
        laps: To be driven; an open road is driven once.
        speed_cm_s: Commanded speed.
        track_width_cm: Distance between the contact points of an axle's wheels.
        off_lane_share: The car is lost when the middle of its front axle is further than this share of the
            lane width from the lane's centre, or when it faces more than 1.2 rad away from the road.
        put_back: Put a lost car back, and count that; otherwise the run ends.
        stuck_s: A car that has not moved for this time is put back, or the run ends.
        slack: A run ends after its nominal time times this.
        pilot: From a lane estimate to the command.
        simulation: Rate, camera, car, look, and what random roads have in common; its seed, frames and driver
            are set here.
    """

    seed: int = Field(default=0, ge=0)
    tracks: tuple[str, ...] = Field(default=("random",), min_length=1)
    count: int = Field(default=20, ge=1)
    laps: int = Field(default=2, ge=1)
    speed_cm_s: float = Field(default=60.0, gt=0.0)
    track_width_cm: float = Field(default=16.0, gt=0.0)
    off_lane_share: float = Field(default=0.75, gt=0.0)
    put_back: bool = True
    stuck_s: float = Field(default=2.0, gt=0.0)
    slack: float = Field(default=3.0, gt=1.0)
    pilot: PilotSettings = PilotSettings()
    simulation: SimulationSettings = SimulationSettings()


def road_names(settings: JudgeSettings) -> list[tuple[str, int]]:
    """Return kind and number of every road of a contest, in order.

    Raises:
        ConfigError: If a kind is named twice.
    """
    kinds = [Path(kind).stem if kind.endswith(_FILE_ENDINGS) else kind for kind in settings.tracks]
    if len(set(kinds)) < len(kinds):
        raise ConfigError(f"tracks: {', '.join(settings.tracks)}: each may be named once")
    return [(kind, number) for kind in kinds for number in range(settings.count)]


def road_simulation(settings: JudgeSettings, index: int) -> SimulationSettings:
    """Return the settings of one road's world.

    Args:
        settings: The contest.
        index: Place in :func:`road_names`.

    Raises:
        ConfigError: If there is no such kind of road.
    """
    kind, number = settings.tracks[index // settings.count], index % settings.count
    # The number alone decides the seed: another kind of road in the list does not change the others.
    seed = int(np.random.SeedSequence([settings.seed, _STREAM, number]).generate_state(1)[0])
    driver = DriverSettings(speed_cm_s=settings.speed_cm_s, wander_cm=0.0)
    changes: dict[str, Any] = {"seed": seed, "track": _track_settings(kind, settings.simulation.track)}
    return settings.simulation.model_copy(update={**changes, "driver": driver})


def _track_settings(kind: str, common: TrackSettings) -> TrackSettings:
    if kind in _DRAWN:
        return common.model_copy(update={"closed": kind == "random"})
    if kind.endswith(_FILE_ENDINGS):
        return load_track_settings(Path(kind))
    known = (*_DRAWN, *preset_names())
    if kind not in known:
        raise ConfigError(
            f"tracks: found {kind!r}, expected {' or '.join(_DRAWN)} (drawn roads), a preset "
            f"({', '.join(preset_names())}) or a track file (.yaml){did_you_mean(kind, known)}"
        )
    return preset(kind)
