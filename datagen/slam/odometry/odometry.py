"""Odometry from image to image: how far the car drove, and how far it turned, from edges alone.

The filter's map is blurred by about as much as the car moves per frame, and a blurred map prefers slow
motion: the less the car moves, the more edges lie on those before. Neighbouring images compared to half a
pixel do not have this bias: their edges meet at the true motion, and nowhere else along a line of dashes,
corners or stains. What one pair of images leaves open, its neighbours settle (see
:mod:`datagen.slam.odometry.motion_grid`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, Float16, Float32, Int

from datagen.slam.commands import LONGEST_STEP, MOST_BRIDGED
from datagen.slam.odometry.image_pairs import ImagePairs, turns_up_to
from datagen.slam.odometry.motion_grid import MotionGrid, SeenTurns, follow_motion, seen_turns
from datagen.slam.odometry.scans import Progress
from lanenet.processes import in_threads

#: Steps that are tried where no speed was recorded, in camera heights per frame: from a crawl up to a fast
#: car at 10 Hz. The factor of 1.1 between them is less than the width of a peak of the fit.
STEPS_HEIGHTS = tuple(0.025 * 1.1**k for k in range(37))
#: Factors that are tried on a recorded speed, whose gain is not known exactly: 0.53 to 1.9.
_GAINS = tuple(1.06**k for k in range(-11, 12))
#: Share by which the grid's tightest curve exceeds that of the typical step: the step may be longer for a
#: while.
_GRID_MARGIN = 1.3
#: Step length, in camera heights, that bounds the turns that are tried: a speed in the wrong unit must not
#: ask for thousands of turns.
_LONGEST_STEP_HEIGHTS = _GRID_MARGIN * STEPS_HEIGHTS[-1]
#: Frames from which the typical step is found. Chosen: time grows in proportion,
#: the error of the mean falls with the root.
_SAMPLED_FRAMES = 60
#: Frames without a gap before them that are enough to find it. Chosen: a fifth of them.
_LEAST_SAMPLED = 12
#: The prominence of a step is measured against steps that are shorter and longer by this factor: what does
#: not move on the road, such as mirrored lamps, fits slow motion of any size.
_BESIDE = 1.5
#: A step far from the recorded speed is believed instead of it where its prominence is this many times as
#: large. Chosen: a wrong unit shows by more.
_CLEARLY = 2.0
#: Over a gap the step is looked for again by up to this share to either side, in so many steps, with this
#: sigma, all as logarithms; and the gain on its likelihood, which no neighbour adds to. Chosen: a few cells
#: of the grid, and as strong as the pairs of a frame without gaps.
_REFINED, _REFINED_STEPS, _REFINED_SIGMA, _REFINED_GAIN = 0.17, 13, 0.1, 4.0
#: Turns of the grid to either side of the one between neighbours, at which images further apart are compared.
#: Measured on ``usi_mat``: all others move the turns by 1e-4 rad in 99 % of its frames, by 0.003 at most.
_WINDOW = 10
#: Least commanded step relative to the typical one: a car that is commanded to stand may still roll.
LEAST_STEP = 0.1


@dataclass(frozen=True)
class Odometry:
    """Motion from frame to frame; the first frame has none.

    Attributes:
        steps_cm: Step length of the rear axle from the frame before.
        turns_rad: Turn, positive left.
    """

    steps_cm: Float[np.ndarray, "n"]
    turns_rad: Float[np.ndarray, "n"]

    @property
    def poses(self) -> Float[np.ndarray, "n 3"]:
        """Rear-axle poses from adding up the steps, heading +x at the start, frame map."""
        heading = np.cumsum(self.turns_rad)
        middle = heading - 0.5 * self.turns_rad
        xy = np.cumsum(self.steps_cm[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1), axis=0)
        return np.column_stack([xy, heading])


@dataclass(frozen=True)
class TypicalStep:
    """What a drive's commands mean in centimetres.

    Attributes:
        relative: Commanded step length of each frame, 1 where it is typical.
        step_heights: The typical step length, camera heights.
        factor: Distance per unit of the commands: gain of a recorded speed, else the typical step, [cm].
        speed_known: Whether a speed was recorded.
    """

    relative: Float[np.ndarray, "n"]
    step_heights: float
    factor: float
    speed_known: bool


def typical_step(images: ImagePairs, distance_cm: Float[np.ndarray, "n"], speed_known: bool) -> TypicalStep:
    """Find how far the car really drives per commanded distance.

    A recorded speed may be far off: another unit, or a camera much higher than the nominal height. Then its
    best gain lies at the limit of those that are tried, or has little prominence, and the best of all steps
    is taken. If that one lies at the limit too, the images say nothing and the recorded speed stands.

    Args:
        images: The drive.
        distance_cm: Commanded distance per frame, or the frame's duration.
        speed_known: Whether that is in centimetres.
    """
    moving = distance_cm[distance_cm > 0.0]
    typical = float(np.median(moving)) if moving.size else 1.0
    relative = np.maximum(distance_cm / typical, LEAST_STEP)
    any_step = np.array(STEPS_HEIGHTS)
    step, fit = best_step(images, relative, any_step)
    if speed_known:
        recorded = typical / images.height_cm
        steps = recorded * np.array(_GAINS)
        near, near_fit = best_step(images, relative, steps)
        clearer = prominence(fit, any_step).max() > _CLEARLY * prominence(near_fit, steps).max()
        if not (at_limit(near, steps) or clearer):
            step = near
        elif at_limit(step, any_step):
            step = recorded
    return TypicalStep(relative, step, step * images.height_cm / typical, speed_known)


def best_step(
    images: ImagePairs,
    relative: Float[np.ndarray, "n"],
    steps: Float[np.ndarray, "w"],
    most_frames: int = _SAMPLED_FRAMES,
) -> tuple[float, Float[np.ndarray, "w"]]:
    """Find the typical step length that fits pairs of images from all over the drive.

    Args:
        images: The drive.
        relative: Step length of each frame relative to the typical one.
        steps: Steps to try, each longer than the one before by the same factor, camera heights.
        most_frames: Frames that are compared with those before them, at most.

    Returns:
        The step, interpolated between those that were tried by a parabola, and the mean fit of each of them.
    """
    frames = sampled_frames(images.periods, images.settings.lags, most_frames)

    def fits_of(k: int) -> Float[np.ndarray, "w"]:
        turns = [_turns_of(images, step * relative[k]) for step in steps]
        tried = np.full((len(steps), max(map(len, turns))), np.nan)
        for row, own in zip(tried, turns, strict=True):
            row[: len(own)] = own
        return images.fit(k, steps, tried, relative).max(axis=1)

    fit = sum(in_threads(fits_of, frames.tolist()), np.zeros(len(steps))) / len(frames)
    above = prominence(fit, steps)
    log_ratio = float(np.log(steps[1] / steps[0]))
    best = int(np.argmax(above))
    shift = 0.0
    if 0 < best < len(steps) - 1:
        left, middle, right = above[best - 1 : best + 2]
        bend = left - 2.0 * middle + right
        shift = float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if bend < 0.0 else 0.0
    return float(steps[best] * np.exp(shift * log_ratio)), fit


def sampled_frames(
    periods: Float[np.ndarray, "n"], lags: Sequence[int], most_frames: int
) -> Int[np.ndarray, "m"]:
    """Choose frames from all over a drive that are compared with those before them.

    Args:
        periods: Time from the frame before to each frame, in typical time steps.
        lags: Frames between the images of a pair.
        most_frames: How many frames to choose, at most.
    """
    n = len(periods)
    first = min(max(lags), n - 1)
    # Steps over a gap say little of the typical one; a drive of gaps alone has no others.
    gaps = np.convolve(periods > 1.0, np.ones(first + 1))[:n]
    frames = np.flatnonzero(gaps[first:] == 0) + first
    if len(frames) < min(_LEAST_SAMPLED, n - first):
        frames = np.arange(first, n)
    spread = np.linspace(0, len(frames) - 1, min(most_frames, len(frames)))
    return frames[np.unique(spread.astype(np.int64))]


def prominence(fit: Float[np.ndarray, "w"], steps: Float[np.ndarray, "w"]) -> Float[np.ndarray, "w"]:
    """Return by how much each step fits better than clearly shorter and longer ones."""
    beside = round(float(np.log(_BESIDE) / np.log(steps[1] / steps[0])))
    padded = np.pad(fit, beside, mode="edge")
    return fit - 0.5 * (padded[: -2 * beside] + padded[2 * beside :])


def at_limit(step: float, steps: Float[np.ndarray, "w"]) -> bool:
    """Whether a step lies within about one of either end of those that were tried."""
    half = np.sqrt(steps[1] / steps[0])
    return not steps[1] * half < step < steps[-2] / half


def _turns_of(images: ImagePairs, step: float) -> Float[np.ndarray, "t"]:
    """Turns that a car may make with a step, in camera heights."""
    most = images.settings.max_curvature_heights * min(step, _LONGEST_STEP_HEIGHTS)
    return turns_up_to(most, images.turn_step_rad)


def _likelihood(fits: Float32[np.ndarray, "n w t"], temper: float) -> Float16[np.ndarray, "n w t"]:
    """Tempered log likelihood of each frame's states, at most 0.

    Half precision saves memory; it is finest near zero, where the differences matter.
    """
    best, least = fits.max(axis=(1, 2)), np.finfo(np.float16).min
    result = np.empty(fits.shape, np.float16)
    for k in range(len(fits)):
        result[k] = np.maximum(np.float32(temper) * (fits[k] - best[k]), least)
    return result


def _turns_per_cell(periods: float) -> int:
    """Into how many turns each cell of the grid is divided over a gap; an odd number, so that it is one."""
    return 2 * int(np.ceil(0.5 * (min(periods, MOST_BRIDGED) - 1.0))) + 1


class Evidence:
    """How likely each motion of each frame is, given the images.

    Attributes:
        seen: Turns as seen in the distance; None where they tell nothing.
    """

    def __init__(
        self,
        images: ImagePairs,
        typical: TypicalStep,
        progress: Progress | None = None,
        far_rad: Float[np.ndarray, "n"] | None = None,
    ) -> None:
        """Compare all images.

        Args:
            images: The drive.
            typical: What its commands mean in centimetres.
            progress: Called with (done, total).
            far_rad: Turn of each frame as the distance shows it (:mod:`datagen.slam.odometry.motion_grid`).
        """
        s, n = images.settings, len(images)
        self.settings, self.images, self.relative = s, images, typical.relative
        self.time = np.minimum(images.periods, LONGEST_STEP)
        self.seen: SeenTurns | None = None
        spread, keep = s.unknown_spread, s.unknown_keep
        if typical.speed_known:
            spread, keep = s.known_spread, s.known_keep
        step = typical.step_heights
        turns_rad = _turns_of(images, _GRID_MARGIN * step)
        self.grid = MotionGrid(step, spread, keep, s.jump, turns_rad, s.turn_walk_rad)
        fits: Float32[np.ndarray, "n w t"] = np.zeros((n, *self.grid.shape), np.float32)
        # Neighbours first: where a car slides, or is caught, the turn changes from frame to frame, and images
        # that are further apart fit no constant turn.
        rates: Float[np.ndarray, "n"] | None = None
        rounds = [lags for lags in (s.lags[:1], s.lags[1:]) if lags]
        for number, lags in enumerate(rounds):
            fit_of = partial(self._fit, lags=lags, rates=rates)
            for k, found in enumerate(in_threads(fit_of, range(1, n)), start=1):
                fits[k] += found
                done, rest = divmod(number * n + k + 1, len(rounds))
                if progress is not None and not rest:
                    progress(done, n)
            if number + 1 < len(rounds):
                # As strong as all pairs together.
                self.log_likelihood = _likelihood(fits, s.temper * len(s.lags))
                turns = self.motion().turns_rad
                if far_rad is not None:
                    self.seen = seen_turns(far_rad, turns)
                if self.seen is not None:
                    turns = self.motion().turns_rad
                rates = turns / self.time
        self.log_likelihood = _likelihood(fits, s.temper)

    def _fit(
        self, k: int, lags: tuple[int, ...], rates: Float[np.ndarray, "n"] | None
    ) -> Float[np.ndarray, "w t"]:
        """Compare a frame with those before it; over a gap, several turns in a cell of the grid are tried."""
        turns, count = self.grid.turns_rad, _turns_per_cell(self.time[k])
        near = slice(0, len(turns))
        if rates is not None:
            middle = int(np.argmin(np.abs(turns - rates[k])))
            near = slice(max(middle - _WINDOW, 0), middle + _WINDOW + 1)
        within = (turns[1] - turns[0]) / count * (np.arange(count) - count // 2)
        tried = (turns[near, None] + within).ravel()
        found = self.images.fit(k, self.grid.steps, tried, self.relative, lags, rates)
        found = found.reshape(len(found), -1, count).max(axis=2)
        # Elsewhere the images are taken to fit as badly as they do anywhere near.
        whole = np.repeat(found.min(axis=1, keepdims=True), len(turns), axis=1)
        whole[:, near] = found
        return whole

    def motion(self, curvature_per_cm: Float[np.ndarray, "n"] | None = None) -> Odometry:
        """Find the likeliest motion.

        Args:
            curvature_per_cm: What the steering predicts, positive left; None where it predicts nothing.
        """
        s, height_cm = self.settings, self.images.height_cm
        if curvature_per_cm is None:
            # Where nothing is seen the car goes straight on.
            curvature, sigma = np.zeros(len(self.relative)), s.max_curvature_heights
        else:
            curvature, sigma = curvature_per_cm * height_cm, s.steering_heights
        steps, rates = follow_motion(
            self.grid, self.log_likelihood, self.relative, curvature, sigma, self.seen, self.time
        )
        for k in np.flatnonzero((self.time > 1.0) & (self.time <= MOST_BRIDGED)).tolist():
            steps[k], rates[k] = self._refined(k, steps[k], rates[k])
        turns = rates * self.time
        steps_cm = steps * self.relative * height_cm
        steps_cm[0] = turns[0] = 0.0
        return Odometry(steps_cm, turns)

    def _refined(self, k: int, step: float, rate: float) -> tuple[float, float]:
        """Find step and turn over a gap more finely than on the grid, whose cells suit a single frame."""
        turns, count = self.grid.turns_rad, _turns_per_cell(self.time[k])
        rates = rate + (turns[1] - turns[0]) / count * np.arange(-2 * count, 2 * count + 1)
        by = np.linspace(-_REFINED, _REFINED, _REFINED_STEPS)
        fit = self.settings.temper * self.images.fit(k, step * np.exp(by), rates, self.relative)
        fit -= 0.5 * ((by / _REFINED_SIGMA) ** 2)[:, None]
        likely = np.exp(_REFINED_GAIN * (fit - fit.max()))
        likely /= likely.sum()
        return step * float(np.exp(likely.sum(axis=1) @ by)), float(likely.sum(axis=0) @ rates)
