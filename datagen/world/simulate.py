"""Synthetic drives: a car is driven by its script or by a pilot who sees the images, and written to disk.

Its frames are drawn by several processes.
"""

from __future__ import annotations

import math
import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from datagen.world.car.driver import LostLane, Pilot, PilotSettings, Sight, place_on_track
from datagen.world.car.recording import BangBang
from datagen.world.render.renderer import Renderer
from datagen.world.render.sensor import as_jpeg
from datagen.world.road.track import write_track
from datagen.world.world import SimulationSettings, World, build_world
from lanenet.config import dump_settings
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.files import write_text
from lanenet.errors import ConfigError, LanenetError
from lanenet.geometry.frames import map_from_car
from lanenet.geometry.lane import POINT_NAMES
from lanenet.processes import prepare_process

#: Frames per task: a tenth of a second of work, beside which handing over does not count.
_CHUNK = 16
#: Tasks per process that may wait: more would only fill the memory.
_CHUNKS_AHEAD = 2
#: Of images on disk, when the camera itself does not compress; chosen: hardly any visible loss.
FILE_JPEG_QUALITY = 92

#: Makes a pilot for a world that has just been built.
BuildPilot = Callable[[World], Pilot]
Image = UInt8[np.ndarray, "h w 3"]

#: The renderer of a worker process, built when the process starts.
_renderers: list[Renderer] = []


@dataclass(frozen=True, eq=False)
class DriveState:
    """The car at the moment of a frame, and its command.

    Attributes:
        frame: Number, from 0.
        t_s: Time since the start.
        pose: True rear-axle centre x, y and heading (unwrapped), frame map.
        true_speed_cm_s: True speed.
        yaw_rate_rad_s: True yaw rate, positive left.
        points_cm: True six points of the label contract, frame car.
        speed_cm_s: Commanded speed from this frame to the next.
        steering_rad: Commanded steering, positive left.
    """

    frame: int
    t_s: float
    pose: Float[np.ndarray, "3"]
    true_speed_cm_s: float
    yaw_rate_rad_s: float
    points_cm: Float[np.ndarray, "6"]
    speed_cm_s: float
    steering_rad: float


def draw_state(renderer: Renderer, state: DriveState) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the frame of a drive at which the car is in this state."""
    return renderer.render(state.pose, state.frame, state.true_speed_cm_s, state.yaw_rate_rad_s)


def scripted_states(world: World) -> Iterator[DriveState]:
    """Let the driver drive through a world that has just been built; once only."""
    car, driver, rate_hz = world.car, world.driver, world.settings.rate_hz
    for frame in range(world.settings.frames):
        t_s = frame / rate_hz
        pose, motion = car.pose, (car.speed_cm_s, car.yaw_rate_rad_s)
        command = transmitted(world, *driver.command(pose, t_s))
        wheelbase_cm = world.settings.car.wheelbase_cm
        points_cm = world.track.truth(pose, wheelbase_cm, driver.s_cm, driver.lane_cm(pose))
        yield DriveState(frame, t_s, pose, *motion, points_cm, *command)
        car.step(*command, 1.0 / rate_hz)


def transmitted(world: World, speed_cm_s: float, steering_rad: float) -> tuple[float, float]:
    """Return what arrives at the car of a command: throttle and angle are limited to -1 to 1."""
    donkey = world.donkey
    if donkey is None:
        return speed_cm_s, steering_rad
    throttle, angle = donkey.throttle(speed_cm_s), donkey.angle(steering_rad)
    return donkey.speed_cm_s(throttle), donkey.steering_rad(angle)


@dataclass(frozen=True, eq=False)
class LoopFrame:
    """One frame of a closed-loop drive.

    Attributes:
        state: The car and its command.
        image_bgr: As drawn; None when the pilot needs no image.
        answered: Whether the pilot had an answer.
        s_cm: Distance of the front axle along the road, counted on over the laps.
        offset_cm: Of the front axle's middle from the lane's centre, left positive.
    """

    state: DriveState
    image_bgr: UInt8[np.ndarray, "h w 3"] | None
    answered: bool
    s_cm: float
    offset_cm: float


class ClosedLoop:
    """Drives a world that has just been built; every frame is one call of :meth:`next_frame`.

    Attributes:
        s_cm: Distance of the front axle along the road, counted on over the laps.
    """

    def __init__(
        self,
        world: World,
        pilot: Pilot,
        settings: PilotSettings,
        speed_cm_s: float,
        jpeg_quality: int | None = None,
    ) -> None:
        """Set out.

        Args:
            world: Its own driver does not steer.
            pilot: Who steers.
            settings: What happens when the lane is lost.
            speed_cm_s: Commanded speed.
            jpeg_quality: Show the pilot each image as a JPEG of this quality; for a world whose renderer does
                not compress.
        """
        self._world, self._pilot, self._speed_cm_s = world, pilot, speed_cm_s
        self._lost = LostLane(settings, world.settings.rate_hz)
        self._jpeg_quality = jpeg_quality
        self._frame, self._command = 0, (0.0, 0.0)
        self.s_cm = world.driver.s_cm
        world.car.place(world.car.pose, speed_cm_s)

    def next_frame(self) -> LoopFrame:
        """Draw, let the pilot decide, and let the car drive on until the next frame."""
        world, car, frame = self._world, self._world.car, self._frame
        wheelbase_cm, interval_s = world.settings.car.wheelbase_cm, 1.0 / world.settings.rate_hz
        pose, motion, t_s = car.pose, (car.speed_cm_s, car.yaw_rate_rad_s), frame * interval_s
        front_cm = map_from_car(np.zeros((1, 2)), pose, wheelbase_cm)[0]
        self.s_cm, offset_cm = place_on_track(world.track, front_cm, self.s_cm)
        image = seen = None
        if self._pilot.needs_image:
            image = seen = world.renderer.render(pose, frame, *motion)
            if self._jpeg_quality is not None:
                seen = as_jpeg(image, self._jpeg_quality)
        wanted_rad = self._pilot.steer(Sight(seen, pose, self.s_cm, t_s, *self._command))
        self._command = transmitted(world, *self._lost.command(wanted_rad, self._speed_cm_s))
        points_cm = world.track.truth(pose, wheelbase_cm, self.s_cm)
        state = DriveState(frame, t_s, pose, *motion, points_cm, *self._command)
        car.step(*self._command, interval_s)
        self._frame += 1
        return LoopFrame(state, image, math.isfinite(wanted_rad), self.s_cm, offset_cm)

    def put_back(self, ahead_cm: float = 0.0) -> None:
        """Put the car back in the middle of the lane, ``ahead_cm`` further along; the pilot starts anew."""
        self.s_cm += ahead_cm
        self._world.car.place(self._world.driver.pose_at(self.s_cm), self._speed_cm_s)
        self._command = (0.0, 0.0)
        self._pilot.reset()
        self._lost.reset()


def simulate_drive(
    settings: SimulationSettings,
    out: Path,
    progress: Callable[[int, int], None] | None = None,
    *,
    workers: int = 1,
    pilot: BuildPilot | None = None,
    pilot_settings: PilotSettings | None = None,
) -> Path:
    """Drive, and write a drive folder.

    Beside the recording (images, ``frames.csv`` with the commands only, ``drive.yaml``, ``camera.yaml``) the
    folder holds what no real drive has: ``truth.csv`` (pose and six points of each frame), ``track.json``
    (the road) and ``simulation.yaml`` (the resolved settings, which give the same drive again).

    Args:
        settings: The drive; the same settings give the same bytes, by any number of processes.
        out: Folder to write; it appears when all is done.
        progress: Called after each frame with (frames done, frames).
        workers: Processes that draw; a pilot needs each frame before the next, and leaves them idle.
        pilot: Who steers instead of the scripted driver, at the driver's speed.
        pilot_settings: What happens when the pilot loses the lane; None takes the defaults.

    Returns:
        The folder.

    Raises:
        ConfigError: See :func:`build_world`.
        LanenetError: If the folder exists and is not a drive, or cannot be written.
    """
    # The file is the camera's own JPEG: compressing twice would change the image.
    world = build_world(settings, compress=False)
    quality = world.settings.look.jpeg_quality or FILE_JPEG_QUALITY
    writer = DriveWriter(
        out,
        camera=world.camera,
        lane_width_cm=world.track.lane_width_cm,
        notes=f"simulated, seed {settings.seed}",
        jpeg_quality=quality,
        camera_method="simulation",
    )
    frames: Iterator[tuple[DriveState, Image]]
    if pilot is None:
        states = [s for s in scripted_states(world) if world.recorded is None or world.recorded[s.frame]]
        frames = zip(states, _render_states(world, states, workers), strict=True)
    else:
        if world.recorded is not None:
            raise ConfigError("gaps: found a pilot, who records all that he drives, expected none")
        frames = _piloted(world, pilot(world), pilot_settings or PilotSettings(), quality)
    total = settings.frames if world.recorded is None else int(world.recorded.sum())
    bang = BangBang() if world.settings.angles == "bang" else None
    with writer:
        for done, (state, image) in enumerate(frames, start=1):
            command = recorded_command(world, state)
            if bang is not None:
                command["angle"] = bang.angle(command["angle"])
            writer.add(image, state.t_s, truth=true_columns(state), **command)
            if progress is not None:
                progress(done, total)
        write_track(writer.folder / "track.json", world.track)
        write_text(writer.folder / "simulation.yaml", dump_settings(world.settings))
    return out


def true_columns(state: DriveState) -> dict[str, float]:
    """Columns of the ground truth: pose and six points of a frame."""
    values = map(float, (*state.pose, *state.points_cm))
    return dict(zip(("x_cm", "y_cm", "heading_rad", *POINT_NAMES), values, strict=True))


def recorded_command(world: World, state: DriveState) -> dict[str, float]:
    """Columns of a recording for a command: what was commanded, never what the car did."""
    speed_cm_s, steering_rad = state.speed_cm_s, state.steering_rad
    if world.donkey is None:
        return {"speed_cm_s": speed_cm_s, "steering_rad": steering_rad}
    return {"throttle": world.donkey.throttle(speed_cm_s), "angle": world.donkey.angle(steering_rad)}


def _piloted(
    world: World, pilot: Pilot, settings: PilotSettings, jpeg_quality: int
) -> Iterator[tuple[DriveState, Image]]:
    """Frame by frame; the pilot sees what the file will hold."""
    speed_cm_s = world.settings.driver.chosen_speed_cm_s(world.settings.rate_hz)
    loop = ClosedLoop(world, pilot, settings, speed_cm_s, jpeg_quality)
    for _ in range(world.settings.frames):
        frame = loop.next_frame()
        image = draw_state(world.renderer, frame.state) if frame.image_bgr is None else frame.image_bgr
        yield frame.state, image


def _render_states(world: World, states: Sequence[DriveState], workers: int) -> Iterator[Image]:
    """Draw the frames of a drive in order; any number of processes draws the same.

    Raises:
        LanenetError: If a process dies.
    """
    if workers <= 1 or len(states) <= _CHUNK:
        yield from (draw_state(world.renderer, state) for state in states)
        return
    # Spawned, because forking a process that has started OpenCV's threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _start_worker, (world.settings,)) as pool:
        waiting: deque[Future[list[Image]]] = deque()
        try:
            for first in range(0, len(states), _CHUNK):
                waiting.append(pool.submit(_draw_chunk, states[first : first + _CHUNK]))
                if len(waiting) > _CHUNKS_AHEAD * workers:
                    yield from waiting.popleft().result()
            while waiting:
                yield from waiting.popleft().result()
        except BrokenProcessPool:
            raise LanenetError("a process that draws frames ended; is there enough memory?") from None
        finally:
            pool.shutdown(cancel_futures=True)


def _start_worker(settings: SimulationSettings) -> None:
    """Build the same world in a worker process."""
    prepare_process()
    _renderers[:] = [build_world(settings, compress=False).renderer]


def _draw_chunk(states: Sequence[DriveState]) -> list[Image]:
    return [draw_state(_renderers[0], state) for state in states]
