"""The bundle adjustment finds the camera where it may, and leaves alone what it may not change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pixel_road import camera_numbers, fisheye, pixels, tape_loop
from tape_road import TapeRoad, tape_road

from datagen.slam.adjustment import adjust as adjustment
from datagen.slam.adjustment.adjust import CAMERA_NAMES, BundleEstimate, BundleSettings, Observations, adjust

#: The pixels are exact, so that they may weigh more, and be looked for nearer, than those of a real picture.
SMALL = BundleSettings(points=40, pixel_sigma=0.3, gates_px=(5.0, 4.0, 3.0, 2.0, 1.0, 1.0))
LAP = 60


def _rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def _around(frames: int = 100) -> tuple[TapeRoad, list[tuple[int, int]]]:
    """A lap and two thirds, and pairs of frames that show the same place."""
    return tape_loop(frames, LAP), [(k, k + LAP) for k in range(0, frames - LAP, 2)]


@pytest.mark.parametrize("seed", range(2))
def test_a_wrong_camera_comes_back_when_the_loop_is_closed(seed):
    camera, (road, loops) = fisheye(), _around()
    m = camera.mounting
    wrong = fisheye(
        pitch_down_rad=m.pitch_down_rad + 0.02,
        yaw_rad=m.yaw_rad + 0.01,
        ahead_of_front_axle_cm=m.ahead_of_front_axle_cm + 1.5,
    )
    wrong.K[:2, :2] *= 1.05
    found = adjust(
        Observations(pixels(road, camera)),
        BundleEstimate.level(road.poses, wrong),
        SMALL,
        _rng(seed),
        loops=loops,
    )
    f = found.camera
    assert f.K[0, 0] == pytest.approx(camera.K[0, 0], rel=0.005)
    assert f.K[1, 1] / f.K[0, 0] == pytest.approx(camera.K[1, 1] / camera.K[0, 0])
    assert f.D[0] == pytest.approx(camera.D[0], abs=0.005)
    assert f.mounting.pitch_down_rad == pytest.approx(m.pitch_down_rad, abs=0.003)
    assert f.mounting.roll_rad == pytest.approx(m.roll_rad, abs=0.003)
    assert f.mounting.yaw_rad == pytest.approx(m.yaw_rad, abs=0.002)
    assert f.mounting.ahead_of_front_axle_cm == pytest.approx(m.ahead_of_front_axle_cm, abs=0.3)
    assert f.mounting.height_cm == m.height_cm and f.wheelbase_cm == camera.wheelbase_cm
    assert len(found.pairs) == sum(100 - lag for lag in SMALL.lags) + 2 * len(loops)
    # The loop makes the focal length known far better than it was.
    assert 0.0 < found.sigma["focal"] < 0.04 < SMALL.focal


def test_sigmas_that_nobody_asked_for_are_left_out():
    camera, (road, loops) = fisheye(), _around(80)
    observed, start = Observations(pixels(road, camera)), BundleEstimate.level(road.poses, camera)
    known, left_out = (
        adjust(observed, start, SMALL, _rng(), loops=loops, with_sigma=w) for w in (True, False)
    )
    np.testing.assert_array_equal(known.poses, left_out.poses)
    assert min(known.sigma.values()) > 0.0 and not any(left_out.sigma.values())


@pytest.mark.slow
def test_an_error_that_all_frames_share_is_not_averaged_away():
    camera, (road, loops) = fisheye(), _around()
    off = []
    for seed in range(3):
        # Edges in a part of the image that face one way are found a little off, in every frame.
        errors_px, edges = 0.15 * _rng(seed).normal(size=(24, 8)), []
        for frame in pixels(road, camera):
            way = np.arctan2(frame.normals[:, 1], frame.normals[:, 0]) / (0.25 * np.pi)
            error_px = errors_px[(frame.uv_px[:, 1] / 10.0).astype(int), np.rint(way).astype(int) % 8]
            edges.append(replace(frame, uv_px=frame.uv_px + error_px[:, None] * frame.normals))
        start = BundleEstimate.level(road.poses, camera)
        found = adjust(Observations(edges), start, SMALL, _rng(seed), loops=loops)
        off.append(np.log(found.camera.K[0, 0] / camera.K[0, 0]) / found.sigma["focal"])
        tilt_rad = found.camera.mounting.pitch_down_rad - camera.mounting.pitch_down_rad
        off.append(tilt_rad / found.sigma["pitch"])
    assert np.max(np.abs(off)) < 2.0
    assert np.sqrt(np.mean(np.square(off))) > 0.2


def test_what_a_rolling_shutter_does_to_the_pitch_is_within_its_sigma(monkeypatch):
    monkeypatch.setattr(adjustment, "_EDGE_ERROR_PX", 0.0)
    camera, (road, loops) = fisheye(), _around()
    step_cm = float(np.median(np.hypot(*np.diff(road.poses[:, :2], axis=0).T)))
    edges = []
    for frame in pixels(road, camera):
        # The lower the row, the later it is read, and the nearer is the road that it shows.
        seen = camera.intersect_ground(frame.uv_px)
        seen[:, 1] -= 0.3 * step_cm * frame.uv_px[:, 1] / camera.height
        edges.append(replace(frame, uv_px=camera.project_ground(seen)))
    start = BundleEstimate.level(road.poses, camera)
    found = adjust(Observations(edges), start, SMALL, _rng(), loops=loops)
    tilt_rad = found.camera.mounting.pitch_down_rad - camera.mounting.pitch_down_rad
    assert 0.2 * found.sigma["pitch"] < abs(tilt_rad) < 2.0 * found.sigma["pitch"]


@pytest.mark.slow
def test_frames_that_shake_do_not_lengthen_the_lens():
    camera, (road, loops) = fisheye(), _around()
    tilt_rad = _rng(3).normal(0.0, [0.012, 0.006], (100, 2))
    observed = Observations(pixels(road, camera, tilt_rad))
    start = BundleEstimate.level(road.poses, camera)
    off = []
    for settings in (BundleSettings(points=40), BundleSettings(points=40).with_free_tilt()):
        found = adjust(observed, start, settings, _rng(), loops=loops)
        off.append(np.log(found.camera.K[0, 0] / camera.K[0, 0]))
    assert abs(off[1]) < 0.5 * abs(off[0])


@pytest.mark.parametrize("free", [(), ("pitch", "yaw"), ("focal", "k1")])
def test_what_is_not_free_stays(free):
    camera, road = fisheye(pitch_down_rad=0.29, yaw_rad=-0.03), tape_road(30)
    found = adjust(
        Observations(pixels(road, fisheye())),
        BundleEstimate.level(road.poses, camera),
        SMALL,
        _rng(),
        free=free,
    )
    moved = np.abs(camera_numbers(found.camera) - camera_numbers(camera))
    for k, name in enumerate(CAMERA_NAMES):
        if name in free:
            assert moved[k] > 1e-6 and found.sigma[name] > 1e-7, name
        else:
            assert moved[k] < 1e-12 and found.sigma[name] == 0.0, name
    np.testing.assert_array_equal(found.camera.D[1:], camera.D[1:])
