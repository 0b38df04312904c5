"""Synthetic drives: a car driven along a random road, frame by frame, with exact truth.

Frames of a drive whose poses are known, drawn by several processes and handed over in order.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.world.car.pilot import Pilot, PilotSettings
from datagen.world.driving import ClosedLoop, DriveState, recorded_commands, scripted_states
from datagen.world.render.renderer import Renderer
from datagen.world.road.track_file import write_track
from datagen.world.world import SimulationSettings, World, build_world
from lanenet.config import dump_settings
from lanenet.data.drives.writer import DriveWriter
from lanenet.data.files import write_text
from lanenet.errors import LanenetError
from lanenet.geometry.lane import POINT_NAMES

_CHUNK = 16  # frames per task
_CHUNKS_AHEAD = 2  # tasks per process that may wait: more would only fill the memory

#: The renderer of a worker process, built when the process starts.
_renderers: list[Renderer] = []


def draw_state(renderer: Renderer, state: DriveState) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the frame of a drive at which the car is in this state."""
    return renderer.render(state.pose, state.frame, state.true_speed_cm_s, state.yaw_rate_rad_s)


def render_states(
    world: World, states: Sequence[DriveState], workers: int = 1
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Draw the frames of a drive.

    A frame depends on its state and number only, so that any number of processes draws the same.

    Args:
        world: Built without compression.
        states: Where the car is at each frame.
        workers: Processes; 1 draws in this one.

    Yields:
        The images in order.

    Raises:
        LanenetError: If a process ends before its time.
    """
    if workers <= 1 or len(states) <= _CHUNK:
        yield from (draw_state(world.renderer, state) for state in states)
        return
    # Spawned, because forking a process that has started OpenCV's threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, start_worker, (world.settings,)) as pool:
        waiting: deque[Future[list[UInt8[np.ndarray, "h w 3"]]]] = deque()
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


def start_worker(settings: SimulationSettings) -> None:
    """Build the same world in a worker process."""
    prepare_process()
    _renderers[:] = [build_world(settings, compress=False).renderer]


def prepare_process() -> None:
    """Make a worker process leave the cores to its siblings, and end at once at Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    cv2.setNumThreads(1)


def _draw_chunk(states: Sequence[DriveState]) -> list[UInt8[np.ndarray, "h w 3"]]:
    return [draw_state(_renderers[0], state) for state in states]


__all__ = [
    "SimulatedFrame",
    "SimulationSettings",
    "World",
    "build_world",
    "drive_frames",
    "frames_of",
    "simulate_drive",
]

_FILE_JPEG_QUALITY = 92  # of images on disk, when the camera itself does not compress

#: Makes a pilot for a world that has just been built.
BuildPilot = Callable[[World], Pilot]
Image = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """One frame of a synthetic drive.

    Attributes:
        frame: Number, from 0.
        t_s: Time since the start.
        image_bgr: What the camera sees.
        speed_cm_s: Commanded speed from this frame to the next.
        steering_rad: Commanded steering, positive left.
        pose: True rear-axle centre x, y and heading (unwrapped), frame map.
        points_cm: True six points of the label contract, frame car.
    """

    frame: int
    t_s: float
    image_bgr: UInt8[np.ndarray, "h w 3"]
    speed_cm_s: float
    steering_rad: float
    pose: Float[np.ndarray, "3"]
    points_cm: Float[np.ndarray, "6"]


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
        progress: Called after each frame with the number done and the number in all.
        workers: Processes that draw; a pilot needs each frame before the next, and leaves them idle.
        pilot: Who steers instead of the scripted driver, at the driver's speed.
        pilot_settings: What happens when the pilot loses the lane; None takes the defaults.

    Returns:
        The folder.

    Raises:
        ConfigError: See :func:`build_world`.
        LanenetError: If the folder exists and is not a drive, or cannot be written.
    """
    # The file is the camera's own JPEG: compressing twice would change the look.
    world = build_world(settings, compress=False)
    quality = world.settings.look.jpeg_quality or _FILE_JPEG_QUALITY
    writer = DriveWriter(
        out,
        camera=world.camera,
        lane_width_cm=world.track.lane_width_cm,
        notes=f"simulated, seed {settings.seed}",
        jpeg_quality=quality,
        camera_method="simulation",
    )
    frames = (
        _scripted(world, workers)
        if pilot is None
        else _piloted(
            world, pilot(world), PilotSettings() if pilot_settings is None else pilot_settings, quality
        )
    )
    with writer:
        for done, (state, image) in enumerate(frames, start=1):
            pose = dict(zip(("x_cm", "y_cm", "heading_rad"), map(float, state.pose), strict=True))
            points = dict(zip(POINT_NAMES, map(float, state.points_cm), strict=True))
            commands = recorded_commands(world, state.speed_cm_s, state.steering_rad)
            writer.add(image, state.t_s, truth={**pose, **points}, **commands)
            if progress is not None:
                progress(done, settings.frames)
        write_track(writer.folder / "track.json", world.track)
        write_text(writer.folder / "simulation.yaml", dump_settings(world.settings))
    return out


def drive_frames(settings: SimulationSettings) -> Iterator[SimulatedFrame]:
    """Drive, one frame at a time, in memory.

    Args:
        settings: The drive; the same settings give the same frames.

    Yields:
        Frames with commands and truth.

    Raises:
        ConfigError: See :func:`build_world`.
    """
    yield from frames_of(build_world(settings))


def frames_of(world: World) -> Iterator[SimulatedFrame]:
    """Let the scripted driver drive through a world that has just been built; once only."""
    for state in scripted_states(world):
        yield SimulatedFrame(
            frame=state.frame,
            t_s=state.t_s,
            image_bgr=draw_state(world.renderer, state),
            speed_cm_s=state.speed_cm_s,
            steering_rad=state.steering_rad,
            pose=state.pose,
            points_cm=state.points_cm,
        )


def _scripted(world: World, workers: int) -> Iterator[tuple[DriveState, Image]]:
    """All poses first, then the frames."""
    states = list(scripted_states(world))
    yield from zip(states, render_states(world, states, workers), strict=True)


def _piloted(
    world: World, pilot: Pilot, settings: PilotSettings, jpeg_quality: int
) -> Iterator[tuple[DriveState, Image]]:
    """Frame by frame; the pilot sees what the file will hold."""
    speed_cm_s = world.settings.driver.chosen_speed_cm_s(world.settings.rate_hz)
    loop = ClosedLoop(world, pilot, settings, speed_cm_s, jpeg_quality)
    for _ in range(world.settings.frames):
        frame = loop.next_frame()
        state, image = frame.state, frame.image_bgr
        if image is None:
            image = draw_state(world.renderer, state)
        yield state, image
