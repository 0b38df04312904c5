"""Turns by what is far away: measured in pictures, and believed only where the road agrees."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from picture_road import made_up_drive
from pixel_road import fisheye

from datagen.slam.odometry.motion_grid import far_turns, seen_turns
from lanenet.geometry.camera import Camera


def _camera() -> Camera:
    # Less tilted than the other tests have it, so that walls are in view.
    return fisheye(pitch_down_rad=0.25)


def _pictures(turns_rad: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """A room around a car that turns, and a road that is another one in every picture, both blurred."""
    rng = np.random.default_rng(seed)
    per_rad = _camera().K[0, 0]
    around = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (120, int(2.0 * np.pi * per_rad))), (0, 0), 1.5)
    images = []
    for heading in np.cumsum(turns_rad):
        columns = np.mod(np.arange(160) - heading * per_rad, around.shape[1] - 1.0)
        u, v = np.meshgrid(columns.astype(np.float32), np.arange(120, dtype=np.float32))
        picture = cv2.remap(around.astype(np.float32), u, v, cv2.INTER_LINEAR)
        picture[50:] = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (70, 160)), (0, 0), 1.5)
        picture += rng.normal(0.0, 2.0, picture.shape)
        images.append(cv2.cvtColor(np.clip(picture, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR))
    return images


def test_a_room_shows_the_turns():
    true = 0.08 * np.sin(np.arange(80) / 7.0)
    far = far_turns(made_up_drive(_pictures(true)), _camera())
    assert np.isnan(far[0]) and np.isfinite(far[1:]).mean() > 0.95
    assert np.nanmax(np.abs(far - true)) < np.deg2rad(0.3)
    # Left is positive on the road as well.
    seen = seen_turns(far, true)
    assert seen is not None
    np.testing.assert_allclose(seen.turns_rad[1:], far[1:], rtol=0.02)


def test_larger_pictures_show_the_same():
    true = 0.08 * np.sin(np.arange(30) / 4.0)
    small, camera = _pictures(true), _camera()
    large = [cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC) for image in small]
    K = camera.K * np.array([[2.0, 1.0, 2.0], [1.0, 2.0, 2.0], [1.0, 1.0, 1.0]])
    twice = replace(camera, width=320, height=240, K=K)
    for drive, seen_by in ((made_up_drive(large), twice), (made_up_drive(small), camera)):
        off = np.abs(far_turns(drive, seen_by) - true)
        assert np.isfinite(off[1:]).all() and np.nanmedian(off) < np.deg2rad(0.2)
        assert np.nanmax(off) < np.deg2rad(0.6)


def test_a_camera_that_does_not_see_the_distance_shows_no_turns():
    drive = made_up_drive(_pictures(np.full(10, 0.05)))
    assert np.isfinite(far_turns(drive, _camera())[1:]).all()
    assert np.isnan(far_turns(drive, _camera().with_mounting(pitch_down_rad=1.2))).all()


def test_a_blank_distance_shows_no_turns():
    images = [np.full((120, 160, 3), 90, np.uint8) for _ in range(60)]
    far = far_turns(made_up_drive(images), _camera())
    assert np.isnan(far).all()
    assert seen_turns(far, np.linspace(-0.1, 0.1, 60)) is None


def test_what_goes_with_the_car_shows_no_turns():
    # The same picture again and again, as lamps or the sky's gradient make it, while the car turns.
    rng = np.random.default_rng(0)
    view = rng.integers(0, 255, (120, 160, 3)).astype(np.uint8)
    far = far_turns(made_up_drive([view] * 60), _camera())
    assert np.nanmax(np.abs(far)) < 1e-3
    assert seen_turns(far, 0.05 * np.sin(np.arange(60) / 5.0)) is None


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.6])
def test_the_road_says_how_much_a_shift_is_although_it_misses_slides(factor):
    rng = np.random.default_rng(1)
    true = 0.06 * np.sin(np.arange(300) / 9.0)
    far = true / factor + rng.normal(0.0, 0.003, 300)
    far[::11] = np.nan
    by_road = true + rng.normal(0.0, 0.004, 300)
    by_road[100:120] = 0.0
    by_road[200:215] = 0.1
    seen = seen_turns(far, by_road)
    assert seen is not None
    np.testing.assert_array_equal(np.isnan(seen.turns_rad), np.isnan(far))
    assert np.nanmedian(seen.turns_rad / far) == pytest.approx(factor, rel=0.05)
    assert 0.004 <= seen.sigma_rad < 0.01
    off = np.abs(seen.turns_rad - true)
    assert np.nanmax(off) < 0.025


def test_turns_that_the_road_does_not_know_are_not_believed():
    rng = np.random.default_rng(2)
    far, by_road = 0.03 * rng.normal(size=(2, 300))
    assert seen_turns(far, by_road) is None
    # A lens three times as long as believed, and a drive too short to tell.
    assert seen_turns(by_road / 3.0, by_road) is None
    assert seen_turns(by_road[:30], by_road[:30]) is None
    assert seen_turns(by_road, by_road) is not None
