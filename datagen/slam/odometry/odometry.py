"""How far the car drove, and turned, from picture to picture, by edges alone.

The filter's map is blurred by about as much as the car moves per frame, and a blurred map likes slow motion:
the less the car moves, the more edges lie on those before. Neighbouring pictures compared to half a pixel do
not mind: their edges meet at the true motion, and nowhere else along a line of dashes, corners or stains.
What one pair of pictures leaves open its neighbours settle (see :mod:`datagen.slam.odometry.motion_grid`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float16, Float32

from datagen.slam.odometry.far_view import SeenTurns, seen_turns
from datagen.slam.odometry.image_pairs import Pictures, turns_up_to
from datagen.slam.odometry.motion_grid import MotionGrid, follow_motion
from datagen.slam.odometry.scans import Progress

#: Steps to try where no speed was recorded, in camera heights per frame: a crawl up to a fast car at 10 Hz.
STEPS_HEIGHTS = tuple(0.025 * 1.1**k for k in range(37))
#: Factors to try on a recorded speed, whose gain is not known exactly.
_GAINS = tuple(1.06**k for k in range(-11, 12))
#: No car turns further per frame than on its tightest curve with this step, in camera heights: a speed in the
#: wrong unit must not ask for thousands of turns.
_MOST_STEP_HEIGHTS = 1.3 * STEPS_HEIGHTS[-1]
#: Pairs of pictures that the usual step is found from.
_PAIRS = 60
#: A step must fit better than those that are shorter and longer by this factor: what does not move on the
#: road, such as mirrored lamps, fits slow motion of any size.
_BESIDE = 1.5
#: How much more than the best step near the recorded one a step must stand out to be believed instead.
_CLEARLY = 2.0
#: A car that is told to stand may roll on: least commanded way, relative to the usual one.
LEAST_WAY = 0.1


@dataclass(frozen=True)
class Odometry:
    """Motion from frame to frame; the first frame has none.

    Attributes:
        ways_cm: Way of the rear axle from the frame before.
        turns_rad: Turn, positive left.
    """

    ways_cm: Float[np.ndarray, "n"]
    turns_rad: Float[np.ndarray, "n"]

    @property
    def poses(self) -> Float[np.ndarray, "n 3"]:
        """Rear-axle poses when the steps are put together, heading +x at the start, frame map."""
        heading = np.cumsum(self.turns_rad)
        middle = heading - 0.5 * self.turns_rad
        xy = np.cumsum(self.ways_cm[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1), axis=0)
        return np.column_stack([xy, heading])


def usual_step(
    pictures: Pictures, relative: Float[np.ndarray, "n"], steps: Float[np.ndarray, "w"], pairs: int = _PAIRS
) -> tuple[float, Float[np.ndarray, "w"]]:
    """Find the way per frame of usual length that suits pairs from all over the drive.

    Args:
        pictures: The drive.
        relative: Way of each frame relative to the usual one.
        steps: Steps to try, each longer than the one before by the same factor, camera heights.
        pairs: Frames that are compared with those before them, at most.

    Returns:
        The step, between the tried ones by a parabola, and the mean fit of each tried one.
    """
    s, n = pictures.settings, len(pictures)
    first = min(max(s.lags), n - 1)
    frames = np.unique(np.linspace(first, n - 1, min(pairs, n - first)).astype(np.int64))
    fit = np.zeros(len(steps))
    for k in frames:
        for i, step in enumerate(steps):
            turns = _turns_of(pictures, step * relative[k])
            fit[i] += pictures.fit(int(k), steps[i : i + 1], turns, relative).max() / len(frames)
    above = standing_out(fit, steps)
    log_ratio = float(np.log(steps[1] / steps[0]))
    best = int(np.argmax(above))
    shift = 0.0
    if 0 < best < len(steps) - 1:
        left, middle, right = above[best - 1 : best + 2]
        bend = left - 2.0 * middle + right
        shift = float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if bend < 0.0 else 0.0
    return float(steps[best] * np.exp(shift * log_ratio)), fit


def standing_out(fit: Float[np.ndarray, "w"], steps: Float[np.ndarray, "w"]) -> Float[np.ndarray, "w"]:
    """By how much each step fits better than clearly shorter and longer ones."""
    beside = round(float(np.log(_BESIDE) / np.log(steps[1] / steps[0])))
    padded = np.pad(fit, beside, mode="edge")
    return fit - 0.5 * (padded[: -2 * beside] + padded[2 * beside :])


def _turns_of(pictures: Pictures, step: float) -> Float[np.ndarray, "t"]:
    """Turns that a car may make with a step, in camera heights."""
    most = pictures.settings.max_curvature_heights * min(step, _MOST_STEP_HEIGHTS)
    return turns_up_to(most, pictures.turn_step_rad)


@dataclass(frozen=True)
class UsualWay:
    """What a drive's commands mean in centimetres.

    Attributes:
        relative: Way of each frame relative to the usual one.
        step_heights: Way per frame of usual length, camera heights.
        factor: Way per unit of the commands: gain of a recorded speed, else the usual way, [cm].
    """

    relative: Float[np.ndarray, "n"]
    step_heights: float
    factor: float


def usual_way(
    pictures: Pictures, distance_cm: Float[np.ndarray, "n"], speed_known: bool, height_cm: float
) -> UsualWay:
    """Find how far the car really drives when it is told to.

    A recorded speed may be far off: another unit, or a camera much higher than the nominal height. Then it
    fits best at the rim of the gains to try, or nowhere in particular, and the step that fits best of all is
    taken. Where that one lies at the rim, too, the pictures say nothing and the recorded speed stands.

    Args:
        pictures: The drive.
        distance_cm: Commanded way per frame, or the frame's duration.
        speed_known: Whether that is in centimetres.
        height_cm: Of the camera.
    """
    moving = distance_cm[distance_cm > 0.0]
    usual = float(np.median(moving)) if moving.size else 1.0
    relative = np.maximum(distance_cm / usual, LEAST_WAY)
    any_step = np.array(STEPS_HEIGHTS)
    step, fit = usual_step(pictures, relative, any_step)
    if speed_known:
        recorded = usual / height_cm
        steps = recorded * np.array(_GAINS)
        near, near_fit = usual_step(pictures, relative, steps)
        clearer = standing_out(fit, any_step).max() > _CLEARLY * standing_out(near_fit, steps).max()
        if not (at_rim(near, steps) or clearer):
            step = near
        elif at_rim(step, any_step):
            step = recorded
    return UsualWay(relative, step, step * height_cm / usual)


def _likelihood(fits: Float32[np.ndarray, "n w t"], temper: float) -> Float16[np.ndarray, "n w t"]:
    """Tempered log likelihood of each frame's states, at most 0.

    In half precision: differences that matter are near zero, where it is finest.
    """
    best, least = fits.max(axis=(1, 2)), np.finfo(np.float16).min
    result = np.empty(fits.shape, np.float16)
    for k in range(len(fits)):
        result[k] = np.maximum(np.float32(temper) * (fits[k] - best[k]), least)
    return result


def at_rim(step: float, steps: Float[np.ndarray, "w"]) -> bool:
    """Whether a step lies within about one of either end of those that were tried."""
    half = np.sqrt(steps[1] / steps[0])
    return not steps[1] * half < step < steps[-2] / half


class Evidence:
    """What the pictures say of each frame's motion, and the grid that it is said on.

    Attributes:
        usual: What the commands mean in centimetres.
        seen: Turns as seen in the distance; None where they tell nothing.
    """

    def __init__(
        self,
        pictures: Pictures,
        distance_cm: Float[np.ndarray, "n"],
        speed_known: bool,
        height_cm: float,
        progress: Progress | None = None,
        far_rad: Float[np.ndarray, "n"] | None = None,
        usual: UsualWay | None = None,
    ) -> None:
        """Compare all pictures.

        Args:
            pictures: The drive.
            distance_cm: Commanded way per frame, or the frame's duration.
            speed_known: Whether that is in centimetres.
            height_cm: Of the camera.
            progress: Called with (done, total).
            far_rad: Turn of each frame as the distance shows it (:mod:`datagen.slam.odometry.far_view`).
            usual: What the commands mean in centimetres; None if that is still to be found.
        """
        s, n = pictures.settings, len(pictures)
        self.settings, self.height_cm = s, height_cm
        self.seen: SeenTurns | None = None
        self.usual = usual_way(pictures, distance_cm, speed_known, height_cm) if usual is None else usual
        self.relative, step = self.usual.relative, self.usual.step_heights
        spread, keep = s.unknown_spread, s.unknown_keep
        if speed_known:
            spread, keep = s.known_spread, s.known_keep
        self.grid = MotionGrid(step, spread, keep, s.jump, _turns_of(pictures, 1.3 * step))
        fits: Float32[np.ndarray, "n w t"] = np.zeros((n, *self.grid.shape), np.float32)
        # Neighbours first: a car that slides, or is caught, turns otherwise from frame to frame, and pictures
        # that are further apart meet at no one turn then.
        nearest, further = s.lags[:1], s.lags[1:]
        turns: Float[np.ndarray, "n"] | None = None
        rounds = [nearest, further] if further else [nearest]
        for number, lags in enumerate(rounds):
            for k in range(1, n):
                steps, grid_turns = self.grid.steps, self.grid.turns_rad
                fits[k] += pictures.fit(k, steps, grid_turns, self.relative, lags, turns)
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
        self.log_likelihood = _likelihood(fits, s.temper)

    def motion(self, curvature_per_cm: Float[np.ndarray, "n"] | None = None) -> Odometry:
        """Find the likeliest motion.

        Args:
            curvature_per_cm: What the steering predicts, positive left; None where it predicts nothing.
        """
        s = self.settings
        if curvature_per_cm is None:
            # Where nothing is seen the car goes straight on.
            curvature, sigma = np.zeros(len(self.relative)), s.max_curvature_heights
        else:
            curvature, sigma = curvature_per_cm * self.height_cm, s.steering_heights
        steps, turns = follow_motion(
            self.grid, self.log_likelihood, self.relative, s.turn_walk_rad, curvature, sigma, self.seen
        )
        ways = steps * self.relative * self.height_cm
        ways[0] = turns[0] = 0.0
        return Odometry(ways, turns)
