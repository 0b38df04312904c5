"""Roads and drives in memory, for tests of the simulator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from datagen.world.render.compiled import TILE
from datagen.world.render.ground import WALL_CM, PixelGround
from datagen.world.road.build import random_track
from datagen.world.road.track import Side, Track, is_painted
from datagen.world.road.track_settings import load_track_settings
from datagen.world.simulate import DriveState, draw_state, scripted_states
from datagen.world.world import SimulationSettings, World, build_world


@dataclass(frozen=True, eq=False)
class SimulatedFrame(DriveState):
    """One frame of a synthetic drive."""

    image_bgr: np.ndarray


def drive_frames(settings: SimulationSettings) -> Iterator[SimulatedFrame]:
    """Drive, one frame at a time."""
    yield from frames_of(build_world(settings))


def frames_of(world: World) -> Iterator[SimulatedFrame]:
    """Let the scripted driver drive through a world that has just been built; once only."""
    for state in scripted_states(world):
        yield SimulatedFrame(**vars(state), image_bgr=draw_state(world.renderer, state))


def load_track(path: Path) -> Track:
    """Build the road of a YAML file, with seed 0."""
    return random_track(load_track_settings(path), np.random.default_rng(0))


def mirror_track(track: Track) -> Track:
    """Return the track with left and right exchanged (y changes sign in the map)."""
    return replace(
        track,
        xy_cm=track.xy_cm * [1.0, -1.0],
        heading_rad=-track.heading_rad,
        curvature_per_cm=-track.curvature_per_cm,
        markings=tuple(replace(m, offset_cm=-m.offset_cm) for m in track.markings),
        boxes=track.boxes * [1.0, -1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0],
        oncoming_cm=None if track.oncoming_cm is None else -track.oncoming_cm,
    )


def move_track(track: Track, pose: np.ndarray) -> Track:
    """Return the track rotated by ``pose[2]`` about the origin and then moved by ``pose[:2]``."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[c, s], [-s, c]])
    boxes = track.boxes.copy()
    boxes[:, :2] = boxes[:, :2] @ turn + pose[:2]
    boxes[:, 2:4] = boxes[:, 2:4] @ turn
    xy_cm = track.xy_cm @ turn + pose[:2]
    return replace(track, xy_cm=xy_cm, heading_rad=track.heading_rad + pose[2], boxes=boxes)


def line_xy(track: Track, side: Side) -> np.ndarray:
    """Return the middle of a line of the driven lane at each sample, frame map, painted or not."""
    return track.beside(np.arange(len(track.s_cm)), track.line_offset_cm(side))


def line_painted(track: Track, side: Side, s_cm: np.ndarray) -> np.ndarray:
    """Tell where along the road a line of the driven lane is painted; on a loop over any number of laps."""
    s_cm = np.mod(s_cm, track.length_cm) if track.closed else s_cm
    beside = [
        m
        for m in track.markings
        if abs(m.offset_cm - track.line_offset_cm(side)) < 0.25 * track.lane_width_cm
    ]
    return np.any([is_painted(m.painted_cm, s_cm) for m in beside], axis=0)


def floor_pixels(ground: PixelGround) -> np.ndarray:
    """Whether each pixel sees the floor, of a camera that does not shake."""
    rays = ground.rays.reshape(-1, 9, TILE)[:, :3].transpose(1, 0, 2)
    right, ahead, up = rays.reshape(3, ground.height, ground.stride)
    with np.errstate(invalid="ignore", divide="ignore"):
        reach_cm = np.hypot(right, ahead) * ground.eye_cm[2] / -up
        return ((up < -1e-6) & (reach_cm < WALL_CM))[:, : ground.width]
