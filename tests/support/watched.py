"""A drive with its map, made up, for tests of what viewers show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from small_map import CAMERA, N, small_map

from lanenet.data.drives.folder import DriveWriter
from lanenet.data.maps.folder import DriveMap, write_map
from lanenet.perception.estimate import LaneEstimate
from lanenet.viewers.seen import Scene, Seen, lane_of, values_of

#: A lane that bends to the left: x falls with y.
POINTS_CM = np.array([-18.0, -20.0, -26.0, 18.0, 16.0, 10.0])
POSE = np.array([120.0, -40.0, 2.0])
PATH = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.5], [120.0, -40.0, 2.0]])
SCENE = Scene(
    "made up",
    CAMERA,
    lines_map_cm={
        "0/left_0": np.array([[0.0, 20.0], [50.0, 20.0], [np.nan, np.nan], [80.0, 20.0], [90.0, 25.0]])
    },
    edges_map_cm=np.array([[0.0, 21.0], [50.0, 19.0]]),
    path_map=PATH,
)


def rotation(q: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion x, y, z, w (Hamilton)."""
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def image() -> np.ndarray:
    """A road with two white lines, dark elsewhere."""
    picture = np.full((CAMERA.height, CAMERA.width, 3), 60, np.uint8)
    for x_cm in (-18.0, 18.0):
        y_cm = np.linspace(0.0, 80.0, 2000)
        for off_cm in np.linspace(-1.5, 1.5, 21):
            road = np.stack([np.full_like(y_cm, x_cm + off_cm), y_cm], axis=1)
            px = np.rint(CAMERA.project_ground(road))
            px = px[np.isfinite(px).all(axis=1)].astype(int)
            inside = (px >= 0).all(axis=1) & (px < (CAMERA.width, CAMERA.height)).all(axis=1)
            picture[px[inside, 1], px[inside, 0]] = 230
    return picture


def frames(times_s: Sequence[float] = (10.0, 10.05, 10.1)) -> list[Seen]:
    """Frames from number 7 on: two with both lines and a pose, the last one with the left line only."""
    estimate = LaneEstimate(POINTS_CM, steering_rad=0.25, confidence=0.75)
    left_only = LaneEstimate(np.where(np.arange(6) < 3, POINTS_CM, np.nan), confidence=0.25)
    seen = [
        Seen(7 + k, t_s, image(), {"detected": lane_of(estimate)}, values_of(estimate), POSE)
        for k, t_s in enumerate(times_s[:-1])
    ]
    lanes = {"detected": lane_of(left_only)}
    return [*seen, Seen(7 + len(seen), times_s[-1], None, lanes, values_of(left_only), None)]


def mapped_drive(folder: Path) -> tuple[Path, DriveMap]:
    """Write a drive and its map; returns the map's folder and the map."""
    with DriveWriter(folder / "drive", CAMERA, 36.0) as writer:
        for k in range(N):
            writer.add(image(), 0.05 * k, throttle=0.2, angle=-0.5)
    drive_map = small_map()
    meta = drive_map.meta.model_copy(update={"drive": str(folder / "drive")})
    drive_map = replace(drive_map, meta=meta, frames=np.arange(N))
    (folder / "map").mkdir()
    edges = {name: np.linspace(0.0, 9.0, 10) for name in ("x_cm", "y_cm")}
    write_map(folder / "map", drive_map, edges, {}, "made up")
    (folder / "map" / "settings.yaml").write_text("{}\n")
    return folder / "map", drive_map
