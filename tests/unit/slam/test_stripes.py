"""Borders of narrow stripes are put where they are on the road."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from datagen.slam.stripes import apparent_px, fit_width, true_borders
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.canny import EdgeSettings, find_edges
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RangeSettings, RoadTable

CAMERA = Camera(
    "fisheye",
    160,
    120,
    np.array([[78.0, 0.0, 79.5], [0.0, 78.0, 59.5], [0.0, 0.0, 1.0]]),
    np.array([-0.03, 0.0, 0.0, 0.0]),
    Mounting(17.0, 0.3, 0.0, 0.0, -2.0, 0.0),
    17.0,
)
TABLE = RoadTable(CAMERA, RangeSettings())
TAPE_CM, FINE = 3.0, 4
#: Beyond, one border of a pair is out of range now and then.
FAR_CM = 70.0


@cache
def fine_road_cm() -> np.ndarray:
    """Road points of the parts of all pixels."""
    step = (np.arange(FINE) + 0.5) / FINE - 0.5
    v, u = (np.repeat(np.arange(size), FINE) + np.tile(step, size) for size in (120, 160))
    return CAMERA.intersect_ground(np.stack([np.tile(u, len(v)), np.repeat(v, len(u))], axis=1))


def picture(tapes: list[tuple[float, float]], wide_cm: float, light: float, floor: float) -> np.ndarray:
    """Straight tapes on the floor, each given by x at y = 0 and its slope, with pixels that average."""
    x, y = fine_road_cm().T
    on = np.zeros(len(x), bool)
    for start, slope in tapes:
        on |= np.abs(x - start - slope * y) < 0.5 * wide_cm * np.hypot(1.0, slope)
    fine = np.where(on & (y < 200.0), light, floor).reshape(120, FINE, 160, FINE)
    return np.rint(fine.mean(axis=(1, 3))).astype(np.uint8)


def drive(wide_cm: float, light: float, floor: float) -> tuple[list[EdgePixels], list]:
    rng = np.random.default_rng(4)
    roads = [[(-18.0 + dx, a), (18.0 + dx, a)] for dx, a in zip(*rng.uniform(-0.5, 0.5, (2, 8)), strict=True)]
    frames = [
        find_edges(picture(tapes, wide_cm, light, floor), EdgeSettings(), TABLE.keep) for tapes in roads
    ]
    return frames, roads


def outwards_px(frames: list[EdgePixels], roads: list, wide_cm: float, near_cm: float) -> float:
    """Mean distance of the borders beyond ``near_cm`` from the true ones, away from the tape's middle."""
    off = []
    for pixels, tapes in zip(frames, roads, strict=True):
        x, y = TABLE.lift_points(pixels).T
        for start, slope in tapes:
            beside_cm = (x - start - slope * y) / np.hypot(1.0, slope)
            ours = (np.abs(beside_cm) < 2.0 * wide_cm) & (y > near_cm) & (y < FAR_CM) & (y < FAR_CM)
            across = np.array([1.0, -slope]) / np.hypot(1.0, slope)
            foot = np.stack([x, y], axis=1)[ours] + np.outer(
                np.sign(beside_cm[ours]) * 0.5 * wide_cm - beside_cm[ours], across
            )
            miss_px = np.abs(
                np.sum((CAMERA.project_ground(foot) - pixels.uv_px[ours]) * pixels.normals[ours], axis=1)
            )
            off.append(np.sign(np.abs(beside_cm[ours]) - 0.5 * wide_cm) * miss_px)
    return float(np.mean(np.concatenate(off)))


@pytest.mark.parametrize(("light", "floor"), [(200.0, 90.0), (30.0, 170.0)], ids=["bright", "dark"])
def test_far_borders_of_a_line_are_no_longer_too_far_apart(light, floor):
    frames, roads = drive(TAPE_CM, light, floor)
    assert outwards_px(frames, roads, TAPE_CM, 50.0) > 0.2
    moved = true_borders(frames, TABLE)
    assert abs(outwards_px(moved, roads, TAPE_CM, 50.0)) < 0.07
    assert abs(outwards_px(moved, roads, TAPE_CM, 0.0)) < 0.03


def test_edges_of_something_else_stay():
    frames, _ = drive(TAPE_CM, 200.0, 90.0)
    wide = find_edges(picture([(0.0, 0.0)], 20.0, 200.0, 90.0), EdgeSettings(), TABLE.keep)
    joint = find_edges(picture([(0.0, 0.0)], 0.6, 60.0, 140.0), EdgeSettings(), TABLE.keep)
    moved = true_borders([*frames, wide, joint], TABLE)
    np.testing.assert_array_equal(moved[-2].uv_px, wide.uv_px)
    np.testing.assert_array_equal(moved[-1].uv_px, joint.uv_px)


def test_stripes_of_no_common_width_stay():
    frames = [
        find_edges(picture([(x, 0.0)], wide_cm, 200.0, 90.0), EdgeSettings(), TABLE.keep)
        for x, wide_cm in zip(np.linspace(-30.0, 30.0, 8), np.geomspace(1.0, 12.0, 8), strict=True)
    ]
    for few in (frames, frames[:1], [EdgePixels(np.empty((0, 2)), np.empty((0, 2)))], []):
        for before, after in zip(few, true_borders(few, TABLE), strict=True):
            np.testing.assert_array_equal(before.uv_px, after.uv_px)


def test_a_stripe_that_is_hardly_there_appears_two_sigma_wide():
    assert apparent_px(np.array([1e-6, 1.0, 20.0]), 0.8) == pytest.approx([1.6, 1.73, 20.0], abs=0.02)


def test_width_and_blur_are_found():
    rng = np.random.default_rng(0)
    per_cm = rng.uniform(0.3, 3.0, 2000)
    apart_px = apparent_px(2.5 * per_cm, 1.4) + rng.normal(0.0, 0.2, 2000)
    apart_px[:300] = rng.uniform(2.0, 12.0, 300)
    assert fit_width(apart_px, per_cm) == pytest.approx((2.5, 1.4), rel=0.03)
