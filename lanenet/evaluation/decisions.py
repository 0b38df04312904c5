"""Wrong decisions about the lane, counted apart from the error where the decision is right.

One frame in another lane weighs in an RMSE as much as two thousand good ones, and says as little of either.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.evaluation.errors import share_interval
from lanenet.geometry.lane import ROWS_CM, SIDES

#: An answered centre further off than this share of the lane's width is another lane's.
_ANOTHER = 0.5
#: A point is surely wrong if it is off by more than so many of its sigmas, and by more than this, [cm].
#: Chosen: beyond chance, and a tenth of a 40 cm lane.
_SIGMAS, SURELY_CM = 3.0, 4.0


@dataclass(frozen=True)
class Wrong:
    """Frames that are wrong in one way.

    Attributes:
        frames: Their number.
        events: Runs of such frames.
        interval: 95 % interval of their share over drives like these; None for too few.
    """

    frames: int
    events: int
    interval: tuple[float, float] | None


@dataclass(frozen=True)
class Decisions:
    """What a detector decides on frames with labels of both lines in a row.

    Attributes:
        frames: Frames with an answered and a labelled centre of the lane.
        wrong_lane: The answered centre is off by more than half of the lane's width.
        surely_wrong: A point is off by more than three of its sigmas and 4 cm; none without sigmas.
        rmse_cm: RMSE of the points of the frames that are not in a wrong lane; NaN, like the next two,
            without one.
        p95_cm: 95th percentile of their absolute errors.
        p99_cm: 99th percentile.
    """

    frames: int
    wrong_lane: Wrong
    surely_wrong: Wrong
    rmse_cm: float
    p95_cm: float
    p99_cm: float

    def as_dict(self) -> dict[str, object]:
        """Return plain values for JSON."""
        kinds = {"wrong_lane": vars(self.wrong_lane), "surely_wrong": vars(self.surely_wrong)}
        return vars(self) | kinds


def decide(
    answer_cm: Float[np.ndarray, "n 6"],
    known_cm: Float[np.ndarray, "n 6"],
    sigma_cm: Float[np.ndarray, "n 6"],
    sources: Int[np.ndarray, "_"],
    cuts: Int[np.ndarray, "_"],
) -> Decisions:
    """Tell a detector's wrong decisions from the errors of right ones.

    Args:
        answer_cm: Its points; NaN where it has no answer.
        known_cm: Their labels; NaN where there is none.
        sigma_cm: Sigmas of the answers; NaN where it predicts none.
        sources: Frames at which another source begins.
        cuts: Where to cut for the bootstrap, see :func:`lanenet.evaluation.errors.bootstrap_segments`.
    """
    miss_cm, shape = answer_cm - known_cm, (len(answer_cm), len(SIDES), len(ROWS_CM))
    left_cm, right_cm = known_cm.reshape(shape).transpose(1, 0, 2)
    # Without both lines of a row, its centre is unknown.
    off = np.abs(miss_cm.reshape(shape).mean(axis=1)) / np.maximum(right_cm - left_cm, 1e-6)
    judged = np.isfinite(off).any(axis=1)
    another = (np.nan_to_num(off, nan=0.0) > _ANOTHER).any(axis=1)
    with np.errstate(invalid="ignore"):
        surely = ((np.abs(miss_cm) > _SIGMAS * sigma_cm) & (np.abs(miss_cm) > SURELY_CM)).any(axis=1)
    errors_cm = np.abs(miss_cm[~another])
    errors_cm = errors_cm[np.isfinite(errors_cm)]
    rmse_cm = p95_cm = p99_cm = float("nan")
    if errors_cm.size:
        rmse_cm = float(np.sqrt(np.mean(errors_cm**2)))
        p95_cm, p99_cm = np.percentile(errors_cm, [95.0, 99.0]).tolist()
    wrong_lane, surely_wrong = (_count(wrong, judged, sources, cuts) for wrong in (another, surely))
    return Decisions(int(judged.sum()), wrong_lane, surely_wrong, rmse_cm, p95_cm, p99_cm)


def _count(
    wrong: Bool[np.ndarray, "n"], judged: Bool[np.ndarray, "n"], sources: np.ndarray, cuts: np.ndarray
) -> Wrong:
    events = sum(int((np.diff(run.astype(np.int8), prepend=0) > 0).sum()) for run in np.split(wrong, sources))
    some, all_of = ([float(part.sum()) for part in np.split(each, cuts)] for each in (wrong, judged))
    return Wrong(int(wrong.sum()), events, share_interval(some, all_of, np.random.default_rng(0)))
