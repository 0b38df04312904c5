"""A coarse camera from the drive alone: the focal length and pitch with which the motion is clearest.

It is the start of the bundle adjustment. With the right camera, the edges of an image meet those of the next
one at the true motion and nowhere else. Before a loop is closed, this gives the pitch to a few degrees and
the focal length to about a fifth, so a prior on the focal length is needed. The lens is taken as an
equidistant fisheye with its axis in the image centre. Scale is not observable: the camera's height is nominal
until the lane width sets it.

Most cameras are level and look far ahead. Where none of those shows the motion clearly, or the best is the
steepest of them, rolled and steeper ones are tried as well.

Also here: cameras that differ from a given one in scale, in where they look, or in one number.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from jaxtyping import Float

from datagen.slam.commands import commands_of
from datagen.slam.odometry.image_pairs import ImagePairs, OdometrySettings
from datagen.slam.odometry.likely import likely_markings
from datagen.slam.odometry.odometry import STEPS_HEIGHTS, at_limit, best_step, prominence, sampled_frames
from datagen.slam.odometry.scans import Progress, seen_edges
from datagen.slam.settings import GuessSettings
from datagen.slam.view import mapping_range
from lanenet.data.drives import Drive
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.canny import find_edges
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import PerceptionSettings, RoadTable
from lanenet.processes import in_threads

#: Step lengths to try with each camera, relative to that of the best camera so far, and those among them that
#: may be the best; the others are what it is compared with. Chosen: half to twice, in steps of a tenth.
_AROUND, _INNER = np.exp(np.linspace(-0.6, 0.6, 13)), slice(2, -2)
#: Frames that are compared with those before them: while nothing is known of the camera, and later. Chosen:
#: the time of the search is proportional to them.
_FIRST_PAIRS, _PAIRS = 20, 40
#: The same for steep and rolled cameras, which are looked for where the motion is less clear.
_STEEP_PAIRS = 80
#: Fit of a candidate from which the motion is clear. Measured: 0.27 to 0.35 on the three real drives with the
#: right camera, 0.02 to 0.09 on drives whose camera was none of those tried.
_CLEAR = 0.15
#: Cost of a squared log ratio between a focal length and the typical one, in log likelihood per point: half
#: or twice the typical length costs 0.024, a tenth to a third of the prominence of a clear step.
_FOCAL_PRIOR = 0.05
#: Height of the camera before the scale is known, [cm]; any would do, this is near those of 1:10 cars.
NOMINAL_HEIGHT_CM = 15.0
#: Angles of the mounting by their names in the adjustment.
_ANGLES = {"pitch": "pitch_down_rad", "roll": "roll_rad", "yaw": "yaw_rad"}
#: Width of the images for which focal lengths are given, [px]: that of a Donkeycar.
_REFERENCE_WIDTH = 160.0


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


@dataclass(frozen=True)
class Candidate:
    """One camera of the search.

    Attributes:
        focal_px: Focal length.
        pitch_deg: Downward pitch.
        roll_deg: Roll.
        step_heights: Its best step length.
        fit: Log likelihood per edge point of this step relative to clearly shorter and longer ones, less the
            prior of the focal length.
    """

    focal_px: float
    pitch_deg: float
    roll_deg: float
    step_heights: float
    fit: float


#: Focal length, pitch and roll of a camera, [px] and degrees.
_Look = tuple[float, float, float]


def coarse_camera(
    drive: Drive,
    perception: PerceptionSettings,
    guess: GuessSettings,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[Camera, list[Candidate]]:
    """Search focal length and pitch for the camera with which the motion from image to image is clearest.

    Returns:
        The camera, and all candidates for the report. Its roll is 0 unless it was searched for, too.
    """
    search = _Search(drive, perception, guess, seed=int(rng.integers(2**31)))
    tried = _level_cameras(search, guess, progress)
    best = _best(tried)
    if best.fit < _CLEAR or best.pitch_deg > max(guess.pitch_deg):
        tried += _steep_cameras(search, guess, progress)
        best = _best(tried)
    return search.camera(best.focal_px, best.pitch_deg, best.roll_deg), tried


def _best(tried: Iterable[Candidate]) -> Candidate:
    return max(tried, key=lambda candidate: candidate.fit)


def _level_cameras(search: _Search, guess: GuessSettings, progress: Progress | None) -> list[Candidate]:
    """Try level cameras: the given grid, then half its steps around the best."""
    focals, pitches = [f * search.scale for f in guess.focal_px], guess.pitch_deg
    # Every second camera of the grid, like the black squares of a chessboard.
    spread = [(f, p, 0.0) for i, f in enumerate(focals) for j, p in enumerate(pitches) if (i + j) % 2 == 0]
    step = clearest_step((search.images(look, _FIRST_PAIRS) for look in spread), search.relative)
    looks = [(f, p, 0.0) for f in focals for p in pitches]
    tried = _rated(search, looks, step, _PAIRS, progress, len(looks) + 9)
    best = _best(tried)
    df, dp = 0.5 * _spacing(guess.focal_px) * search.scale, 0.5 * _spacing(pitches)
    near = [(best.focal_px + i * df, best.pitch_deg + j * dp, 0.0) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    new = [look for look in near if look not in looks]
    return tried + _rated(search, new, best.step_heights, _PAIRS, progress, len(looks) + 9, len(tried))


def _steep_cameras(search: _Search, guess: GuessSettings, progress: Progress | None) -> list[Candidate]:
    """Try steep and rolled cameras: the given grid, then half its steps around the best, and a quarter."""
    focals = [f * search.scale for f in guess.steep_focal_px]
    pitches, rolls = guess.steep_pitch_deg, guess.steep_roll_deg
    looks = list(product(focals, pitches, rolls))
    # Every third camera of the grid.
    spread = looks[::3]
    step = clearest_step((search.images(look, _FIRST_PAIRS) for look in spread), search.relative)
    total = len(looks) + 2 * 27
    tried = _rated(search, looks, step, _STEEP_PAIRS, progress, total)
    for share in (0.5, 0.25):
        best = _best(tried)
        at = (best.focal_px, best.pitch_deg, best.roll_deg)
        ratio = float(np.exp(share * _spacing(tuple(np.log(guess.steep_focal_px)))))
        dp, dr = share * _spacing(pitches), share * _spacing(rolls)
        near = [
            (at[0] * ratio**i, at[1] + j * dp, at[2] + k * dr) for i, j, k in product((-1, 0, 1), repeat=3)
        ]
        new = [look for look in near if look != at]
        tried += _rated(search, new, best.step_heights, _STEEP_PAIRS, progress, total, len(tried))
    return tried


def _rated(
    search: _Search,
    looks: Sequence[_Look],
    step_heights: float,
    pairs: int,
    progress: Progress | None,
    total: int,
    done: int = 0,
) -> list[Candidate]:
    """Rate some cameras, and report progress."""
    tried = []
    for candidate in in_threads(partial(search.try_camera, step_heights=step_heights, pairs=pairs), looks):
        tried.append(candidate)
        if progress is not None:
            progress(min(done + len(tried), total), total)
    return tried


class _Search:
    """Edges of some consecutive frames, seen with one camera after the other."""

    def __init__(self, drive: Drive, perception: PerceptionSettings, guess: GuessSettings, seed: int) -> None:
        count = min(guess.frames, len(drive))
        start = max(0, (len(drive) - count) // 3)
        self.periods = commands_of(drive.subset(slice(start, start + count)), guess.wheelbase_cm).periods
        #: Frames that are compared, by the number of pairs.
        self.compared = {most: self._compared(most) for most in (_FIRST_PAIRS, _PAIRS, _STEEP_PAIRS)}
        everywhere = np.ones((drive.height, drive.width), np.uint8)
        self.edges = {
            k: likely_markings(find_edges(drive.image(start + k), perception.edges), everywhere)
            for k in sorted(set().union(*self.compared.values()))
        }
        self.size = drive.width, drive.height
        self.scale = drive.width / _REFERENCE_WIDTH
        self.limits, self.guess, self.seed = perception.range, guess, seed
        #: Step lengths of the frames relative to the typical one.
        self.relative = np.ones(count)
        self.typical_focal_px = float(np.exp(np.mean(np.log(guess.focal_px)))) * self.scale

    def camera(self, focal_px: float, pitch_deg: float, roll_deg: float) -> Camera:
        level = guessed_camera(*self.size, focal_px, pitch_deg, self.guess)
        return level.with_mounting(roll_rad=float(np.deg2rad(roll_deg)))

    def _compared(self, most: int) -> set[int]:
        """Frames that :func:`best_step` compares, and those before them that it compares them with."""
        lags = OdometrySettings().lags
        frames = sampled_frames(self.periods, lags, most)
        return {int(k) - lag for k in frames for lag in (0, *lags) if lag <= k}

    def images(self, look: _Look, most: int) -> ImagePairs:
        """The edges that see the road with a camera; the same points are drawn for every camera.

        Args:
            look: Focal length, pitch and roll.
            most: Frames that will be compared with those before them; the others stay empty.
        """
        camera = self.camera(*look)
        table = RoadTable(camera, mapping_range(camera.mounting, self.limits))
        compared, none = self.compared[most], EdgePixels(np.empty((0, 2)), np.empty((0, 2)))
        edges = [
            seen_edges(self.edges[k], table) if k in compared else none for k in range(len(self.periods))
        ]
        rng = np.random.default_rng(self.seed)
        return ImagePairs(edges, camera, OdometrySettings(), rng, self.periods)

    def try_camera(self, look: _Look, step_heights: float, pairs: int) -> Candidate:
        """Rate a camera by how clear the motion is with it, around a step length."""
        images = self.images(look, pairs)
        steps = step_heights * _AROUND
        _, fits = best_step(images, self.relative, steps, pairs)
        # The fit itself decides nothing: with too much pitch, standing still fits better than the true motion
        # with the right camera.
        clear = prominence(fits, steps)[_INNER] / images.points_per_frame
        fit = float(clear.max() - _FOCAL_PRIOR * np.log(look[0] / self.typical_focal_px) ** 2)
        return Candidate(*look, float(steps[_INNER][np.argmax(clear)]), fit)


def clearest_step(cameras: Iterable[ImagePairs], relative: Float[np.ndarray, "n"]) -> float:
    """Typical step length, in camera heights, with the camera in which one is most prominent.

    With a camera that is far off, images agree at no step. The best fit then lies at either end: almost no
    motion, which leaves all edges where they are, or more than an image shows.

    Args:
        cameras: The same images, seen with each camera.
        relative: Step length of each frame relative to the typical one.
    """
    steps = np.array(STEPS_HEIGHTS)
    best, most = float(np.sqrt(steps[0] * steps[-1])), 0.0
    for images in cameras:
        step, fit = best_step(images, relative, steps, _FIRST_PAIRS)
        clear = float(prominence(fit, steps).max()) / images.points_per_frame
        if clear > most and not at_limit(step, steps):
            best, most = step, clear
    return best


def _spacing(values: tuple[float, ...]) -> float:
    return float(np.min(np.diff(np.sort(values)))) if len(values) > 1 else 0.1 * values[0]


def with_known_scale(camera: Camera, factor: float, wheelbase_cm: float) -> Camera:
    """Scale a camera of nominal height; the lever arm scales, the wheelbase is the car's own."""
    scaled = camera.scaled_lengths(factor)
    lever = scaled.wheelbase_cm + scaled.mounting.ahead_of_front_axle_cm
    kept = replace(scaled, wheelbase_cm=wheelbase_cm)
    return kept.with_mounting(ahead_of_front_axle_cm=lever - wheelbase_cm)


def looking_alike(camera: Camera, like: Camera) -> Camera:
    """Turn a camera so that its image centre shows the place that it shows with another camera.

    Pitch and yaw are found together with a principal point: with another one, some pixels stand for degrees.
    """
    m = like.mounting
    middle = np.array([[0.5 * (like.width - 1), 0.5 * (like.height - 1)]])
    x_cm, y_cm = like.intersect_ground(middle)[0] - [m.right_of_centre_cm, m.ahead_of_front_axle_cm]
    if not np.isfinite(x_cm):
        return camera.with_mounting(pitch_down_rad=m.pitch_down_rad, yaw_rad=m.yaw_rad)
    pitch = float(np.arctan2(m.height_cm, np.hypot(x_cm, y_cm)))
    return camera.with_mounting(pitch_down_rad=pitch, yaw_rad=float(np.arctan2(-x_cm, y_cm)))


def nudged(camera: Camera, name: str, by: float) -> Camera:
    """Return the camera with one of its adjustable numbers changed.

    Args:
        camera: The camera.
        name: One of :data:`datagen.slam.adjustment.adjust.CAMERA_NAMES`.
        by: Change in the adjustment's unit: [rad] for angles, camera heights for the lever, a logarithm for
            the focal length, [px] for the principal point.
    """
    m = camera.mounting
    if name in _ANGLES:
        return camera.with_mounting(**{_ANGLES[name]: getattr(m, _ANGLES[name]) + by})
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
