"""A drive, from images to adjusted poses: observe, track, close loops, adjust.

A slow car is tracked by keyframes; the frames between them are placed and adjusted afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from datagen.slam.adjustment.adjust import CAMERA_NAMES, BundleEstimate, BundleResult, adjust
from datagen.slam.commands import MOST_BRIDGED, CommandedMotion, SteeringFit, commands_of, fit_steering
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.keyframes import (
    choose_keyframes,
    commands_between,
    keyframe_pairs,
    poses_between,
    values_between,
)
from datagen.slam.loops.consistency import (
    consistent_revisits,
    of_one_lap,
    of_one_length,
    with_supported,
    without_contradicted,
)
from datagen.slam.loops.parts import (
    JOINED,
    LEAST_TIED,
    carried,
    connected,
    hanging,
    joined_twice,
    placing_revisits,
    tied_frames,
    whole_turns,
)
from datagen.slam.loops.pose_graph import close_loops, inlier_revisits, loop_pairs, neighbouring_laps
from datagen.slam.loops.revisits import (
    PlaceMatcher,
    Revisit,
    propose_beside,
    propose_revisits,
    propose_turned,
    thumbnails,
)
from datagen.slam.odometry.scans import Scans
from datagen.slam.settings import SlamSettings
from datagen.slam.track import track
from datagen.slam.view import (
    LEAST_POINTS,
    RoadView,
    SegmentView,
    view_road,
    view_segment,
    with_measured_periods,
)
from lanenet.data.drives import Drive
from lanenet.errors import TrackingLostError, counted
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import path_lengths

#: Called with (stage, done, total).
StageProgress = Callable[[str, int, int], None]
_ADJUST = "adjust poses"
#: Camera parameters that are observable without a loop closure. The focal length is not: before the loop was
#: closed it diverged on two of three real drives.
_OPEN_LOOP = ("pitch", "roll", "yaw", "lever")
#: Median residuals of revisits after closure along and across the road, in camera heights, and misfit of
#: neighbouring frames relative to before, at most. True closures leave 0.08 and 0.03 heights on the real
#: drives, and a misfit of 1.11 times at most on these and on rings of tiles; places that only look alike, as
#: on an open road, leave more.
MAX_MISSED, MAX_MISFIT = (0.6, 0.3), 1.15
#: The camera is adjusted until its focal length moves by less than this share, or so often. Chosen: a tenth
#: of the uncertainty of the focal length on a good drive (2 to 3 %).
_SETTLED, _MAX_CAMERA_ROUNDS = 0.003, 6
#: Heading that the open loop misses in a lap, [rad]; in addition, per logarithm of a focal length that is
#: off; and over a gap that was bridged. Measured: with the cameras that they had found, 0.30 on
#: ``garage_tape``, 0.26 on ``usi_mat`` and 0.49 on ``donkey_circuit``, and 0.05 over the gaps of the last; on
#: rings of tiles 0.05 at most, and 0.3 to 1.2 where the closure was false; with focal lengths that were 4 and
#: 10 % off, a turn that was 2 and 23 % off.
_DRIFT_RAD, _DRIFT_OF_LENS_RAD, _GAP_RAD = 0.3, 15.0, 0.05
#: Log likelihood of a revisit that a closure explains, over that of a false one, which may lie anywhere
#: within the search. Chosen: far below the ratio of both volumes, 8, since neighbours err alike.
_EXPLAINED = 1.0
#: Times that loops are closed again with the revisits that the closed poses confirm. Chosen: two or three
#: rounds are usual.
_MOST_GROWTH = 6
#: Rounds in which revisits spread along sections that none holds, by up to 12 camera heights each. Chosen:
#: ends where none is found; a lap of 240 heights in any case.
_MOST_SPREAD = 20


#: The open loop of a camera yet to be found is adjusted until its turn in a lap stays within, [rad], or
#: so often. Measured: on two loops of tiles it still moved by 0.3 after the first adjustment, which held a
#: tenth less than the true turn; on ``usi_mat`` by 0.02.
_STAYS_RAD, _MOST_REPEATED = 0.04, 11
#: Path from the place of a revisit to places beside it, in camera heights, and the share of its match that
#: these may have where it tells the place. Chosen: from further than places are aligned along the road to the
#: length of a short straight. Measured, the least of a drive: 0.95 on circles, 0.8 where a ring was closed
#: falsely, 0.63 to 0.67 on rings with corners.
_BESIDE_HEIGHTS, _TELLS = (4.0, 8.0, 12.0), 0.75
#: Heading by which places beside each other on a straight may differ, [rad]. Chosen: below that of a circle
#: of 40 camera heights, 12 of them further on.
_STRAIGHT_RAD = 0.3
#: Difference of the costs of another way around and of the best one, up to which the lens may be either's; up
#: to twice as much, its camera is adjusted. Measured on rings of tiles, without the number of revisits and
#: with the camera of the start right: 25 and more beside the true one; where the false one won, 0 to 10.
_NEAR = 20.0
#: Closures by different ways around whose camera is adjusted. Chosen: the true one was the first or second
#: of four rings of tiles.
_MOST_WAYS = 3
#: Laps that differ in length by more than this logarithm, or in their whole turns, lead along other ways.
#: Chosen: less than a tile of a ring of ten.
_OTHER_LAP = 0.1


@dataclass(frozen=True)
class SolvedSegment:
    """A tracked, closed and adjusted drive, or what hangs together of it, in the scale of its camera.

    Attributes:
        rows: Its frames, as positions in the drive.
        camera: The camera, adjusted where it was not known.
        scans: Edge points per frame, with the camera tilted as it was in each.
        trajectory: Open-loop trajectory of the particle filter; of a slow car that of the keyframes, with the
            other frames placed between.
        open_poses: Rear-axle poses, adjusted, before loops were closed.
        poses: The same after closing loops, frame map.
        steering: How curvature answers to the command, where it does.
        revisits: Loop closures.
        bundle: The adjustment.
        part: Number of the part that each frame belongs to; between parts lies a long gap of the recording.
        keys: Keyframes by which a slow car was tracked; None where every frame is one.
        decided: Whether revisits tell how far a lap turns: beside them places look otherwise, or lie on a
            straight.
        alike: Whether places beside all revisits look like theirs, so that it is open how long a lap is.
        missed: Heading that the open loop misses in a lap, in sigmas of one with a known camera; 0 without a
            revisit within a part.
        rivals: Cameras that other ways to close the loops need, the likeliest first.
    """

    rows: Int[np.ndarray, "n"]
    camera: Camera
    scans: Scans
    trajectory: Trajectory
    open_poses: Float[np.ndarray, "n 3"]
    poses: Float[np.ndarray, "n 3"]
    steering: SteeringFit | None
    revisits: list[Revisit]
    bundle: BundleResult
    part: Int[np.ndarray, "n"]
    keys: Int[np.ndarray, "k"] | None = None
    decided: bool = True
    alike: bool = False
    missed: float = 0.0
    rivals: tuple[Camera, ...] = ()

    @property
    def ties_camera(self) -> bool:
        """Whether a loop was closed that tells how far a lap turns: that determines the lens."""
        return bool(self.revisits) and self.decided

    @property
    def focal_by_drift(self) -> float:
        """Logarithm of the focal length that would explain the heading that odometry misses in a lap."""
        return self.missed * _DRIFT_RAD / _DRIFT_OF_LENS_RAD

    @property
    def path_cm(self) -> Float[np.ndarray, "n"]:
        """Length of the path up to each frame; what lies between two parts does not count."""
        steps = np.diff(path_lengths(self.poses), prepend=0.0)
        return np.cumsum(np.where(np.diff(self.part, prepend=0) > 0, 0.0, steps))

    @property
    def laps(self) -> Int[np.ndarray, "n"]:
        """Lap of each frame, from 0."""
        return count_laps(self.path_cm, self.revisits_within_parts)

    @property
    def hanging(self) -> int:
        """Number of frames that revisits hold at one end alone."""
        height_cm = self.camera.mounting.height_cm
        return int(np.sum(hanging(self.poses, self.part, self.revisits, height_cm)))

    @property
    def revisits_within_parts(self) -> list[Revisit]:
        """Revisits between whose visits the drive was recorded without a long gap."""
        return _within_parts(self.part, self.revisits)

    def only(self, chosen: Int[np.ndarray, "m"]) -> SolvedSegment:
        """Return some of its frames, which no revisit joins to the others.

        Args:
            chosen: Their positions in the segment, in ascending order.
        """
        place = np.full(len(self.rows), -1)
        place[chosen] = np.arange(len(chosen))
        t, bundle = self.trajectory, self.bundle
        kept = [r for r in self.revisits if place[r.earlier] >= 0]
        return replace(
            self,
            rows=self.rows[chosen],
            scans=self.scans.only(chosen),
            trajectory=Trajectory(t.poses[chosen], t.factor[chosen], t.match[chosen], t.spread_cm[chosen]),
            open_poses=self.open_poses[chosen],
            poses=self.poses[chosen],
            revisits=[replace(r, earlier=int(place[r.earlier]), later=int(place[r.later])) for r in kept],
            bundle=replace(bundle, poses=bundle.poses[chosen], tilt=bundle.tilt[chosen]),
            part=self.part[chosen],
            keys=None if self.keys is None else place[self.keys][place[self.keys] >= 0],
        )


def _within_parts(part: Int[np.ndarray, "n"], revisits: Sequence[Revisit]) -> list[Revisit]:
    """Those between whose visits no long gap lies."""
    return [r for r in revisits if part[r.earlier] == part[r.later]]


def heading_drift(poses: Float[np.ndarray, "n 3"], revisits: list[Revisit]) -> float:
    """Heading that an open loop misses in one lap, [rad]; from medians over revisits."""
    path, heading = path_lengths(poses), poses[:, 2]
    between = np.array([path[r.later] - path[r.earlier] for r in revisits])
    missed = [heading[r.later] - heading[r.earlier] - r.relative[2] - 2.0 * np.pi * r.turns for r in revisits]
    return float(np.median(missed / between)) * float(np.median(between[of_one_lap(between)]))


def count_laps(path_cm: Float[np.ndarray, "n"], revisits: list[Revisit]) -> Int[np.ndarray, "n"]:
    """Number the laps from 0; a lap is as long as the path between two visits of a place."""
    if not revisits:
        return np.zeros(len(path_cm), dtype=np.int64)
    between_cm = np.array([path_cm[r.later] - path_cm[r.earlier] for r in revisits])
    lap_cm = float(np.median(between_cm[of_one_lap(between_cm)]))
    return (path_cm // lap_cm).astype(np.int64)


@dataclass(frozen=True)
class SegmentSolver:
    """Solves segments: what all of them share.

    Attributes:
        settings: Settings of all stages.
        rng: Source of randomness; every solution draws from it.
        progress: Called with (stage, done, total); stages come again with every start of the camera.
    """

    settings: SlamSettings
    rng: np.random.Generator
    progress: StageProgress | None = None

    def solve(
        self,
        drive: Drive,
        camera: Camera,
        find_camera: bool = False,
        prior_camera: Camera | None = None,
        commands: CommandedMotion | None = None,
    ) -> SolvedSegment:
        """Track one segment, close its loops, and adjust all of it together.

        Args:
            drive: The segment.
            camera: Its camera, or a coarse guess of it.
            find_camera: Adjust the camera too.
            prior_camera: Centre of the camera's priors; None for ``camera``.
            commands: What was commanded; None for what the drive recorded.

        Raises:
            TrackingLostError: If the road shows too few edges.
        """
        if commands is None:
            commands = commands_of(drive, camera.wheelbase_cm)
        view = view_segment(drive, camera, commands, self.settings, self.rng)
        keys = choose_keyframes(view.steps_heights, commands.part)
        tied = tied_frames(commands.part, keys, view.road.shows_road)
        if not len(tied):
            raise TrackingLostError(
                f"{drive.path}: {counted(len(drive), 'frame')} in "
                f"{counted(int(commands.part.max()) + 1, 'part')} between breaks, none with {LEAST_TIED} "
                f"frames that show {LEAST_POINTS} edge points on the road; mapping needs a recording without "
                "breaks"
            )
        if len(tied) < len(drive):
            solved = self.solve(drive.subset(tied), camera, find_camera, prior_camera, commands.only(tied))
            return replace(solved, rows=tied[solved.rows])
        if len(keys) == len(drive):
            view = with_measured_periods(view)
            return _DenseSegment(view, self, find_camera, prior_camera or camera).solve()
        # The keyframes show the step length better: if the car is still slow, they are thinned again.
        between = commands_between(commands, keys)
        solved = self.solve(drive.subset(keys), camera, find_camera, prior_camera, between)
        keys = keys[solved.rows]
        rows = np.flatnonzero(np.isin(commands.part, commands.part[keys]))
        drive, commands = drive.subset(rows), commands.only(rows)
        placed = self.place_between(
            solved, np.searchsorted(rows, keys), view.steps_heights[rows], drive, commands
        )
        return replace(placed, rows=rows)

    def tell(self, stage: str, done: int, total: int) -> None:
        """Report progress, if anybody listens."""
        if self.progress is not None:
            self.progress(stage, done, total)

    def place_between(
        self,
        solved: SolvedSegment,
        keys: Int[np.ndarray, "k"],
        steps: Float[np.ndarray, "n"],
        drive: Drive,
        commands: CommandedMotion,
    ) -> SolvedSegment:
        """Place the frames between keyframes on the keyframes' map, and adjust all of them together.

        Args:
            solved: The keyframes' segment.
            keys: The keyframes.
            steps: Rough step length of every frame, in any unit.
            drive: All frames.
            commands: What was commanded in all frames.
        """
        camera, settings = solved.camera, self.settings
        height = camera.mounting.height_cm
        road = view_road(drive, camera, settings, keys)
        poses = poses_between(solved.poses, keys, steps)
        revisits = [
            replace(r, earlier=int(keys[r.earlier]), later=int(keys[r.later])) for r in solved.revisits
        ]
        part = commands.part
        pairs = keyframe_pairs(keys, settings.bundle.lags, part)
        if revisits:
            # Revisits that the keyframes' map contradicts would pull again.
            inliers = inlier_revisits(poses, revisits, height)
            pairs += loop_pairs(inliers, part) + neighbouring_laps(poses, height, settings.revisits)
        start = BundleEstimate(poses, values_between(solved.bundle.tilt, keys, steps), camera)
        self.tell(_ADJUST, 0, 1)
        bundle = adjust(road.observed(commands), start, settings.bundle, self.rng, (), pairs)
        self.tell(_ADJUST, 1, 1)
        opened, t = poses_between(solved.open_poses, keys, steps), solved.trajectory
        # The match of a keyframe stands for the frames before it.
        after = np.searchsorted(keys, np.arange(len(drive)))
        return replace(
            solved,
            rows=np.arange(len(drive)),
            scans=road.scans(camera, bundle.tilt),
            trajectory=Trajectory(
                poses_between(t.poses, keys, steps), t.factor[after], t.match[after], t.spread_cm[after]
            ),
            open_poses=opened if revisits else bundle.poses,
            poses=bundle.poses,
            steering=fit_steering(opened, commands, height),
            revisits=revisits,
            bundle=replace(bundle, sigma=solved.bundle.sigma),
            part=part,
            keys=keys,
        )


@dataclass(frozen=True, eq=False)
class _Closure:
    """Loops that were closed with some revisits, the adjusted map, and the road that its camera sees.

    Attributes:
        decided: Whether its revisits tell how far a lap turns.
        alike: Whether they do not tell how long it is.
    """

    revisits: list[Revisit]
    bundle: BundleResult
    road: RoadView
    decided: bool = True
    alike: bool = False


def _go_around_alike(path_cm: Float[np.ndarray, "n"], one: list[Revisit], other: list[Revisit]) -> bool:
    """Whether the laps by two sets of revisits are alike, or those of one are several of the other.

    Args:
        path_cm: Length of the open loop up to each frame.
        one: Revisits.
        other: Others.
    """
    laps = []
    for revisits in (one, other):
        between_cm = np.array([path_cm[r.later] - path_cm[r.earlier] for r in revisits])
        once, turns = of_one_lap(between_cm), np.array([r.turns for r in revisits])
        laps.append((float(np.median(between_cm[once])), float(np.median(turns[once]))))
    (short_cm, short_turns), (long_cm, long_turns) = sorted(laps)
    times = max(round(long_cm / short_cm), 1)
    as_long = bool(abs(np.log(long_cm / (times * short_cm))) < _OTHER_LAP)
    return as_long and long_turns == times * short_turns


def shared_misfits(bundles: Sequence[BundleResult]) -> list[float]:
    """Mean robust loss per point in view, over the pairs of frames that all of some adjustments compare."""
    sums = []
    for bundle in bundles:
        found: dict[tuple[int, int], Float[np.ndarray, "2"]] = {}
        ends = np.sort(bundle.pairs, axis=1).tolist()
        for (a, b), *values in zip(ends, bundle.loss.tolist(), bundle.in_view.tolist(), strict=True):
            found[a, b] = found.get((a, b), np.zeros(2)) + values
        sums.append(found)
    shared = set(sums[0]).intersection(*sums[1:])
    totals = [sum((found[pair] for pair in shared), np.zeros(2)) for found in sums]
    return [float(loss / max(in_view, 1.0)) for loss, in_view in totals]


def _pairs(revisits: list[Revisit]) -> tuple[tuple[int, int], ...]:
    """Which frames some revisits join."""
    return tuple(sorted((r.earlier, r.later) for r in revisits))


def _together(matched: list[Revisit], closed: list[Revisit]) -> list[Revisit]:
    """All candidates, with those that were found since by their place."""
    known = {(r.earlier, r.later) for r in matched}
    return matched + [r for r in closed if (r.earlier, r.later) not in known]


class _DenseSegment:
    """A drive that is tracked by all of its frames."""

    def __init__(
        self, view: SegmentView, solver: SegmentSolver, find_camera: bool, prior_camera: Camera
    ) -> None:
        self.view, self.solver = view, solver
        self.find_camera = find_camera
        self.adjust = partial(
            adjust, settings=solver.settings.bundle, rng=solver.rng, prior_camera=prior_camera
        )
        self.revisit_settings = solver.settings.revisits
        self.height = view.camera.mounting.height_cm
        self.free = _OPEN_LOOP if find_camera else ()
        self.observed = view.road.observed(view.commands)
        self.part = view.commands.part

    def solve(self) -> SolvedSegment:
        """Take the drive through all stages."""
        view, solver = self.view, self.solver

        def followed(done: int, total: int) -> None:
            # Of two looks at each frame: a share says more than their sum.
            solver.tell("follow the drive, %", 100 * done // total, 100)

        trajectory, steering = track(view, solver.settings, solver.rng, followed)
        solver.tell(_ADJUST, 0, 3)
        opened = self.open_loop(BundleEstimate.level(trajectory.poses, view.camera))
        solver.tell(_ADJUST, 1, 3)
        matched = self.find_revisits(opened)
        rivals = self.closures(opened, matched)
        solver.tell(_ADJUST, 2, 3)
        if self.find_camera:
            rivals = [self.adjust_with_camera(one, _together(matched, one.revisits)) for one in rivals]
        likely = self.likeliest_first(rivals, opened)
        closure = likely[0] if likely else None
        bundle, road = (opened, view.road) if closure is None else (closure.bundle, closure.road)
        solver.tell(_ADJUST, 3, 3)
        return SolvedSegment(
            rows=np.arange(len(view.drive)),
            camera=bundle.camera,
            scans=road.scans(bundle.camera, bundle.tilt),
            trajectory=trajectory,
            open_poses=opened.poses,
            poses=bundle.poses,
            steering=steering,
            revisits=[] if closure is None else closure.revisits,
            bundle=bundle,
            part=self.part,
            decided=closure is None or closure.decided,
            alike=closure is not None and closure.alike,
            missed=0.0 if closure is None else self.missed(closure, opened, _DRIFT_RAD),
            rivals=tuple(one.bundle.camera for one in likely[1:]),
        )

    def open_loop(self, start: BundleEstimate) -> BundleResult:
        """Adjust the drive without closing loops.

        Edges meet the nearest ones of the other image, so that one adjustment moves a turn that is off by a
        degree a frame by a part of it only. With a camera that is yet to be found it starts far off, and a
        path that is bent still closes on the wrong corner: it is repeated until the turn of a lap stays.
        """
        opened = self.adjust(self.observed, start, free=self.free)
        for _ in range(_MOST_REPEATED if self.find_camera else 0):
            before = opened.poses[-1, 2] - opened.poses[0, 2]
            opened = self.adjust(self.observed, opened, free=self.free)
            turn = opened.poses[-1, 2] - opened.poses[0, 2]
            if abs(turn - before) < _STAYS_RAD * max(abs(turn) / (2.0 * np.pi), 1.0):
                break
        return opened

    def find_revisits(self, opened: BundleResult) -> list[Revisit]:
        """Propose pairs of frames that look alike, and align each with the map around the earlier one."""
        s, periods = self.revisit_settings, self.view.commands.periods
        pairs = propose_revisits(thumbnails(self.view.drive), opened.poses, periods, self.height, s)
        matcher, rng = self.place_matcher(opened), self.solver.rng
        turned = propose_turned(opened.poses, self.part, self.height, s)
        return matcher.matched(pairs, rng) + matcher.turned(turned, rng)

    def place_matcher(self, opened: BundleResult) -> PlaceMatcher:
        """Aligns visits of a place by the edges that the open loop maps around each."""
        scans = self.view.road.scans(opened.camera, opened.tilt)
        return PlaceMatcher(scans, opened.poses, self.part, self.view.camera, self.revisit_settings)

    def closures(self, opened: BundleResult, matched: list[Revisit]) -> list[_Closure]:
        """Close the loops with each set of revisits that may be true.

        Returns:
            The likeliest one of those that go around alike; the likeliest of the others too where the camera
            is yet to be found, since a wrong camera makes up for much.
        """
        found: list[_Closure] = []
        tried: set[tuple[tuple[int, int, int], ...]] = set()
        least = self.revisit_settings.min_revisits

        def try_first(rivals: Sequence[list[Revisit]]) -> None:
            """Close the loops with the first set of a group that fits."""
            for group in rivals:
                grown = self.grown(opened.poses, group, matched)
                # The same pairs with other whole turns between them are another way around.
                key = tuple(sorted((r.earlier, r.later, r.turns) for r in grown))
                if key in tried or len(grown) < least:
                    continue
                tried.add(key)
                closure = self.try_closure(grown, opened)
                if closure is not None:
                    found.append(closure)
                    break

        for rivals in self.sets_to_try(opened.poses, matched):
            try_first(rivals)
        if self.find_camera:
            for group in self.otherwise(opened.poses, matched, found):
                try_first([group])
        path_cm = path_lengths(opened.poses)
        chosen: list[_Closure] = []
        for one in sorted(found, key=lambda closure: self.cost(closure, closure.bundle.misfit, opened)):
            if not any(_go_around_alike(path_cm, one.revisits, other.revisits) for other in chosen):
                chosen.append(one)
        if self.find_camera:
            costs = self.costs(chosen, opened)
            order = np.argsort(costs)[:_MOST_WAYS]
            chosen = [chosen[k] for k in order if costs[k] <= min(costs) + 2.0 * _NEAR]
        else:
            chosen = chosen[:1]
        return [self.confirmed_closure(one, opened, matched) for one in chosen]

    def confirmed_closure(self, closure: _Closure, opened: BundleResult, matched: list[Revisit]) -> _Closure:
        """Close the loops again where the adjusted map tells better which revisits are true.

        Those that it contradicts still pull.
        """
        confirmed = self.spread_out(opened, closure, matched)
        few = len(confirmed) < self.revisit_settings.min_revisits
        if few or _pairs(confirmed) == _pairs(closure.revisits):
            return closure
        return self.try_closure(confirmed, opened) or closure

    def spread_out(self, opened: BundleResult, closure: _Closure, matched: list[Revisit]) -> list[Revisit]:
        """Revisits that a closed map confirms, and more along the sections that none of them holds.

        These sections are bent by the drift of the open loop, the more, the further from a revisit: each
        round of close ones brings the next within reach.
        """
        matcher, rng = self.place_matcher(opened), self.solver.rng
        periods, s = self.view.commands.periods, self.revisit_settings
        poses, pool = closure.bundle.poses, list(matched)
        confirmed = self.confirmed(poses, pool)
        alike = _pairs(matched)
        tried = set(alike)
        for _ in range(_MOST_SPREAD):
            pairs = [p for p in propose_beside(poses, periods, confirmed, self.height, s) if p not in tried]
            found = matcher.matched(pairs, rng, poses)
            tried.update(pairs)
            if not found:
                break
            pool += found
            grown = self.confirmed(poses, pool)
            agreeing = _pairs(without_contradicted(opened.poses, grown, self.height))
            # Those whose images are alike are true without the odometry's word.
            confirmed = [r for r in grown if (r.earlier, r.later) in {*alike, *agreeing}]
            poses, _ = close_loops(opened.poses, confirmed, self.height, periods)
        return confirmed

    def sets_to_try(
        self, poses: Float[np.ndarray, "n 3"], matched: list[Revisit]
    ) -> Iterator[list[list[Revisit]]]:
        """Sets of revisits that may be true together; of each group, the first that fits is enough."""
        s = self.revisit_settings
        for explained, _ in consistent_revisits(poses, matched, s):
            supported = with_supported(poses, explained, matched, self.height, s)
            # Neighbours may support more than the drift explains. Where these do not fit, the explained may.
            groups = [supported, explained] if len(supported) > len(explained) else [supported]
            yield [self.uncontradicted(poses, group) for group in groups]
        alike = [r for r in matched if not r.faces]
        placing = [placing_revisits(poses, self.part, some, self.height) for some in (matched, alike)]
        yield [one for one in placing if len(one) >= s.min_revisits]
        # A wrong camera bends the open loop: then true revisits explain each other better than it does.
        if len(matched) >= s.min_revisits:
            yield [[replace(r, turns=whole_turns(poses, r)) for r in matched]]

    def otherwise(
        self, poses: Float[np.ndarray, "n 3"], matched: list[Revisit], found: list[_Closure]
    ) -> Iterator[list[Revisit]]:
        """Sets of revisits that no closure explains, and that may close the loops another way around.

        Where all corners look alike, most revisits are wrong; those between whose visits the path is as long
        share one mistake.
        """
        known = {(r.earlier, r.later) for one in found for r in one.revisits}
        left = [r for r in _within_parts(self.part, matched) if (r.earlier, r.later) not in known]
        for together in of_one_length(poses, left, self.revisit_settings):
            for explained, _ in consistent_revisits(poses, together, self.revisit_settings):
                yield self.uncontradicted(poses, explained)

    def uncontradicted(self, poses: Float[np.ndarray, "n 3"], revisits: list[Revisit]) -> list[Revisit]:
        """Leave out revisits that those beside them contradict, unless too few would be left."""
        left = without_contradicted(poses, revisits, self.height)
        return left if len(left) >= self.revisit_settings.min_revisits else revisits

    def cost(self, closure: _Closure, misfit: float, opened: BundleResult) -> float:
        """Negative log likelihood of a closure with some misfit per point in view."""
        return len(self.part) * misfit + closure.bundle.prior + self.beside_images(closure, opened)

    def beside_images(self, closure: _Closure, opened: BundleResult) -> float:
        """Negative log likelihood of a closure's revisits, and of the heading that odometry misses in a lap.

        A lap with five corners instead of four may look alike in all frames; the odometry knows better. It
        knows less where a gap was bridged, and where its camera was another one. And a car that was turned
        round or lifted goes on near where it was.
        """
        group, breaks = connected(self.part, closure.revisits), np.flatnonzero(np.diff(self.part))
        breaks = breaks[group[breaks] == group[breaks + 1]]
        moved = carried(closure.bundle.poses, breaks, self.height)
        joins = len(np.unique(self.part)) - len(np.unique(group))
        within = len(_within_parts(self.part, closure.revisits))
        other = float(np.log(closure.bundle.camera.K[0, 0] / opened.camera.K[0, 0]))
        drift_rad = float(np.hypot(_DRIFT_RAD, _DRIFT_OF_LENS_RAD * other))
        missed = self.missed(closure, opened, drift_rad)
        odometry = 0.5 * missed**2 + float(np.log(drift_rad / _DRIFT_RAD))
        return odometry + moved - JOINED * joins - _EXPLAINED * within

    def missed(self, closure: _Closure, opened: BundleResult, drift_rad: float) -> float:
        """Heading that odometry misses in a lap of a closure, in sigmas, of which its drift is one part."""
        within = _within_parts(self.part, closure.revisits)
        if not within:
            return 0.0
        periods = self.view.commands.periods
        laps = max(float(np.ptp(opened.poses[:, 2])) / (2.0 * np.pi), 1.0)
        gaps = float(np.sum((periods > 1.0) & (periods <= MOST_BRIDGED))) / laps
        return abs(heading_drift(opened.poses, within)) / float(np.hypot(drift_rad, gaps**0.5 * _GAP_RAD))

    def costs(self, rivals: Sequence[_Closure], opened: BundleResult) -> list[float]:
        """Negative log likelihoods of closures that go around by other ways.

        What counts is how well the pairs of frames agree that each of them compares, how unlike ordinary ones
        the camera is that it needs, and what counts beside images. The motion's priors do not: of the closure
        that ties the most laps they expect too much. On a circle every way around may do, with a camera for
        each.
        """
        if not rivals:
            return []
        agree = shared_misfits([one.bundle for one in rivals])
        return [self.cost(one, misfit, opened) for one, misfit in zip(rivals, agree, strict=True)]

    def likeliest_first(self, rivals: Sequence[_Closure], opened: BundleResult) -> list[_Closure]:
        """Order closures that go around by other ways by their likelihood, and note what the first tells."""
        if not rivals or not self.find_camera:
            return list(rivals)
        costs = self.costs(rivals, opened)
        best, *others = np.argsort(costs).tolist()
        near = [rivals[k].bundle.camera for k in (best, *others) if costs[k] <= costs[best] + _NEAR]
        chosen = rivals[best].bundle
        camera = chosen.camera
        apart = {
            "focal": max(abs(float(np.log(one.K[0, 0] / camera.K[0, 0]))) for one in near),
            "pitch": max(abs(one.mounting.pitch_down_rad - camera.mounting.pitch_down_rad) for one in near),
        }
        # The lens is known no better than those agree that explain the images as well.
        spanning = chosen.sigma | {name: max(chosen.sigma[name], most) for name, most in apart.items()}
        closure = replace(rivals[best], bundle=replace(chosen, sigma=spanning))
        return [self.with_told(closure, opened), *(rivals[k] for k in others)]

    def with_told(self, closure: _Closure, opened: BundleResult) -> _Closure:
        """Note what its revisits tell: places beside them match worse than their own.

        All along a circle they match as well, with any lap. Along a straight they do, too, but with laps that
        turn alike, which is what the lens depends on.
        """
        matcher, path, heading = self.place_matcher(opened), path_lengths(opened.poses), opened.poses[:, 2]
        decided = False
        for r in closure.revisits:
            turned: list[float] = []
            for beside in _BESIDE_HEIGHTS:
                at_cm = path[r.earlier] + np.array([-1.0, 1.0]) * beside * self.height
                at = np.searchsorted(path, at_cm[at_cm >= 0.0])
                pairs = [(int(k), r.later) for k in at if k < r.later]
                found = matcher.matched(pairs, self.solver.rng)
                alike = [other.earlier for other in found if other.match >= _TELLS * r.match]
                if not alike:
                    return replace(closure, decided=True, alike=False)
                turned += np.abs(heading[alike] - heading[r.earlier]).tolist()
            decided = decided or max(turned) < _STRAIGHT_RAD
        return replace(closure, decided=decided, alike=True)

    def grown(
        self, poses: Float[np.ndarray, "n 3"], revisits: list[Revisit], matched: list[Revisit]
    ) -> list[Revisit]:
        """Close the loops with what the closed poses confirm and what places more parts, in rounds."""
        revisits = joined_twice(poses, self.part, revisits, self.height)
        for _ in range(_MOST_GROWTH):
            closed, _ = close_loops(poses, revisits, self.height, self.view.commands.periods)
            confirmed = self.confirmed(closed, matched)
            if len(confirmed) < self.revisit_settings.min_revisits or _pairs(confirmed) == _pairs(revisits):
                break
            revisits = confirmed
        return revisits

    def confirmed(self, poses: Float[np.ndarray, "n 3"], matched: list[Revisit]) -> list[Revisit]:
        """Revisits that a closed map confirms, and those that place parts on it that it lacks."""
        turned = [replace(r, turns=whole_turns(poses, r)) for r in matched]
        inliers = joined_twice(poses, self.part, inlier_revisits(poses, turned, self.height), self.height)
        group = connected(self.part, inliers)
        placing = placing_revisits(poses, group, turned, self.height)
        return sorted([*inliers, *placing], key=lambda r: (r.later, r.earlier))

    def try_closure(self, revisits: list[Revisit], opened: BundleResult) -> _Closure | None:
        """Close the loops with these revisits; None where they do not meet, or the frames agree less."""
        poses, missed = close_loops(opened.poses, revisits, self.height, self.view.commands.periods)
        along, across = np.median(np.abs(missed[:, :2]), axis=0) / self.height
        if not (along < MAX_MISSED[0] and across < MAX_MISSED[1]):
            return None
        loops = loop_pairs(revisits, self.part)
        start = replace(opened, poses=poses)
        # Without its lens, a wrong camera would refuse the true closure, and a false one bends with less.
        free = CAMERA_NAMES if self.find_camera else ()
        closed = self.adjust(self.observed, start, free=free, loops=loops, with_sigma=False)
        # Loops add pairs, which agree less than neighbours; those may not agree less than they did.
        after, before = shared_misfits([closed, opened])
        return _Closure(revisits, closed, self.view.road) if after < MAX_MISFIT * before else None

    def adjust_with_camera(self, closure: _Closure, matched: list[Revisit]) -> _Closure:
        """Adjust all of the camera with the poses, in rounds: another camera sees other edges on the road."""
        drive, revisits, bundle = self.view.drive, closure.revisits, closure.bundle
        tilting = self.solver.settings.bundle.with_free_tilt()
        for number in range(_MAX_CAMERA_ROUNDS):
            road = view_road(drive, bundle.camera, self.solver.settings)
            before = bundle.camera.K[0, 0]
            revisits = self.confirmed(bundle.poses, matched)
            loops = loop_pairs(revisits, self.part)
            loops += neighbouring_laps(bundle.poses, self.height, self.revisit_settings)
            settings = tilting.going_on() if number else tilting
            bundle = self.adjust(road.observed(self.view.commands), bundle, settings=settings, loops=loops)
            if abs(bundle.camera.K[0, 0] / before - 1.0) < _SETTLED:
                break
        # With the camera known, frames are nearly level again.
        settings, observed = self.solver.settings.bundle.going_on(), road.observed(self.view.commands)
        settled = self.adjust(observed, bundle, settings=settings, free=(), loops=loops)
        return _Closure(revisits, replace(settled, sigma=bundle.sigma), road)
