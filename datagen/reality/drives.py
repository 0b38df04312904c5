"""Random synthetic drives through cameras like those of real ones, drawn and measured over processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import numpy as np
from pydantic import Field

from datagen.reality.measure import MeasuredDrive, measure_frames
from datagen.world.driving import scripted_states
from datagen.world.variety import camera_like, first_world, vary_simulation
from datagen.world.world import SimulationSettings
from lanenet.config import Settings
from lanenet.errors import LanenetError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.processes import prepare_process


class RealitySettings(Settings):
    """What synthetic drives are compared with real ones.

    Attributes:
        seed: Every drive's seed follows from this and its number.
        count: Synthetic drives.
        frames: Frames that are drawn of each.
        real_frames: Frames that are measured of a recorded drive, at most.
        every: Only one frame of so many is drawn: neighbours show the same.
        vary_camera: Draw each drive's camera near that of a real drive, by turns, and the car's
            size; else ``simulation.camera`` and the car as it is.
        vary_road: Draw each drive's kind of road; else ``simulation.track``.
        vary_driver: Draw how each is driven; else ``simulation.driver``.
        simulation: What all drives share; its seed and number of frames are set here.
        perception: How edges are found, in all drives alike.
        window: The network's window.
    """

    seed: int = Field(default=0, ge=0)
    count: int = Field(default=60, ge=1)
    frames: int = Field(default=40, ge=1)
    real_frames: int = Field(default=200, ge=1)
    every: int = Field(default=6, ge=1)
    vary_camera: bool = True
    vary_road: bool = True
    vary_driver: bool = True
    simulation: SimulationSettings = SimulationSettings()
    perception: PerceptionSettings = PerceptionSettings()
    window: BirdseyeWindow = BirdseyeWindow()


def drawn_simulation(settings: RealitySettings, cameras: Sequence[Camera], number: int) -> SimulationSettings:
    """Return the settings of one synthetic drive.

    Args:
        settings: The comparison.
        cameras: Of the real drives.
        number: Of the synthetic drive.
    """
    # The number alone decides: more drives leave the first ones as they are.
    simulation = settings.simulation.model_copy(update={"frames": (settings.frames - 1) * settings.every + 1})
    return vary_simulation(
        simulation,
        np.random.SeedSequence([settings.seed, number]),
        number,
        cameras=[camera_like(camera) for camera in cameras] if settings.vary_camera else [],
        road=settings.vary_road,
        driver=settings.vary_driver,
    )


def measure_synthetic(settings: RealitySettings, cameras: Sequence[Camera], number: int) -> MeasuredDrive:
    """Draw and measure one synthetic drive, in memory.

    Raises:
        ConfigError: If the settings leave no road.
    """
    world = first_world(drawn_simulation(settings, cameras, number))
    states = list(scripted_states(world))[:: settings.every]
    images = [
        world.renderer.render(state.pose, state.frame, state.true_speed_cm_s, state.yaw_rate_rad_s)
        for state in states
    ]
    return measure_frames(
        f"synthetic_{number:03d}",
        lambda i: images[i],
        len(images),
        world.camera,
        settings.frames,
        settings.perception,
        settings.window,
    )


def measure_all_synthetic(
    settings: RealitySettings,
    cameras: Sequence[Camera],
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[MeasuredDrive]:
    """Draw and measure all synthetic drives; the same by any number of processes.

    Raises:
        ConfigError: See :func:`measure_synthetic`.
        LanenetError: If a process ends before its time.
    """
    numbers, found = range(settings.count), []

    def take(drive: MeasuredDrive) -> None:
        found.append(drive)
        if progress is not None:
            progress(len(found), settings.count)

    if workers <= 1 or settings.count == 1:
        for number in numbers:
            take(measure_synthetic(settings, cameras, number))
        return found
    # Spawned, because forking a process that has started OpenCV's threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, settings.count), context, prepare_process) as pool:
        futures = [pool.submit(measure_synthetic, settings, cameras, number) for number in numbers]
        try:
            for future in futures:
                take(future.result())
        except BrokenProcessPool:
            raise LanenetError("a process that draws drives ended; is there enough memory?") from None
        finally:
            pool.shutdown(cancel_futures=True)
    return found
