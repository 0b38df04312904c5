"""Settings of a training run's data: which drives, and how they are made, mapped and split."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from datagen.settings import MapSettings
from datagen.world.car.camera import CameraSettings
from datagen.world.world import SimulationSettings
from lanenet.config import Settings
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import LaneWidthCm
from lanenet.perception.edges.road import COLOUR_WEIGHT, PerceptionSettings

Role = Literal["train", "validation", "test"]
ROLES: tuple[Role, ...] = ("train", "validation", "test")


class SyntheticSettings(Settings):
    """Synthetic drives, each with its own road and its own look.

    Attributes:
        seed: Every drive's seed follows from this, its role and its number.
        train: Drives to learn from.
        validation: Drives to choose the epoch by.
        test: Drives whose truth scores the result.
        variety: What differs between drives. ``none``: only what their seeds draw; ``roads``: also the kind
            of road and the driver; ``all``: also the size of the car, and the camera, drawn near ``cameras``.
        cameras: Lenses and mountings that the drives' cameras are drawn near, in turn; empty takes the
            simulation's.
        may_fail: Up to this share of the mapped drives may be left out because their map is rejected or their
            road cannot be driven. Not every random road makes a good drive.
        weight: How often their frames are shown beside those of recorded drives, as ``weight`` there.
        simulation: What all drives share; each gets its own ``seed``.
    """

    seed: int = Field(default=0, ge=0)
    train: int = Field(default=0, ge=0)
    validation: int = Field(default=0, ge=0)
    test: int = Field(default=0, ge=0)
    variety: Literal["none", "roads", "all"] = "none"
    cameras: tuple[CameraSettings, ...] = ()
    may_fail: float = Field(default=0.0, ge=0.0, le=1.0)
    weight: float = Field(default=1.0, gt=0.0, le=1000.0)
    simulation: SimulationSettings = SimulationSettings()

    @model_validator(mode="after")
    def _cameras_are_used(self) -> SyntheticSettings:
        if self.cameras and self.variety != "all":
            raise ValueError(f"cameras need variety 'all', found {self.variety!r}")
        return self


class RecordedSettings(Settings):
    """A recorded drive, split along its time or by its laps, or all of it in one part.

    Attributes:
        path: Drive folder, tub or video, a finished map of one, or its label set (``.parquet``); relative to
            the folder in which the command runs.
        lane_width_cm: Between the middles of the lines of the driven lane.
        camera: Camera file; without it the camera is found from the drive.
        wheelbase_cm, camera_height_cm, tape_width_cm: As for ``lanenet map``; None if not measured.
        frames: First and last number of the frames to map; None for all. Not for a finished map.
        split: ``time`` cuts at the shares below; ``lap`` keeps the last lap for the test, the one before it
            for the validation and all earlier ones for learning; ``auto`` is ``lap`` where there are three
            complete laps, and else ``time``; ``train``, ``validation`` and ``test`` give all of it to that
            part, so that other drives must make up the others; ``none`` is the older word for ``train``.
        name: Of the drive in messages; empty takes its path.
        track: Name of the track. Drives of one track are all in one part, see :mod:`datagen.datasets.leaks`;
            empty if that is not asked.
        licence, car: For the data sheet, beside the track: under what the recording may be used, and the name
            of the car; empty if unknown.
        train_share: Share of the labelled frames, from the start, to learn from. Chosen, like the next.
        validation_share: Share of the following frames to choose the epoch by; the rest is for the test.
        gap_frames: Frames left out between the parts, so that neighbours are never on both sides. Chosen: 2 s
            at 20 frames/s.
        gap_cm: Distance left out between the parts, likewise; the longer of the two gaps counts.
        counts_as: Number of drives that this one counts as beside synthetic ones: its frames are shown that
            many times as often.
        weight: How often it is shown beside others, in any ratio, and beside ``counts_as``: with 0.3, three
            of ten times as often as one of weight 1. An epoch has as many samples as with equal weights.
        map: Settings for mapping this drive, unless it is a map.
    """

    path: Path
    lane_width_cm: LaneWidthCm
    camera: Path | None = None
    wheelbase_cm: float | None = Field(default=None, gt=0.0)
    camera_height_cm: float | None = Field(default=None, gt=0.0)
    tape_width_cm: float | None = Field(default=None, gt=0.0)
    frames: tuple[int, int] | None = None
    split: Literal["time", "lap", "auto", "train", "validation", "test", "none"] = "time"
    name: str = ""
    track: str = ""
    licence: str = ""
    car: str = ""
    train_share: float = Field(default=0.6, gt=0.0, lt=1.0)
    validation_share: float = Field(default=0.15, gt=0.0, lt=1.0)
    gap_frames: int = Field(default=40, ge=0)
    gap_cm: float = Field(default=0.0, ge=0.0)
    counts_as: int = Field(default=1, ge=1, le=100)
    weight: float = Field(default=1.0, gt=0.0, le=1000.0)
    map: MapSettings = MapSettings()

    @property
    def parts(self) -> tuple[Role, ...]:
        """The parts that the drive is in: one if all of it is in that, else the three."""
        whole: dict[str, Role] = {"none": "train", **{role: role for role in ROLES}}
        return (whole[self.split],) if self.split in whole else ROLES

    @model_validator(mode="after")
    def _leave_some_for_the_test(self) -> RecordedSettings:
        if self.train_share + self.validation_share > 0.999:
            raise ValueError("train_share and validation_share must sum to less than 1: the rest is the test")
        return self


class LibrarySettings(Settings):
    """Drives of a library, all drives of a track in one part, see :mod:`datagen.datasets.from_library`.

    Attributes:
        file: The library (``lanenet drives``), relative to the folder in which the command runs.
        labelled: What ``lanenet label-all`` wrote: drives have their maps from there, and those that it
            refused are left out; None maps all drives.
        split: ``track`` draws the part of each track; ``train``, ``validation`` and ``test`` give all drives
            to that part, so that others, simulated ones for example, make up the rest.
        seed: Of the draw of the tracks.
        validation_share: Share of the tracks to choose the epoch by, rounded up. Chosen, like the next.
        test_share: Share of the tracks to test on, likewise; the rest is learned from.
        validation_tracks, test_tracks: Tracks of these parts, instead of drawn ones.
        counts_as, weight: Of each drive, see :class:`RecordedSettings`.
    """

    file: Path
    labelled: Path | None = None
    split: Literal["track", "train", "validation", "test"] = "track"
    seed: int = Field(default=0, ge=0)
    validation_share: float = Field(default=0.15, gt=0.0, lt=1.0)
    test_share: float = Field(default=0.2, gt=0.0, lt=1.0)
    validation_tracks: tuple[str, ...] = ()
    test_tracks: tuple[str, ...] = ()
    counts_as: int = Field(default=1, ge=1, le=100)
    weight: float = Field(default=1.0, gt=0.0, le=1000.0)

    @model_validator(mode="after")
    def _a_track_is_in_one_part(self) -> LibrarySettings:
        both = sorted(set(self.validation_tracks) & set(self.test_tracks))
        if both:
            raise ValueError(f"{both[0]!r} is one of validation_tracks and of test_tracks")
        return self


class DataSettings(Settings):
    """Where the label sets of a run come from.

    Attributes:
        synthetic: Synthetic drives.
        drives: Recorded drives.
        library: More recorded drives, of a library, split by their tracks.
        known_drives: A library that is asked for recordings that are not where their maps say, so that they
            cannot leak; None takes that of ``library``, else ``drives.sqlite`` of the current folder, if
            there is one.
        map: Settings for mapping the synthetic drives.
        window: The bird's-eye window of the network: wide enough for the lane's lines on either side.
        colour_weight: Weight of colours beside brightness in the network's edges; maps use brightness alone.
        workers: Processes that simulate, map and evaluate; 0 uses one per core.
    """

    synthetic: SyntheticSettings = SyntheticSettings()
    drives: tuple[RecordedSettings, ...] = ()
    library: LibrarySettings | None = None
    known_drives: Path | None = None
    map: MapSettings = MapSettings()
    window: BirdseyeWindow = BirdseyeWindow()
    colour_weight: float = Field(default=COLOUR_WEIGHT, ge=0.0, le=1.0)
    workers: int = Field(default=0, ge=0)

    @property
    def processes(self) -> int:
        """Processes at a time."""
        return self.workers or os.cpu_count() or 1

    @property
    def perceptions(self) -> list[PerceptionSettings]:
        """How the network's edges are found: in synthetic drives, and in each recorded one."""
        simulated = [self.map] if self.synthetic.train or self.synthetic.validation else []
        maps = [*simulated, *(drive.map for drive in self.drives)]
        return [settings.perception.with_colours(self.colour_weight) for settings in maps]

    @model_validator(mode="after")
    def _each_drive_once(self) -> DataSettings:
        paths = [drive.path.resolve() for drive in self.drives]
        twice = next((drive.path for drive in self.drives if paths.count(drive.path.resolve()) > 1), None)
        if twice is not None:
            raise ValueError(f"drives: {twice} is listed twice; use counts_as to show a drive more often")
        return self
