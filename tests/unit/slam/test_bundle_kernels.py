"""The kernels' camera against the project's own, and their derivatives against differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pixel_road import HEIGHT, WIDTH, fisheye, pinhole, pixels
from tape_road import HEIGHT_CM, tape_road

from datagen.slam.adjustment.adjust import CAMERA_NAMES, BundleProblem, BundleSettings
from datagen.slam.adjustment.kernels import N_VIEW, lift_pixel, project_point, project_with_jacobian, set_view
from datagen.slam.adjustment.state import BundleEstimate, BundleState, Observations
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.pixels import EdgePixels

CAMERAS = {"fisheye": fisheye(), "pinhole": pinhole()}
SMALL = BundleSettings(lags=(1, 4), points=40)


#: Differences of the camera's numbers.
STEPS = np.array([1e-4, 1e-2, 1e-2, 1e-4, 1e-5, 1e-5, 1e-5, 1e-4])


def _problem(camera: Camera, frames: int = 2) -> BundleProblem:
    observed = Observations(pixels(tape_road(frames), camera))
    return BundleProblem(observed, camera, SMALL, np.random.default_rng(0))


def _vectors(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Lens and view."""
    state, view = BundleState.at(BundleEstimate.level(np.zeros((1, 3)), camera)), np.empty(N_VIEW)
    set_view(state.mount, 0.0, 0.0, view)
    return state.lens, view


def _ground(camera: Camera, uv: np.ndarray) -> np.ndarray:
    """(Ahead of the rear axle, left), in camera heights, by the project's own camera."""
    car = camera.intersect_ground(uv)
    return np.column_stack([car[:, 1] + camera.wheelbase_cm, -car[:, 0]]) / camera.mounting.height_cm


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
@pytest.mark.parametrize("seed", range(3))
def test_lifting_and_projecting_agree_with_the_camera(model, seed):
    rng = np.random.default_rng(seed)
    camera = CAMERAS[model].with_mounting(
        pitch_down_rad=float(rng.uniform(0.0, 0.8)),
        roll_rad=float(rng.uniform(-0.3, 0.3)),
        yaw_rad=float(rng.uniform(-0.5, 0.5)),
        ahead_of_front_axle_cm=float(rng.uniform(-15.0, 10.0)),
        right_of_centre_cm=float(rng.uniform(-6.0, 6.0)),
    )
    lens, view = _vectors(camera)
    is_fisheye = model == "fisheye"
    uv = rng.uniform(0.0, [WIDTH - 1.0, HEIGHT - 1.0], (300, 2))
    expected = _ground(camera, uv)
    lifted = np.array([lift_pixel(is_fisheye, lens, view, u, v) for u, v in uv])
    near = np.isfinite(expected).all(axis=1) & (np.abs(expected).max(axis=1) < 30.0)
    assert near.sum() > 100
    np.testing.assert_allclose(lifted[near], expected[near], atol=1e-5, rtol=1e-5)
    # A pixel above the horizon has no road.
    assert np.isnan(lifted[~np.isfinite(expected).all(axis=1)]).all()
    back = np.array([project_point(is_fisheye, lens, view, a, b) for a, b in expected[near]])
    np.testing.assert_allclose(back, uv[near], atol=1e-6)


def test_a_pinhole_does_not_see_behind_itself():
    lens, view = _vectors(CAMERAS["pinhole"])
    assert np.isnan(project_point(False, lens, view, -3.0, 0.0)).all()


def _changed(camera: Camera, name: str, amount: float) -> Camera:
    """The project's camera with one of the adjustable numbers changed."""
    K, D = camera.K.copy(), camera.D.copy()
    m = camera.mounting
    if name == "focal":
        K[:2, :2] *= 1.0 + amount
    elif name in ("cx", "cy"):
        K[("cx", "cy").index(name), 2] += amount
    elif name == "k1":
        D[0] += amount
    elif name == "lever":
        return camera.with_mounting(ahead_of_front_axle_cm=m.ahead_of_front_axle_cm + amount * m.height_cm)
    else:
        field = {"pitch": "pitch_down_rad", "roll": "roll_rad", "yaw": "yaw_rad"}[name]
        return camera.with_mounting(**{field: getattr(m, field) + amount})
    return replace(camera, K=K, D=D)


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
@pytest.mark.parametrize("seed", range(2))
def test_slopes_of_projecting_by_the_point_and_by_the_camera(model, seed):
    rng = np.random.default_rng(seed)
    camera, by = CAMERAS[model], np.empty((2, 2 + len(CAMERA_NAMES)))
    lens, view = _vectors(camera)

    def seen(point: np.ndarray, which: Camera = camera) -> np.ndarray:
        car = HEIGHT_CM * np.array([[-point[1], point[0]]]) - [0.0, camera.wheelbase_cm]
        return which.project_ground(car)[0]

    for point in rng.uniform([1.5, -2.0], [6.0, 2.0], (20, 2)):
        np.testing.assert_allclose(
            project_with_jacobian(model == "fisheye", lens, view, *point, by), seen(point), atol=1e-6
        )
        slopes = [(seen(point + d) - seen(point - d)) / 2e-4 for d in 1e-4 * np.eye(2)]
        for name, step in zip(CAMERA_NAMES, STEPS, strict=True):
            ends = [seen(point, _changed(camera, name, sign * step)) for sign in (1.0, -1.0)]
            slopes.append((ends[0] - ends[1]) / (2.0 * step))
        np.testing.assert_allclose(by, np.stack(slopes, axis=1), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_derivatives_of_lifting_by_the_camera(model):
    camera = CAMERAS[model]
    problem = _problem(camera)
    lifted, by, half = problem.lift(BundleState.at(BundleEstimate.level(np.zeros((2, 3)), camera)))
    np.testing.assert_allclose(lifted, _ground(camera, problem.points.uv), atol=1e-6)
    np.testing.assert_allclose(
        half, _ground(camera, problem.points.uv + 0.5 * problem.points.normals), atol=1e-5
    )
    near = lifted[:, 0] < 6.0
    for k, name in enumerate(CAMERA_NAMES):
        h = 0.5 * STEPS[k]
        ends = [_ground(_changed(camera, name, sign * h), problem.points.uv) for sign in (1.0, -1.0)]
        expected = (ends[0] - ends[1])[near] / (2.0 * h)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(by[near, k], expected, atol=1e-4 * scale, err_msg=name)


def test_a_frame_that_nods_is_a_camera_that_is_mounted_so():
    camera = fisheye()
    problem = _problem(camera)
    tilt = np.array([[0.0, 0.0], [0.02, -0.015]])
    lifted, _, _ = problem.lift(BundleState.at(BundleEstimate(np.zeros((2, 3)), tilt, camera)))
    m = camera.mounting
    nodded = camera.with_mounting(pitch_down_rad=m.pitch_down_rad + 0.02, roll_rad=m.roll_rad - 0.015)
    for frame, seen in enumerate((camera, nodded)):
        mine = slice(problem.points.starts[frame], problem.points.starts[frame + 1])
        np.testing.assert_allclose(lifted[mine], _ground(seen, problem.points.uv[mine]), atol=1e-5)


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
@pytest.mark.parametrize("seed", range(2))
def test_the_normal_equations_hold_the_slope_of_the_cost(model, seed):
    """Of every unknown: poses, tilts and the camera, with all priors, away from the solution."""
    rng = np.random.default_rng(seed)
    camera, frames = CAMERAS[model], 12
    road = tape_road(frames)
    problem = _problem(camera, frames)
    poses_cm = road.poses + rng.normal(size=(frames, 3)) * [0.01 * HEIGHT_CM, 0.01 * HEIGHT_CM, 0.004]
    state = BundleState.at(BundleEstimate(poses_cm, 0.003 * rng.normal(size=(frames, 2)), camera))
    away = np.concatenate([np.zeros(5 * frames), [0.02, 0.3, -0.4, 0.004, 0.003, 0.002, -0.004, 0.05]])
    state = state.moved(away, problem.free)
    links = problem.associate(state, 4.0)
    assert len(links.point) > 300
    now = problem.equations(state, links)
    descent, curvature = now.descent, np.concatenate([now.frames.diagonal(), np.diag(now.camera)])
    assert abs(now.frames - now.frames.T).max() < 1e-9 * abs(now.frames).max()
    size = np.concatenate([np.full(5 * frames, 1e-5), 0.1 * STEPS])
    # The first pose is held by a prior that drowns every other slope.
    for k in [*rng.choice(np.arange(3, 5 * frames), 12, replace=False), *range(5 * frames, 5 * frames + 8)]:
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(len(descent))
            step[k] = sign * size[k]
            ends.append(problem.equations(state.moved(step, problem.free), links).cost)
        slope = (ends[0] - ends[1]) / (2.0 * size[k])
        tolerance = 1e-4 * abs(slope) + 1e-4 * np.sqrt(curvature[k])
        assert -descent[k] == pytest.approx(slope, abs=tolerance), k


@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_uncertainty_of_a_link_grows_with_the_stretch(model):
    """As told by the camera: a pixel across the edge, moved over the road, is so many pixels long."""
    camera, frames = CAMERAS[model], 6
    road = tape_road(frames)
    problem = _problem(camera, frames)
    state = BundleState.at(BundleEstimate.level(road.poses, camera))
    links = problem.associate(state, 2.0)
    i, j = problem.pairs[links.pair].T
    ends = [
        _ground(camera, problem.points.uv[links.point] + s * problem.points.normals[links.point])
        for s in (0.0, 0.5)
    ]
    poses = state.poses
    there = []
    for end in ends:
        c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
        dx = poses[i, 0] + c * end[:, 0] - s * end[:, 1] - poses[j, 0]
        dy = poses[i, 1] + s * end[:, 0] + c * end[:, 1] - poses[j, 1]
        c, s = np.cos(poses[j, 2]), np.sin(poses[j, 2])
        car = HEIGHT_CM * np.column_stack([s * dx - c * dy, c * dx + s * dy]) - [0.0, camera.wheelbase_cm]
        there.append(camera.project_ground(car))
    stretch = 2.0 * np.linalg.norm(there[1] - there[0], axis=1)
    assert stretch.max() < 4.0 and stretch.max() > 1.5 and stretch.min() < 0.8
    np.testing.assert_allclose(links.sigma, np.sqrt(0.5 * (1.0 + stretch**2)), rtol=1e-4)
    # Seen from further back an edge is a narrower band, seen from nearer a wider one.
    assert np.median(links.sigma[i < j]) > 1.0 > np.median(links.sigma[i > j])


def test_an_edge_that_brightens_the_other_way_is_not_met():
    camera = fisheye()
    edges = pixels(tape_road(2), camera)
    turned = EdgePixels(edges[1].uv_px, -edges[1].normals)
    state = BundleState.at(BundleEstimate.level(tape_road(2).poses, camera))
    met = []
    for second in (edges[1], turned):
        problem = BundleProblem(Observations([edges[0], second]), camera, SMALL, np.random.default_rng(0))
        met.append(len(problem.associate(state, 0.3).point))
    assert met[0] > 20 and met[1] == 0
