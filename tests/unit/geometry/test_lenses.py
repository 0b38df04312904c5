from __future__ import annotations

import numpy as np
import pytest

from lanenet.geometry.camera import (
    distort_pinhole,
    fisheye_radius,
    fisheye_slope,
    invert_fisheye,
    invert_pinhole,
    pinhole_radius,
)

FISHEYE = np.array([-0.03, 0.004, -0.002, 0.0003])
PINHOLE = np.array([-0.25, 0.06, 0.002, -0.003, -0.005])


def test_without_coefficients_a_fisheye_is_equidistant_and_a_pinhole_straight() -> None:
    angles = np.linspace(0.0, 3.0, 7)
    np.testing.assert_array_equal(fisheye_radius(angles, np.zeros(4)), angles)
    np.testing.assert_array_equal(fisheye_slope(angles, np.zeros(4)), 1.0)
    np.testing.assert_allclose(invert_fisheye(angles, np.zeros(4), np.pi), angles, atol=1e-15)
    xy = np.array([[0.0, 0.0], [0.7, -1.3]])
    np.testing.assert_array_equal(distort_pinhole(xy, np.zeros(5)), xy)
    np.testing.assert_array_equal(invert_pinhole(xy, np.zeros(4)), xy)


def test_the_slope_of_a_fisheye_is_that_of_its_radius() -> None:
    angles, step = np.linspace(0.1, 1.4, 20), 1e-6
    rise = fisheye_radius(angles + step, FISHEYE) - fisheye_radius(angles - step, FISHEYE)
    np.testing.assert_allclose(fisheye_slope(angles, FISHEYE), rise / (2.0 * step), atol=1e-9)


def test_a_radius_of_a_fisheye_has_its_angle_up_to_the_largest() -> None:
    angles = np.linspace(0.0, 1.5, 31)
    found = invert_fisheye(fisheye_radius(angles, FISHEYE), FISHEYE, 1.5)
    np.testing.assert_allclose(found, angles, atol=1e-12)
    beyond = fisheye_radius(np.array([1.5]), FISHEYE) + 1e-6
    assert np.isnan(invert_fisheye(beyond, FISHEYE, 1.5)).all()


def test_the_distortion_of_a_pinhole_can_be_undone() -> None:
    xy = np.random.default_rng(3).uniform(-0.6, 0.6, (200, 2))
    np.testing.assert_allclose(invert_pinhole(distort_pinhole(xy, PINHOLE), PINHOLE), xy, atol=1e-9)


def test_the_radius_of_a_pinhole_is_its_distortion_without_the_tangential_part() -> None:
    xy = np.array([[0.3, 0.4], [-0.6, 0.0]])
    radial = PINHOLE * [1.0, 1.0, 0.0, 0.0, 1.0]
    moved = np.linalg.norm(distort_pinhole(xy, radial), axis=1)
    np.testing.assert_allclose(pinhole_radius(np.array([0.5, 0.6]), PINHOLE), moved)
    # By hand: 0.5 (1 - 0.25 / 4 + 0.06 / 16 - 0.005 / 64).
    assert moved[0] == pytest.approx(0.5 * (1.0 - 0.0625 + 0.00375 - 0.000078125))


def test_coefficients_that_are_not_given_are_zero() -> None:
    xy = np.array([[0.3, 0.4]])
    np.testing.assert_array_equal(
        distort_pinhole(xy, PINHOLE[:4]), distort_pinhole(xy, PINHOLE * [1.0, 1.0, 1.0, 1.0, 0.0])
    )
