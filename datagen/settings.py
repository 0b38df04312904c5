"""Settings of all mapping stages."""

from __future__ import annotations

from dataclasses import replace

from pydantic import Field, field_validator

from datagen.lanes.fit import FitSettings
from datagen.lanes.markings import TraceSettings
from datagen.quality.verdict import VerdictSettings
from datagen.slam.settings import GuessSettings, SlamSettings
from lanenet.geometry.camera import Camera


class MapSettings(SlamSettings):
    """Settings of everything from images to a map with lane lines; the defaults are meant to fit every drive.

    Attributes:
        trace: How lane lines are looked for.
        fit: Cubics through them.
        held_out_every: One of so many frames is held out from the lines, so that the map can be checked
            against it; 0 for none. Chosen: a tenth of the frames leaves the lines as they are, and 100 frames
            of a drive of 1000 for the check.
        verdict: What counts as a good map.
    """

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
) -> tuple[MapSettings, Camera | None, tuple[str, ...]]:
    """Put the wheelbase where mapping looks for it: poses are of the rear axle, labels of the front.

    Args:
        settings: Settings; those of a guessed camera have a wheelbase.
        camera: A known camera, which has one of its own; None for one that is to be found.
        wheelbase_cm: Distance between the axles; None if it was not given.

    Returns:
        Settings and camera with it, and a note where it is only nominal.
    """
    if wheelbase_cm is None:
        # Settings that were saved in full contain it whether or not it was given: the value decides.
        nominal_cm = GuessSettings().wheelbase_cm
        nominal = camera is None and settings.guess.wheelbase_cm == nominal_cm
        given = "give the car's with --wheelbase or guess.wheelbase_cm if it is another"
        note = f"the wheelbase is a nominal {nominal_cm:g} cm; {given}"
        return settings, camera, (note,) if nominal else ()
    guess = settings.guess.model_copy(update={"wheelbase_cm": wheelbase_cm})
    settings = settings.model_copy(update={"guess": guess})
    camera = None if camera is None else replace(camera, wheelbase_cm=wheelbase_cm)
    return settings, camera, ()
