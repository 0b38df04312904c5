"""The tapes of a made-up road as edge pixels of a camera: exact, so that an adjustment can be exact too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from tape_road import HEIGHT_CM, WHEELBASE_CM, TapeRoad, tapes_along

from lanenet.geometry.camera import Camera, Mounting
from lanenet.geometry.frames import car_from_map
from lanenet.perception.edges.pixels import EdgePixels

WIDTH, HEIGHT = 160, 120
#: Edge points per frame at most; more would only cost time.
_MOST = 220


def fisheye(**mounting: float) -> Camera:
    """A wide lens that looks a little to the side, tilted, beside the middle of the car."""
    K = np.array([[80.0, 0.0, 78.5], [0.0, 81.0, 60.5], [0.0, 0.0, 1.0]])
    return Camera(
        "fisheye", WIDTH, HEIGHT, K, np.array([-0.03, 0.004, 0.0, 0.0]), _mount(mounting), WHEELBASE_CM
    )


def pinhole(**mounting: float) -> Camera:
    """A common lens with all of OpenCV's five coefficients, on the same mount."""
    K = np.array([[110.0, 0.0, 80.5], [0.0, 109.0, 58.0], [0.0, 0.0, 1.0]])
    D = np.array([-0.11, 0.02, 0.002, -0.003, 0.004])
    return Camera("pinhole", WIDTH, HEIGHT, K, D, _mount(mounting), WHEELBASE_CM)


def _mount(changes: dict[str, float]) -> Mounting:
    usual = {
        "pitch_down_rad": 0.3,
        "roll_rad": 0.03,
        "yaw_rad": -0.04,
        "ahead_of_front_axle_cm": -4.0,
        "right_of_centre_cm": 1.5,
    }
    return Mounting(HEIGHT_CM, **(usual | changes))


def mirrored(camera: Camera) -> Camera:
    """The camera as a mirror beside the car shows it."""
    K = camera.K.copy()
    K[0, 2] = camera.width - 1 - K[0, 2]
    m = camera.mounting
    return replace(camera, K=K).with_mounting(
        roll_rad=-m.roll_rad, yaw_rad=-m.yaw_rad, right_of_centre_cm=-m.right_of_centre_cm
    )


def camera_numbers(camera: Camera) -> np.ndarray:
    """What an adjustment may change, in its order: focal length, cx, cy, k1, pitch, roll, yaw, lever."""
    m = camera.mounting
    mount = [m.pitch_down_rad, m.roll_rad, m.yaw_rad, m.ahead_of_front_axle_cm]
    return np.array([camera.K[0, 0], camera.K[0, 2], camera.K[1, 2], camera.D[0], *mount])


def bean(lap_cm: float) -> tuple[np.ndarray, np.ndarray]:
    """Length along a road that closes on itself, and its curvature: twofold symmetry closes the curve."""
    s = np.linspace(0.0, lap_cm, 4 * int(lap_cm) + 1)
    return s, 2.0 * np.pi / lap_cm * (1.0 + 0.7 * np.cos(4.0 * np.pi * s / lap_cm))


def tape_loop(frames: int, lap_frames: int = 60, lap_cm: float = 330.0) -> TapeRoad:
    """A bean of a road that closes on itself, driven again and again; dashes do not repeat within a lap."""
    s, curvature = bean(lap_cm)
    road = tapes_along(s, curvature, np.arange(lap_frames) * (len(s) - 1) // lap_frames)
    laps, place = np.divmod(np.arange(frames), lap_frames)
    poses = road.poses[place] + np.outer(laps, [0.0, 0.0, 2.0 * np.pi])
    return TapeRoad(road.points_cm, road.normals, poses)


def pixels(road: TapeRoad, camera: Camera, tilt_rad: np.ndarray | None = None) -> list[EdgePixels]:
    """Edge pixels from each pose of the road, with the camera as it nods in each frame."""
    tilt = np.zeros((len(road.poses), 2)) if tilt_rad is None else tilt_rad
    return [_frame(road, pose, camera, t) for pose, t in zip(road.poses, tilt, strict=True)]


def _frame(road: TapeRoad, pose: np.ndarray, camera: Camera, tilt: np.ndarray) -> EdgePixels:
    m = camera.mounting
    nodded = camera.with_mounting(
        pitch_down_rad=m.pitch_down_rad + float(tilt[0]), roll_rad=m.roll_rad + float(tilt[1])
    )
    along = np.column_stack([-road.normals[:, 1], road.normals[:, 0]])
    ends = (road.points_cm, road.points_cm + 1e-3 * along, road.points_cm + 1e-3 * road.normals)
    car = [car_from_map(points, pose, WHEELBASE_CM) for points in ends]
    near = (car[0][:, 1] > 2.0) & (car[0][:, 1] < 90.0) & (np.abs(car[0][:, 0]) < 60.0)
    uv, beside, towards = (nodded.project_ground(points[near]) for points in car)
    seen = np.all((uv > 0.0) & (uv < [WIDTH - 1.0, HEIGHT - 1.0]), axis=1)
    uv, beside, towards = uv[seen], beside[seen] - uv[seen], towards[seen] - uv[seen]
    # The gradient stands across the edge as the picture shows it, on the side that is brighter.
    normal = np.column_stack([-beside[:, 1], beside[:, 0]])
    normal *= np.where(np.sum(normal * towards, axis=1) < 0.0, -1.0, 1.0)[:, None]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # Those that are nearest, as in a picture where far tapes merge.
    rows = np.sort(np.argsort(-uv[:, 1], kind="stable")[:_MOST])
    return EdgePixels(uv[rows], normal[rows])


def drifted(poses: np.ndarray, way: float, turn_rad: float) -> np.ndarray:
    """What open loop makes of a drive: every way and every turn is wrong by as much."""
    turns = np.diff(poses[:, 2])
    heading = poses[0, 2] + np.concatenate([[0.0], np.cumsum(turns + turn_rad)])
    step = np.diff(poses[:, :2], axis=0)
    c, s = np.cos(heading[:-1] - poses[:-1, 2]), np.sin(heading[:-1] - poses[:-1, 2])
    moved = (1.0 + way) * np.column_stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1]])
    xy = poses[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    return np.column_stack([xy, heading])
