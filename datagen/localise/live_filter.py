"""DP-SLAM as the car drives: the filter alone, a frame at a time, with bounded memory.

No loop is closed and nothing is smoothed: a pose is what is known when its frame has been seen. Where the
recording is interrupted, a new segment begins with a map of its own.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from datagen.settings import MapSettings
from datagen.slam.commands import CommandedMotion, SteeringFit, commanded_motion, fit_steering
from datagen.slam.filter.dp_slam import Estimate, ParticleFilter, Survivors, smooth_lineages
from datagen.slam.filter.motion import OFFSET, MotionModel
from datagen.slam.odometry.image_pairs import ImagePairs
from datagen.slam.odometry.odometry import typical_step
from datagen.slam.odometry.scans import Scan, pack_scans, seen_edges
from datagen.slam.odometry.stillness import StandstillDetector, shrink_image
from datagen.slam.view import mapping_range
from lanenet.config import Settings
from lanenet.data.drives import Drive
from lanenet.data.drives.recording import COMMAND_NAMES, Commands
from lanenet.errors import CalibrationError, DriveFormatError, TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import check_frame, find_edges
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RoadEdges, RoadTable

#: Frames that are needed to find the typical step: as many as the odometry compares.
LEAST_START = 60
#: After a longer pause a new segment begins: a car at 1 m/s has lost its last frame from sight, and what
#: follows cannot be put beside it while driving.
_MAX_PAUSE_S = 1.0
#: Time steps whose median is the typical one: five seconds at 20 Hz.
_TIMES = 100
#: Walk per frame of the distance factor about a recorded speed, whose gain is nearly 1; in camera heights,
#: about the typical step where only a throttle is known; and the pull back to it. Chosen: with a wider walk
#: or a weaker pull the filter creeps, since its blurred map prefers slow motion.
_KNOWN_WALK, _UNKNOWN_WALK_HEIGHTS, _PULL = 0.005, 0.006, 0.1
#: Relative sigma of the factor at the start, and of each step. Chosen: the first is what the typical step is
#: known to.
_START_SPREAD, _DISTANCE_NOISE = 0.05, 0.02
#: Noise of the curvature, and its bound, so that the heading cannot spin; times camera height. Twice the
#: noise where the steering predicts nothing. Both as in :class:`datagen.slam.settings.MotionSettings`.
_CURVATURE_NOISE_HEIGHTS, _MAX_CURVATURE_HEIGHTS = 0.01, 0.8
#: Walk of the curvature's offset, times camera height, without and with a prediction from the steering, and
#: the share of it that is then forgotten per frame. Chosen: with a prediction little is left for the offset.
_OFFSET_WALK_HEIGHTS, _PREDICTED_OFFSET_WALK_HEIGHTS, _PREDICTED_OFFSET_DECAY = 0.012, 0.004, 0.02


class StartSettings(Settings):
    """What is known of the car, or is to be found while it sets out.

    Attributes:
        frames: Frames from which the typical step and the answer to the steering are found.
        factor: Gain of a recorded speed, or the typical step length, [cm], where none is recorded. None finds
            it from the first frames; their poses come when the last of them has been seen.
    """

    frames: int = Field(default=300, ge=LEAST_START)
    factor: float | None = Field(default=None, gt=0.0)


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """A frame with what the car knows when it comes, from a recording or from the camera.

    Attributes:
        frame: Frame number.
        t_s: Time of the frame, rising from frame to frame.
        image: The image; None where it could not be read.
        commands: What was commanded, in one row.
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
        segment: Number of the segment, from 0; each has a map of its own.
        estimate: Pose and how sure it is; ``match`` is NaN where the frame was not matched.
        points_cm: Edge points of the frame, frame car; none where the car stands.
    """

    frame: int
    t_s: float
    segment: int
    estimate: Estimate
    points_cm: Float[np.ndarray, "m 2"]


def live_frames(drive: Drive) -> Iterator[LiveFrame]:
    """Replay a recorded drive; a frame that cannot be read comes without its image."""
    for k in range(len(drive)):
        image: UInt8[np.ndarray, "h w 3"] | None
        try:
            image = drive.image(k)
        except DriveFormatError:
            image = None
        commands = drive.commands.subset(np.array([k]))
        yield LiveFrame(int(drive.frames[k]), float(drive.t_s[k]), image, commands, bool(drive.breaks[k]))


def live_motion(
    commands: CommandedMotion,
    curvature_per_cm: Float[np.ndarray, "n"] | None,
    factor: float,
    height_cm: float,
) -> MotionModel:
    """Return how a car may move to its next frame when only its past is known.

    Args:
        commands: What was commanded.
        curvature_per_cm: Curvature that the steering predicts; None where it predicts nothing.
        factor: Distance per unit of the commands, see :class:`datagen.slam.odometry.odometry.TypicalStep`.
        height_cm: Of the camera.
    """
    noise, walk, decay = 2.0 * _CURVATURE_NOISE_HEIGHTS, _OFFSET_WALK_HEIGHTS, 0.0
    if curvature_per_cm is not None:
        noise, walk = _CURVATURE_NOISE_HEIGHTS, _PREDICTED_OFFSET_WALK_HEIGHTS
        decay = _PREDICTED_OFFSET_DECAY
    else:
        curvature_per_cm = np.zeros(len(commands.distance_cm))
    return MotionModel(
        distance_cm=commands.distance_cm,
        curvature_per_cm=curvature_per_cm,
        factor_start=(factor, _START_SPREAD * factor),
        factor_walk=_KNOWN_WALK if commands.speed_known else _UNKNOWN_WALK_HEIGHTS * height_cm,
        factor_pull=_PULL,
        distance_noise=_DISTANCE_NOISE,
        offset_walk_per_cm=walk / height_cm,
        offset_decay=decay,
        curvature_noise_per_cm=noise / height_cm,
        max_curvature_per_cm=_MAX_CURVATURE_HEIGHTS / height_cm,
    )


@dataclass(frozen=True, eq=False)
class _Observed:
    """What the filter needs of a frame: its edges, and what was commanded since the frame before."""

    frame: int
    t_s: float
    pixels: EdgePixels
    scan: Scan
    commands: CommandedMotion


class LiveLocaliser:
    """Poses of a car as it drives, a frame at a time.

    Attributes:
        segment: Number of the segment that is being driven.
        factor: Typical distance factor (see :class:`MotionModel`); None until it is known.
        steering: How the car answers to the steering; None until it is known.
        unreadable: Frames without an image.
        standing: Frames in which the car stood.
        dropped: Frames of segments too short to find a typical step in.
    """

    def __init__(self, camera: Camera, settings: MapSettings, start: StartSettings) -> None:
        self.camera, self.settings, self.start = camera, settings, start
        self.height_cm = camera.mounting.height_cm
        self.factor = start.factor
        self.steering: SteeringFit | None = None
        self.segment = self.unreadable = self.standing = self.dropped = 0
        self._table = RoadTable(camera, mapping_range(camera.mounting, settings.perception.range))
        self._rng = np.random.default_rng(settings.seed)
        self._intervals_s: deque[float] = deque(maxlen=_TIMES)
        self._held: dict[str, float] = {}
        self._waiting: list[_Observed] = []
        #: Times of the last frame that was taken, of the last with an image, and of the last that the filter
        #: saw.
        self._t_s = self._t_image_s = self._t_driven_s = -np.inf
        self._begin()

    @property
    def map_bytes(self) -> int:
        """Memory of the map."""
        return 0 if self._filter is None else self._filter.map.bytes

    def take(self, frame: LiveFrame) -> list[LivePose]:
        """Take in the next frame.

        Returns:
            The poses that it makes known: its own; none while the typical step is being found, or where no
            frame has been readable for a while; those of all frames so far once the typical step has been
            found.

        Raises:
            DriveFormatError: If time goes back.
            CalibrationError: If the image's size is not the camera's.
        """
        if frame.t_s <= self._t_s:
            raise DriveFormatError(f"frame {frame.frame}: time {frame.t_s:g} s after {self._t_s:g} s")
        first, poses = not np.isfinite(self._t_s), list[LivePose]()
        paused = self._t_image_s < frame.t_s - _MAX_PAUSE_S
        if not first and (frame.starts or (paused and frame.image is not None)):
            poses = self.finish()
            self.segment += bool(self._filter is not None)
            self._begin()
        elif not first:
            self._intervals_s.append(frame.t_s - self._t_s)
        self._t_s = frame.t_s
        if frame.image is None:
            self.unreadable += 1
            # Over a gap the motion is predicted, as long as that can be believed.
            return poses if paused else [*poses, *self._follow(self._observed(frame))]
        self._t_image_s = frame.t_s
        self._check_size(frame.frame, frame.image)
        stands = self._standstill.stands(shrink_image(frame.image))
        if stands and (self._filter is not None or self._waiting):
            self.standing += 1
            # Time in which the car stands is not driven.
            self._t_driven_s = frame.t_s
            return poses if self._last is None else [*poses, self._stay(frame)]
        return [*poses, *self._follow(self._observed(frame))]

    def finish(self) -> list[LivePose]:
        """End a segment: return the poses of frames that still wait for the typical step."""
        waiting, self._waiting = self._waiting, []
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
                f"{self.dropped} frames of a moving car: the typical step length needs {LEAST_START} that "
                "follow each other, or has to be given"
            )

    def _begin(self) -> None:
        """Begin a segment: forget where the car was; what was learned of the car itself stays."""
        self._standstill = StandstillDetector()
        self._filter: ParticleFilter | None = None
        self._waiting = []
        self._last: LivePose | None = None
        self._history: deque[Survivors] = deque(maxlen=self.start.frames)
        self._distances_cm: deque[float] = deque(maxlen=self.start.frames)
        self._turns: deque[float] = deque(maxlen=self.start.frames)
        self._t_driven_s = -np.inf

    def _check_size(self, number: int, image: UInt8[np.ndarray, "h w 3"]) -> None:
        height, width = check_frame(image).shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise CalibrationError(
                f"frame {number}: image of {width}x{height} px, but the camera is for "
                f"{self.camera.width}x{self.camera.height}"
            )

    def _observed(self, frame: LiveFrame) -> _Observed:
        pixels = EdgePixels(np.empty((0, 2)), np.empty((0, 2)))
        road = RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
        if frame.image is not None:
            edges = self.settings.perception.edges
            pixels = seen_edges(
                find_edges(frame.image, edges, self._table.keep, self._table.scale), self._table
            )
            road = self._table.lift(pixels)
        commands = self._commanded(frame)
        self._t_driven_s = frame.t_s
        return _Observed(
            frame.frame,
            frame.t_s,
            pixels,
            pack_scans([road], self.height_cm, self.camera.mounting.lead_cm).scan(0),
            commands,
        )

    def _commanded(self, frame: LiveFrame) -> CommandedMotion:
        """What was commanded since the last frame that the filter saw, or that showed a standing car."""
        rows = {}
        for name in COMMAND_NAMES:
            values = getattr(frame.commands, name)
            if values is None:
                continue
            if np.isfinite(values[0]):
                self._held[name] = float(values[0])
            rows[name] = np.full(2, self._held.get(name, 0.0))
        before_s = self._t_driven_s if np.isfinite(self._t_driven_s) else frame.t_s
        typical_s = float(np.median(self._intervals_s)) if self._intervals_s else 1.0
        times = np.array([before_s, frame.t_s])
        both = commanded_motion(Commands(**rows), times, typical_s, self.camera.wheelbase_cm)
        turn = None if both.turn is None else both.turn[1:]
        return replace(both, distance_cm=both.distance_cm[1:], turn=turn, periods=both.periods[1:])

    def _follow(self, observed: _Observed) -> list[LivePose]:
        if self.factor is not None:
            return [self._step(observed)]
        self._waiting.append(observed)
        if len(self._waiting) < self.start.frames:
            return []
        waiting, self._waiting = self._waiting, []
        return self._set_out(waiting)

    def _set_out(self, waiting: list[_Observed]) -> list[LivePose]:
        """Find the typical step in the frames so far, and run the filter over them."""
        edges = [observed.pixels for observed in waiting]
        images = ImagePairs(edges, self.camera, self.settings.odometry, self._rng)
        distances_cm = np.concatenate([observed.commands.distance_cm for observed in waiting])
        self.factor = typical_step(images, distances_cm, waiting[0].commands.speed_known).factor
        return [self._step(observed) for observed in waiting]

    def _step(self, observed: _Observed) -> LivePose:
        motion = self._motion(observed.commands)
        if self._filter is None:
            self._filter = ParticleFilter(
                motion, self.settings.filter, self.height_cm, self.camera.wheelbase_cm, self._rng
            )
        estimate = self._filter.step(observed.scan, motion, 0)
        if self.steering is None and self._turns:
            self._learn_steering(self._filter, observed.commands.speed_known)
        self._last = LivePose(observed.frame, observed.t_s, self.segment, estimate, observed.scan.points_cm)
        return self._last

    def _motion(self, commands: CommandedMotion) -> MotionModel:
        """How the car may have moved to this frame."""
        assert self.factor is not None
        curvature = None
        if commands.turn is not None:
            self._turns.append(float(commands.turn[0]))
            self._distances_cm.append(float(commands.distance_cm[0]))
        if self.steering is not None and self._turns:
            curvature = np.array([self._predicted(self.steering)])
        return live_motion(commands, curvature, self.factor, self.height_cm)

    def _predicted(self, steering: SteeringFit) -> float:
        """Curvature that the steering predicts for the last frame, [1/cm]."""
        # Until the delay has passed, the first known command.
        turn = self._turns[max(len(self._turns) - 1 - steering.lag_frames, 0)]
        return steering.gain * turn + steering.trim_per_cm

    def _learn_steering(self, particles: ParticleFilter, speed_known: bool) -> None:
        """Once enough frames have been seen, find how the car answers to the steering."""
        self._history.append(particles.survivors)
        if len(self._history) < self.start.frames:
            return
        final = np.bincount(particles.survivor_of, particles.weights)
        states = smooth_lineages(list(self._history), final)
        n = len(states)
        commands = CommandedMotion.without_gaps(
            np.array(self._distances_cm)[-n:], speed_known, np.array(self._turns)[-n:]
        )
        self.steering = fit_steering(states[:, :3], commands, self.height_cm)
        self._history.clear()
        if self.steering is not None:
            # What the steering predicts from now on, the particles need not hold as an offset.
            particles.states[:, OFFSET] -= self._predicted(self.steering)

    def _stay(self, frame: LiveFrame) -> LivePose:
        """Pose of a car that stands where it was."""
        assert self._last is not None
        estimate = replace(self._last.estimate, match=float("nan"))
        return LivePose(frame.frame, frame.t_s, self.segment, estimate, np.empty((0, 2)))
