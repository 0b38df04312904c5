"""Frames of a drive whose poses are known, drawn by several processes and handed over in order."""

from __future__ import annotations

import multiprocessing
import signal
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import cv2
import numpy as np
from jaxtyping import UInt8

from datagen.world.drive_loop import DriveState
from datagen.world.renderer import Renderer
from datagen.world.world import SimulationSettings, World, build_world
from lanenet.errors import LanenetError

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
