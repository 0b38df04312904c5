"""A coarse camera from the drive alone: the focal length and pitch with which the motion is clearest.

It is the start of the bundle adjustment. With the right camera, the edges of an image meet those of the next
one at the true motion and nowhere else. Before a loop is closed, this gives the pitch to a few degrees and
the focal length to about a fifth, so a prior on the focal length is needed. Scale is not observable: the
camera's height is nominal until the lane width sets it.

Most cameras have an equidistant fisheye with its axis in the image centre, are level and look far ahead. From
the best of those the search goes on to wider and narrower lenses, pinholes, and images whose centre lies
beside the lens's axis, as far as these show the motion more clearly. Where none shows it clearly, or the best
is steeper than the first ones, rolled and steep cameras are tried as well.

Also here: cameras that differ from a given one in scale, in where they look, or in one number.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

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
from lanenet.geometry.camera import Camera, CameraModel, Mounting
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
#: Fit from which no unusual camera is tried, for that takes four times as long, and how many times as well
#: such a one must fit as the best usual one. Measured: usual ones fit by 0.20 to 0.34 on three real drives,
#: and at most 1.01 times as well was found. With the axis 68 and 90 px beside the middle of 640, the best
#: usual ones fitted by 0.15 and 0.20, what was found near the true ones 1.9 and 1.27 times as well.
_USUAL_FIT, _BETTER = 0.19, 1.25
#: Places of the axis right of and below the middle that are tried, in image widths, and the widest lens, [px]
#: for images 160 px wide. Measured: on four drives with the axis off by 37 to 99 px in 640, one with half
#: of the offset had half of the advantage of the true camera. Derived: 200 degrees; full circles are refused.
_ASIDE, _BELOW, _WIDEST_PX = (-0.18, -0.09, 0.0, 0.09, 0.18), (-0.09, 0.0, 0.09), 45.0
_LENSES: tuple[CameraModel, ...] = ("fisheye", "pinhole")
#: Steps from the best of these to others: of the logarithm of the focal length, of the pitch, [degrees], and
#: of the axis beside and below the middle, in image widths. Chosen: half of those of the grid.
_STEPS = (0.1, 2.0, 0.045, 0.045)
#: Height of the camera before the scale is known, [cm]; any would do, this is near those of 1:10 cars.
NOMINAL_HEIGHT_CM = 15.0
#: Angles of the mounting by their names in the adjustment.
_ANGLES = {"pitch": "pitch_down_rad", "roll": "roll_rad", "yaw": "yaw_rad"}
#: Width of the images for which focal lengths are given, [px]: that of a Donkeycar.
_REFERENCE_WIDTH = 160.0


def guessed_camera(
    width: int,
    height: int,
    focal_px: float,
    pitch_deg: float,
    guess: GuessSettings,
    off_px: tuple[float, float] = (0.0, 0.0),
    lens: CameraModel = "fisheye",
) -> Camera:
    """Build a camera of nominal height, ``lever_heights`` ahead of the rear axle, its axis off the middle."""
    cx, cy = 0.5 * (width - 1) + off_px[0], 0.5 * (height - 1) + off_px[1]
    K = np.array([[focal_px, 0.0, cx], [0.0, focal_px, cy], [0.0, 0.0, 1.0]])
    ahead = guess.lever_heights * NOMINAL_HEIGHT_CM - guess.wheelbase_cm
    mounting = Mounting(
        NOMINAL_HEIGHT_CM, pitch_down_rad=float(np.deg2rad(pitch_deg)), ahead_of_front_axle_cm=ahead
    )
    k1 = guess.k1 if lens == "fisheye" else 0.0
    return Camera(lens, width, height, K, np.array([k1, 0.0, 0.0, 0.0]), mounting, guess.wheelbase_cm)


class Look(NamedTuple):
    """Lens and direction of a camera that is tried.

    Attributes:
        focal_px: Focal length.
        pitch_deg: Downward pitch.
        roll_deg: Roll.
        off_px: Place of the lens's axis right of and below the middle of the image.
        lens: Model of the lens.
    """

    focal_px: float
    pitch_deg: float
    roll_deg: float = 0.0
    off_px: tuple[float, float] = (0.0, 0.0)
    lens: CameraModel = "fisheye"


@dataclass(frozen=True)
class Candidate:
    """One camera of the search.

    Attributes:
        look: The camera.
        step_heights: Its best step length.
        fit: Log likelihood per edge point of this step relative to clearly shorter and longer ones, less the
            prior of the focal length.
    """

    look: Look
    step_heights: float
    fit: float

    @property
    def is_clear(self) -> bool:
        """Whether it shows the motion clearly."""
        return self.fit >= _CLEAR

    @property
    def figures(self) -> dict[str, Any]:
        """For a map's report."""
        off = {f"off_{axis}_px": off_px for axis, off_px in zip("uv", self.look.off_px, strict=True)}
        look = self.look._asdict() | off
        del look["off_px"]
        return look | {"step_heights": self.step_heights, "fit": self.fit}


def coarse_camera(
    drive: Drive,
    perception: PerceptionSettings,
    guess: GuessSettings,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[Camera, list[Candidate]]:
    """Search focal length and pitch for the camera with which the motion from image to image is clearest.

    Returns:
        The camera, and all candidates for the report, the best one first. Its roll is 0 unless that was
        searched for, too.
    """
    search = _Search(drive, perception, guess, seed=int(rng.integers(2**31)))
    tried = _level_cameras(search, guess, progress)
    best = _best(tried)
    if best.fit < _USUAL_FIT:
        unusual = _unusual_cameras(search, guess, best, progress, len(tried))
        tried += unusual
        if _best(unusual).fit > _BETTER * best.fit:
            best = _best(unusual)
    if not best.is_clear or best.look.pitch_deg > max(guess.pitch_deg):
        steep = _steep_cameras(search, guess, progress)
        tried += steep
        best = _best([best, *steep])
    return search.camera(best.look), [best, *(one for one in tried if one is not best)]


def _best(tried: Iterable[Candidate]) -> Candidate:
    return max(tried, key=lambda candidate: candidate.fit)


def _unusual_cameras(
    search: _Search, guess: GuessSettings, best: Candidate, progress: Progress | None, done: int
) -> list[Candidate]:
    """Try wide and narrow fisheyes and pinholes, with the axis off the middle too, and walk on from there.

    Returns:
        Those of the walk.

    Source:
        Hooke and Jeeves 1961, "Direct search solution of numerical and statistical problems", Journal of the
        ACM 8: pattern search.
    """
    width = search.size[0]
    # Of a pinhole, focal length and pitch make up for an axis below the middle.
    places = [(lens, u, v) for lens, u, v in product(_LENSES, _ASIDE, _BELOW) if lens == "fisheye" or not v]
    cells = _chessboard(search, (_WIDEST_PX, *guess.steep_focal_px), guess.pitch_deg)
    grid = [Look(f, p, 0.0, (u * width, v * width), lens) for (f, p), (lens, u, v) in product(cells, places)]
    total = done + len(grid)
    best = _best(_rated(search, grid, best.step_heights, _FIRST_PAIRS, progress, total, done))
    # Among so many, the best of a few pairs of images is partly luck.
    walk = _rated(search, [best.look], best.step_heights, _PAIRS, progress, total, total)
    best, share = walk[0], 1.0
    while share > 0.2:
        known = {one.look for one in walk}
        near = [look for look in _beside(best.look, share, width) if look not in known]
        walk += _rated(search, near, best.step_heights, _PAIRS, progress, total, total)
        if _best(walk) is best:
            share *= 0.5
        best = _best(walk)
    return walk


def _beside(look: Look, share: float, width: int) -> list[Look]:
    """Cameras that differ from one in a single number, and the one with the other lens."""
    focal, pitch, aside, below = share * np.array(_STEPS) * [1.0, 1.0, width, width]
    other: CameraModel = "pinhole" if look.lens == "fisheye" else "fisheye"
    u, v = look.off_px
    found = [look._replace(lens=other)]
    for sign in (-1.0, 1.0):
        found += [
            look._replace(focal_px=float(look.focal_px * np.exp(sign * focal))),
            look._replace(pitch_deg=float(look.pitch_deg + sign * pitch)),
            look._replace(off_px=(float(u + sign * aside), v)),
            look._replace(off_px=(u, float(v + sign * below))),
        ]
    return found


def _chessboard(
    search: _Search, focals_px: Sequence[float], pitches_deg: Sequence[float]
) -> list[tuple[float, float]]:
    """Every second camera of a grid, like the black squares of a chessboard."""
    grid = product(enumerate(focals_px), enumerate(pitches_deg))
    return [(f * search.scale, p) for (i, f), (j, p) in grid if (i + j) % 2 == 0]


def _level_cameras(search: _Search, guess: GuessSettings, progress: Progress | None) -> list[Candidate]:
    """Try level cameras: the given grid, then half its steps around the best."""
    focals, pitches = [f * search.scale for f in guess.focal_px], guess.pitch_deg
    spread = [Look(f, p) for f, p in _chessboard(search, guess.focal_px, pitches)]
    step = clearest_step((search.images(look, _FIRST_PAIRS) for look in spread), search.relative)
    looks = [Look(f, p) for f in focals for p in pitches]
    tried = _rated(search, looks, step, _PAIRS, progress, len(looks) + 9)
    best = _best(tried)
    df, dp = 0.5 * _spacing(guess.focal_px) * search.scale, 0.5 * _spacing(pitches)
    at = best.look
    near = [Look(at.focal_px + i * df, at.pitch_deg + j * dp) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    new = [look for look in near if look not in looks]
    return tried + _rated(search, new, best.step_heights, _PAIRS, progress, len(looks) + 9, len(tried))


def _steep_cameras(search: _Search, guess: GuessSettings, progress: Progress | None) -> list[Candidate]:
    """Try steep and rolled cameras: the given grid, then half its steps around the best, and a quarter."""
    focals = [f * search.scale for f in guess.steep_focal_px]
    pitches, rolls = guess.steep_pitch_deg, guess.steep_roll_deg
    looks = [Look(*look) for look in product(focals, pitches, rolls)]
    # Every third camera of the grid.
    spread = looks[::3]
    step = clearest_step((search.images(look, _FIRST_PAIRS) for look in spread), search.relative)
    total = len(looks) + 2 * 27
    tried = _rated(search, looks, step, _STEEP_PAIRS, progress, total)
    for share in (0.5, 0.25):
        best = _best(tried)
        at = best.look
        ratio = float(np.exp(share * _spacing(tuple(np.log(guess.steep_focal_px)))))
        dp, dr = share * _spacing(pitches), share * _spacing(rolls)
        near = [
            Look(at.focal_px * ratio**i, at.pitch_deg + j * dp, at.roll_deg + k * dr)
            for i, j, k in product((-1, 0, 1), repeat=3)
        ]
        new = [look for look in near if look != at]
        tried += _rated(search, new, best.step_heights, _STEEP_PAIRS, progress, total, len(tried))
    return tried


def _rated(
    search: _Search,
    looks: Sequence[Look],
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

    def camera(self, look: Look) -> Camera:
        level = guessed_camera(*self.size, look.focal_px, look.pitch_deg, self.guess, look.off_px, look.lens)
        return level.with_mounting(roll_rad=float(np.deg2rad(look.roll_deg)))

    def _compared(self, most: int) -> set[int]:
        """Frames that :func:`best_step` compares, and those before them that it compares them with."""
        lags = OdometrySettings().lags
        frames = sampled_frames(self.periods, lags, most)
        return {int(k) - lag for k in frames for lag in (0, *lags) if lag <= k}

    def images(self, look: Look, most: int) -> ImagePairs:
        """The edges that see the road with a camera; the same points are drawn for every camera.

        Args:
            look: The camera.
            most: Frames that will be compared with those before them; the others stay empty.
        """
        camera = self.camera(look)
        table = RoadTable(camera, mapping_range(camera.mounting, self.limits))
        compared, none = self.compared[most], EdgePixels(np.empty((0, 2)), np.empty((0, 2)))
        edges = [
            seen_edges(self.edges[k], table) if k in compared else none for k in range(len(self.periods))
        ]
        rng = np.random.default_rng(self.seed)
        return ImagePairs(edges, camera, OdometrySettings(), rng, self.periods)

    def try_camera(self, look: Look, step_heights: float, pairs: int) -> Candidate:
        """Rate a camera by how clear the motion is with it, around a step length."""
        images = self.images(look, pairs)
        steps = step_heights * _AROUND
        _, fits = best_step(images, self.relative, steps, pairs)
        # The fit itself decides nothing: with too much pitch, standing still fits better than the true motion
        # with the right camera.
        clear = prominence(fits, steps)[_INNER] / images.points_per_frame
        fit = float(clear.max() - _FOCAL_PRIOR * np.log(look.focal_px / self.typical_focal_px) ** 2)
        return Candidate(look, float(steps[_INNER][np.argmax(clear)]), fit)


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
