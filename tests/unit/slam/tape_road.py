"""A made-up road of dashed tapes as oriented edge points, driven in noise-free scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from datagen.slam.odometry.scans import Scans, pack_scans
from lanenet.geometry.frames import car_from_map
from lanenet.perception.edges.road import RoadEdges

HEIGHT_CM = 15.0
WHEELBASE_CM = 17.0
STEP_CM = 3.0
TAPE_CM = 2.0
#: Offset to the left of the middle, painted length, period and phase of each line.
LINES = ((18.0, 14.0, 26.0, 5.0), (-18.0, 30.0, 40.0, 11.0))


@dataclass(frozen=True)
class TapeRoad:
    """Edge points of the tapes, [cm], frame map, and poses along the middle of the lane."""

    points_cm: np.ndarray
    normals: np.ndarray
    poses: np.ndarray

    def moved(self, x_cm: float, y_cm: float, turn_rad: float) -> TapeRoad:
        """The same road elsewhere on the map."""
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        rotation = np.array([[c, -s], [s, c]])
        xy = self.poses[:, :2] @ rotation.T + [x_cm, y_cm]
        poses = np.column_stack([xy, self.poses[:, 2] + turn_rad])
        return TapeRoad(self.points_cm @ rotation.T + [x_cm, y_cm], self.normals @ rotation.T, poses)

    def mirrored(self) -> TapeRoad:
        """The road seen in a mirror along the map's x axis."""
        flip = np.array([1.0, -1.0])
        return TapeRoad(self.points_cm * flip, self.normals * flip, self.poses * [1.0, -1.0, -1.0])

    def scans(self, poses: np.ndarray | None = None) -> Scans:
        """What a camera sees from each pose: 8 to 75 cm ahead, 60 cm to each side."""
        return pack_scans([self._scan(pose) for pose in (self.poses if poses is None else poses)], HEIGHT_CM)

    def _scan(self, pose: np.ndarray) -> RoadEdges:
        points = car_from_map(self.points_cm, pose, WHEELBASE_CM)
        seen = (points[:, 1] > 8.0) & (points[:, 1] < 75.0) & (np.abs(points[:, 0]) < 60.0)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        nx, ny = self.normals[seen].T
        return RoadEdges(points[seen], np.column_stack([nx * s - ny * c, nx * c + ny * s]))


def tape_road(frames: int, curvature_per_cm: float = 0.004, swing_per_cm: float = 0.008) -> TapeRoad:
    """A road that bends both ways; left line in dashes of 14 cm every 26 cm, right in 30 cm every 40 cm.

    Poses are ``STEP_CM`` apart along the middle of a lane of 36 cm, from the origin along +x.
    """
    ds = 0.25
    s = np.arange(0.0, frames * STEP_CM + 130.0, ds)
    curvature = curvature_per_cm + swing_per_cm * np.sin(2.0 * np.pi * s / 250.0)
    return tapes_along(s, curvature, (np.arange(frames) * STEP_CM / ds).astype(int))


def tapes_along(s: np.ndarray, curvature: np.ndarray, driven: np.ndarray) -> TapeRoad:
    """Tape both sides of a lane; ``driven`` are the rows of ``s`` at which the car is, frame by frame."""
    xy, heading = _centre_line(s, curvature)
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    points, normals = [], []
    for offset, dash, period, phase in LINES:
        painted = np.mod(s + phase, period) < dash
        rows = np.flatnonzero(painted)[::4]
        for side in (0.5, -0.5):
            points.append(xy[rows] + (offset + side * TAPE_CM) * left[rows])
            normals.append(-np.sign(side) * left[rows])
        ahead = np.column_stack([np.cos(heading), np.sin(heading)])
        for ends, sign in (
            (np.flatnonzero(~painted[:-1] & painted[1:]), 1.0),
            (np.flatnonzero(painted[:-1] & ~painted[1:]), -1.0),
        ):
            for across in (-0.7, 0.0, 0.7):
                points.append(xy[ends] + (offset + across) * left[ends])
                normals.append(sign * ahead[ends])
    return TapeRoad(
        np.concatenate(points), np.concatenate(normals), np.column_stack([xy[driven], heading[driven]])
    )


def dashes_along(s: np.ndarray, curvature: np.ndarray) -> list[np.ndarray]:
    """The middle of every dash of the same tapes, as points of the map."""
    xy, heading = _centre_line(s, curvature)
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    dashes = []
    for offset, dash, period, phase in LINES:
        painted = np.flatnonzero(np.mod(s + phase, period) < dash)
        runs = np.split(painted, np.flatnonzero(np.diff(painted) > 1) + 1)
        dashes += [xy[run] + offset * left[run] for run in runs if len(run) > 1]
    return dashes


def _centre_line(s: np.ndarray, curvature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and headings of the middle of the lane, from the origin along +x."""
    ds = float(s[1] - s[0])
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]) * ds)])
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = ds * np.column_stack([np.cos(middle), np.sin(middle)])
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), heading
