"""Synthetic drives: a car driven along a random road, frame by frame, with exact truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from datagen.world.closed_loop import ClosedLoop
from datagen.world.drive_loop import DriveState, recorded_commands, scripted_states
from datagen.world.pilot import Pilot, PilotSettings
from datagen.world.render_pool import draw_state, render_states
from datagen.world.track_file import write_track
from datagen.world.world import SimulationSettings, World, build_world
from lanenet.config import dump_settings
from lanenet.data.drive_writer import DriveWriter
from lanenet.data.files import write_text
from lanenet.geometry.lane import POINT_NAMES

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
