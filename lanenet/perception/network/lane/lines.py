"""Both lines of each lane on the edge points of their markings, and what their borders say of the lane."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.perception.estimate import SEEN
from lanenet.perception.network.lane.marking_widths import MarkingWidths
from lanenet.perception.network.lane.settings import BorderWeight
from lanenet.perception.network.lane.view import LinesInView
from lanenet.perception.network.refinement import BIN_CM, RoadBorders, refined

_ROWS = len(ROWS_CM)
#: Sigma of a line that is not seen, [cm]: it measures nothing.
NOTHING_CM = 1e4
#: Length of borders of a line that tells the width of its marking, or of the lane, [cm]. Chosen: a third of
#: what is looked at.
MEASURED_CM = 15.0
#: Width of a marking before any was seen, and its sigma; its sigma once it is known, [cm]. Chosen.
_MARKING_CM, _MARKING_SIGMA_CM, _KNOWN_SIGMA_CM = 3.0, 2.0, 0.3
_ANY_MARKING = ((_MARKING_CM, _MARKING_SIGMA_CM), (-_MARKING_CM, _MARKING_SIGMA_CM))
#: Columns of what :func:`lanenet.perception.network.refinement.refined` returns.
_POINTS, _SIGMAS, _WIDTH, _SEEN_CM = slice(0, 3), slice(3, 6), 6, 7
_SEEN_AT, _LOOK, _END = slice(8, 11), slice(11, 14), 14


class LinesSeen(NamedTuple):
    """Both lines of lanes, as edges show them.

    Attributes:
        points_cm: On their markings; where a line is not seen, where the lane has it.
        sigma_cm: Of these; huge where a line is not seen.
        seen_cm: Length along the road in which borders are seen.
        in_view: Bins of 3 cm in which the camera would show them.
        unseen: Share of these without a border.
        looks: Colour and gaps, see :class:`lanenet.perception.network.refinement.RefinedLines`.
        end_cm: y of the last border; 0 where none is seen.
    """

    points_cm: Float[np.ndarray, "n 6"]
    sigma_cm: Float[np.ndarray, "n 6"]
    seen_cm: Float[np.ndarray, "n 2"]
    in_view: Float[np.ndarray, "n 2"]
    unseen: Float[np.ndarray, "n 2"]
    looks: Float[np.ndarray, "n 2 3"]
    end_cm: Float[np.ndarray, "n 2"]

    def some(self, index: Int[np.ndarray, "m"]) -> LinesSeen:
        """Return those of some lanes, in this order."""
        return LinesSeen(*(each[index] for each in self))


class LineFinder:
    """Finds lines on their markings, whose widths it learns.

    Attributes:
        markings: Widths of the markings of the car's lane.
    """

    def __init__(self, view: LinesInView, settings: BorderWeight) -> None:
        """Know no marking yet."""
        self._view, self._settings, self.markings = view, settings, MarkingWidths()

    def find(
        self, points_cm: Float[np.ndarray, "n 6"], sigma_cm: Float[np.ndarray, "n 6"], borders: RoadBorders
    ) -> LinesSeen:
        """Find the lines of lanes whose points and standard deviations are given.

        A line on few borders, or far from where the lane has it, is measured less surely: the tail of
        Student's t in place of a gate.
        """
        s, n = self._settings, len(points_cm)
        best = self._best_markings(points_cm, np.sqrt(sigma_cm**2 + s.prior_cm**2), borders)
        seen_cm = best[..., _SEEN_CM]
        expected, spread = (each.reshape(n, len(SIDES), _ROWS) for each in (points_cm, sigma_cm**2))
        lines = np.where(seen_cm[..., None] > 0.0, best[..., _POINTS], expected)
        sigma = np.where(best[..., _SEEN_AT] > 0.0, 1.0, s.unseen_row) * best[..., _SIGMAS]
        few = (s.few_cm / np.maximum(seen_cm, 1.0))[..., None]
        noise = (sigma**2 + s.least_cm**2) * (1.0 + few**2)
        surprise = ((lines - expected) ** 2 / (spread + noise)).mean(axis=2, keepdims=True)
        noise = noise * (1.0 + surprise / s.surprise)
        seen, bins = (seen_cm >= s.seen_cm)[..., None], seen_cm / BIN_CM
        in_view = np.maximum(self._view.bins(lines), bins)
        return LinesSeen(
            np.where(seen, lines, expected).reshape(n, -1),
            np.where(seen, np.sqrt(noise), NOTHING_CM).reshape(n, -1),
            seen_cm,
            in_view,
            1.0 - bins / np.maximum(in_view, 1.0),
            best[..., _LOOK],
            np.where(seen_cm > 0.0, best[..., _END], 0.0),
        )

    def log_likelihood(self, lines: LinesSeen) -> Float[np.ndarray, "n"]:
        """Log likelihood of the borders that are seen, and of those that are not, over those of clutter."""
        s, seen = self._settings, lines.seen_cm / BIN_CM
        met = math.log(s.seen_share / s.clutter_share)
        missed = math.log((1.0 - s.seen_share) / (1.0 - s.clutter_share))
        return s.weight * (seen * met + (lines.in_view - seen) * missed).sum(axis=1)

    def learn_markings(
        self,
        points_cm: Float[np.ndarray, "6"],
        sigma_cm: Float[np.ndarray, "6"],
        presence: Float[np.ndarray, "2"],
        lane_cm: Float[np.ndarray, "6"],
        most_cm: float,
        borders: RoadBorders,
    ) -> None:
        """Measure the markings of the network's own lines, without what was learned of them.

        Args:
            points_cm: The network's lines.
            sigma_cm: Their standard deviations.
            presence: Probability that each can be seen.
            lane_cm: The lane that was found.
            most_cm: How far its lines may be from where the network's are found.
            borders: The frame's edge points.
        """
        if not self.markings.next_frame():
            return
        lines, sigmas = points_cm.reshape(-1, _ROWS), sigma_cm.reshape(-1, _ROWS)
        asked = [
            [*lines[side], *sigmas[side], *marking, math.nan, math.nan]
            for side in range(len(SIDES))
            for marking in _ANY_MARKING
        ]
        found = refined(np.array(asked), borders).reshape(len(SIDES), len(_ANY_MARKING), -1)
        for side, tried in enumerate(found):
            line = tried[tried[:, _SEEN_CM].argmax()]
            off_cm = np.abs(line[_POINTS] - lane_cm[_ROWS * side : _ROWS * (side + 1)]).max()
            if presence[side] > SEEN and line[_SEEN_CM] >= MEASURED_CM and off_cm < most_cm:
                self.markings.learn(side, float(line[_WIDTH]))

    def _best_markings(
        self, points_cm: Float[np.ndarray, "n 6"], sigma_cm: Float[np.ndarray, "n 6"], borders: RoadBorders
    ) -> Float[np.ndarray, "n 2 k"]:
        """Return the rows of ``refined`` of the markings of which most is seen, of each line."""
        n, asked, sides = len(points_cm), [], []
        for side in range(len(SIDES)):
            rows, usual_cm = slice(_ROWS * side, _ROWS * (side + 1)), self.markings.usual_cm(side)
            for marking in _ANY_MARKING if usual_cm is None else [(usual_cm, _KNOWN_SIGMA_CM)]:
                line = np.full((n, 10), np.nan)
                line[:, _POINTS], line[:, _SIGMAS] = points_cm[:, rows], sigma_cm[:, rows]
                line[:, 6:8] = marking
                asked.append(line)
                sides.append(side)
        # In one go, since each look at the edge points has a price.
        found = refined(np.concatenate(asked), borders).reshape(len(asked), n, -1)
        best = np.empty((n, len(SIDES), found.shape[2]))
        for side in range(len(SIDES)):
            tried = found[[k for k, of in enumerate(sides) if of == side]]
            best[:, side] = tried[tried[:, :, _SEEN_CM].argmax(axis=0), np.arange(n)]
        return best
