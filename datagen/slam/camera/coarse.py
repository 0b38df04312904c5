"""A coarse camera from the drive alone: focal length and pitch by how clearly pictures tell the motion.

This is a start for the bundle adjustment. Seen with the right camera, the edges of a picture meet those of
the next one at the true motion and nowhere else. That tells the pitch to a few degrees and the focal length
to a fifth or so before a loop is closed, so that what lenses usually have counts, too. The lens is taken as
an equidistant fisheye with its axis in the image's middle. Scale is not observable: the camera's height is
nominal until the lane width sets it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from pydantic import Field

from datagen.slam.odometry.image_pairs import ImagePairs, OdometrySettings
from datagen.slam.odometry.odometry import STEPS_HEIGHTS, at_limit, best_step, prominence
from datagen.slam.odometry.scans import Progress, seen_edges
from lanenet.config import Settings
from lanenet.data.drives import Drive
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.canny import EdgePixels, find_edges
from lanenet.perception.edges.road import PerceptionSettings, RangeSettings, RoadTable


class GuessSettings(Settings):
    """First guess of an unknown camera; lengths in camera heights where the name says so.

    Attributes:
        focal_px: Focal lengths to try for images of 160 px width; wider images scale them. Their geometric
            mean is what lenses are expected to have where pictures leave it open.
        pitch_deg: Downward tilts to try.
        k1: First coefficient of the fisheye.
        lever_heights: Camera ahead of the rear axle.
        wheelbase_cm: Distance between the axles, which sets where y = 0 lies under the car.
        frames: Frames that the search looks at.
    """

    focal_px: tuple[float, ...] = (65.0, 80.0, 95.0, 110.0)
    pitch_deg: tuple[float, ...] = (7.0, 11.0, 15.0, 19.0, 23.0)
    k1: float = -0.03
    lever_heights: float = Field(default=0.9, gt=0.0)
    wheelbase_cm: float = Field(default=17.0, gt=0.0)
    frames: int = Field(default=250, ge=50)


#: Steps tried with each camera, relative to the one that suits the best camera so far, and the part of them
#: that may be the best: those beyond are what it is compared with.
_AROUND, _INNER = np.exp(np.linspace(-0.6, 0.6, 13)), slice(2, -2)
#: Frames that are compared with those before them: while nothing is known of the camera, and then.
_FIRST_PAIRS, _PAIRS = 20, 40
#: What a squared logarithm between the focal length and the middle of those to try costs, in log likelihood
#: per point: for half or twice the usual one a tenth to a third of what a clear step is worth.
_FOCAL_PRIOR = 0.05
#: Height of the camera before the scale is known.
NOMINAL_HEIGHT_CM = 15.0


def guessed_camera(
    width: int, height: int, focal_px: float, pitch_deg: float, guess: GuessSettings
) -> Camera:
    """Build a fisheye camera of nominal height, ``lever_heights`` ahead of the rear axle."""
    K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    ahead = guess.lever_heights * NOMINAL_HEIGHT_CM - guess.wheelbase_cm
    mounting = Mounting(
        NOMINAL_HEIGHT_CM, pitch_down_rad=float(np.deg2rad(pitch_deg)), ahead_of_front_axle_cm=ahead
    )
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
    """One camera of the search, with its best step, in camera heights, and how well it does.

    ``fit`` is how much likelier an edge point of a pair of pictures is with this step than with clearly
    shorter and longer ones, as a logarithm, less the prior's.
    """

    focal_px: float
    pitch_deg: float
    step_heights: float
    fit: float


def coarse_camera(
    drive: Drive,
    perception: PerceptionSettings,
    guess: GuessSettings,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[Camera, list[Candidate]]:
    """Search focal length and pitch for the camera with which the motion between pictures is clearest.

    Returns:
        The camera, and all candidates for the report.
    """
    count = min(guess.frames, len(drive))
    start = max(0, (len(drive) - count) // 3)
    pixels = [find_edges(drive.image(k), perception.edges) for k in range(start, start + count)]
    scale = drive.width / 160.0
    seed = int(rng.integers(2**31))
    tried: dict[tuple[float, float], Candidate] = {}
    grid = [(f * scale, p) for f in guess.focal_px for p in guess.pitch_deg]
    total = len(grid) + 9
    relative = np.ones(count)
    # Every second camera of the grid, as on a chessboard.
    spread = [
        guessed_camera(drive.width, drive.height, f * scale, p, guess)
        for i, f in enumerate(guess.focal_px)
        for j, p in enumerate(guess.pitch_deg)
        if (i + j) % 2 == 0
    ]
    usual = clearest_step((_pictures(pixels, camera, perception, seed) for camera in spread), relative)
    usual_focal = float(np.exp(np.mean(np.log(guess.focal_px)))) * scale
    # Two rounds: the given grid, then half its steps around the best.
    for round_index in range(2):
        for focal, pitch in grid:
            if (focal, pitch) not in tried:
                camera = guessed_camera(drive.width, drive.height, focal, pitch, guess)
                pictures = _pictures(pixels, camera, perception, seed)
                steps = usual * _AROUND
                _, fits = best_step(pictures, relative, steps, _PAIRS)
                # How well a step fits says little: with a camera that looks too far down, standing still
                # fits better than the truth with the right one.
                clear = prominence(fits, steps)[_INNER] / pictures.points_per_frame
                fit = float(clear.max() - _FOCAL_PRIOR * np.log(focal / usual_focal) ** 2)
                step = float(steps[_INNER][np.argmax(clear)])
                tried[focal, pitch] = Candidate(focal, pitch, step, fit)
            if progress is not None:
                progress(min(len(tried), total), total)
        best = max(tried.values(), key=lambda candidate: candidate.fit)
        usual = best.step_heights
        if round_index == 0:
            df = 0.5 * _spacing(guess.focal_px) * scale
            dp = 0.5 * _spacing(guess.pitch_deg)
            grid = [(best.focal_px + i * df, best.pitch_deg + j * dp) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    camera = guessed_camera(drive.width, drive.height, best.focal_px, best.pitch_deg, guess)
    return camera, list(tried.values())


def clearest_step(cameras: Iterable[ImagePairs], relative: Float[np.ndarray, "n"]) -> float:
    """The way per frame, in camera heights, with the camera in which one stands out most.

    A camera that is far off has no step that the pictures meet at. What it likes best then lies at either
    end: next to nothing, which leaves all edges where they are, or more than a picture shows.

    Args:
        cameras: The same pictures, seen with each camera.
        relative: Way of each frame relative to the usual one.
    """
    steps = np.array(STEPS_HEIGHTS)
    best, most = float(np.sqrt(steps[0] * steps[-1])), 0.0
    for pictures in cameras:
        step, fit = best_step(pictures, relative, steps, _FIRST_PAIRS)
        clear = float(prominence(fit, steps).max()) / pictures.points_per_frame
        if clear > most and not at_limit(step, steps):
            best, most = step, clear
    return best


def _spacing(values: tuple[float, ...]) -> float:
    return float(np.min(np.diff(np.sort(values)))) if len(values) > 1 else 0.1 * values[0]


def _pictures(
    pixels: list[EdgePixels], camera: Camera, perception: PerceptionSettings, seed: int
) -> ImagePairs:
    """The edges that see the road with a camera, the same draw of points for every camera."""
    table = RoadTable(camera, mapping_range(camera.mounting.height_cm, perception.range))
    edges = [seen_edges(frame, table) for frame in pixels]
    return ImagePairs(edges, camera, OdometrySettings(), np.random.default_rng(seed))


def with_known_scale(camera: Camera, factor: float, guess: GuessSettings) -> Camera:
    """Scale a guessed camera; the wheelbase is the car's own and stays, so that the lever arm scales."""
    scaled = camera.scaled_lengths(factor)
    lever = scaled.wheelbase_cm + scaled.mounting.ahead_of_front_axle_cm
    kept = replace(scaled, wheelbase_cm=guess.wheelbase_cm)
    return kept.with_mounting(ahead_of_front_axle_cm=lever - guess.wheelbase_cm)


def looking_alike(camera: Camera, like: Camera) -> Camera:
    """Turn a camera so that the middle of its picture shows the place that it shows with another one.

    Pitch and yaw were found together with a principal point, and with another one they are others: a few
    pixels make up for degrees.
    """
    m = like.mounting
    middle = np.array([[0.5 * (like.width - 1), 0.5 * (like.height - 1)]])
    x_cm, y_cm = like.intersect_ground(middle)[0] - [m.right_of_centre_cm, m.ahead_of_front_axle_cm]
    if not np.isfinite(x_cm):
        return camera.with_mounting(pitch_down_rad=m.pitch_down_rad, yaw_rad=m.yaw_rad)
    pitch = float(np.arctan2(m.height_cm, np.hypot(x_cm, y_cm)))
    return camera.with_mounting(pitch_down_rad=pitch, yaw_rad=float(np.arctan2(-x_cm, y_cm)))


def nudged(camera: Camera, name: str, by: float) -> Camera:
    """Return the camera with one of its adjustable numbers changed, in the adjustment's units."""
    m = camera.mounting
    if name == "pitch":
        return camera.with_mounting(pitch_down_rad=m.pitch_down_rad + by)
    if name == "roll":
        return camera.with_mounting(roll_rad=m.roll_rad + by)
    if name == "yaw":
        return camera.with_mounting(yaw_rad=m.yaw_rad + by)
    if name == "lever":
        return camera.with_mounting(ahead_of_front_axle_cm=m.ahead_of_front_axle_cm + by * m.height_cm)
    K, D = np.array(camera.K, dtype=np.float64), np.array(camera.D, dtype=np.float64)
    if name == "focal":
        K[:2, :2] *= np.exp(by)
    elif name == "k1":
        D[0] += by
    else:
        K[("cx", "cy").index(name), 2] += by
    return replace(camera, K=K, D=D)
