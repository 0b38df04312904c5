"""DP-SLAM as the car drives: the filter alone, a frame at a time, with bounded memory.

No loop is closed and nothing is smoothed: a pose is what is known when its frame has been seen. Where the
recording is interrupted, a new segment begins with a map of its own.

How a car may move to its next frame when only its past is known.

What a live filter takes in and gives out, a frame at a time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from datagen.settings import MapSettings
from datagen.slam.commands import CommandedMotion, SteeringFit, commanded_motion, fit_steering
from datagen.slam.filter.dp_slam import Estimate, ParticleFilter, Survivors, smooth_lineages
from datagen.slam.filter.motion import OFFSET, MotionModel
from datagen.slam.odometry.image_pairs import Pictures
from datagen.slam.odometry.odometry import usual_way
from datagen.slam.odometry.scans import Scans, pack_scans, seen_edges
from datagen.slam.odometry.stillness import StandingWatch, shrink_picture
from datagen.slam.view import mapping_range
from lanenet.config import Settings
from lanenet.data.drives import Drive
from lanenet.data.drives.recording import COMMAND_NAMES, MAX_PAUSE_S, Commands
from lanenet.errors import CalibrationError, DriveFormatError, TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import EdgePixels, check_frame, find_edges
from lanenet.perception.edges.road import RoadEdges, RoadTable

#: Change per frame of the factor on the commands: of a recorded speed, which it nearly is, and, in camera
#: heights, of the usual way where only a throttle is known. A wider walk, or a weaker pull back to what is
#: usual, lets the filter creep: its blurred map likes slow motion.
_KNOWN_WALK, _UNKNOWN_WALK_HEIGHTS, _PULL = 0.005, 0.006, 0.1
_DISTANCE_NOISE = 0.02
#: In camera heights: noise of the curvature, and its bound, so that the heading cannot spin.
_CURVATURE_NOISE_HEIGHTS, _MAX_CURVATURE_HEIGHTS = 0.01, 0.8
#: Walk of the curvature's offset, in camera heights, and share of it that is forgotten per frame: with a
#: prediction from the steering there is little left for it.
_OFFSET_WALK_HEIGHTS, _PREDICTED_OFFSET_WALK_HEIGHTS, _PREDICTED_OFFSET_DECAY = 0.012, 0.004, 0.02


def live_motion(
    commands: CommandedMotion,
    curvature_per_cm: Float[np.ndarray, "n"] | None,
    factor: float,
    height_cm: float,
) -> MotionModel:
    """Return how a car may move that nobody has seen arrive yet.

    Args:
        commands: What was commanded.
        curvature_per_cm: Curvature that the steering predicts; None where it predicts nothing.
        factor: Usual way per unit of the commands, see :class:`datagen.slam.odometry.odometry.UsualWay`.
        height_cm: Of the camera.
    """
    predicted = curvature_per_cm is not None
    walk = _PREDICTED_OFFSET_WALK_HEIGHTS if predicted else _OFFSET_WALK_HEIGHTS
    return MotionModel(
        distance_cm=commands.distance_cm,
        curvature_per_cm=np.zeros(len(commands.distance_cm))
        if curvature_per_cm is None
        else curvature_per_cm,
        factor_start=(factor, 0.05 * factor),
        factor_walk=_KNOWN_WALK if commands.speed_known else _UNKNOWN_WALK_HEIGHTS * height_cm,
        factor_pull=_PULL,
        distance_noise=_DISTANCE_NOISE,
        offset_walk_per_cm=walk / height_cm,
        offset_decay=_PREDICTED_OFFSET_DECAY if predicted else 0.0,
        curvature_noise_per_cm=(1.0 if predicted else 2.0) * _CURVATURE_NOISE_HEIGHTS / height_cm,
        max_curvature_per_cm=_MAX_CURVATURE_HEIGHTS / height_cm,
    )


#: Frames in which a speed can be found.
LEAST_START = 60


class StartSettings(Settings):
    """What is known of the car, or is to be found while it sets out.

    Attributes:
        frames: Frames in which the usual speed and how the car answers to the steering are found.
        factor: Gain of a recorded speed; the usual way per frame, [cm], where none is recorded. None finds it
            from the first frames, whose poses come when the last of them has been seen.
    """

    frames: int = Field(default=300, ge=LEAST_START)
    factor: float | None = Field(default=None, gt=0.0)


@dataclass(frozen=True, eq=False)
class Moment:
    """What a car knows at one moment, from a recording or from its camera.

    Attributes:
        frame: Frame number.
        t_s: Time of the frame, rising from moment to moment.
        image: The frame; None where it could not be read.
        commands: What the car is told to do, in one row.
        starts: Whether the frame is known not to follow the one before.
    """

    frame: int
    t_s: float
    image: UInt8[np.ndarray, "h w 3"] | None
    commands: Commands
    starts: bool = False


@dataclass(frozen=True, eq=False)
class LivePose:
    """Pose of a frame, as known when it had been seen.

    Attributes:
        frame: Frame number.
        t_s: Its time.
        segment: Stretch without an interruption, from 0; each has a map of its own.
        estimate: Pose and how sure it is; ``match`` is NaN where the frame was not matched.
        points_cm: Edge points of the frame, frame car; none where the car stands.
    """

    frame: int
    t_s: float
    segment: int
    estimate: Estimate
    points_cm: Float[np.ndarray, "m 2"]


def moments_of(drive: Drive) -> Iterator[Moment]:
    """Replay a recorded drive; a frame that cannot be read comes without its image."""
    for k in range(len(drive)):
        image: UInt8[np.ndarray, "h w 3"] | None
        try:
            image = drive.image(k)
        except DriveFormatError:
            image = None
        commands = drive.commands.subset(np.array([k]))
        yield Moment(int(drive.frames[k]), float(drive.t_s[k]), image, commands, bool(drive.breaks[k]))


_TIMES = 100  # steps of time of which the median is the usual one


@dataclass(frozen=True, eq=False)
class _Seen:
    """A frame's part in the filter: its edges, and what was commanded on the way to it."""

    frame: int
    t_s: float
    pixels: EdgePixels
    edges: Scans
    commands: CommandedMotion


class LiveLocaliser:
    """Poses of a car as it drives, a frame at a time.

    Attributes:
        segment: Number of the stretch that is being driven.
        factor: Usual distance factor (see :class:`MotionModel`); None until it is known.
        steering: How the car answers to the steering; None until it is known.
        unreadable: Frames without an image.
        standing: Frames in which the car stood.
        dropped: Frames of stretches too short to find a speed in.
    """

    def __init__(self, camera: Camera, settings: MapSettings, start: StartSettings) -> None:
        height = camera.mounting.height_cm
        self.camera, self.settings, self.start = camera, settings, start
        self.factor = start.factor
        self.steering: SteeringFit | None = None
        self.segment = self.unreadable = self.standing = self.dropped = 0
        self._table = RoadTable(camera, mapping_range(height, settings.perception.range))
        self._rng = np.random.default_rng(settings.seed)
        self._steps_s: deque[float] = deque(maxlen=_TIMES)
        self._held: dict[str, float] = {}
        self._waiting: list[_Seen] = []
        #: Times of the last frame that was taken, that had an image, and that the filter saw.
        self._t_s = self._t_seen_s = self._t_filtered_s = -np.inf
        self._begin()

    @property
    def map_bytes(self) -> int:
        """Memory of the map."""
        return 0 if self._filter is None else self._filter.map.bytes

    def take(self, moment: Moment) -> list[LivePose]:
        """Take in the next frame.

        Returns:
            The poses that it makes known: its own; none while the speed is being found, or where no frame
            has been readable for a while; those of all frames so far once the speed has been found.

        Raises:
            DriveFormatError: If time goes back.
            CalibrationError: If the image's size is not the camera's.
        """
        if moment.t_s <= self._t_s:
            raise DriveFormatError(f"frame {moment.frame}: time {moment.t_s:g} s after {self._t_s:g} s")
        paused = self._t_seen_s < moment.t_s - MAX_PAUSE_S
        if np.isfinite(self._t_s) and (moment.starts or (paused and moment.image is not None)):
            poses = self.finish()
            self.segment += bool(self._filter is not None)
            self._begin()
        else:
            poses = []
            if np.isfinite(self._t_s):
                self._steps_s.append(moment.t_s - self._t_s)
        self._t_s = moment.t_s
        if moment.image is None:
            self.unreadable += 1
            # Over a gap the motion is predicted, as long as that can be believed.
            return poses if paused else [*poses, *self._follow(self._seen(moment, None))]
        self._t_seen_s = moment.t_s
        stands = self._watch.stands(shrink_picture(self._checked(moment)))
        if stands and (self._filter is not None or self._waiting):
            self.standing += 1
            return poses if self._last is None else [*poses, self._stay(moment)]
        return [*poses, *self._follow(self._seen(moment, moment.image))]

    def finish(self) -> list[LivePose]:
        """End a segment: return the poses of frames that still wait for the speed to be found."""
        waiting = self._waiting
        self._waiting = []
        if len(waiting) < LEAST_START:
            self.dropped += len(waiting)
            return []
        return self._set_out(waiting)

    def check_found(self) -> None:
        """Refuse a drive at whose end nothing is known.

        Raises:
            TrackingLostError: Says how many frames there were, and what helps.
        """
        if self.factor is None:
            raise TrackingLostError(
                f"{self.dropped} frames of a moving car: the usual way per frame is found from "
                f"{LEAST_START} that follow each other at least, or has to be given"
            )

    def _begin(self) -> None:
        """Forget where the car was; what was learned of the car itself stays."""
        self._watch = StandingWatch()
        self._filter: ParticleFilter | None = None
        self._waiting = []
        self._last: LivePose | None = None
        self._history: deque[Survivors] = deque(maxlen=self.start.frames)
        self._ways: deque[float] = deque(maxlen=self.start.frames)
        self._turns: deque[float] = deque(maxlen=self.start.frames)
        self._t_filtered_s = -np.inf

    def _checked(self, moment: Moment) -> UInt8[np.ndarray, "h w 3"]:
        height, width = check_frame(moment.image).shape[:2]  # type: ignore[arg-type]
        if (width, height) != (self.camera.width, self.camera.height):
            raise CalibrationError(
                f"frame {moment.frame}: image of {width}x{height} px, but the camera is for "
                f"{self.camera.width}x{self.camera.height}"
            )
        assert moment.image is not None
        return moment.image

    def _seen(self, moment: Moment, image: UInt8[np.ndarray, "h w 3"] | None) -> _Seen:
        pixels, road = (
            EdgePixels(np.empty((0, 2)), np.empty((0, 2))),
            RoadEdges(np.empty((0, 2)), np.empty((0, 2))),
        )
        if image is not None:
            found = find_edges(image, self.settings.perception.edges, self._table.keep, self._table.scale)
            pixels = seen_edges(found, self._table)
            road = self._table.lift(pixels)
        edges = pack_scans([road], self.camera.mounting.height_cm)
        before = self._t_filtered_s if np.isfinite(self._t_filtered_s) else moment.t_s
        commands = self._commanded(moment, before)
        self._t_filtered_s = moment.t_s
        return _Seen(moment.frame, moment.t_s, pixels, edges, commands)

    def _commanded(self, moment: Moment, before_s: float) -> CommandedMotion:
        """What was commanded on the way from the last frame that the filter saw."""
        rows = {}
        for name in COMMAND_NAMES:
            values = getattr(moment.commands, name)
            if values is None:
                continue
            if np.isfinite(values[0]):
                self._held[name] = float(values[0])
            rows[name] = np.full(2, self._held.get(name, 0.0))
        usual_s = float(np.median(self._steps_s)) if self._steps_s else 1.0
        times = np.array([before_s, moment.t_s])
        both = commanded_motion(Commands(**rows), times, usual_s, self.camera.wheelbase_cm)
        return CommandedMotion(
            both.distance_cm[1:], both.speed_known, None if both.turn is None else both.turn[1:]
        )

    def _follow(self, seen: _Seen) -> list[LivePose]:
        if self.factor is not None:
            return [self._step(seen)]
        self._waiting.append(seen)
        if len(self._waiting) < self.start.frames:
            return []
        waiting = self._waiting
        self._waiting = []
        return self._set_out(waiting)

    def _set_out(self, waiting: list[_Seen]) -> list[LivePose]:
        """Find the usual speed in the frames so far, and run the filter over them."""
        odometry, height = self.settings.odometry, self.camera.mounting.height_cm
        pictures = Pictures([seen.pixels for seen in waiting], self.camera, odometry, self._rng)
        ways = np.concatenate([seen.commands.distance_cm for seen in waiting])
        self.factor = usual_way(pictures, ways, waiting[0].commands.speed_known, height).factor
        return [self._step(seen) for seen in waiting]

    def _step(self, seen: _Seen) -> LivePose:
        motion = self._motion(seen)
        height, wheelbase_cm = self.camera.mounting.height_cm, self.camera.wheelbase_cm
        if self._filter is None:
            self._filter = ParticleFilter(motion, self.settings.filter, height, wheelbase_cm, self._rng)
        edges = seen.edges
        estimate = self._filter.step(edges.points_cm, edges.normals, edges.weights, motion, 0)
        if self.steering is None and self._turns:
            self._learn_steering(seen.commands.speed_known)
        self._last = LivePose(seen.frame, seen.t_s, self.segment, estimate, edges.points_cm)
        return self._last

    def _motion(self, seen: _Seen) -> MotionModel:
        """How the car may have moved to this frame."""
        assert self.factor is not None
        height, curvature = self.camera.mounting.height_cm, None
        if seen.commands.turn is not None:
            self._turns.append(float(seen.commands.turn[0]))
            self._ways.append(float(seen.commands.distance_cm[0]))
        if self.steering is not None and self._turns:
            curvature = np.array([self._predicted()])
        return live_motion(seen.commands, curvature, self.factor, height)

    def _predicted(self) -> float:
        """Curvature that the steering predicts for the last frame, [1/cm]."""
        assert self.steering is not None
        # As long as the delay has not passed, the first command that is known.
        turn = self._turns[max(len(self._turns) - 1 - self.steering.lag_frames, 0)]
        return self.steering.gain * turn + self.steering.trim_per_cm

    def _learn_steering(self, speed_known: bool) -> None:
        """Once enough frames have been seen, find how the car answers to the steering."""
        assert self._filter is not None
        self._history.append(self._filter.survivors)
        if len(self._history) < self.start.frames:
            return
        final = np.bincount(self._filter.survivor_of, self._filter.weights)
        states = smooth_lineages(list(self._history), final)
        n = len(states)
        commands = CommandedMotion(np.array(self._ways)[-n:], speed_known, np.array(self._turns)[-n:])
        self.steering = fit_steering(states[:, :3], commands, self.camera.mounting.height_cm)
        self._history.clear()
        if self.steering is not None:
            # What the steering predicts from now on, the particles need not hold as an offset.
            self._filter.states[:, OFFSET] -= self._predicted()

    def _stay(self, moment: Moment) -> LivePose:
        """Pose of a car that stands where it was."""
        assert self._last is not None
        known = self._last.estimate
        estimate = Estimate(known.pose, known.factor, float("nan"), known.spread_cm)
        return LivePose(moment.frame, moment.t_s, self.segment, estimate, np.empty((0, 2)))
