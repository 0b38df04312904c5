"""What the pictures of a drive show before its motion is known: edges of the road, and the usual step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, UInt8

from datagen.settings import MapSettings
from datagen.slam.camera.coarse import mapping_range
from datagen.slam.keyframes import alongside
from datagen.slam.odometry.image_pairs import ImagePairs
from datagen.slam.odometry.odometry import TypicalStep, typical_step
from datagen.slam.odometry.reflections import without_reflections
from datagen.slam.odometry.scans import Scans, edges_of_drive, scans_of
from datagen.slam.track import CommandedMotion
from lanenet.data.drives import Drive
from lanenet.errors import TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import EdgePixels
from lanenet.perception.edges.road import RangeSettings, RoadTable


@dataclass(frozen=True)
class SeenRoad:
    """Edges of the road in every frame.

    Attributes:
        edges: Per frame.
        keep: Pixels in which they were looked for, 0 elsewhere.
    """

    edges: list[EdgePixels]
    keep: UInt8[np.ndarray, "h w"]


def road_edges(
    drive: Drive,
    camera: Camera,
    limits: RangeSettings,
    settings: MapSettings,
    keys: Int[np.ndarray, "k"] | None = None,
) -> SeenRoad:
    """Edges of the road in every frame, without those of lamps that are mirrored in it.

    Args:
        drive: The drive.
        camera: Its camera.
        limits: Which part of the road counts.
        settings: How edges are found.
        keys: Key frames of a car that crawls; what stands still is told by frames as far apart as they are.
    """
    table = RoadTable(camera, limits)
    edges = edges_of_drive(drive, settings.perception.edges, table)
    kept = list(edges)
    for rows in [np.arange(len(edges))] if keys is None else alongside(keys, len(edges)):
        for k, pixels in zip(rows, without_reflections([edges[k] for k in rows], camera, table), strict=True):
            kept[k] = pixels
    return SeenRoad(kept, table.keep)


@dataclass(frozen=True)
class SeenDrive:
    """What the pictures of a segment show, before its motion is known.

    Attributes:
        drive: The segment.
        camera: Its camera, or a coarse guess of it.
        commands: What was commanded.
        road: Edges of the road.
        scans: The same on the road.
        pictures: The same, ready to be compared.
        usual: What the commands mean in centimetres.
    """

    drive: Drive
    camera: Camera
    commands: CommandedMotion
    road: SeenRoad
    scans: Scans
    pictures: ImagePairs
    usual: TypicalStep


def see_drive(
    drive: Drive,
    camera: Camera,
    commands: CommandedMotion,
    settings: MapSettings,
    rng: np.random.Generator,
) -> SeenDrive:
    """Find the edges of the road in a segment, and how far the car usually drives from frame to frame.

    Raises:
        TrackingLostError: If there are too few edges.
    """
    height = camera.mounting.height_cm
    limits = mapping_range(height, settings.perception.range)
    road = road_edges(drive, camera, limits, settings)
    scans = scans_of(road.edges, camera, limits)
    if len(scans.points_cm) < 20 * len(scans):
        raise TrackingLostError(
            f"{drive.path}: {len(scans.points_cm) / max(len(scans), 1):.0f} edge points per frame on the "
            "road; mapping needs 20"
        )
    pictures = ImagePairs(road.edges, camera, settings.odometry, rng)
    usual = typical_step(pictures, commands.distance_cm, commands.speed_known)
    return SeenDrive(drive, camera, commands, road, scans, pictures, usual)
