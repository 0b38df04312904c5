"""The lane from frame to frame: what the network sees, what the edges confirm, and what was there before.

A single frame can look like another lane. The lane of the last frame, found again on this frame's edges, is
a second answer beside the network's; of all pairs of lines the one is taken that shows most of its markings
and has the lane's width. Once the car has crossed a line, the lane beyond it is one more, if its lines are
seen. Where nearly as much speaks for a pair in the next lane, nothing is answered, and both are followed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import ROWS_CM, SIDES, parallel_points
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.estimate import SEEN, SURE, LaneMemory
from lanenet.perception.network.corner import corners
from lanenet.perception.network.refinement import RoadBorders, refined
from lanenet.perception.network.tracking.camera_view import CameraView
from lanenet.perception.network.tracking.lane_belief import Keep, LineLooks
from lanenet.perception.network.tracking.lane_beyond import lane_beyond
from lanenet.perception.network.tracking.lane_corner import CornerAhead, find_corner
from lanenet.perception.network.tracking.line_beside import SeenLine, WidthHere, line_beside
from lanenet.perception.network.tracking.marking_widths import MarkingWidths
from lanenet.perception.network.tracking.pair import Candidate, Pair, best_pair, tells_width
from lanenet.perception.network.tracking.side_road import SideRoadAhead, find_side_road
from lanenet.perception.network.tracking.straight_on import SeenLines, StraightOn, turns_away_cm
from lanenet.perception.network.tracking.which_lane import WhichLane

#: Factor on a network's own sigma. On nine drives, eight simulated, refined lines lay within one and two
#: sigma in 66 and 90 % with it, in 51 and 80 % without.
_NETWORK_SIGMA = 2.0
#: Presence below which the line of the network is not looked for among the edges. Chosen.
_LEAST_PRESENCE = 0.3
#: Sigma of what changes at the label rows from one frame to the next. Chosen: a car at 1 m/s and 20 frames/s
#: moves by 5 cm between two, and turns by 0.1 rad in the tightest bend.
_MOVED_CM = (2.0, 3.0, 5.0)
#: Width of a marking before any was seen, and its sigma; its sigma once it is known. Chosen.
_MARKING_CM, _MARKING_SIGMA_CM, _KNOWN_SIGMA_CM = 3.0, 2.0, 0.3
#: Length along the road, [cm], in which a border has to be seen for a width to count, and for a line to.
_WIDTH_SEEN_CM, _LINE_SEEN_CM = 12.0, 9.0
#: What speaks for a line, in centimetres of seen borders: the presence that the network gives it, and that it
#: continues the last frame's. Chosen.
_BY_PRESENCE_CM, _BY_CONTINUING_CM = 6.0, 3.0
#: Length in which a line beyond a crossed one has to be seen. A single border, as that of a mat, is seen over
#: half of the 46 cm that count.
_BEYOND_SEEN_CM = 26.0
_MIDDLE = 1
#: Sigma that is added to a line seen over less than ``_LINE_SEEN_CM``: on nine drives such lines lay 2 to
#: 4 cm off. Factor on sigma beyond the last border ahead, where tape may turn: 1 to 3 were tried.
_BARELY_CM, _AHEAD = 2.0, 3.0
#: A point is unknown if the sigma of its line is above this share of the lane's width, or of the likely one.
#: What lies between a line and the network's own answer, 15 cm ahead and at the point itself, counts with it:
#: on 120 simulated drives the RMSE is 1.22 cm for it, with the distance 15 cm ahead alone 1.41, and 0.4 %
#: fewer points are answered. Tried: 0.14, 0.16 and 0.18 gave 1.22, 1.27 and 1.31 cm, 96.1, 96.4 and 96.6 %.
_MOST_LANES = 0.16
#: Where a line is out of view beside the car, this share of the distance to where it comes into view counts
#: as well: of the errors 10 cm and more out of view 92 and 92 % lay within two sigma on two real drives, and
#: 96 and 98 % do with it. Simulated cameras, which are known exactly, would not need it.
_HIDDEN = 0.08
#: The sigma that is answered is this share of all these together and of what labels are wrong by, [cm]. A
#: line's own sigma was too large where line and network agree, and too small elsewhere: on 144 simulated
#: drives of six seeds the mean pinball loss of 72 and 94 %, which lie between those of a normal distribution
#: and what heavy tails leave, is 0.30 instead of 0.36. A share of 0.55 fits these best, but real roads are
#: harder: see docs/studies.md.
_CLAIMED, _LABEL_CM = 0.62, 0.2
#: What it costs at most that a marking has another hue than its line had. Tried: 0, 15 and 40, which makes up
#: for a line and loses those in the light of a lamp.
_BY_LOOK_CM = 15.0
#: A line is another one from this share of the lane's width away, and the same one within that share. Chosen.
_CHANGED, _SAME = 0.5, 0.3
#: Of a line that has moved by less than this share of the lane's width since the last frame, 15 cm ahead, the
#: place beside the car is recalled where it is not seen; 1, 2 and 4 cm were tried for what it moves there.
#: The 95th percentile of the errors of 144 simulated drives fell from 1.86 to 1.80 cm, of three real ones
#: from 1.01, 1.81 and 1.65 to 0.99, 1.67 and 1.61, for lanes of 40 cm.
_RECALLED = 0.15
#: So far beyond a corner a line still holds. Tried: 0, 2 and 4 cm refuse 79, 56 and 40 points that are more
#: than 2 cm off on 144 simulated drives, and 109, 90 and 76 others.
_CORNER_CM = 2.0
#: A line that is seen up to there, and over so much on the way, has no corner within the label rows. Chosen:
#: one bin of its borders more than a corner at the last row leaves of them; two thirds of the way, since what
#: lies beyond the corner may be the border of something else.
_GOES_ON_CM, _GOES_ON_SEEN_CM = 38.0, 28.0
#: The other line of a bend is found within this share of the width of where it is expected. Chosen.
_BESIDE = 0.1
#: The road's other border turns with a bend if it turns by this share of what a parallel line would, where
#: that is plain, [cm]: a straight one lies within the same distance. Chosen: one that bends does so by 0.8.
_BENT, _LEAST_BENT_CM = 0.5, 1.5
_NOWHERE, _UNSEEN = [False] * len(ROWS_CM), [math.nan] * len(ROWS_CM)


# Below, lines are plain numbers: for so few of them arrays cost more than their sums.


class _Start(NamedTuple):
    """Where a line may be: at most that surely, and what speaks for it before the edges were looked at.

    A line is known as the left one, 0, or the right one, 1, if it should look like that; as None it may have
    any look. The presence is the network's, of the lines that it sees itself. One that is measured shows how
    wide its marking is, and what was learned of that has no say.
    """

    side: int
    points_cm: list[float]
    sigma_cm: list[float]
    score_cm: float
    known_as: int | None
    presence: float = 0.0
    beyond: bool = False
    measured: bool = False


class _Found(NamedTuple):
    """A line on its marking: see :class:`lanenet.perception.network.refinement.RefinedLines`."""

    points_cm: list[float]
    sigma_cm: list[float]
    marking_cm: float
    seen_cm: float
    seen_at: list[bool]
    look: list[float]
    seen_to_cm: float

    @classmethod
    def of_row(cls, row: list[float]) -> _Found:
        """Take a row of what :func:`lanenet.perception.network.refinement.refined` returns."""
        return cls(row[:3], row[3:6], row[6], row[7], list(map(bool, row[8:11])), row[11:14], row[14])


#: Points, or sigmas, of the left and of the right line.
_Both = list[list[float]]


class LaneTracker:
    """Refines a network's lines, and keeps to the lane of the last frames.

    Attributes:
        lane: The lane's width, given or remembered.
        looks: What its lines look like, and whether it is the lane to drive in.
    """

    def __init__(self, lane: LaneMemory, keep: Keep | None = None, view: CameraView | None = None) -> None:
        self.lane = lane
        self.looks = LineLooks(keep)
        self._last: tuple[_Both, _Both] | None = None
        self._rival: Pair | None = None
        self._which_lane = WhichLane()
        self.straight_on = StraightOn()
        self.corner = CornerAhead()
        self.side_road = SideRoadAhead()
        #: Whether the last frame in which its lines were followed showed both beyond the label rows.
        self._goes_on = False
        self._view = view
        self._markings = MarkingWidths()
        self._width_here = WidthHere()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self._last = self._rival = None
        self._which_lane.reset()
        self.straight_on.reset()
        self.corner.reset()
        self.side_road.reset()
        self._goes_on = False
        self.looks.reset()
        self._width_here.reset()
        self._markings.reset()

    def follow(
        self,
        points_cm: Float[np.ndarray, "6"],
        sigma_cm: Float[np.ndarray, "6"],
        presence: Float[np.ndarray, "2"],
        edges: RoadEdges,
    ) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"], Float[np.ndarray, "2"]]:
        """Return the lane of a frame.

        Args:
            points_cm: The network's answer, frame car.
            sigma_cm: Its sigmas.
            presence: Probability that each line can be seen.
            edges: The frame's edge points.

        Returns:
            Points and sigmas, NaN where the place is unknown, and the length along the road in which each
            line was seen, [cm].
        """
        borders = RoadBorders(edges)
        if self._at_corner(borders):
            return self._around_corner()
        network_cm = points_cm.tolist()
        own = _both(network_cm), _both([_NETWORK_SIGMA * each_cm for each_cm in sigma_cm.tolist()])
        present = presence.tolist()
        starts, measured = self._starts(own, present), self._to_measure(own, present)
        # In one go, since each look at the edge points has a price.
        found = self._refine([*starts, *measured], borders)
        looked_for, measures = found[: len(starts)], found[len(starts) :]
        candidates = self._candidates(starts, looked_for, own, present)
        beside_cm = math.inf if self._last is None else self._nearest_line()[1]
        pair, across_cm, self._rival = best_pair(*candidates, self.lane, beside_cm)
        decided = self._rival is None
        if self._at_junction(pair, present, borders):
            continued_cm, continued_sigma_cm = (x.ravel().tolist() for x in self.straight_on.lane())
            self._last = _both(continued_cm), _both(continued_sigma_cm)
            self._width_here.look(None)
            known_cm, known_sigma_cm = self._known(continued_cm, continued_sigma_cm, continued_cm)
            self._which_lane.keep(not np.isnan(known_cm).all())
            return known_cm, known_sigma_cm, np.zeros(len(SIDES))
        self._notice_change(pair)
        self._width_here.look(across_cm if decided and tells_width(pair) else None)
        self._learn_markings(pair, zip(measured, measures, strict=True))
        for side, line in enumerate(pair):
            if line.seen_cm >= _WIDTH_SEEN_CM:
                self.looks.remember(side, line.look)
        self.looks.judge()
        left, right = pair
        found_cm, found_sigma_cm = left.points_cm + right.points_cm, _sigma_cm(left) + _sigma_cm(right)
        self._recall_near(pair, found_cm, found_sigma_cm)
        seen = [line.seen_cm >= _LINE_SEEN_CM for line in pair]
        if seen[0] != seen[1]:
            side = seen.index(True)
            self._tell_other(side, pair[side], found_cm, found_sigma_cm, edges)
        self._last = _both(found_cm), _both(found_sigma_cm)
        if (doubts := self.straight_on.doubts(np.array(found_cm), self.lane.width_cm)) is not None:
            found_sigma_cm = np.where(doubts, math.inf, found_sigma_cm).tolist()
        for side, line in enumerate(pair):
            # A solid line that is not seen ahead turns away there, or ends.
            if line.seen_cm >= _LINE_SEEN_CM and not line.seen_at[-1] and self.looks.is_solid(side):
                found_sigma_cm[len(ROWS_CM) * (side + 1) - 1] = math.inf
        self._doubt_beyond_corners(pair, present, borders, found_sigma_cm)
        on_edges, guessed = min(left.seen_cm, right.seen_cm) >= _WIDTH_SEEN_CM, False
        if decided:
            side, beside_cm = self._nearest_line()
            beside = beside_cm / self.lane.likely_cm
            self._which_lane.arrive(beside, on_edges and min(present) > SEEN)
            guessed = self._which_lane.is_a_guess(beside, present[side] >= SEEN)
        # What edges show of one line may be anything, if the network sees neither.
        unseen = max(present) < SEEN and not on_edges
        if not decided or guessed or unseen:
            found_sigma_cm = [math.inf] * len(found_cm)
        known_cm, known_sigma_cm = self._known(found_cm, found_sigma_cm, network_cm)
        if np.isnan(known_cm).all():
            # A car between two lanes has not lost them.
            if decided and not guessed:
                self.lose()
        elif not self._which_lane.find(on_edges):
            known_cm[:] = known_sigma_cm[:] = math.nan
        return known_cm, known_sigma_cm, np.array([left.seen_cm, right.seen_cm])

    def moved(self, travel_cm: float, turn_rad: float, wheelbase_cm: float) -> None:
        """Take the car's motion since the last frame, as :class:`lanenet.perception.estimate.TakesMotion`."""
        self.straight_on.moved(travel_cm, turn_rad, wheelbase_cm)
        self.corner.moved(travel_cm, turn_rad, wheelbase_cm)
        self.side_road.moved(travel_cm, turn_rad)

    def lose(self) -> None:
        """Take a frame that shows nothing of the lane."""
        self._goes_on = False
        self._which_lane.keep(False)

    def _tell_other(
        self,
        side: int,
        line: Candidate,
        found_cm: list[float],
        found_sigma_cm: list[float],
        edges: RoadEdges,
    ) -> None:
        """Take the lane's other line from the one of a side, where that alone is seen."""
        width_cm = self.lane.width_cm
        if width_cm is None:
            return
        marking_cm = self._markings.usual_cm(side) or _MARKING_CM
        seen = SeenLine(side, np.array(line.points_cm), line.seen_at[-1], marking_cm)
        own, other = len(ROWS_CM) * side, len(ROWS_CM) * (1 - side)
        usual_sigma_cm = self.lane.width_sigma * width_cm
        width_cm, sigma_cm = self._width_here.instead_of(width_cm)
        for i, told_cm in enumerate(line_beside(seen, width_cm, edges).tolist()):
            if math.isnan(told_cm):
                found_sigma_cm[other + i] = math.inf
                continue
            found_cm[other + i] = told_cm
            found_sigma_cm[other + i] = math.hypot(found_sigma_cm[own + i], usual_sigma_cm, sigma_cm)

    def _doubt_beyond_corners(
        self,
        pair: Pair,
        presence: list[float],
        borders: RoadBorders,
        found_sigma_cm: list[float],
    ) -> None:
        """Make unknown what a line says beyond a corner at which its tape turns off it.

        The lane's other line turns there as well; only one that is seen tells itself where.
        """
        seen = [side for side, line in enumerate(pair) if line.seen_cm >= _LINE_SEEN_CM]
        plain = [side for side in seen if presence[side] >= SEEN]
        self._goes_on = len(plain) == len(pair) and all(
            line.seen_to_cm >= _GOES_ON_CM and line.seen_cm >= _GOES_ON_SEEN_CM for line in pair
        )
        if self._goes_on:
            return
        lines = [pair[side] for side in seen]
        found = corners([line.points_cm for line in lines], [line.marking_cm for line in lines], borders)
        for side, corner in zip(seen, found, strict=True):
            if corner is None:
                continue
            ends_cm = {side: corner.ahead_cm + _CORNER_CM}
            if 1 - side not in plain:
                width_cm, _ = self._width_here.instead_of(self.lane.likely_cm)
                ends_cm[1 - side] = corner.of_other_cm(side, width_cm)
            for doubted, end_cm in ends_cm.items():
                for i, row_cm in enumerate(ROWS_CM, start=len(ROWS_CM) * doubted):
                    if row_cm > end_cm:
                        found_sigma_cm[i] = math.inf

    def _recall_near(
        self,
        pair: Pair,
        found_cm: list[float],
        found_sigma_cm: list[float],
    ) -> None:
        """Where a line passes out of view beside the car, fuse its place there with the last frame's."""
        if self._last is None:
            return
        for side, (line, last_cm, last_sigma_cm) in enumerate(zip(pair, *self._last, strict=True)):
            off_cm = abs(last_cm[_MIDDLE] - line.points_cm[_MIDDLE])
            if line.seen_cm < _LINE_SEEN_CM or line.seen_at[0] or off_cm > _RECALLED * self.lane.likely_cm:
                continue
            beside = len(ROWS_CM) * side
            found, recalled = found_sigma_cm[beside] ** 2, _moved(last_sigma_cm)[0] ** 2
            gain = found / (found + recalled)
            found_cm[beside] += gain * (last_cm[0] - found_cm[beside])
            found_sigma_cm[beside] = math.sqrt(gain * recalled)

    def _known(
        self, points_cm: list[float], sigma_cm: list[float], own_cm: list[float]
    ) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"]]:
        """Return points and sigmas, NaN where the place is unknown; ``own_cm`` is the network's answer."""
        most_cm, known_cm, known_sigma_cm = _MOST_LANES * self.lane.likely_cm, [], []
        apart_cm = [abs(x - own_x) for x, own_x in zip(points_cm, own_cm, strict=True)]
        middles_cm = [middle for middle in apart_cm[_MIDDLE :: len(ROWS_CM)] for _ in ROWS_CM]
        places = zip(points_cm, sigma_cm, apart_cm, middles_cm, strict=True)
        for i, (x, sigma, apart, middle) in enumerate(places):
            hidden_cm = 0.0 if self._view is None else self._view.hidden_cm(i % len(ROWS_CM), x)
            doubt_cm = math.hypot(sigma, max(apart, middle), _HIDDEN * hidden_cm, _LABEL_CM)
            known = doubt_cm <= most_cm
            known_cm.append(x if known else math.nan)
            known_sigma_cm.append(_CLAIMED * doubt_cm if known else math.nan)
        return np.array(known_cm), np.array(known_sigma_cm)

    def _candidates(
        self, starts: list[_Start], found: list[_Found], own: tuple[_Both, _Both], presence: list[float]
    ) -> tuple[list[Candidate], list[Candidate]]:
        """Rate what the left and the right line may be; the last of each is the network's, as it is."""
        candidates: tuple[list[Candidate], list[Candidate]] = ([], [])
        for start, line in zip(starts, found, strict=True):
            if start.beyond and line.seen_cm < _BEYOND_SEEN_CM:
                continue
            score_cm = start.score_cm
            score_cm = line.seen_cm + score_cm if line.seen_cm > 0.0 else min(score_cm, _BY_CONTINUING_CM)
            score_cm -= _BY_LOOK_CM * self.looks.unlike(start.known_as, line.look)
            points_cm, sigma_cm, marking_cm, seen_cm, seen_at, look, seen_to_cm = line
            as_seen = points_cm, sigma_cm, seen_cm, score_cm, seen_at, look
            rated = Candidate(*as_seen, marking_cm, start.presence, seen_to_cm)
            candidates[start.side].append(rated)
        for side, lines in enumerate(candidates):
            doubt_cm = _BY_PRESENCE_CM * (presence[side] - 0.5)
            unseen = 0.0, doubt_cm, _NOWHERE, _UNSEEN, _MARKING_CM
            lines.append(Candidate(own[0][side], own[1][side], *unseen))
        return candidates

    def _starts(self, own: tuple[_Both, _Both], presence: list[float]) -> list[_Start]:
        """Return where lines are looked for: by the network, by the last frame, and beyond a crossed line."""
        last, starts = self._last, []
        # The next lane's lines need not look like those of this one.
        crossed = last is not None and (last[0][0][0] > 0.0 or last[0][1][0] < 0.0)
        for side, present in enumerate(presence):
            known_as = None if crossed else side
            if present >= _LEAST_PRESENCE:
                score_cm = _BY_PRESENCE_CM * present
                starts.append(_Start(side, own[0][side], own[1][side], score_cm, known_as, present))
            if last is not None:
                moved_cm = _moved(last[1][side])
                starts.append(_Start(side, last[0][side], moved_cm, _BY_CONTINUING_CM, known_as))
        if crossed:
            starts += self._beyond_a_crossed_line()
        for side, line in enumerate(self._rival or ()):
            starts.append(_Start(side, line.points_cm, _moved(line.sigma_cm), _BY_CONTINUING_CM, None))
        return starts

    def _nearest_line(self) -> tuple[int, float]:
        """Return the lane's line that is nearest to the front axle's middle, and how far that is, [cm]."""
        assert self._last is not None
        beside_cm = [abs(line_cm[0]) for line_cm in self._last[0]]
        side = beside_cm.index(min(beside_cm))
        return side, beside_cm[side]

    def _beyond_a_crossed_line(self) -> list[_Start]:
        """Return where the lines of the next lane are expected, once the front axle has crossed one."""
        starts: list[_Start] = []
        width_cm = self.lane.width_cm
        if self._last is None or width_cm is None:
            return starts
        for side, outwards in ((0, -1.0), (1, 1.0)):
            crossed_cm = self._last[0][side]
            if outwards * crossed_cm[0] >= 0.0:
                continue
            sigma_cm = _moved(self._last[1][side])
            next_cm = parallel_points(np.array(crossed_cm), outwards * width_cm).tolist()
            if all(map(math.isfinite, next_cm)):
                # That is the next lane's other line, and lines beyond it may look like any.
                crossed = 1 - side, crossed_cm, sigma_cm, _BY_CONTINUING_CM, side
                starts.append(_Start(*crossed, beyond=True))
                beyond = side, next_cm, _moved(sigma_cm), _BY_CONTINUING_CM, None
                starts.append(_Start(*beyond, beyond=True))
        return starts

    def _at_corner(self, borders: RoadBorders) -> bool:
        """Look for corners and side roads ahead, and return whether the lane turns at once here.

        That needs the car's motion, and how wide the markings are.
        """
        width_cm = self.lane.width_cm
        markings_cm = self._known_markings_cm() if self.straight_on.told else None
        if width_cm is None or markings_cm is None:
            self.corner.reset()
            self.side_road.reset()
            return False
        if self.corner.on:
            goes_on = self.corner.follow(markings_cm, borders.edges)
            if not goes_on:
                self._leave_corner()
            return goes_on
        lines_cm, found = self.straight_on.expected_cm, None
        if lines_cm is not None and not self.straight_on.on and not self._goes_on:
            hints = corners(lines_cm.tolist(), markings_cm, borders)
            found = find_corner(lines_cm, width_cm, markings_cm, hints, borders.edges)
            if found is None and self._view is not None:
                road = find_side_road(lines_cm, width_cm, markings_cm, borders.edges, self._view)
                self.side_road.look(road)
        self.corner.look(found)
        return self.corner.on

    def _around_corner(
        self,
    ) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"], Float[np.ndarray, "2"]]:
        """Answer with the lane that turns at once."""
        self.straight_on.forget_lane()
        self.side_road.reset()
        self._last = self._rival = None
        self._goes_on = False
        self._width_here.look(None)
        points_cm, sigma_cm = self.corner.lane()
        doubt_cm = np.hypot(sigma_cm, _LABEL_CM)
        known = doubt_cm <= _MOST_LANES * self.lane.likely_cm
        self._which_lane.keep(True)
        answer = np.where(known, points_cm, np.nan), np.where(known, _CLAIMED * doubt_cm, np.nan)
        return answer[0].ravel(), answer[1].ravel(), np.zeros(len(SIDES))

    def _leave_corner(self) -> None:
        """Look for the lane beyond a corner where it is expected, unless the corner was given up."""
        lines_cm = self.corner.lane_beyond() if self.corner.is_behind else None
        if lines_cm is not None:
            self._last = lines_cm.tolist(), [list(_MOVED_CM)] * len(SIDES)
            self.straight_on.start_again(lines_cm)
        self.corner.reset()

    def _known_markings_cm(self) -> list[float] | None:
        """Return how wide the lines' markings are; None before both are known."""
        usual_cm = [self._markings.usual_cm(side) for side in range(len(SIDES))]
        known_cm = [marking_cm for marking_cm in usual_cm if marking_cm is not None]
        return known_cm if len(known_cm) == len(SIDES) else None

    def _at_junction(self, pair: Pair, presence: list[float], borders: RoadBorders) -> bool:
        """Return whether the lines that the frame shows are not those of the lane, which goes straight on."""
        width_cm = self.lane.width_cm
        if self._last is None or width_cm is None:
            return False
        left, right = pair
        points_cm = left.points_cm, right.points_cm
        lines = SeenLines(points_cm, (left.seen_cm, right.seen_cm), (left.seen_at, right.seen_at))
        bends, leaving = self._turning(pair, width_cm, borders)
        road = self.side_road.road if self.side_road.is_here(width_cm) else None
        if self.straight_on.on:
            assert self.straight_on.leaving is not None
            found = self._is_sure_of(1 - self.straight_on.leaving, pair, presence)
            passes = road is not None
            self.straight_on.look_for_its_end(lines, found or (bends and not passes), width_cm, passes=passes)
        else:
            if bends:
                self.straight_on.forget_turn()
            # A line that goes on has bays beside it.
            if road is not None and not (
                pair[road.side].seen_to_cm >= _GOES_ON_CM or self._is_sure_of(1 - road.side, pair, presence)
            ):
                self.straight_on.begin(road.side)
            if not self.straight_on.on:
                self.straight_on.look(lines, leaving, presence, width_cm)
        if self.straight_on.on:
            self._look_beyond(width_cm, borders.edges)
        return self.straight_on.on

    @staticmethod
    def _is_sure_of(side: int, pair: Pair, presence: list[float]) -> bool:
        """Return whether network and edges both show a line."""
        return presence[side] > SURE and pair[side].seen_cm >= _WIDTH_SEEN_CM

    def _look_beyond(self, width_cm: float, edges: RoadEdges) -> None:
        """Turn the continued lane to where both of its lines are seen further ahead.

        That needs the car's motion, and how wide the markings are.
        """
        markings_cm = self._known_markings_cm()
        if not self.straight_on.told or markings_cm is None:
            return
        continued_cm, _ = self.straight_on.lane()
        beyond_cm = lane_beyond(continued_cm, width_cm, markings_cm, edges)
        if beyond_cm is not None:
            self.straight_on.anchor(beyond_cm, width_cm)

    def _turning(self, pair: Pair, width_cm: float, borders: RoadBorders) -> tuple[bool, int | None]:
        """Return whether the lines turn together, or which one does alone."""
        for side, (line, other) in enumerate(zip(pair, pair[::-1], strict=True)):
            turns = self.straight_on.turns_away(line.points_cm, line.seen_at, side, width_cm)
            if line.seen_cm < _LINE_SEEN_CM or not turns or self.looks.is_between_lanes(side):
                continue
            # Beyond the lane beside it the road's other border turns as well.
            turns_with_it = self._turns_with(line, side, width_cm, borders)
            if turns_with_it or self._turns_with(line, side, 2.0 * width_cm, borders, _BENT):
                return True, None
            if turns_with_it is None:
                continue
            speck = self.straight_on.is_a_speck(other.points_cm, other.seen_cm, 1 - side, width_cm)
            if not other.seen_at[-1] or other.seen_cm < _LINE_SEEN_CM or speck:
                return False, side
        return False, None

    def _turns_with(
        self, line: Candidate, side: int, across_cm: float, borders: RoadBorders, least_bent: float = 0.0
    ) -> bool | None:
        """Return whether there is a line parallel to one of a side; None where none would be in view.

        It turns by this share at least of what a parallel one does.
        """
        beside_cm = parallel_points(np.array(line.points_cm), across_cm if side == 0 else -across_cm)
        if not np.isfinite(beside_cm).all() or self._view is None or not self._view.shows_line(beside_cm):
            return None
        start = _Start(1 - side, beside_cm.tolist(), _moved(line.sigma_cm), 0.0, None)
        (found,) = self._refine([start], borders)
        off_cm = np.abs(found.points_cm - beside_cm).max()
        is_near = bool(off_cm < _BESIDE * self.lane.likely_cm)
        turn_cm, expected_cm = (turns_away_cm(x, side) for x in (found.points_cm, beside_cm.tolist()))
        bends = least_bent == 0.0 or (expected_cm > _LEAST_BENT_CM and turn_cm > least_bent * expected_cm)
        return found.seen_at[-1] and found.seen_cm >= _WIDTH_SEEN_CM and is_near and bends

    def _notice_change(self, pair: Pair) -> None:
        """Notice that one of the lane's lines was the other one before: the car is in the next lane."""
        width_cm = self.lane.width_cm
        if self._last is None or width_cm is None:
            return
        before_cm = [line_cm[_MIDDLE] for line_cm in self._last[0]]
        for side in range(len(SIDES)):
            now_cm = pair[1 - side].points_cm[_MIDDLE]
            was_cm, crossed_cm = before_cm[1 - side], before_cm[side]
            if abs(now_cm - was_cm) > _CHANGED * width_cm and abs(now_cm - crossed_cm) < _SAME * width_cm:
                self._which_lane.enter()
                self._width_here.reset()
                self.looks.cross(side)
                self._markings.cross(side)
                return

    def _to_measure(self, own: tuple[_Both, _Both], presence: list[float]) -> list[_Start]:
        """Return the lines whose markings are measured in this frame: the network's own."""
        if not self._markings.next_frame():
            return []
        return [
            _Start(side, own[0][side], own[1][side], 0.0, None, measured=True)
            for side, present in enumerate(presence)
            if present >= _LEAST_PRESENCE
        ]

    def _learn_markings(self, pair: Pair, measured: Iterable[tuple[_Start, _Found]]) -> None:
        """Learn how wide the lane's markings are, and whether they are light, from what was measured."""
        for start, found in measured:
            both_cm = zip(found.points_cm, pair[start.side].points_cm, strict=True)
            off_cm = max(abs(x - chosen_x) for x, chosen_x in both_cm)
            if found.seen_cm >= _WIDTH_SEEN_CM and off_cm < _SAME * self.lane.likely_cm:
                self._markings.learn(start.side, found.marking_cm)

    def _refine(self, starts: Sequence[_Start], borders: RoadBorders) -> list[_Found]:
        """Refine lines; light and dark are tried until markings are known, and where they are measured."""
        asked, both = [], []
        for start in starts:
            usual_cm = None if start.measured else self._markings.usual_cm(start.side)
            unknown = usual_cm is None
            marking_cm = usual_cm or _MARKING_CM
            sigma_cm = _MARKING_SIGMA_CM if unknown else _KNOWN_SIGMA_CM
            hues = self.looks.hues(start.known_as)
            for width_cm in (marking_cm, -marking_cm) if unknown else (marking_cm,):
                asked.append([*start.points_cm, *start.sigma_cm, width_cm, sigma_cm, *hues])
            both.append(unknown)
        if not asked:
            return []
        rows = iter(map(_Found.of_row, refined(np.array(asked), borders).tolist()))
        found = []
        for tried_both in both:
            line = next(rows)
            if tried_both and (dark := next(rows)).seen_cm > line.seen_cm:
                line = dark
            found.append(line)
        return found


def _both(values: list[float]) -> _Both:
    return [values[: len(ROWS_CM)], values[len(ROWS_CM) :]]


def _moved(sigma_cm: list[float]) -> list[float]:
    """Return the sigmas of a line one frame later."""
    return list(map(math.hypot, sigma_cm, _MOVED_CM))


def _sigma_cm(line: Candidate) -> list[float]:
    """Return the sigmas of a line that is seen here and there, or not as far as the label rows."""
    sigma_cm = line.sigma_cm
    if 0.0 < line.seen_cm < _LINE_SEEN_CM:
        sigma_cm = [math.hypot(each_cm, _BARELY_CM) for each_cm in sigma_cm]
    if line.seen_cm > 0.0 and not line.seen_at[-1]:
        sigma_cm = [*sigma_cm[:-1], _AHEAD * sigma_cm[-1]]
    return sigma_cm
