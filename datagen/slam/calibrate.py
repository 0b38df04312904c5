"""A usable camera from the drive alone: focal length and pitch by match score, yaw by closing the lap.

This finds a coarse camera. The lens is taken as an equidistant fisheye with its axis in the image's middle.
Scale is not observable: the camera's height is nominal until the lane width sets it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from pydantic import Field

from datagen.slam.filter import FilterSettings, run_filter
from datagen.slam.motion import MotionModel
from datagen.slam.places import Revisit
from datagen.slam.scans import Progress, pack_scans
from lanenet.config import Settings
from lanenet.data.drive import Drive
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.birdseye import PerceptionSettings, RangeSettings, RoadEdges, RoadTable
from lanenet.perception.edges import EdgePixels, find_edges


class GuessSettings(Settings):
    """First guess of an unknown camera; lengths in camera heights where the name says so.

    Attributes:
        focal_px: Focal lengths to try for images of 160 px width; wider images scale them.
        pitch_deg: Downward tilts to try.
        k1: First coefficient of the fisheye.
        lever_heights: Camera ahead of the rear axle.
        wheelbase_cm: Distance between the axles, which sets where y = 0 lies under the car.
        frames: Frames that the search looks at.
        refine_yaw: Whether the yaw is found by closing laps.
    """

    focal_px: tuple[float, ...] = (65.0, 80.0, 95.0, 110.0)
    pitch_deg: tuple[float, ...] = (7.0, 11.0, 15.0, 19.0, 23.0)
    k1: float = -0.03
    lever_heights: float = Field(default=0.9, gt=0.0)
    wheelbase_cm: float = Field(default=17.0, gt=0.0)
    frames: int = Field(default=250, ge=50)
    refine_yaw: bool = True


#: Height of the camera before the scale is known.
NOMINAL_HEIGHT_CM = 15.0


def guessed_camera(
    width: int, height: int, focal_px: float, pitch_rad: float, guess: GuessSettings
) -> Camera:
    """Build a fisheye camera of nominal height, ``lever_heights`` ahead of the rear axle."""
    K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    ahead = guess.lever_heights * NOMINAL_HEIGHT_CM - guess.wheelbase_cm
    mounting = Mounting(NOMINAL_HEIGHT_CM, pitch_down_rad=pitch_rad, ahead_of_front_axle_cm=ahead)
    return Camera(
        "fisheye", width, height, K, np.array([guess.k1, 0.0, 0.0, 0.0]), mounting, guess.wheelbase_cm
    )


def mapping_range(camera_height_cm: float, base: RangeSettings) -> RangeSettings:
    """Range for mapping, in proportion to the camera's height; rows stay as configured."""
    reach = 6.0 * camera_height_cm
    coarse = 0.3 * camera_height_cm
    return base.model_copy(update={"far_cm": reach, "side_cm": reach, "max_cm_per_px": coarse})


@dataclass(frozen=True)
class Candidate:
    """One camera of the search and its mean matched share."""

    focal_px: float
    pitch_deg: float
    match: float


def coarse_camera(
    drive: Drive,
    perception: PerceptionSettings,
    guess: GuessSettings,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[Camera, list[Candidate]]:
    """Search focal length and pitch for the highest mean match of a short run of the filter.

    Returns:
        The camera, and all candidates for the report.
    """
    count = min(guess.frames, len(drive))
    start = max(0, (len(drive) - count) // 3)
    pixels = [find_edges(drive.image(k), perception.edges) for k in range(start, start + count)]
    scale = drive.width / 160.0
    # Two rounds: the given grid, then half its steps around the best.
    seed = int(rng.integers(2**31))
    tried: dict[tuple[float, float], float] = {}
    grid = [(f * scale, p) for f in guess.focal_px for p in guess.pitch_deg]
    total = len(grid) + 8
    for round_index in range(2):
        for focal, pitch in grid:
            if (focal, pitch) not in tried:
                camera = guessed_camera(drive.width, drive.height, focal, np.deg2rad(pitch), guess)
                tried[focal, pitch] = _match(pixels, camera, perception, np.random.default_rng(seed))
            if progress is not None:
                progress(min(len(tried), total), total)
        best = max(tried, key=lambda key: tried[key])
        if round_index == 0:
            df = 0.5 * _spacing(guess.focal_px) * scale
            dp = 0.5 * _spacing(guess.pitch_deg)
            grid = [(best[0] + i * df, best[1] + j * dp) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    candidates = [Candidate(f, p, match) for (f, p), match in tried.items()]
    return guessed_camera(drive.width, drive.height, best[0], np.deg2rad(best[1]), guess), candidates


def _spacing(values: tuple[float, ...]) -> float:
    return float(np.min(np.diff(np.sort(values)))) if len(values) > 1 else 0.1 * values[0]


def _match(
    pixels: list[EdgePixels], camera: Camera, perception: PerceptionSettings, rng: np.random.Generator
) -> float:
    """Mean matched share of a small filter that knows nothing of the commands."""
    height = camera.mounting.height_cm
    table = RoadTable(camera, mapping_range(height, perception.range))
    scans = pack_scans([_lift(table, edges) for edges in pixels], height)
    step = 0.2 * height
    n = len(scans)
    motion = MotionModel(
        distance_cm=np.ones(n),
        curvature_per_cm=np.zeros(n),
        factor_start=(step, 0.5 * step),
        factor_walk=0.01 * height,
        factor_pull=0.01,
        distance_noise=0.02,
        offset_walk_per_cm=0.012 / height,
        offset_decay=0.0,
        curvature_noise_per_cm=0.02 / height,
        max_curvature_per_cm=0.8 / height,
    )
    settings = FilterSettings(particles=120, max_points=150)
    trajectory = run_filter(scans, motion, settings, height, camera.wheelbase_cm, rng)
    return float(np.nanmean(trajectory.match))


def _lift(table: RoadTable, edges: EdgePixels) -> RoadEdges:
    nearest = np.rint(edges.uv_px).astype(np.intp)
    keep = table.keep[nearest[:, 1], nearest[:, 0]] > 0
    return table.lift(EdgePixels(edges.uv_px[keep], edges.normals[keep]))


def heading_error_per_lap(poses: Float[np.ndarray, "n 3"], revisits: list[Revisit]) -> float:
    """Median heading that an open-loop trajectory misses from one visit of a place to the next, [rad].

    A closed lap turns by a multiple of 2 pi; what is left over is drift, and most of it is camera yaw.
    """
    errors = []
    for revisit in revisits:
        turned = poses[revisit.later, 2] - poses[revisit.earlier, 2] - revisit.relative[2]
        errors.append(turned - 2.0 * np.pi * np.round(turned / (2.0 * np.pi)))
    return float(np.median(errors))


def next_yaw(tried: list[tuple[float, float]]) -> float:
    """Return the yaw to try after (yaw, heading error) pairs: a secant step, bounded to three degrees.

    The first step takes the usual sensitivity: one degree of yaw turns a lap by about 30 degrees.
    """
    yaw, error = tried[-1]
    slope = 30.0
    if len(tried) > 1 and abs(yaw - tried[-2][0]) > 1e-4:
        measured = (error - tried[-2][1]) / (yaw - tried[-2][0])
        slope = measured if abs(measured) > 5.0 else slope
    return float(yaw - np.clip(error / slope, -0.052, 0.052))


def with_known_scale(camera: Camera, factor: float, guess: GuessSettings) -> Camera:
    """Scale a guessed camera; the wheelbase is the car's own and stays, so that the lever arm scales."""
    scaled = camera.scaled_lengths(factor)
    lever = scaled.wheelbase_cm + scaled.mounting.ahead_of_front_axle_cm
    kept = replace(scaled, wheelbase_cm=guess.wheelbase_cm)
    return kept.with_mounting(ahead_of_front_axle_cm=lever - guess.wheelbase_cm)
