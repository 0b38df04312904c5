"""Curvilinear coordinates: the path of a circle, and points along it."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.lanes.path import Path, edges_along_path, path_of_poses
from datagen.slam.odometry.scans import pack_scans
from lanenet.errors import TrackingLostError
from lanenet.geometry.frames import car_from_map
from lanenet.perception.edges.road import RoadEdges

HEIGHT_CM = 15.0
WHEELBASE_CM = 17.0


def _arc_poses(frames: int, radius_cm: float, step_cm: float = 3.0) -> np.ndarray:
    """Poses around a circle; a negative radius turns right."""
    angle = np.arange(frames) * step_cm / radius_cm
    return np.column_stack([radius_cm * np.sin(angle), radius_cm * (1.0 - np.cos(angle)), angle])


def _exact_path(length_cm: float, radius_cm: float | None, frames: int, step_cm: float = 1.0) -> Path:
    """A path that is exactly a circle or a straight line, with frames every 3 cm from its start."""
    s = np.arange(0.0, length_cm, step_cm)
    if radius_cm is None:
        xy, heading = np.column_stack([s, np.zeros_like(s)]), np.zeros_like(s)
    else:
        heading = s / radius_cm
        xy = np.column_stack([radius_cm * np.sin(heading), radius_cm * (1.0 - np.cos(heading))])
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    return Path(step_cm, xy, left, 3.0 * np.arange(frames))


@pytest.mark.parametrize("radius", [100.0, -70.0, 300.0])
def test_the_path_of_a_circle_is_the_circle_and_goes_on_with_its_curvature(radius):
    poses = _arc_poses(100, radius)
    path = path_of_poses(poses, 1.8, 75.0)
    from_centre = np.linalg.norm(path.xy_cm - [0.0, radius], axis=1)
    np.testing.assert_allclose(from_centre[: -int(75.0 / 1.8)], abs(radius), atol=0.5)
    # 75 cm beyond the last pose a straight line would be off by 27 to 33 cm for the two tight circles.
    # Smoothing takes about a seventh of the last curvature.
    np.testing.assert_allclose(from_centre, abs(radius), atol=0.2 * 75.0**2 / (2.0 * abs(radius)))
    turned = np.unwrap(np.arctan2(*np.diff(path.xy_cm, axis=0).T[::-1]))
    assert turned[-1] == pytest.approx((297.0 + 72.0) / radius, abs=0.25 * 75.0 / abs(radius))
    assert path.s_cm[-1] == pytest.approx(297.0 + 75.0, rel=0.03)
    # The left normals are unit vectors across it, towards the centre when it turns left.
    np.testing.assert_allclose(np.linalg.norm(path.left, axis=1), 1.0, atol=1e-9)
    inward = np.sign(radius) * ([0.0, radius] - path.xy_cm) / from_centre[:, None]
    driven = np.sum(inward * path.left, axis=1)[: -int(75.0 / 1.8)]
    assert driven.min() > np.cos(np.deg2rad(4.0))
    assert np.median(driven) > np.cos(np.deg2rad(0.5))


@pytest.mark.parametrize("radius", [100.0, -70.0, 300.0])
def test_frames_lie_on_their_place_of_the_path(radius):
    poses = _arc_poses(100, radius)
    path = path_of_poses(poses, 1.8, 75.0)
    assert (np.diff(path.s_frames_cm) > 0.0).all()
    assert path.s_frames_cm[0] == 0.0
    place = np.stack([np.interp(path.s_frames_cm, path.s_cm, path.xy_cm[:, i]) for i in (0, 1)], axis=1)
    apart = np.linalg.norm(place - poses[:, :2], axis=1)
    # Smoothing pulls in the ends by less than two steps.
    assert apart.max() < 5.0
    assert np.median(apart) < 0.5
    # d = 0 at the rear axle: the distance across the path is smaller still.
    left = np.stack([np.interp(path.s_frames_cm, path.s_cm, path.left[:, i]) for i in (0, 1)], axis=1)
    assert np.abs(np.sum((poses[:, :2] - place) * left, axis=1)).max() < 0.5


def test_the_path_is_even_and_smooth_although_poses_jitter_and_stop():
    rng = np.random.default_rng(0)
    poses = np.concatenate([_arc_poses(60, 150.0), np.repeat(_arc_poses(60, 150.0)[-1:], 20, axis=0)])
    poses[:, :2] += 0.1 * rng.normal(size=(80, 2))
    poses = np.concatenate([poses, _arc_poses(110, 150.0)[60:]])
    path = path_of_poses(poses, 1.8, 40.0)
    assert (np.diff(path.s_frames_cm) > 0.0).all()
    inner = path.xy_cm[5:-5]
    np.testing.assert_allclose(np.linalg.norm(np.diff(inner, axis=0), axis=1), 1.8, atol=0.35)
    np.testing.assert_allclose(np.linalg.norm(inner - [0.0, 150.0], axis=1), 150.0, atol=1.5)


def test_moving_the_drive_moves_the_path():
    poses = _arc_poses(60, 90.0)
    c, s = np.cos(2.0), np.sin(2.0)
    rotation, shift = np.array([[c, -s], [s, c]]), np.array([500.0, -80.0])
    moved = np.column_stack([poses[:, :2] @ rotation.T + shift, poses[:, 2] + 2.0])
    here, there = path_of_poses(poses, 1.8, 60.0), path_of_poses(moved, 1.8, 60.0)
    np.testing.assert_allclose(there.xy_cm, here.xy_cm @ rotation.T + shift, atol=1e-6)
    np.testing.assert_allclose(there.left, here.left @ rotation.T, atol=1e-6)
    np.testing.assert_allclose(there.s_frames_cm, here.s_frames_cm, atol=1e-6)


def test_a_parked_car_has_no_path():
    with pytest.raises(TrackingLostError, match=r"moved 0\.0 cm in 80 frames"):
        path_of_poses(np.tile([10.0, 20.0, 0.3], (80, 1)), 1.8, 75.0)


def test_offsets_are_to_the_left():
    path = _exact_path(50.0, None, 10)
    np.testing.assert_allclose(path.points(np.full(50, 2.0)), path.xy_cm + [0.0, 2.0])


@pytest.mark.parametrize("radius", [None, 120.0, -90.0])
def test_points_get_their_exact_place_along_and_beside_the_path(radius):
    frames = 30
    path = _exact_path(220.0, radius, frames)
    rng = np.random.default_rng(0)
    if radius is None:
        poses = np.column_stack([3.0 * np.arange(frames), np.zeros((frames, 2))])
    else:
        poses = _arc_poses(frames, radius)
    # The car may be beside its path and askew: only the point's place on the map counts.
    poses = poses + rng.normal(size=poses.shape) * [0.5, 0.5, 0.1]
    s_true, d_true, scans = [], [], []
    for k in range(frames):
        s = 3.0 * k + WHEELBASE_CM + rng.uniform(5.0, 40.0, 25)
        d = rng.uniform(-25.0, 25.0, 25)
        angle = s / radius if radius is not None else np.zeros_like(s)
        if radius is None:
            on_path = np.column_stack([s, np.zeros_like(s)])
        else:
            on_path = np.column_stack([radius * np.sin(angle), radius * (1.0 - np.cos(angle))])
        left = np.column_stack([-np.sin(angle), np.cos(angle)])
        points = car_from_map(on_path + d[:, None] * left, poses[k], WHEELBASE_CM)
        c, sn = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        # Every other edge brightens to the left, the rest to the right.
        side = np.where(np.arange(25) % 2 == 0, 1.0, -1.0)[:, None] * left
        normals = np.column_stack([side[:, 0] * sn - side[:, 1] * c, side[:, 0] * c + side[:, 1] * sn])
        s_true.append(s)
        d_true.append(d)
        scans.append(RoadEdges(points, normals))
    edges = edges_along_path(path, pack_scans(scans, HEIGHT_CM), poses, WHEELBASE_CM, 60.0)
    assert len(edges.s_cm) == 25 * frames
    # Between samples 1 cm apart the tangent stands for the arc: the sagitta of half a centimetre.
    np.testing.assert_allclose(edges.d_cm, np.concatenate(d_true), atol=0.02)
    np.testing.assert_allclose(edges.s_cm, np.concatenate(s_true), atol=0.2)
    expected = np.tile(np.where(np.arange(25) % 2 == 0, 1.0, -1.0), frames)
    np.testing.assert_allclose(edges.side, expected, atol=1e-3)


def test_far_points_and_points_beyond_the_path_are_left_out():
    path = _exact_path(60.0, None, 1)
    points = np.array([[0.0, 20.0], [0.0, 39.0], [0.0, 55.0], [0.0, 80.0]])
    scans = pack_scans([RoadEdges(points, np.tile([-1.0, 0.0], (4, 1)))], HEIGHT_CM)
    edges = edges_along_path(path, scans, np.zeros((1, 3)), WHEELBASE_CM, 60.0)
    # 17 + 55 is beyond the path's end, 80 beyond the reach.
    np.testing.assert_allclose(edges.s_cm, [37.0, 56.0], atol=1e-9)
    np.testing.assert_allclose(edges.weight, scans.weights[:2])


@pytest.mark.parametrize("lead", [0.0, 40.0])
def test_the_reach_begins_at_a_camera_that_is_far_before_the_axle(lead):
    path = _exact_path(200.0, None, 1)
    points = np.array([[0.0, 20.0], [0.0, 59.0], [0.0, 61.0], [0.0, 99.0], [0.0, 101.0]])
    scans = pack_scans([RoadEdges(points, np.tile([-1.0, 0.0], (5, 1)))], HEIGHT_CM, lead)
    edges = edges_along_path(path, scans, np.zeros((1, 3)), WHEELBASE_CM, 60.0, lead)
    np.testing.assert_allclose(edges.s_cm, WHEELBASE_CM + points[points[:, 1] < 60.0 + lead, 1])
    np.testing.assert_allclose(edges.distance_cm, np.abs(points[: len(edges.s_cm), 1] - lead))
    # A point at four camera heights has half the weight of one at the camera.
    assert scans.weights[1] == pytest.approx(1.0 / (1.0 + ((59.0 - lead) / 60.0) ** 4))


def test_another_lap_does_not_take_the_points():
    # Two laps around one circle: the second lap's frames see road of the second lap only.
    radius = 60.0
    lap = 2.0 * np.pi * radius
    path = _exact_path(2.0 * lap, radius, 200)
    poses = _arc_poses(200, radius)
    ahead = np.array([[-18.0, 10.0], [0.0, 20.0]])
    scans = pack_scans([RoadEdges(ahead, np.tile([-1.0, 0.0], (2, 1)))] * 200, HEIGHT_CM)
    edges = edges_along_path(path, scans, poses, WHEELBASE_CM, 60.0)
    assert len(edges.s_cm) == 400
    frame = np.repeat(np.arange(200), 2)
    offset = edges.s_cm - 3.0 * frame
    assert offset.min() > 15.0
    assert offset.max() < 50.0
