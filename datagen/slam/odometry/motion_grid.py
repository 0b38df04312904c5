"""The likeliest motion of a drive: a hidden Markov model of steps and turns, and turns seen in the distance.

The state is the typical step length and the turn of a frame. It changes slowly, and the images say how likely
each state is; both directions of time are combined.

Walls and what stands before them move across the image when the car turns, and hardly when it drives. That
shows a turn where the road does not: in blur, in a slide, on a road whose lines look alike. How many pixels a
turn is depends on a lens that may not be known, and some drives show nothing in the distance but the sky, or
lamps that move with the car. The shifts therefore count only where they agree with the turns by the road in
most of the drive, and in the scale that those give.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from datagen.slam.commands import LONGEST_STEP
from lanenet.data.drives import Drive
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import to_gray

#: Spacing of the steps as a logarithm, about the accuracy of one pair of images; how many spreads they reach
#: to either side; and the least reach. Chosen: 2.8 spreads hold 99.5 % of a normal distribution.
_SPACING, _SPREADS, _LEAST_REACH = 0.056, 2.8, 0.3
#: Variance per step of the birth-and-death chain, in cells, beyond which it would have to move by more than
#: one cell.
_CHAIN_VARIANCE = 0.5
#: Share and width of turns that change quickly, as when a driver catches a slide. Chosen: rare, and
#: wide enough for a slide.
_QUICK_SHARE, _QUICK_FACTOR = 0.1, 4.0
#: Cells around the likeliest state whose mean is taken. Chosen: the width of a peak.
_AROUND = 2
#: The steering's prediction is tempered, since its errors last for several frames, and its likelihood has a
#: floor, since it may be wrong altogether. Chosen: neighbouring frames count for about a third of one each.
_STEERING_TEMPER, _STEERING_FLOOR = 0.3, 0.02
#: Errors of turns seen in the distance last as well: each frame's sigma is widened, and there is a floor.
#: Chosen: lower than the steering's, as these turns are measured.
_SEEN_WIDER, _SEEN_FLOOR = 1.5, 0.005
#: What is this far away on the ground, in camera heights, and all above it counts as far. With a focal length
#: of 80 px, a step of half a camera height moves that row by 0.6 px.
_FAR_HEIGHTS = 8.0
#: Width at which images are compared, that of a Donkeycar tub, and the fewest rows that tell anything.
_WIDTH, _LEAST_ROWS = 160, 12
#: Correlation peak from which a shift is believed, and the largest such shift as a share of the width.
#: Chosen: well above the peak of noise; a larger shift leaves too little overlap.
_LEAST_PEAK, _MOST_SHIFT = 0.3, 0.25
#: Least standard deviation of a view, gray levels: less is the noise of a blank wall.
_LEAST_CONTRAST = 2.0
#: Frames, correlation with the turns by the road, and share of inliers that are needed. Chosen: 50 frames are
#: two to five seconds; lamps that move with the car, and blank distance, must stay below the others.
_LEAST_FRAMES, _LEAST_CORRELATION, _LEAST_SHARE = 50, 0.8, 0.6
#: Inliers are within so many sigmas; rounds of the fit without the others. Chosen: usual for a robust fit.
_INLIER, _ROUNDS = 4.0, 5
#: Factor on the turns that the lens gives, at most, either way: a guessed lens is not further off.
_LENS_FACTOR = 2.0
#: Least sigma of such a turn, [rad]: a third of a pixel of a lens of 80 px.
_LEAST_SIGMA_RAD = 0.004


@dataclass(frozen=True)
class MotionGrid:
    """States, and how they change.

    Attributes:
        typical: Step length about which the steps lie.
        spread: Standard deviation of the step about it, as a logarithm.
        keep: Share of the deviation that stays until the next frame.
        jump: Probability that the step changes to any other.
        turns_rad: Turns of the grid in a typical time step, evenly spaced.
        turn_walk_rad: Standard deviation of the change of turn from one typical time step to the next.
    """

    typical: float
    spread: float
    keep: float
    jump: float
    turns_rad: Float[np.ndarray, "t"]
    turn_walk_rad: float

    @property
    def log_factors(self) -> Float[np.ndarray, "w"]:
        """Logarithms of the steps over the typical one."""
        half = int(np.ceil(max(_SPREADS * self.spread, _LEAST_REACH) / _SPACING))
        return _SPACING * np.arange(-half, half + 1)

    @property
    def steps(self) -> Float[np.ndarray, "w"]:
        """The grid's steps."""
        return self.typical * np.exp(self.log_factors)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of steps and of turns."""
        return len(self.log_factors), len(self.turns_rad)

    def step_changes(self) -> Float[np.ndarray, "w w"]:
        """Probability of each step (columns) after each other (rows): a walk that is pulled to the middle.

        Source:
            Ornstein-Uhlenbeck process as a birth-and-death chain with the same drift and variance per frame.
        """
        x = self.log_factors
        variance = self.spread**2 * (1.0 - self.keep**2) / _SPACING**2
        # A change of more than about a cell takes several steps of the chain.
        times = max(1, int(np.ceil(variance / _CHAIN_VARIANCE)))
        keep = self.keep ** (1.0 / times)
        drift = -(1.0 - keep) * x / _SPACING
        variance = self.spread**2 * (1.0 - keep**2) / _SPACING**2
        up, down = (np.clip(0.5 * (variance + sign * drift), 0.0, 0.5) for sign in (1.0, -1.0))
        up[-1] = down[0] = 0.0
        chain = np.diag(1.0 - up - down) + np.diag(up[:-1], 1) + np.diag(down[1:], -1)
        anywhere = np.exp(-0.5 * (x / self.spread) ** 2)
        jumps = self.jump * anywhere / anywhere.sum()
        changes: Float[np.ndarray, "w w"] = (1.0 - self.jump) * np.linalg.matrix_power(chain, times) + jumps
        return changes

    def turn_changes(self) -> Float[np.ndarray, "t t"]:
        """Probability of each turn (columns) after each other (rows)."""
        apart = self.turns_rad[:, None] - self.turns_rad[None, :]
        changes, walk_rad = np.zeros_like(apart), self.turn_walk_rad
        for share, sigma in ((1.0 - _QUICK_SHARE, walk_rad), (_QUICK_SHARE, _QUICK_FACTOR * walk_rad)):
            part = np.exp(-0.5 * (apart / sigma) ** 2)
            changes += share * part / part.sum(axis=1, keepdims=True)
        return changes


def follow_motion(
    grid: MotionGrid,
    log_likelihood: Float[np.ndarray, "n w t"],
    relative: Float[np.ndarray, "n"],
    curvature: Float[np.ndarray, "n"],
    curvature_sigma: float,
    seen: SeenTurns | None = None,
    periods: Float[np.ndarray, "n"] | None = None,
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Find each frame's step and turn, given all frames.

    Args:
        grid: States.
        log_likelihood: Log likelihood of each state given the images, at most 0.
        relative: Step length of each frame relative to the typical one.
        curvature: Predicted curvature.
        curvature_sigma: Standard deviation of the prediction.
        seen: Turns as seen in the distance, if any.
        periods: Time from the frame before to each frame, in typical time steps; None for a drive without
            gaps. Over a gap the state changes as often as in as many frames.

    Returns:
        Typical steps, and turns in a typical time step: the mean over the states around the likeliest one.

    Source:
        Rabiner 1989, "A tutorial on hidden Markov models", eq. 19-27 (forward and backward, scaled).
    """
    n = len(log_likelihood)
    time = np.ones(n) if periods is None else np.minimum(periods, LONGEST_STEP)
    # Before an image that came early the motion may change as well.
    whole = np.maximum(np.rint(time).astype(int), 1).tolist()
    by_step, by_turn = (
        {m: np.linalg.matrix_power(once, m) for m in set(whole)}
        for once in (grid.step_changes(), grid.turn_changes())
    )
    steps, turns_rad = grid.steps, grid.turns_rad

    def likelihood(k: int) -> Float[np.ndarray, "w t"]:
        likely: Float[np.ndarray, "w t"] = np.exp(log_likelihood[k].astype(np.float64))
        # One sigma for all steps: a prediction of the turn says nothing about the step.
        sigma = max(curvature_sigma * grid.typical * relative[k], 0.5 * grid.turn_walk_rad)
        miss = (time[k] * turns_rad[None, :] - curvature[k] * (steps[:, None] * relative[k])) / sigma
        likely = likely * (np.exp(-0.5 * miss**2) + _STEERING_FLOOR) ** _STEERING_TEMPER
        if seen is not None and np.isfinite(seen.turns_rad[k]):
            off = (time[k] * turns_rad - seen.turns_rad[k]) / (_SEEN_WIDER * seen.sigma_rad)
            likely = likely * (np.exp(-0.5 * off**2) + _SEEN_FLOOR)
        return likely

    forward = np.empty(log_likelihood.shape, np.float32)
    # At the first frame the car may be in any motion.
    state = np.repeat(np.exp(-0.5 * (grid.log_factors / grid.spread) ** 2)[:, None], grid.shape[1], axis=1)
    for k, m in enumerate(whole):
        state = (by_step[m].T @ state @ by_turn[m] if k else state) * likelihood(k)
        state /= state.sum()
        forward[k] = state
    step, turn = np.empty(n), np.empty(n)
    later = np.ones(grid.shape)
    for k in range(n - 1, -1, -1):
        both = forward[k] * later
        # The likeliest step over all turns, and the likeliest turn with that step.
        i = int(both.sum(axis=1).argmax())
        rows = slice(max(i - _AROUND, 0), i + _AROUND + 1)
        j = int(both[rows].sum(axis=0).argmax())
        columns = slice(max(j - _AROUND, 0), j + _AROUND + 1)
        near = both[rows, columns] / both[rows, columns].sum()
        step[k] = grid.typical * np.exp(near.sum(axis=1) @ grid.log_factors[rows])
        turn[k] = near.sum(axis=0) @ turns_rad[columns]
        later = by_step[whole[k]] @ (later * likelihood(k)) @ by_turn[whole[k]].T
        later /= later.sum()
    return step, turn


@dataclass(frozen=True)
class SeenTurns:
    """Turns as seen in the distance.

    Attributes:
        turns_rad: Turn from the frame before, positive left; NaN where it was not seen.
        sigma_rad: Standard deviation of each.
    """

    turns_rad: Float[np.ndarray, "n"]
    sigma_rad: float


def far_turns(drive: Drive, camera: Camera) -> Float[np.ndarray, "n"]:
    """Measure how far the distance turned from each frame to the next, in the scale of the given camera.

    Returns:
        Turns, positive left, [rad]; NaN for the first frame, and where nothing was recognised.

    Source:
        Phase correlation: Kuglin and Hines 1975; here OpenCV's.
    """
    turns = np.full(len(drive), np.nan)
    m = camera.mounting
    far = [[m.right_of_centre_cm, m.ahead_of_front_axle_cm + _FAR_HEIGHTS * m.height_cm]]
    width = min(_WIDTH, camera.width)
    scale = width / camera.width
    row = float(camera.project_ground(np.array(far))[0, 1])
    rows = int(scale * row) if np.isfinite(row) else 0
    if rows < _LEAST_ROWS * width / _WIDTH:
        return turns
    rows = min(rows, round(scale * camera.height))
    window = cv2.createHanningWindow((width, rows), cv2.CV_32F)
    before: Float32[np.ndarray, "h w"] | None = None
    for k in range(len(drive)):
        view = to_gray(drive.image(k))[: int(np.ceil(rows / scale))]
        if view.shape != (rows, width):
            view = cv2.resize(view, (width, rows), interpolation=cv2.INTER_AREA)
        view = view.astype(np.float32)
        blank = float(view.std()) < _LEAST_CONTRAST
        # Without the mean: the window itself would look alike in all images.
        view = (view - view.mean()) * window
        if before is not None and not blank:
            (right_px, _), peak = cv2.phaseCorrelate(before.copy(), view.copy())
            if peak > _LEAST_PEAK and abs(right_px) < _MOST_SHIFT * width:
                turns[k] = right_px / (scale * camera.K[0, 0])
        before = None if blank else view
    return turns


def seen_turns(far_rad: Float[np.ndarray, "n"], turns_rad: Float[np.ndarray, "n"]) -> SeenTurns | None:
    """Compare the turns by the distance with those by the road, and bring them to the scale of the latter.

    Args:
        far_rad: See :func:`far_turns`.
        turns_rad: Turns by the road.

    Returns:
        None where the two do not agree.
    """
    known = np.isfinite(far_rad)
    known[:1] = False
    x, y = far_rad[known], turns_rad[known]
    if len(x) < _LEAST_FRAMES or not np.any(x):
        return None
    factor = _median_ratio(x, y)
    for _ in range(_ROUNDS):
        miss = np.abs(y - factor * x)
        sigma = max(1.4826 * float(np.median(miss)), _LEAST_SIGMA_RAD)
        kept: Bool[np.ndarray, "m"] = miss < _INLIER * sigma
        factor = float(x[kept] @ y[kept] / max(x[kept] @ x[kept], 1e-12))
    moved = np.std(x[kept]) > 0.0 and np.std(y[kept]) > 0.0
    if not moved or np.corrcoef(x[kept], y[kept])[0, 1] < _LEAST_CORRELATION:
        return None
    if kept.mean() < _LEAST_SHARE or not 1.0 / _LENS_FACTOR < factor < _LENS_FACTOR:
        return None
    return SeenTurns(factor * far_rad, sigma)


def _median_ratio(x: Float[np.ndarray, "m"], y: Float[np.ndarray, "m"]) -> float:
    """Slope through the origin with the least absolute errors; turns that the road misses are outliers."""
    moved = x != 0.0
    ratio, weight = y[moved] / x[moved], np.abs(x[moved])
    order = np.argsort(ratio)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    return float(ratio[order[half]])
