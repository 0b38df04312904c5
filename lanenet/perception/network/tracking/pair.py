"""Which two of the lines found in a frame are the lane's, and whether that is clear.

Of all pairs that one is taken which shows most of its markings and has the lane's width. What a marking
counts is a length, [cm], in which its borders are seen; whatever else speaks for or against a pair is counted
as if it were such a length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.perception.estimate import SEEN, LaneMemory
from lanenet.perception.network import compiled
from lanenet.perception.network.refinement import BASIS, line_at

#: What the width of a pair costs at most, [cm], and sigma of the width's logarithm. Tried: a lane may widen
#: in plain sight, but the line of another lane is none of its own.
_BY_WIDTH_CM, _WIDTH_SIGMA = 45.0, 0.2
#: What speaks for the network's own pair, if it has the lane's width, while the front axle's middle is within
#: this share of that width of a line: it has learned from the labels in which lane a car on a line is. Tried:
#: 18 and 36 cm; and for each of its lines apart, which took dashes inside a lane for its border.
_BY_BOTH_CM, _ON_LINE = 18.0, 0.12
#: What it costs at most that the front axle's middle is not between the two, and how far beside them that is.
#: Chosen: more than what a network's opinion brings, less than a line that is not to be seen.
_BY_OUTSIDE_CM, _OUTSIDE_CM = 20.0, 2.0
#: It is not clear which lane a car is in if less than so much more, [cm], speaks for its pair than for one
#: that lies this share of the lane's width beside it. On 144 simulated drives of five seeds 0.4 % fewer
#: points are answered for it, and their RMSE is 1.78 instead of 2.40 cm. With the other pair looked for again
#: in the next frame, 9, 13, 18, 22 and 26 cm gave 1.38, 1.33, 1.32, 1.31 and 1.31 cm on 264 drives of eleven
#: seeds.
_UNDECIDED_CM, _NEXT_LANE = 18.0, 0.5
#: Narrower than this share of the lane's width no pair is a lane.
_NARROWEST = 0.3
#: Length along the road in which both lines have to be seen to tell the lane's width, as lines that the
#: network sees, too: the rim of a reflection that is found again in each frame tells none. On 120 simulated
#: drives without a given width the RMSE is 2.54 instead of 3.60 cm for it. Tried: 9, 15 and 21 cm gave 2.58,
#: 2.55 and 2.28 cm, and 94.8, 94.1 and 92.9 % of the points are answered.
_TELLS_WIDTH_CM = 15.0
_MIDDLE = 1
_CERTAIN = np.ones(len(SIDES))


class Candidate(NamedTuple):
    """One line that may be the answer, in plain numbers: for so few, arrays cost more than their sums.

    Attributes:
        points_cm: x at the label rows, frame car.
        sigma_cm: Standard deviation of each.
        seen_cm: Length along the road in which its borders are seen.
        score_cm: What speaks for it.
        seen_at: Whether it is seen at each label row.
        look: What it looks like, see :class:`lanenet.perception.network.refinement.RefinedLines`; not a
            number where it is not seen.
        marking_cm: Width of its marking, negative for one that is darker than the floor.
        presence: The network's, if it sees the line itself.
        seen_to_cm: How far ahead it is seen.
    """

    points_cm: list[float]
    sigma_cm: list[float]
    seen_cm: float
    score_cm: float
    seen_at: list[bool]
    look: list[float]
    marking_cm: float
    presence: float = 0.0
    seen_to_cm: float = -math.inf


#: The left and the right line of a lane.
Pair = tuple[Candidate, Candidate]


class Choice(NamedTuple):
    """What was chosen.

    Attributes:
        lines: The lane's.
        width_cm: Their distance, across the lane; not a number if no pair can be a lane.
        rival: The best pair in the next lane, if nearly as much speaks for it: then it is not clear in which
            lane the car is.
    """

    lines: Pair
    width_cm: float = math.nan
    rival: Pair | None = None


def best_pair(
    lefts: Sequence[Candidate], rights: Sequence[Candidate], lane: LaneMemory, beside_cm: float
) -> Choice:
    """Choose the left and the right line of the lane.

    Args:
        lefts: What the left line may be.
        rights: What the right line may be.
        lane: The lane's width; learns it from the pair that would be chosen without knowing it.
        beside_cm: Distance of the front axle's middle from the nearest line of the last frame's lane.

    Returns:
        The choice; of pairs that are too narrow for a lane, the last of both sides.
    """
    across_cm = distances_cm(_points_of(lefts), _points_of(rights)).tolist()
    least_cm = _NARROWEST * lane.likely_cm
    pairs, scores, widths = [], [], []
    for left, row in zip(lefts, across_cm, strict=True):
        for right, width_cm in zip(rights, row, strict=True):
            if width_cm < least_cm:
                continue
            score_cm = left.score_cm + right.score_cm
            outside_cm = max(left.points_cm[0], -right.points_cm[0])
            if outside_cm > 0.0:
                score_cm -= _BY_OUTSIDE_CM * min(outside_cm / _OUTSIDE_CM, 1.0)
            pairs.append((left, right))
            scores.append(score_cm)
            widths.append(width_cm)
    if not pairs:
        return Choice((lefts[-1], rights[-1]))
    likely = lane.match(np.array(widths), _WIDTH_SIGMA).tolist()
    shown = pairs[scores.index(max(scores))]
    # A belief must not choose its own evidence: else a wrong one would never be unlearned.
    if tells_width(shown):
        lane.learn(np.array(shown[0].points_cm + shown[1].points_cm), _CERTAIN)
    scores = [score - _BY_WIDTH_CM * (1.0 - own) for score, own in zip(scores, likely, strict=True)]
    if beside_cm < _ON_LINE * lane.likely_cm:
        both = [min(left.presence, right.presence) for left, right in pairs]
        scores = [s + _BY_BOTH_CM * p * own for s, p, own in zip(scores, both, likely, strict=True)]
    chosen = scores.index(max(scores))
    middle_cm, next_cm = _middle_cm(pairs[chosen]), _NEXT_LANE * lane.likely_cm
    rivals = [
        i
        for i, score in enumerate(scores)
        if score >= scores[chosen] - _UNDECIDED_CM and abs(_middle_cm(pairs[i]) - middle_cm) > next_cm
    ]
    rival = pairs[max(rivals, key=scores.__getitem__)] if rivals else None
    return Choice(pairs[chosen], widths[chosen], rival)


def tells_width(lines: Pair) -> bool:
    """Return whether both lines tell the lane's width: they are seen, and the car is between them."""
    left, right = lines
    between = left.points_cm[0] <= 0.0 <= right.points_cm[0]
    return between and all(line.seen_cm >= _TELLS_WIDTH_CM and line.presence > SEEN for line in lines)


def _middle_cm(lines: Pair) -> float:
    """Return x of the middle between two lines, 15 cm ahead."""
    left, right = lines
    return 0.5 * (left.points_cm[_MIDDLE] + right.points_cm[_MIDDLE])


def _points_of(lines: Sequence[Candidate]) -> Float[np.ndarray, "l 3"]:
    return np.array([line.points_cm for line in lines])


#: y at which two lines are compared, beyond the label rows on both sides, and which lie between the rows.
_COMPARED_CM = np.arange(-12.0, 49.0, 4.0)
_BEGIN, _END = np.searchsorted(_COMPARED_CM, [ROWS_CM[0], ROWS_CM[-1] + 1e-9]).tolist()
_AHEAD_CM2 = np.subtract.outer(_COMPARED_CM, _COMPARED_CM) ** 2


def distances_cm(
    lefts_cm: Float[np.ndarray, "l 3"], rights_cm: Float[np.ndarray, "r 3"]
) -> Float[np.ndarray, "l r"]:
    """Return the distance of each left line to each right one, across the lane: at corners as well.

    The median distance of the points of one to the nearest of the other; negative where they are swapped.

    Args:
        lefts_cm: x at the label rows, frame car.
        rights_cm: Likewise.
    """
    if compiled.is_here():
        return compiled.distances(lefts_cm, rights_cm, BASIS, _COMPARED_CM, (_BEGIN, _END))
    left, right = line_at(lefts_cm, _COMPARED_CM)[0], line_at(rights_cm, _COMPARED_CM)[0]
    squares = (right[None, :, None, :] - left[:, None, :, None]) ** 2 + _AHEAD_CM2
    nearest = np.concatenate([squares.min(axis=axis)[..., _BEGIN:_END] for axis in (3, 2)], axis=2)
    return np.sqrt(np.median(nearest, axis=2)) * np.sign(rights_cm[None, :, 1] - lefts_cm[:, None, 1])
