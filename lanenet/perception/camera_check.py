"""Whether the images still fit the calibration: the camera was hit, turned, or mounted upside down since."""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import UInt8

from lanenet.geometry.camera import Camera
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor, RoadEdges

#: Time between two frames that are looked at: what is looked for lasts, and views that are closer resemble
#: each other. Chosen: 4 a second.
_EVERY_S = 0.25
#: Views that are remembered, and how many make a judgement. Chosen: of 15 s, and of 4 s.
_LENGTH, _ENOUGH = 60, 16
#: Only edges within this of the car are compared, to the side and ahead: further away the road may slope.
_SIDE_CM, _FAR_CM = 50.0, 60.0
#: Edges further across than this (cosine to the car's x axis) are dash ends, joints and stop lines.
_ALONG = 0.6
#: Fewest edge points, and the least spread of the agreeing ones to the side: one line alone shows no slant.
_LEAST_POINTS, _LEAST_SPREAD_CM = 40, 8.0
#: Edge points that are used at most: each line has some hundred, which tell the same.
_MOST_POINTS = 400
#: Steps of the robust fit with the scale of each, slopes dx/dy: it narrows down to what straight tape shows.
_SCALES = (0.3, 0.15, 0.1, 0.075, 0.06, 0.05)
#: Weak priors on curvature and slant, in points: without lines on both sides the slant stays 0.
_PRIOR = np.array([1e-3, 0.3, 0.3])
#: Where the lane's direction is taken. Chosen: in the middle of the edges.
_AHEAD_CM = 25.0
#: How far commanded steering may be from what the wheels do, as a share of it. Chosen: synthetic cars and
#: real drives turned 0.4 to 0.9 times as much as commanded.
_STEERING_SIGMA = 0.25
#: Least spread of directions about the fit, and passes of that fit. Chosen: 2 degrees, of a good view.
_LEAST_SPREAD_RAD, _PASSES = 0.03, 4
#: Views that resemble each other give less than their number: one in so many counts.
_ALIKE = 4.0
#: Units of the fit, [cm]: they make its three numbers alike in size.
_Y_CM, _X_CM = 30.0, 20.0


class Concern(IntEnum):
    """How much a finding matters."""

    NONE = 0
    WARN = 1
    SLOW = 2
    STOP = 3


@dataclass(frozen=True)
class Finding:
    """What the last views say of the camera.

    Attributes:
        concern: What to do.
        text: What was found and what was expected; empty if nothing.
    """

    concern: Concern = Concern.NONE
    text: str = ""


@dataclass(frozen=True)
class Limits:
    """From which value on a finding matters, [rad]."""

    warn: float
    slow: float
    stop: float

    def concern_of(self, value: float) -> Concern:
        """Return what a value means; NaN means nothing."""
        size = abs(value)
        reached = [
            concern
            for concern, limit in zip(Concern, (0.0, *vars(self).values()), strict=True)
            if size >= limit
        ]
        return reached[-1] if reached else Concern.NONE


#: Of the pitch error, after subtraction of two standard errors. Measured: at most 1.5 degrees on synthetic
#: and real drives (docs/driving.md has the table); an error of 5 degrees gives 2 to 5.
PITCH_LIMITS = Limits(*map(math.radians, (1.8, 2.5, 3.5)))
#: Of the lane's direction, likewise. Measured: at most 2.7 degrees on the same drives.
HEADING_LIMITS = Limits(*map(math.radians, (3.5, 5.0, 7.5)))
#: Pitch error that shows in one place already. Measured: on the same drives two views of 1637 showed it, one
#: view in a hundred 10 degrees, and the median of six views in a row 9 at most. Upside down, half of them do.
GROSS_RAD = math.radians(15.0)
#: Views in a row whose median is looked at for that: of 1.5 s.
_GROSS_VIEWS = 6


def view_of(edges: RoadEdges, height_cm: float) -> tuple[float, float]:
    """Return the error of the camera's pitch, and the direction of the lane ahead, from one view.

    On the road of a calibrated camera, lane lines are concentric: all edges fit one field of directions,
    slope = s + k (y + x slope). An error of the pitch lets the lines on both sides converge or diverge, which
    adds x p / h with the pitch error p and the camera's height h. Fitted robustly, since not every edge is a
    line's.

    Args:
        edges: Edge points of a frame on the road.
        height_cm: Height of the camera.

    Returns:
        The pitch error, [rad], positive if the camera looks further down than its calibration says, so that
        lines spread ahead; and the direction 25 cm ahead of the front axle, [rad], positive to the left. NaN
        if the view has no lines on both sides.

    Source:
        Own derivation; ``tests/unit/perception/test_camera_check.py`` checks it with rotated cameras.
    """
    x, y = edges.points_cm.T.astype(np.float64)
    across = edges.normals[:, 0].astype(np.float64)
    near = np.flatnonzero((y > -5.0) & (y < _FAR_CM) & (np.abs(x) < _SIDE_CM) & (np.abs(across) > _ALONG))
    if near.size < _LEAST_POINTS:
        return math.nan, math.nan
    near = near[:: -(-near.size // _MOST_POINTS)]
    x, y, across = x[near], y[near], across[near]
    slopes = -edges.normals[near, 1].astype(np.float64) / across
    rows = np.stack([np.ones_like(x), (y + x * slopes) / _Y_CM, x / _X_CM])
    prior, found = np.diag(_PRIOR), np.array([float(np.median(slopes)), 0.0, 0.0])
    # A slope is known the less, the steeper it is.
    sure = across * across
    off = sure * (slopes - found @ rows)
    for scale in _SCALES:
        weighted = rows * (sure / (1.0 + (off / scale) ** 2)) ** 2
        found = np.linalg.solve(weighted @ rows.T + prior, weighted @ slopes)
        off = sure * (slopes - found @ rows)
    agree = np.abs(off) < 2.0 * _SCALES[-1]
    if agree.sum() < _LEAST_POINTS // 2 or float(np.std(x[agree])) < _LEAST_SPREAD_CM:
        return math.nan, math.nan
    slope, curvature, slant = found.tolist()
    return math.atan(slant / _X_CM * height_cm), -math.atan(slope + curvature / _Y_CM * _AHEAD_CM)


class CameraCheck:
    """Compares what changes slowly with the calibration, over the last views of a moving car.

    Attributes:
        finding: Of the views so far.
    """

    def __init__(self, camera: Camera, mask: UInt8[np.ndarray, "h w"] | None = None) -> None:
        """Take the calibration.

        Args:
            camera: The calibrated camera.
            mask: Nonzero on the car itself.
        """
        self._extractor = RoadEdgeExtractor(camera, PerceptionSettings(), mask)
        self._height_cm, self._wheelbase_cm = camera.mounting.height_cm, camera.wheelbase_cm
        self._pitches_rad: deque[float] = deque(maxlen=_LENGTH)
        # Direction of the lane, and of the car's own path there.
        self._directions_rad: deque[tuple[float, float]] = deque(maxlen=_LENGTH)
        self.reset()

    def reset(self) -> None:
        """Forget the views."""
        self._pitches_rad.clear()
        self._directions_rad.clear()
        self._looked_s = -math.inf
        self.finding = Finding()

    def view(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> tuple[float, float]:
        """Return what one frame shows, see :func:`view_of`."""
        return view_of(self._extractor.extract(frame_bgr), self._height_cm)

    def look(
        self, frame_bgr: UInt8[np.ndarray, "h w 3"], t_s: float, steering_rad: float = math.nan
    ) -> Finding:
        """Take a frame in which a moving car saw its lane; most frames are passed over.

        Args:
            frame_bgr: The image.
            t_s: Its time.
            steering_rad: Steering of the car, positive left; NaN where it is not known what the wheels do.

        Returns:
            What the views so far say.
        """
        if t_s - self._looked_s >= _EVERY_S:
            self._looked_s = t_s
            self.add(*self.view(frame_bgr), steering_rad)
        return self.finding

    def add(self, pitch_rad: float, direction_rad: float, steering_rad: float) -> None:
        """Take what one view shows; NaN where it shows nothing."""
        path_rad = math.tan(steering_rad) / self._wheelbase_cm * (_AHEAD_CM + self._wheelbase_cm)
        if math.isfinite(pitch_rad):
            self._pitches_rad.append(pitch_rad)
        if math.isfinite(direction_rad + path_rad):
            self._directions_rad.append((direction_rad, path_rad))
        pitch, heading = _sure_median(self._pitches_rad), _sure_heading(self._directions_rad)
        last = list(self._pitches_rad)[-_GROSS_VIEWS:]
        if len(last) == _GROSS_VIEWS and abs(now := statistics.median(last)) >= GROSS_RAD:
            pitch = now
        by_pitch, by_heading = PITCH_LIMITS.concern_of(pitch), HEADING_LIMITS.concern_of(heading)
        if by_pitch is by_heading is Concern.NONE:
            self.finding = Finding()
        elif by_pitch >= by_heading:
            self.finding = Finding(
                by_pitch,
                f"the camera looks {math.degrees(abs(pitch)):.1f} degrees further "
                f"{'down' if pitch > 0.0 else 'up'} than it was calibrated: has it moved, is it upside down?",
            )
        else:
            self.finding = Finding(
                by_heading,
                f"the lane runs {math.degrees(abs(heading)):.1f} degrees to the "
                f"{'left' if heading > 0.0 else 'right'} of the car's path: has the camera turned or moved?",
            )


def _sure_median(values: Collection[float]) -> float:
    """Return the median, brought towards 0 by twice its standard error; NaN of too few values."""
    if len(values) < _ENOUGH:
        return math.nan
    middle = statistics.median(values)
    # 1.48 makes the median deviation a standard deviation, 1.25 that of a mean that of a median.
    spread = 1.48 * statistics.median(abs(value - middle) for value in values)
    return _towards_zero(middle, 2.0 * 1.25 * spread / math.sqrt(len(values)))


def _sure_heading(directions_rad: Collection[tuple[float, float]]) -> float:
    """Return by how much the lane differs from the path of a car that follows it, as :func:`_sure_median`.

    Robust least squares of direction = error + gain x path: the gain of the steering is not known well.
    """
    if len(directions_rad) < _ENOUGH:
        return math.nan
    seen, path = np.array(directions_rad).T
    rows = np.stack([np.ones_like(path), path])
    prior = np.diag([0.0, _STEERING_SIGMA**-2])
    found = np.array([0.0, 1.0])
    for _ in range(_PASSES):
        off = seen - found @ rows
        spread = max(_LEAST_SPREAD_RAD, 1.48 * float(np.median(np.abs(off))))
        weighted = rows / (1.0 + (off / (2.0 * spread)) ** 2) / (_ALIKE * spread**2)
        information = weighted @ rows.T + prior
        found = np.linalg.solve(information, weighted @ seen + prior @ (0.0, 1.0))
    return _towards_zero(float(found[0]), 2.0 * math.sqrt(float(np.linalg.inv(information)[0, 0])))


def _towards_zero(value: float, by: float) -> float:
    return math.copysign(max(0.0, abs(value) - by), value)
