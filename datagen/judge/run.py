"""One run: an entrant drives one road and is measured: wheels over a line, offsets, steering, answers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from datagen.judge.settings import JudgeSettings, Road
from datagen.world.car.driver import (
    DetectorPilot,
    DriverPilot,
    Pilot,
    PilotSettings,
    TruePointsPilot,
    control_settings,
)
from datagen.world.road.track import Track
from datagen.world.simulate import ClosedLoop, LoopFrame
from datagen.world.variety import tightest_bend_cm
from datagen.world.world import World, assemble_world
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car, wrap_angle
from lanenet.perception.estimate import Detector

#: How far inside all wheels must be before the next departure counts; chosen: half a tape.
_BACK_INSIDE_CM = 1.0


def wheel_offsets_cm(
    track: Track, pose: Float[np.ndarray, "3"], wheelbase_cm: float, track_width_cm: float, near_s_cm: float
) -> Float[np.ndarray, "4"]:
    """Return the offsets of the wheels' contact points from the lane's centre, [cm], left positive.

    Args:
        track: The road.
        pose: Rear-axle centre x, y and heading, frame map.
        wheelbase_cm: Distance between the axles.
        track_width_cm: Distance between the contact points of an axle.
        near_s_cm: Place of the car along the road.

    Returns:
        Front left, front right, rear left, rear right.
    """
    half_cm = 0.5 * track_width_cm
    wheels_cm = np.array(
        [[-half_cm, 0.0], [half_cm, 0.0], [-half_cm, -wheelbase_cm], [half_cm, -wheelbase_cm]]
    )
    places_cm = map_from_car(wheels_cm, pose, wheelbase_cm)
    return np.array([track.nearest(place_cm, near_s_cm)[1] for place_cm in places_cm])


class DepartureCounter:
    """Counts how often a wheel crosses the middle of a line; out and back is one departure.

    Attributes:
        count: Departures so far.
        over: Whether the car is out: until all its wheels are 1 cm inside again, so that a wheel that runs
            along the line does not count with every frame.
    """

    def __init__(self, lane_width_cm: float) -> None:
        """Start inside."""
        self.count, self.over = 0, False
        self._half_cm = 0.5 * lane_width_cm

    def update(self, offsets_cm: Float[np.ndarray, "wheels"]) -> bool:
        """Take the wheels' offsets of the next frame; return whether the car is out."""
        if float(np.max(np.abs(offsets_cm))) > self._half_cm:
            self.count += not self.over
            self.over = True
        elif self.well_inside(offsets_cm):
            self.over = False
        return self.over

    def well_inside(self, offsets_cm: Float[np.ndarray, "wheels"]) -> bool:
        """Return whether all wheels are inside by as much as ends a departure."""
        return float(np.max(np.abs(offsets_cm))) < self._half_cm - _BACK_INSIDE_CM


#: Makes a detector for a camera, a lane width and a width of the markings, both in cm.
BuildDetector = Callable[[Camera, float, float | None], Detector]

#: The scripted driver, who is given the true pose, and the steering law, given the true points.
TRUTH, TRUE_POINTS = "truth", "true-points"

#: A car that faces further away from the road has left the lane; chosen: no bend is driven at 70 degrees.
_FACING_AWAY_RAD = 1.2
#: A car that started across is back in its lane when, for this time, all its wheels have been inside by as
#: much as ends a departure, and it has faced along the road within this angle. Chosen: half a second is no
#: swing through the lane, and 10 degrees are a correction like others.
_BACK_FOR_S, _BACK_WITHIN_RAD = 0.5, math.radians(10.0)
_SAME_TIME_S = 1e-6
#: Such a start is where the road turns, over this distance, by no more than this share of what the car can.
#: Chosen: 30 degrees are turned in 40 cm, delay included; outwards in a bend that takes the full lock, no
#: driver comes back from them.
_GENTLE_CM, _GENTLE_SHARE = 50.0, 0.25
#: A car that has not gone this far for ``stuck_s`` is stuck.
_MOVED_CM = 5.0
#: How far ahead a car that is stuck is put back: past what stopped it.
_AHEAD_OF_STUCK_CM = 50.0
#: An open road is driven to here before its end: further on there is not enough road in sight.
_BEFORE_THE_END_CM = 60.0


@dataclass(frozen=True)
class Entrant:
    """Who takes part.

    Attributes:
        name: In tables and file names.
        build: Makes its detector; None for those that get the ground truth.
        identity: Hash of files that its answers depend on, beside the settings.
    """

    name: str
    build: BuildDetector | None = None
    identity: str = ""


@dataclass(frozen=True)
class RunResult:
    """How one run went.

    Attributes:
        entrant: Who drove.
        kind: Kind of road.
        number: Number of the road among its kind.
        seed: Of the world.
        completed: Whether the whole distance was driven, put back or not.
        ended: Why the run ended: ``completed``, ``left the lane``, ``stuck`` or ``out of time``.
        laps: Driven; of an open road the driven share.
        departures: How often a wheel went over a line, but not while a start across was being corrected;
            a car that was lost in the meantime has departed once.
        put_backs: How often the car had to be put back.
        mean_offset_cm: Mean distance of the front axle's middle from the lane's centre.
        worst_offset_cm: Largest such distance.
        steering_rms_rad_s: Root mean square of the change of the commanded steering per second.
        unanswered: Share of the frames without an answer.
        frames: Number of frames.
        time_s: Time driven.
        across_deg: By how much the car was turned in its lane at the start, positive left.
        back: Whether it came back into its lane after such a start, without being put back and in time; true
            where it started straight.
        back_after_s: Time until it was back, or until it was clear that it would not be.
    """

    entrant: str
    kind: str
    number: int
    seed: int
    completed: bool
    ended: str
    laps: float
    departures: int
    put_backs: int
    mean_offset_cm: float
    worst_offset_cm: float
    steering_rms_rad_s: float
    unanswered: float
    frames: int
    time_s: float
    across_deg: float = 0.0
    back: bool = True
    back_after_s: float = 0.0

    @property
    def road(self) -> str:
        """Name of the road."""
        return f"{self.kind}_{self.number:02d}"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One run frame by frame.

    Attributes:
        t_s: Time since the start.
        xy_cm: Middle of the front axle, frame map.
        s_cm: Its distance along the road.
        offset_cm: Its offset from the lane's centre, left positive.
        steering_rad: Commanded steering.
        answered: Whether the detector had an answer.
        over: Whether the car was out of its lane, as departures are counted.
        put_back: Whether the car was put back after this frame.
    """

    t_s: Float[np.ndarray, "n"]
    xy_cm: Float[np.ndarray, "n 2"]
    s_cm: Float[np.ndarray, "n"]
    offset_cm: Float[np.ndarray, "n"]
    steering_rad: Float[np.ndarray, "n"]
    answered: Bool[np.ndarray, "n"]
    over: Bool[np.ndarray, "n"]
    put_back: Bool[np.ndarray, "n"]


def drive_run(settings: JudgeSettings, road: Road, entrant: Entrant) -> tuple[RunResult, Trajectory]:
    """Let an entrant drive a road.

    Args:
        settings: The contest.
        road: The road and its car, see :func:`datagen.judge.settings.contest_roads`.
        entrant: Who drives.
    """
    world, across_deg = assemble_world(road.simulation), road.across_deg(settings)
    if across_deg:
        driver = world.driver
        driver.s_cm = gentle_start_cm(world.track, tightest_bend_cm(world.settings.car), driver.s_cm)
        world.car.place(driver.pose_at(driver.s_cm, slope=math.tan(math.radians(across_deg))))
    loop = ClosedLoop(world, build_pilot(world, entrant, settings.pilot), settings.pilot, settings.speed_cm_s)
    referee = _Referee(settings, road, world, loop.s_cm)
    rate_hz = road.simulation.rate_hz
    most_frames = math.ceil(settings.slack * referee.distance_cm / settings.speed_cm_s * rate_hz)
    ended = "out of time"
    for _ in range(most_frames):
        lost = referee.look(loop.next_frame())
        if referee.share == 1.0:
            ended = "completed"
            break
        if lost and not settings.put_back:
            ended = lost
            break
        if lost:
            loop.put_back(_AHEAD_OF_STUCK_CM if lost == "stuck" else 0.0)
            referee.put_back(loop.s_cm)
    trajectory = referee.trajectory()
    result = RunResult(
        entrant=entrant.name,
        kind=road.kind,
        number=road.number,
        seed=road.simulation.seed,
        completed=ended == "completed",
        ended=ended,
        laps=referee.share * referee.laps,
        departures=referee.wheels.count,
        put_backs=int(trajectory.put_back.sum()),
        mean_offset_cm=float(np.abs(trajectory.offset_cm).mean()),
        worst_offset_cm=float(np.abs(trajectory.offset_cm).max()),
        steering_rms_rad_s=_steering_rms_rad_s(trajectory, rate_hz),
        unanswered=float(1.0 - trajectory.answered.mean()),
        frames=len(trajectory.t_s),
        time_s=float(trajectory.t_s[-1]),
        across_deg=across_deg,
        back=referee.start.back,
        back_after_s=referee.start.after_s,
    )
    return result, trajectory


def gentle_start_cm(track: Track, tightest_cm: float, from_cm: float) -> float:
    """Return where a car that starts across its lane can come back into it.

    Args:
        track: The road.
        tightest_cm: Smallest radius that the car can follow.
        from_cm: Earliest place along the road.

    Returns:
        The first place in the half road from there on whose next 50 cm turn by no more than a quarter of what
        the car can; the gentlest place if there is none.
    """
    turns_rad = np.abs(wrap_angle(np.diff(track.heading_rad, append=track.heading_rad[:1])))
    if not track.closed:
        turns_rad[-1] = 0.0
    ahead = max(1, round(_GENTLE_CM / track.step_cm))
    sums_rad = np.concatenate([[0.0], np.cumsum(np.concatenate([turns_rad, turns_rad[: ahead - 1]]))])
    turned_rad = sums_rad[ahead:] - sums_rad[:-ahead]
    reach = np.flatnonzero((track.s_cm >= from_cm) & (track.s_cm <= from_cm + 0.5 * track.length_cm))
    gentle = reach[turned_rad[reach] <= _GENTLE_SHARE * _GENTLE_CM / tightest_cm]
    first = gentle[0] if len(gentle) else reach[np.argmin(turned_rad[reach])]
    return max(from_cm, float(track.s_cm[first]))


class StartWatch:
    """Watches a car that started across its lane until it is back, or cannot be any more.

    Attributes:
        open: Whether it is neither.
        back: Whether it is back in its lane.
        after_s: Time since the start at which it was back; while it is not, the last time.
    """

    def __init__(self, across: bool, within_s: float) -> None:
        """Start; a car that does not start across is back at once."""
        self.open, self.back, self.after_s = across, not across, 0.0
        self._within_s = within_s
        self._since_s: float | None = None

    def update(self, t_s: float, inside: bool, straight: bool) -> None:
        """Take the next frame.

        Args:
            t_s: Time since the start.
            inside: Whether all wheels are well inside the lane.
            straight: Whether the car faces along the road.
        """
        self.after_s = t_s
        if not (inside and straight):
            self._since_s = None
            self.open = t_s < self._within_s
            return
        self._since_s = t_s if self._since_s is None else self._since_s
        if t_s - self._since_s > _BACK_FOR_S - _SAME_TIME_S:
            self.open, self.back, self.after_s = False, True, self._since_s


class _Referee:
    """Watches a run: where the car is, whether its wheels are out, whether it is lost.

    Attributes:
        distance_cm: To be driven.
        laps: That distance in laps; of an open road its share.
        share: Of the distance, driven so far.
        wheels: Counts the departures.
        start: Watches a start across the lane.
    """

    def __init__(self, settings: JudgeSettings, road: Road, world: World, start_cm: float) -> None:
        self._settings, self._track, self._driver = settings, world.track, world.driver
        self._wheelbase_cm, self._track_width_cm = world.settings.car.wheelbase_cm, road.track_width_cm
        length_cm, laps = world.track.length_cm, settings.laps if world.track.closed else 1
        if world.track.closed:
            whole_cm = laps * length_cm
        else:
            whole_cm = max(length_cm - _BEFORE_THE_END_CM - start_cm, 1.0)
        self.distance_cm = min(whole_cm, settings.distance_cm or whole_cm)
        self.laps = laps * self.distance_cm / whole_cm
        self.share = 0.0
        self.wheels = DepartureCounter(world.track.lane_width_cm)
        self.start = StartWatch(settings.start_across_deg > 0.0, settings.back_within_s)
        self._start_cm, self._moved_at_s, self._moved_to_cm = start_cm, 0.0, start_cm
        self._rows: list[list[float]] = []

    def look(self, frame: LoopFrame) -> str:
        """Take a frame; return why the car cannot recover, or an empty text."""
        state, lost = frame.state, self._lost(frame)
        over = self._over(frame, lost)
        front_cm = map_from_car(np.zeros((1, 2)), state.pose, self._wheelbase_cm)[0]
        flags = [float(frame.answered), float(over), 0.0]
        numbers = [state.t_s, *map(float, front_cm), frame.s_cm, frame.offset_cm, state.steering_rad]
        self._rows.append(numbers + flags)
        self.share = min(max((frame.s_cm - self._start_cm) / self.distance_cm, 0.0), 1.0)
        return lost

    def _lost(self, frame: LoopFrame) -> str:
        state, settings, track = frame.state, self._settings, self._track
        if abs(frame.s_cm - self._moved_to_cm) > _MOVED_CM:
            self._moved_at_s, self._moved_to_cm = state.t_s, frame.s_cm
        away_rad = math.remainder(float(state.pose[2]) - track.point(frame.s_cm)[1], 2.0 * math.pi)
        outside = abs(frame.offset_cm) > settings.off_lane_share * track.lane_width_cm
        if outside or abs(away_rad) > _FACING_AWAY_RAD:
            return "left the lane"
        return "stuck" if state.t_s - self._moved_at_s > settings.stuck_s else ""

    def _over(self, frame: LoopFrame, lost: str) -> bool:
        """Return whether the car is out of its lane; a start across is given time."""
        pose = frame.state.pose
        offsets_cm = wheel_offsets_cm(self._track, pose, self._wheelbase_cm, self._track_width_cm, frame.s_cm)
        if self.start.open:
            # As a car stands that follows the road: in a bend its nose points outwards.
            along_rad = float(self._driver.pose_at(frame.s_cm)[2])
            away_rad = abs(math.remainder(float(pose[2]) - along_rad, 2.0 * math.pi))
            inside = self.wheels.well_inside(offsets_cm)
            self.start.update(frame.state.t_s, inside, away_rad < _BACK_WITHIN_RAD)
            if self.start.open and not lost:
                return False
            self.start.open = False
        return self.wheels.update(offsets_cm)

    def put_back(self, s_cm: float) -> None:
        """The car stands in the lane again, at a place along the road."""
        self._rows[-1][-1] = 1.0
        self._moved_at_s, self._moved_to_cm = self._rows[-1][0], s_cm
        self.wheels.over = False

    def trajectory(self) -> Trajectory:
        """Return the run so far."""
        table = np.array(self._rows)
        flags = (table[:, 6:] > 0.5).T
        return Trajectory(table[:, 0], table[:, 1:3], table[:, 3], table[:, 4], table[:, 5], *flags)


def build_pilot(world: World, entrant: Entrant, settings: PilotSettings) -> Pilot:
    """Return who steers in a world."""
    car, track = world.settings.car, world.track
    control = control_settings(settings, car.wheelbase_cm, car.max_steering_rad, track.lane_width_cm)
    if entrant.build is not None:
        marking_cm = track.markings[0].width_cm if track.markings else None
        detector = entrant.build(world.camera, track.lane_width_cm, marking_cm)
        return DetectorPilot(detector, control)
    return DriverPilot(world.driver) if entrant.name == TRUTH else TruePointsPilot(track, control.steering)


def _steering_rms_rad_s(trajectory: Trajectory, rate_hz: float) -> float:
    """Of the commands of frames between which the car was not put back."""
    change = np.diff(trajectory.steering_rad)[~trajectory.put_back[:-1]] * rate_hz
    return float(np.sqrt(np.mean(change**2))) if change.size else 0.0
