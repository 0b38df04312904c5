"""Synthetic drives on disk: a car is driven along a road, and its frames are drawn by several processes."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from datagen.world.car.pilot import Pilot, PilotSettings
from datagen.world.driving import ClosedLoop, DriveState, draw_state, scripted_states
from datagen.world.render.renderer import Renderer
from datagen.world.road.track_file import write_track
from datagen.world.world import SimulationSettings, World, build_world
from lanenet.config import dump_settings
from lanenet.data.drives.writer import DriveWriter
from lanenet.data.files import write_text
from lanenet.errors import LanenetError
from lanenet.geometry.lane import POINT_NAMES
from lanenet.processes import prepare_process

#: Frames per task: a tenth of a second of work, beside which handing over does not count.
_CHUNK = 16
#: Tasks per process that may wait: more would only fill the memory.
_CHUNKS_AHEAD = 2
#: Of images on disk, when the camera itself does not compress; chosen: hardly any visible loss.
_FILE_JPEG_QUALITY = 92

#: Makes a pilot for a world that has just been built.
BuildPilot = Callable[[World], Pilot]
Image = UInt8[np.ndarray, "h w 3"]

#: The renderer of a worker process, built when the process starts.
_renderers: list[Renderer] = []


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
    quality = world.settings.look.jpeg_quality or _FILE_JPEG_QUALITY
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
        states = list(scripted_states(world))
        frames = zip(states, _render_states(world, states, workers), strict=True)
    else:
        frames = _piloted(world, pilot(world), pilot_settings or PilotSettings(), quality)
    with writer:
        for done, (state, image) in enumerate(frames, start=1):
            pose = dict(zip(("x_cm", "y_cm", "heading_rad"), map(float, state.pose), strict=True))
            points = dict(zip(POINT_NAMES, map(float, state.points_cm), strict=True))
            writer.add(image, state.t_s, truth={**pose, **points}, **_recorded_command(world, state))
            if progress is not None:
                progress(done, settings.frames)
        write_track(writer.folder / "track.json", world.track)
        write_text(writer.folder / "simulation.yaml", dump_settings(world.settings))
    return out


def _recorded_command(world: World, state: DriveState) -> dict[str, float]:
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
