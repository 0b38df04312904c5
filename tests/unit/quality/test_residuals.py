"""Residuals of projected borders: known shifts come back, clutter and wrong directions do not count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datagen.quality.residuals import border_residuals, coverage, reference_scale, robust_sd
from lanenet.data.maps.frame_lines import FrameLines
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.pixels import EdgePixels

CAMERA = Camera(
    "fisheye",
    160,
    120,
    np.array([[80.0, 0.0, 79.5], [0.0, 80.0, 59.5], [0.0, 0.0, 1.0]]),
    np.array([-0.03, 0.0, 0.0, 0.0]),
    Mounting(15.0, pitch_down_rad=0.3, ahead_of_front_axle_cm=-3.0),
    17.0,
)
TAPE_CM = 3.0
KEEP = np.full((120, 160), 255, np.uint8)


def lane(bend_per_cm: float = 0.0, end_cm: float = 100.0) -> FrameLines:
    y = np.arange(-20.0, end_cm, 2.0)
    left, right = (np.column_stack([x + 0.5 * bend_per_cm * y**2, y]) for x in (-18.0, 22.0))
    return FrameLines(left, right, np.full(6, np.nan))


def edges_of(lines: FrameLines, shift_px: float = 0.0, tape_cm: float = TAPE_CM) -> EdgePixels:
    """Edges exactly on the borders, a tenth of a centimetre apart, moved along their gradient."""
    uv, normals = [], []
    for line in (lines.left_cm, lines.right_cm):
        if not np.isfinite(line).all():
            continue
        y = np.arange(-10.0, 95.0, 0.1)
        x = np.interp(y, line[:, 1], line[:, 0])
        slope = np.gradient(x, y)
        across = np.column_stack([np.ones_like(y), -slope]) / np.hypot(1.0, slope)[:, None]
        for border in (-0.5, 0.5):
            points = np.column_stack([x, y]) + border * tape_cm * across
            at = CAMERA.project_ground(points)
            inwards = CAMERA.project_ground(points - np.sign(border) * 0.01 * across) - at
            tangent = np.gradient(at, axis=0)
            normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            normal *= np.sign(np.sum(normal * inwards, axis=1))[:, None]
            uv.append(at + shift_px * normal)
            normals.append(normal)
    return EdgePixels(np.concatenate(uv), np.concatenate(normals))


def measure(edges: EdgePixels, lines: FrameLines, **changes: float) -> np.ndarray:
    return np.concatenate(border_residuals(edges, lines, TAPE_CM, CAMERA, KEEP, **changes))


@pytest.mark.parametrize("bend_per_cm", [0.0, 0.006, -0.006])
def test_edges_on_the_borders_have_no_residual(bend_per_cm):
    lines = lane(bend_per_cm)
    for found in border_residuals(edges_of(lines), lines, TAPE_CM, CAMERA, KEEP):
        assert coverage(found) > 0.98 and len(found) > 20
        assert np.nanpercentile(np.abs(found), 95.0) < 0.1


@settings(max_examples=15)
@given(st.floats(-2.5, 2.5))
def test_a_shift_along_the_gradient_comes_back_with_its_sign(shift_px):
    """Markings wider than thought give negative residuals, whatever side the border is on."""
    found = measure(edges_of(lane(), shift_px), lane())
    assert np.nanmedian(found) == pytest.approx(shift_px, abs=0.06)
    assert robust_sd(found) == pytest.approx(1.4826 * abs(shift_px), abs=0.1)


def test_a_wider_tape_lies_outside():
    assert np.nanmedian(measure(edges_of(lane(), tape_cm=TAPE_CM + 1.0), lane())) < -0.2


def test_edges_beyond_the_gate_or_of_the_other_direction_are_not_found():
    edges = edges_of(lane())
    # Further away the marking is narrower than the gate, and its other border is within it.
    near = lane(end_cm=12.0)
    for wrong in (EdgePixels(edges.uv_px, -edges.normals), edges_of(lane(), 6.0)):
        found = measure(wrong, near)
        assert len(found) > 10 and coverage(found) == 0.0
    nothing = measure(EdgePixels(np.empty((0, 2)), np.empty((0, 2))), lane())
    assert coverage(nothing) == 0.0 and np.isnan(robust_sd(nothing)) and len(nothing) > 50


def test_a_line_in_the_empty_middle_of_the_lane_meets_nothing():
    alone = replace(lane(), right_cm=np.full((60, 2), np.nan))
    assert coverage(measure(edges_of(lane()), alone)) > 0.98
    aside = measure(edges_of(lane()), alone, aside_cm=20.0)
    assert len(aside) > 20 and coverage(aside) == 0.0


def test_only_what_the_frame_shows_counts():
    keep = KEEP.copy()
    keep[:, :80] = 0
    left, right = border_residuals(edges_of(lane()), lane(), TAPE_CM, CAMERA, keep)
    assert not len(left) and len(right) > 20
    unsupported = FrameLines(np.full((5, 2), np.nan), np.full((5, 2), np.nan), np.full(6, np.nan))
    assert len(measure(edges_of(lane()), unsupported)) == 0


def test_the_tilt_of_the_frame_matters():
    edges = edges_of(lane())
    m = CAMERA.mounting
    nodded = CAMERA.with_mounting(pitch_down_rad=m.pitch_down_rad + 0.01)
    found = np.concatenate(border_residuals(edges, lane(), TAPE_CM, nodded, KEEP))
    assert robust_sd(found) > 0.3


def test_figures_of_known_residuals():
    residual_px = np.array([-1.0, 0.5, np.nan, 2.0, 0.0])
    assert coverage(residual_px) == pytest.approx(0.8)
    assert robust_sd(residual_px) == pytest.approx(1.4826 * 0.75)
    assert np.isnan(coverage(np.empty(0)))


def test_a_camera_close_to_the_road_is_not_held_to_fractions_of_a_millimetre():
    assert reference_scale(CAMERA) == 1.0
    wide = replace(CAMERA, width=320, height=240, K=CAMERA.K * [[2.0], [2.0], [1.0]])
    assert reference_scale(wide) == pytest.approx(0.5)
    # Several times as near to what lies 45 cm ahead.
    near = CAMERA.with_mounting(height_cm=8.0, ahead_of_front_axle_cm=36.0, pitch_down_rad=0.9)
    left, right = near.project_ground(np.array([[-0.5, 45.0], [0.5, 45.0]]))
    assert reference_scale(near) == pytest.approx(1.0 / (0.45 * (right - left)[0]), rel=0.02)
    assert reference_scale(near) < 0.5
    # That place is behind it.
    ahead = CAMERA.with_mounting(ahead_of_front_axle_cm=80.0)
    assert reference_scale(ahead) == reference_scale(CAMERA.with_mounting(ahead_of_front_axle_cm=40.0))


def test_a_line_that_knows_its_marking_is_compared_with_that():
    unknown = np.full(len(lane().left_cm), np.nan)
    wide = replace(lane(), widths_cm=(np.full_like(unknown, TAPE_CM + 1.5), unknown))
    assert abs(np.nanmedian(measure(edges_of(lane()), lane()))) < 0.05
    left, right = border_residuals(edges_of(lane()), wide, TAPE_CM, CAMERA, KEEP)
    assert np.nanmedian(left) > 0.3 and abs(np.nanmedian(right)) < 0.05
