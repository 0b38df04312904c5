"""Random synthetic drives through cameras like those of real ones, drawn and measured by many processes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from pydantic import Field

from datagen.reality.measure import MeasuredDrive, Sampling, measure_frames
from datagen.world.simulate import draw_state, scripted_states
from datagen.world.variety import camera_like, first_world, vary_simulation
from datagen.world.world import SimulationSettings
from lanenet.config import Settings
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.processes import run_jobs


class RealitySettings(Settings):
    """What synthetic drives are compared with real ones.

    Attributes:
        seed: Every drive's seed follows from this and its number.
        count: Synthetic drives.
        frames: Frames that are drawn of each.
        real_frames: Most frames that are measured of a recorded drive.
        every: Only every so many frames one is drawn: neighbours show the same.
        vary_camera: Draw each drive's camera near that of a real drive, which take turns, and the car's
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

    def sampling(self, most: int) -> Sampling:
        """Return how a drive is measured on at most this many frames."""
        return Sampling(most, self.perception, self.window)


def drawn_simulation(settings: RealitySettings, cameras: Sequence[Camera], number: int) -> SimulationSettings:
    """Return the settings of one synthetic drive.

    Args:
        settings: The comparison.
        cameras: Of the real drives.
        number: Of the synthetic drive.
    """
    # The number alone decides: more drives do not change the first ones.
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
    images = [draw_state(world.renderer, s) for s in list(scripted_states(world))[:: settings.every]]
    name, sampling = f"synthetic_{number:03d}", settings.sampling(settings.frames)
    return measure_frames(name, images.__getitem__, len(images), world.camera, sampling)


def measure_all_synthetic(
    settings: RealitySettings,
    cameras: Sequence[Camera],
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[MeasuredDrive]:
    """Draw and measure all synthetic drives; the same by any number of processes.

    Raises:
        ConfigError: See :func:`measure_synthetic`.
        LanenetError: If a process dies.
    """
    jobs = [(f"synthetic_{number:03d}", number) for number in range(settings.count)]
    return run_jobs(partial(measure_synthetic, settings, cameras), jobs, workers, progress)
