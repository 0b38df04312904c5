"""Settings of all stages from images to adjusted poses."""

from __future__ import annotations

from pydantic import Field

from datagen.slam.adjustment.adjust import BundleSettings
from datagen.slam.filter.dp_slam import FilterSettings
from datagen.slam.loops.revisits import RevisitSettings
from datagen.slam.odometry.image_pairs import OdometrySettings
from lanenet.config import Settings
from lanenet.geometry.camera import NOMINAL_WHEELBASE_CM
from lanenet.perception.edges.road import PerceptionSettings


class GuessSettings(Settings):
    """First guess of an unknown camera; lengths in camera heights where the name says so.

    Attributes:
        focal_px: Focal lengths to try, for images 160 px wide; they scale with the width. Their geometric
            mean is the prior. The range covers the lenses of the three real drives (79 to 105 px) with a
            margin.
        pitch_deg: Downward pitches to try. The real drives have 13 to 18 degrees.
        steep_focal_px: Focal lengths to try, as above, where none of these cameras shows the motion clearly.
            Chosen: a third apart.
        steep_pitch_deg: Pitches to try then: a camera that looks at the road just before the car.
        steep_roll_deg: Rolls to try then: a pan and tilt bracket, or one bent by hand, is seldom level.
        k1: First coefficient of the fisheye; the real drives have -0.03 to -0.07.
        lever_heights: Distance of the camera ahead of the rear axle; 0.9 on a Donkeycar.
        wheelbase_cm: Distance between the axles, which sets where y = 0 lies under the car.
        frames: Frames that the search looks at. Chosen: at 20 frames a second a bend and a straight section.
    """

    focal_px: tuple[float, ...] = (65.0, 80.0, 95.0, 110.0)
    pitch_deg: tuple[float, ...] = (7.0, 11.0, 15.0, 19.0, 23.0)
    steep_focal_px: tuple[float, ...] = (60.0, 78.0, 101.0, 131.0)
    steep_pitch_deg: tuple[float, ...] = (19.0, 25.0, 31.0, 37.0)
    steep_roll_deg: tuple[float, ...] = (-12.0, -6.0, 0.0, 6.0, 12.0)
    k1: float = -0.03
    lever_heights: float = Field(default=0.9, gt=0.0)
    wheelbase_cm: float = Field(default=NOMINAL_WHEELBASE_CM, gt=0.0)
    frames: int = Field(default=250, ge=50)


class MotionSettings(Settings):
    """How far the particle filter may depart from the odometry.

    The filter's map prefers slow motion, a little in every frame: the filter may correct a single step, but
    not the speed.

    Attributes:
        factor_walk: Change of the filter's factor on the odometry's steps, per frame.
        factor_pull: Share by which that factor returns to 1 per frame.
        distance_noise: Standard deviation of a step length, relative.
        curvature_noise_heights: Standard deviation of a curvature times camera height.
        offset_walk_heights: Change of the curvature's offset per frame, times camera height.
        offset_decay: Share of the offset that is forgotten per frame.
        max_curvature_heights: Bound of the curvature times camera height, so that the heading cannot spin. A
            camera 15 cm high and 0.8 allow a radius of 19 cm; 1:10 cars need 60 cm.
    """

    factor_walk: float = Field(default=0.001, gt=0.0)
    factor_pull: float = Field(default=0.1, ge=0.0, lt=1.0)
    distance_noise: float = Field(default=0.005, gt=0.0)
    curvature_noise_heights: float = Field(default=0.01, gt=0.0)
    offset_walk_heights: float = Field(default=0.001, gt=0.0)
    offset_decay: float = Field(default=0.1, ge=0.0, le=1.0)
    max_curvature_heights: float = Field(default=0.8, gt=0.0)


class SlamSettings(Settings):
    """Settings of everything from images to adjusted poses; the defaults are meant to fit every drive.

    Attributes:
        seed: Of the random generator.
        find_bumper: Look for the car's own parts at the bottom of the image and leave those rows out, unless
            ``perception.range.bottom_rows`` gives their number.
        perception: How the map's edge points are found, and, except for colours, those of its labels.
        guess: First guess of an unknown camera.
        odometry: Motion from image to image.
        filter: Particle filter.
        motion: How far the filter may depart from the odometry.
        bundle: Bundle adjustment of poses and camera.
        revisits: What counts as the same place.
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
