"""Settings of a contest: what is driven, how far and how fast, and when a car is lost; its roads and cars."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from datagen.world.car.driver import DriverSettings, PilotSettings
from datagen.world.road.track_settings import TrackSettings, load_track_settings, preset, preset_names
from datagen.world.variety import vary_simulation
from datagen.world.world import SimulationSettings, draw_track
from lanenet.config import Settings, check_settings, read_yaml
from lanenet.errors import ConfigError, did_you_mean

_FILE_ENDINGS = (".yaml", ".yml")
_DRAWN = ("random", "open", "varied")
#: Seeds that are tried for a varied road.
_ROAD_TRIES = 8
#: Of seeds; the drives of a training run take 0 to 2, so that no road of a contest was trained on.
_STREAM = 3


class JudgeSettings(Settings):
    """A contest.

    Attributes:
        seed: Every road's seed follows from this and its number; all detectors drive the same roads, with the
            same appearance and the same errors of the car.
        tracks: ``random`` (loops), ``open`` (roads with two ends), ``varied`` (each road of another kind, as
            those that networks are trained on), names of presets, or track files.
        count: Roads of each kind; a track file is one road in this many appearances.
        counts: Roads of single kinds, where it is not ``count``.
        laps: To be driven; an open road is driven once.
        distance_cm: Driven at most; None: the laps.
        speed_cm_s: Commanded speed.
        start_across_deg: Each car starts with its front axle in the middle of the lane, turned by this, to
            the left on roads of even number and to the right on the others, where the road lets it come back.
        back_within_s: Time to get back into the lane after such a start. Until then, or until the car is
            back, wheels over a line do not count as departures.
        track_width_cm: Distance between the contact points of an axle's wheels. On a preset whose
            competition has cars of its own (``cars.yaml``), this, ``simulation.car.wheelbase_cm`` and
            ``simulation.camera.height_cm`` are those of its cars, unless the settings of the contest name
            them.
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
    counts: dict[str, Annotated[int, Field(ge=1)]] = Field(default={})
    laps: int = Field(default=2, ge=1)
    distance_cm: float | None = Field(default=None, gt=0.0)
    speed_cm_s: float = Field(default=60.0, gt=0.0)
    start_across_deg: float = Field(default=0.0, ge=0.0, le=60.0)
    back_within_s: float = Field(default=5.0, gt=0.0)
    track_width_cm: float = Field(default=16.0, gt=0.0)
    off_lane_share: float = Field(default=0.75, gt=0.0)
    put_back: bool = True
    stuck_s: float = Field(default=2.0, gt=0.0)
    slack: float = Field(default=3.0, gt=1.0)
    pilot: PilotSettings = PilotSettings()
    simulation: SimulationSettings = SimulationSettings()


class CompetitionCar(Settings):
    """Size of the cars of a competition.

    Attributes:
        track_width_cm: Distance between the contact points of an axle's wheels.
        wheelbase_cm: Distance between the axles.
        camera_height_cm: Of the optical centre above the road.
    """

    track_width_cm: float = Field(gt=0.0)
    wheelbase_cm: float = Field(gt=0.0)
    camera_height_cm: float = Field(gt=0.0)


@dataclass(frozen=True)
class Road:
    """One road of a contest, and the car on it.

    Attributes:
        kind: Kind of road.
        number: Number of the road among its kind.
        simulation: Its world.
        track_width_cm: Distance between the contact points of an axle's wheels.
    """

    kind: str
    number: int
    simulation: SimulationSettings
    track_width_cm: float

    def across_deg(self, settings: JudgeSettings) -> float:
        """Return by how much a car starts turned in its lane, positive left."""
        return settings.start_across_deg * (-1.0 if self.number % 2 else 1.0)


def contest_roads(settings: JudgeSettings) -> list[Road]:
    """Return the roads of a contest, in order.

    Raises:
        ConfigError: If a kind is named twice, there is none of that name, or ``counts`` names another one.
    """
    kinds = [Path(kind).stem if kind.endswith(_FILE_ENDINGS) else kind for kind in settings.tracks]
    if len(set(kinds)) < len(kinds):
        raise ConfigError(f"tracks: {', '.join(settings.tracks)}: each may be named once")
    for name in settings.counts:
        if name not in kinds:
            raise ConfigError(f"counts: found {name!r}, expected one of tracks: {', '.join(kinds)}")
    return [
        _road(settings, track, kind, number)
        for track, kind in zip(settings.tracks, kinds, strict=True)
        for number in range(settings.counts.get(kind, settings.count))
    ]


def _road(settings: JudgeSettings, track: str, kind: str, number: int) -> Road:
    # The number alone decides the seed: another kind of road in the list does not change the others.
    sequence = np.random.SeedSequence([settings.seed, _STREAM, number])
    common = settings.simulation.model_copy(
        update={"driver": DriverSettings(speed_cm_s=settings.speed_cm_s, wander_cm=0.0)}
    )
    if track == "varied":
        return _with_its_car(settings, kind, number, _varied(common, sequence, number))
    seed = int(sequence.generate_state(1)[0])
    drawn = common.model_copy(update={"seed": seed, "track": _track_settings(track, common.track)})
    return _with_its_car(settings, kind, number, drawn)


def _varied(common: SimulationSettings, sequence: np.random.SeedSequence, number: int) -> SimulationSettings:
    """Draw a kind of road that the camera sees; if there is none of its seed, that of one of the next."""
    drawn = vary_simulation(common, sequence, number, driver=False)
    for attempt in range(_ROAD_TRIES):
        simulation = drawn.model_copy(update={"seed": drawn.seed + attempt})
        try:
            draw_track(simulation)
        except ConfigError:
            continue
        return simulation
    draw_track(drawn)
    return drawn


def _with_its_car(settings: JudgeSettings, kind: str, number: int, simulation: SimulationSettings) -> Road:
    """Put the competition's car on a preset; what the settings name stays."""
    track_width_cm, car, camera = settings.track_width_cm, simulation.car, simulation.camera
    own = competition_cars().get(simulation.track.preset or "")
    if own is not None:
        if "track_width_cm" not in settings.model_fields_set:
            track_width_cm = own.track_width_cm
        if "wheelbase_cm" not in car.model_fields_set:
            car = car.model_copy(update={"wheelbase_cm": own.wheelbase_cm})
        if "height_cm" not in camera.model_fields_set:
            camera = camera.model_copy(update={"height_cm": own.camera_height_cm})
    return Road(kind, number, simulation.model_copy(update={"car": car, "camera": camera}), track_width_cm)


@functools.cache
def competition_cars() -> dict[str, CompetitionCar]:
    """Return the cars of the competitions, by preset."""
    with resources.as_file(resources.files("datagen.judge") / "cars.yaml") as path:
        return {
            name: check_settings(CompetitionCar, size, f"{path}: {name}")
            for name, size in read_yaml(path).items()
        }


def _track_settings(kind: str, common: TrackSettings) -> TrackSettings:
    if kind in _DRAWN:
        return common.model_copy(update={"closed": kind == "random"})
    if kind.endswith(_FILE_ENDINGS):
        return load_track_settings(Path(kind))
    known = (*_DRAWN, *preset_names())
    if kind not in known:
        raise ConfigError(
            f"tracks: found {kind!r}, expected {', '.join(_DRAWN)} (drawn roads), a preset "
            f"({', '.join(preset_names())}) or a track file (.yaml){did_you_mean(kind, known)}"
        )
    return preset(kind)
