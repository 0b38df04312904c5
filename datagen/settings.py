"""Settings of all mapping stages in one place."""

from __future__ import annotations

from dataclasses import replace

from pydantic import Field, field_validator

from datagen.lanes.fit import FitSettings
from datagen.lanes.follow import TraceSettings
from datagen.quality.verdict import VerdictSettings
from datagen.slam.adjustment.adjust import BundleSettings
from datagen.slam.camera.coarse import GuessSettings
from datagen.slam.filter.dp_slam import FilterSettings
from datagen.slam.loops.revisits import RevisitSettings
from datagen.slam.odometry.image_pairs import OdometrySettings
from datagen.slam.track import MotionSettings
from lanenet.config import Settings
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.road import PerceptionSettings


class MapSettings(Settings):
    """Everything that mapping a drive can be told; the defaults are meant to fit every drive.

    Attributes:
        seed: Of the particle filter.
        find_bumper: Look for the car's own parts at the bottom of the picture and leave those rows out,
            unless ``perception.range.bottom_rows`` says how many they are.
        perception: How the map's edge points are found, and but for colours those of its labels.
        guess: First guess of an unknown camera.
        odometry: Motion from picture to picture.
        filter: Particle filter.
        motion: How far it may stray from the odometry.
        bundle: Adjustment of poses and camera together.
        revisits: What counts as the same place.
        trace: How lane lines are looked for.
        fit: Cubics through them.
        held_out_every: Of every so many frames one has no say in the lines, so that the map can be checked
            against it; 0 for none.
        verdict: What counts as a good map.
    """

    seed: int = Field(default=0, ge=0)
    find_bumper: bool = True
    perception: PerceptionSettings = PerceptionSettings()
    guess: GuessSettings = GuessSettings()
    odometry: OdometrySettings = OdometrySettings()
    filter: FilterSettings = FilterSettings()
    motion: MotionSettings = MotionSettings()
    bundle: BundleSettings = BundleSettings()
    revisits: RevisitSettings = RevisitSettings()
    trace: TraceSettings = TraceSettings()
    fit: FitSettings = FitSettings()
    held_out_every: int = Field(default=10, ge=0)
    verdict: VerdictSettings = VerdictSettings()

    @field_validator("held_out_every")
    @classmethod
    def _leaves_frames_for_the_map(cls, every: int) -> int:
        if every == 1:
            raise ValueError("expected 0 or at least 2: every frame held out leaves none for the lines")
        return every


def with_wheelbase(
    settings: MapSettings, camera: Camera | None, wheelbase_cm: float | None
) -> tuple[MapSettings, Camera | None, list[str]]:
    """Put the wheelbase where mapping looks for it: poses are of the rear axle, labels of the front.

    Args:
        settings: Settings; those of a guessed camera name a wheelbase.
        camera: A known camera, which has one of its own; None for one that is to be found.
        wheelbase_cm: Distance between the axles; None if nobody said.

    Returns:
        Settings and camera with it, and a note where it is only nominal.
    """
    if wheelbase_cm is None:
        # Settings that were saved in full name it whether or not anybody did: the value tells.
        nominal_cm = GuessSettings().wheelbase_cm
        nominal = camera is None and settings.guess.wheelbase_cm == nominal_cm
        given = "give the car's with --wheelbase or guess.wheelbase_cm if it is another"
        note = f"the wheelbase is a nominal {nominal_cm:g} cm; {given}"
        return settings, camera, [note] if nominal else []
    guess = settings.guess.model_copy(update={"wheelbase_cm": wheelbase_cm})
    settings = settings.model_copy(update={"guess": guess})
    return settings, None if camera is None else replace(camera, wheelbase_cm=wheelbase_cm), []
