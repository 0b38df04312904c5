"""The lane from frame to frame: a few hypotheses of where it is, weighed against each other.

Each is a lane of :mod:`lanenet.perception.network.lane.shape` with a covariance and a log weight. Between
frames they move with the car. In a frame the network's probabilities of places and the borders of markings
draw them to where the lines are, and weigh them: a border that ought to be seen and is not speaks against a
lane. New ones begin where the network sees the lane, and beside the car's lane where it comes near a line.
The answer is the likeliest one; the others count in its standard deviation, so that where two lanes compete
nothing is answered.

Source:
    A sum of Gaussians, each followed by an extended Kalman filter (Alspach and Sorenson 1972), with births,
    merging and pruning as in multiple hypothesis tracking (Reid 1979). Own: the likelihoods.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.estimate import SEEN, LaneMemory
from lanenet.perception.network.lane.hypotheses import Hypotheses, fitted, variances
from lanenet.perception.network.lane.lines import MEASURED_CM, NOTHING_CM, LineFinder, LinesSeen
from lanenet.perception.network.lane.looks import Keep, LineLooks
from lanenet.perception.network.lane.network_answer import NetworkAnswer
from lanenet.perception.network.lane.settings import LaneFilterSettings
from lanenet.perception.network.lane.shape import (
    LOG_WIDTH,
    OFFSET,
    ROW_CM,
    SLOPE,
    STEEPEST_RAD,
    linearised,
    moved,
)
from lanenet.perception.network.lane.view import LinesInView
from lanenet.perception.network.refinement import RoadBorders

_ROWS = len(ROWS_CM)
#: Sigmas from which a distance counts as it is, not squared. Chosen.
_HUBER = 4.0
#: A measurement narrows its window by at least so much, or says nothing. Chosen, for the division.
_MOST_OF_WINDOW = 0.97
_TINY = 1e-9
_CERTAIN = np.ones(len(SIDES))
#: So far beside the car, in lane widths, no lane is followed. Chosen: no edge is looked for there.
_FURTHEST_LANES = 3.0
#: Why a frame is not answered that shows nothing.
NOTHING_SEEN = "no edge in view"
#: Parts of the doubt, as :class:`lanenet.perception.network.lane.settings.DoubtWeights` names them, and what
#: is said where one of them leaves a point unknown.
PARTS = {
    "rivals": "two lanes compete",
    "own": "the lane is little known",
    "unseen_cm": "few borders are seen",
    "neither_cm": "no line is seen",
    "beyond": "no border is seen that far",
    "apart": "the network sees the line elsewhere",
    "apart_ahead": "the network sees the line elsewhere",
    "network": "the network is unsure",
}


class LaneAnswer(NamedTuple):
    """The lane of a frame.

    Attributes:
        points_cm: The six points, frame car; NaN where unknown.
        sigma_cm: Their standard deviations.
        seen_cm: Length along the road in which each line's borders are seen.
        reason: What most of the doubt comes from where a point is unknown; else empty.
        doubts: Squares of the parts of the standard deviations, in the order of :data:`PARTS`, unweighted.
    """

    points_cm: Float[np.ndarray, "6"]
    sigma_cm: Float[np.ndarray, "6"]
    seen_cm: Float[np.ndarray, "2"]
    reason: str
    doubts: Float[np.ndarray, "6 d"]

    @classmethod
    def none(cls, reason: str) -> LaneAnswer:
        """Return that nothing is known."""
        unknown = np.full(len(ROW_CM), np.nan)
        return cls(unknown, unknown, np.zeros(len(SIDES)), reason, np.full((len(ROW_CM), len(PARTS)), np.nan))


class LaneFilter:
    """Follows the lane over a few hypotheses.

    Attributes:
        lane: The lane's width, given or remembered.
        looks: What its lines look like, and whether it is the lane to drive in.
    """

    def __init__(
        self,
        lane: LaneMemory,
        view: LinesInView,
        keep: Keep | None = None,
        settings: LaneFilterSettings | None = None,
    ) -> None:
        """Know no lane yet."""
        self.lane, self._settings = lane, settings or LaneFilterSettings()
        self._doubt_squares = np.square(self._settings.doubt.weights)
        #: Variance of a line about the curve of its state, at each row.
        self._shape = (self._settings.shape_cm + self._settings.shape_per_cm * ROW_CM) ** 2
        self.looks, self._lines = LineLooks(keep), LineFinder(view, self._settings.borders)
        self.reset()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self._found, self._is_moved = Hypotheses.none(), False
        self.looks.reset()
        self._lines.markings.reset()

    def moved(self, travel_cm: float, turn_rad: float, wheelbase_cm: float) -> None:
        """Take the car's motion since the last frame, as :class:`lanenet.perception.estimate.TakesMotion`."""
        if not math.isfinite(travel_cm + turn_rad):
            self._spread_unknown()
            return
        states, change = moved(self._found.states, travel_cm, turn_rad, wheelbase_cm)
        covariances = change @ self._found.covariances @ np.swapaxes(change, 1, 2)
        self._found = self._found._replace(states=states, covariances=covariances)
        self._spread(abs(travel_cm), abs(turn_rad), 1.0)
        self._is_moved = True

    def lose(self) -> None:
        """Take a frame that shows nothing of the lane."""
        self._end_motion()

    def follow(self, answer: NetworkAnswer, edges: RoadEdges) -> LaneAnswer:
        """Return the lane of a frame.

        Args:
            answer: The network's.
            edges: The frame's edge points.
        """
        if not answer.is_finite:
            self.lose()
            return LaneAnswer.none("the network's answer is no number")
        borders, s = RoadBorders(edges), self._settings
        self._end_motion()
        # The lane's usual width is known in each frame, as far as it stays the same along a road.
        known = self._found.with_width(math.log(self.lane.likely_cm), self._width_sigma)
        self._found = known._replace(log_weights=s.hypotheses.kept * known.log_weights)
        found, expected, is_new = self._with_births(answer)
        before_cm = expected[0][0]
        found, by_network = self._drawn_to_network(found, expected, is_new, answer)
        points, change = expected = linearised(found.states)
        variance = variances(change, found.covariances) + self._shape
        lines = self._lines.find(points, np.sqrt(variance), borders)
        before, found = (
            found,
            found.updated(
                expected, lines.points_cm, np.sqrt(lines.sigma_cm**2 + self._shape), s.network.correlation
            ),
        )
        # Where a line shows no border it may turn away.
        shape = self._shape + (s.bend_per_cm * ROW_CM * np.repeat(lines.unseen, _ROWS, axis=1)) ** 2
        # To first order: edges move a lane that the network has placed by little.
        points = points + (change @ (found.states - before.states)[..., None])[..., 0]
        variance = variances(change, found.covariances) + shape
        gain = variance / (variance + lines.sigma_cm**2)
        points = points + gain * (lines.points_cm - points)
        variance = (1.0 - gain) * variance
        log_weights = self._weighed(found, by_network + self._lines.log_likelihood(lines))
        inside = log_weights + self._log_inside(points)
        order = self._distinct(points, log_weights, inside)
        self._found = found._replace(log_weights=log_weights).some(order)
        lines = lines.some(order)
        points, variance, inside = points[order], variance[order], inside[order]
        self._notice_crossing(before_cm, points[0])
        found_lane = self._answer(answer, points, variance, inside, lines)
        if np.isfinite(found_lane.points_cm[1::_ROWS]).all():
            self._learn(answer, points[0], lines, borders)
        return found_lane

    def _end_motion(self) -> None:
        """Spread the hypotheses where nobody told how the car has moved, and drop those that are lost."""
        if not self._is_moved:
            self._spread_unknown()
        self._is_moved, (states, covariances, _) = False, self._found
        width_cm = self.lane.likely_cm
        is_known = (
            (np.abs(states[:, OFFSET]) < _FURTHEST_LANES * width_cm)
            & (np.abs(states[:, SLOPE]) < math.tan(STEEPEST_RAD))
            & (covariances[:, OFFSET, OFFSET] < width_cm**2)
        )
        if not is_known.all():
            self._found = self._found.some(np.flatnonzero(is_known))

    def _spread_unknown(self) -> None:
        """Add the process noise of a step of which nothing is known."""
        motion = self._settings.motion
        self._spread(motion.usual_step_cm, motion.usual_turn_rad, motion.unknown)
        self._is_moved = True

    def _spread(self, travel_cm: float, turn_rad: float, factor: float) -> None:
        """Add the process noise of a step."""
        noise = self._settings.motion
        sigma = (
            math.hypot(factor * noise.offset_cm, noise.offset_share * travel_cm),
            math.hypot(factor * noise.slope, noise.slope_per_rad * turn_rad),
            factor * noise.curvature_per_cm,
            noise.log_width,
        )
        covariances = self._found.covariances.copy()
        covariances[:, range(len(sigma)), range(len(sigma))] += np.square(sigma)
        self._found = self._found._replace(covariances=covariances)

    def _with_births(
        self, answer: NetworkAnswer
    ) -> tuple[Hypotheses, tuple[np.ndarray, np.ndarray], Bool[np.ndarray, "n"]]:
        """Add lanes that none of the hypotheses is: where the network sees one, and beside the car's lane.

        Returns:
            The hypotheses, their points and derivatives, and which of them begin with the network's answer.
        """
        s, found, width_cm = self._settings.hypotheses, self._found, self.lane.likely_cm
        known = linearised(found.states)
        likeliest_cm = answer.places_cm[answer.log_share.argmax(axis=1)]
        starts = [
            start_cm
            for start_cm in (answer.points_cm, likeliest_cm)
            if not self._is_one_of(start_cm, known[0])
        ]
        if len(starts) > 1 and self._is_one_of(starts[1], starts[0][None]):
            starts.pop()
        born = []
        if starts:
            points_cm = np.array(starts)
            states = np.zeros((len(starts), 4))
            states[:, LOG_WIDTH], states[:, OFFSET] = math.log(width_cm), points_cm[:, ::_ROWS].mean(axis=1)
            sigma = np.array([s.any_offset_lanes * width_cm, s.any_slope, s.any_curvature, self._width_sigma])
            covariances = np.broadcast_to(np.diag(sigma**2), (len(starts), 4, 4))
            start = Hypotheses(states, covariances, np.full(len(starts), s.born))
            network = self._settings.network
            sigma_cm = np.broadcast_to(network.sigma_factor * answer.sigma_cm, points_cm.shape)
            born.append(fitted(start, points_cm, sigma_cm, network.correlation))
        if (beside := self._beside(known[0])) is not None:
            born.append(beside)
        count = len(found.states)
        for new in born:
            found = found.and_others(new)
        expected = linearised(found.states) if born else known
        rows = np.arange(len(found.states))
        return found, expected, (rows >= count) & (rows < count + len(starts))

    def _beside(self, points_cm: Float[np.ndarray, "n 6"]) -> Hypotheses | None:
        """Return the next lane beyond a line that the car comes near, if it is not followed yet."""
        if not len(points_cm):
            return None
        s, found = self._settings.hypotheses, self._found
        left_cm, right_cm = points_cm[0, ::_ROWS].tolist()
        side, beyond_cm = max((-1.0, left_cm), (1.0, -right_cm), key=lambda one: one[1])
        if beyond_cm <= -s.near_lanes * self.lane.likely_cm:
            return None
        state, covariance = found.states[:1].copy(), found.covariances[:1].copy()
        state[0, OFFSET] += side * math.exp(state[0, LOG_WIDTH]) * math.hypot(1.0, state[0, SLOPE])
        if self._is_one_of(linearised(state)[0][0], points_cm):
            return None
        covariance[0, OFFSET, OFFSET] += s.beside_cm**2
        return Hypotheses(state, covariance, found.log_weights[:1] + s.beside)

    def _is_one_of(self, line_cm: Float[np.ndarray, "6"], known_cm: Float[np.ndarray, "n 6"]) -> bool:
        """Tell whether a lane is one of some, 15 cm ahead."""
        apart_cm = np.abs(known_cm - line_cm)[:, 1::_ROWS]
        return bool((apart_cm.max(axis=1) < self._settings.hypotheses.same_lanes * self.lane.likely_cm).any())

    @property
    def _width_sigma(self) -> float:
        return math.hypot(self._settings.hypotheses.width_sigma, self.lane.width_sigma)

    def _drawn_to_network(
        self,
        found: Hypotheses,
        expected: tuple[Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6 4"]],
        is_new: Bool[np.ndarray, "n"],
        answer: NetworkAnswer,
    ) -> tuple[Hypotheses, Float[np.ndarray, "n"]]:
        """Draw each hypothesis to the places that the network gives near it; return their log likelihoods.

        Around a hypothesis the probabilities of places are cut out by its own distribution; mean and variance
        of what is left, less that distribution, are a measurement. So two places stay two.
        """
        s, (points, change) = self._settings.network, expected
        window = np.maximum(variances(change, found.covariances) + self._shape, s.window_cm**2)
        power = s.weight * (s.unseen_weight + (1.0 - s.unseen_weight) * np.repeat(answer.presence, _ROWS))
        share = (np.exp(answer.log_share) + s.least_share) ** power[:, None]
        places = answer.places_cm
        around = np.exp((-0.5 / window)[..., None] * (places - points[..., None]) ** 2)
        both = share * around
        total = both.sum(axis=2) + _TINY
        mean = both @ places / total
        variance = (both * (places - mean[..., None]) ** 2).sum(axis=2) / total + s.variance_cm2
        in_window = (points > places[0]) & (points < places[-1])
        likely = np.log(total / (around.sum(axis=2) + _TINY))
        log_likelihood = np.where(in_window, likely, -power * math.log(len(places))).sum(axis=1)
        variance = np.minimum(variance, _MOST_OF_WINDOW * window)
        measured = (mean * window - points * variance) / (window - variance)
        usable = in_window & ~is_new[:, None]
        sigma_cm = np.where(usable, np.sqrt(variance * window / (window - variance)), NOTHING_CM)
        measured = np.where(usable, measured, points)
        return found.updated(expected, measured, sigma_cm, s.correlation), log_likelihood

    def _weighed(self, found: Hypotheses, log_likelihood: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the log weights after a frame, which tells nothing with some probability."""
        s = self._settings.hypotheses
        share = np.exp(log_likelihood - log_likelihood.max())
        log_weights = found.log_weights + np.log((1.0 - s.surprise) * share + s.surprise)
        return log_weights - log_weights.max()

    def _log_inside(self, points_cm: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n"]:
        """Log probability that the car is in each lane: that over which its front axle is."""
        over = np.maximum(points_cm[:, 0], -points_cm[:, _ROWS]) / self._settings.hypotheses.inside_cm
        over = np.maximum(over, 0.0)
        # Huber's loss: far beside, only the distance counts.
        return -np.where(over < _HUBER, 0.5 * over * over, _HUBER * (over - 0.5 * _HUBER))

    def _distinct(
        self,
        points_cm: Float[np.ndarray, "n 6"],
        log_weights: Float[np.ndarray, "n"],
        inside: Float[np.ndarray, "n"],
    ) -> Int[np.ndarray, "m"]:
        """Return the hypotheses to keep, the likeliest first: of those that have become one, the likelier."""
        s, kept = self._settings.hypotheses, list[int]()
        for k in np.argsort(-inside).tolist():
            if log_weights[k] < s.least or (kept and self._is_one_of(points_cm[k], points_cm[kept])):
                continue
            kept.append(k)
            if len(kept) == s.most:
                break
        return np.array(kept)

    def _notice_crossing(self, before_cm: Float[np.ndarray, "6"], now_cm: Float[np.ndarray, "6"]) -> None:
        """Let what was learned of a line change sides with it, where the next lane has become the car's.

        Args:
            before_cm: The lane of the last frame, moved with the car.
            now_cm: The lane of this frame.
        """
        crossed_cm = 0.5 * float((before_cm - now_cm)[1::_ROWS].sum())
        if abs(crossed_cm) > 0.5 * self.lane.likely_cm:
            side = int(crossed_cm < 0.0)
            self._lines.markings.cross(side)
            self.looks.cross(side)

    def _learn(
        self, answer: NetworkAnswer, best_cm: Float[np.ndarray, "6"], lines: LinesSeen, borders: RoadBorders
    ) -> None:
        """Learn what the lines of the best lane look like, and the width of the lane."""
        seen_cm, present = lines.seen_cm[0], answer.presence > SEEN
        for side in range(len(SIDES)):
            if seen_cm[side] >= MEASURED_CM:
                self.looks.remember(side, lines.looks[0, side].tolist())
        self.looks.judge()
        if present.all() and (seen_cm >= MEASURED_CM).all() and best_cm[0] <= 0.0 <= best_cm[_ROWS]:
            self.lane.learn(lines.points_cm[0], _CERTAIN)
        self._lines.learn_markings(
            answer.points_cm,
            self._settings.network.sigma_factor * answer.sigma_cm,
            answer.presence,
            best_cm,
            self._settings.hypotheses.same_lanes * self.lane.likely_cm,
            borders,
        )

    def _answer(
        self,
        answer: NetworkAnswer,
        points_cm: Float[np.ndarray, "n 6"],
        variance: Float[np.ndarray, "n 6"],
        log_weights: Float[np.ndarray, "n"],
        lines: LinesSeen,
    ) -> LaneAnswer:
        """Return the first lane, with the doubt that it is that one."""
        s, best_cm = self._settings.doubt, points_cm[0]
        weights = np.exp(log_weights - log_weights.max())
        weights /= weights.sum()
        apart_cm = np.abs(best_cm - answer.points_cm)
        beyond_cm = np.maximum(ROW_CM - lines.end_cm[0].max(), 0.0)
        doubts = np.empty((len(best_cm), len(PARTS)))
        doubts[:, 0] = weights @ (points_cm - best_cm) ** 2
        doubts[:, 1] = weights @ variance
        doubts[:, 2] = lines.unseen[0].min() ** 2
        doubts[:, 3] = (lines.unseen[0].min() * (1.0 - answer.presence.max())) ** 2
        doubts[:, 4] = beyond_cm**2
        doubts[:, 5] = apart_cm**2
        doubts[:, 6] = np.repeat(apart_cm[1::_ROWS], _ROWS) ** 2
        doubts[:, 7] = answer.sigma_cm**2
        squares = self._doubt_squares
        sigma_cm = np.sqrt(doubts @ squares)
        unknown, reason = sigma_cm > s.most_lanes * self.lane.likely_cm, ""
        if unknown.any():
            reason = list(PARTS.values())[int((doubts[unknown].sum(axis=0) * squares).argmax())]
        known_cm, known_sigma_cm = (np.where(unknown, np.nan, each) for each in (best_cm, sigma_cm))
        return LaneAnswer(known_cm, known_sigma_cm, lines.seen_cm[0], reason, doubts)
