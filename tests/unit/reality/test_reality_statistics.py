"""Statistics of drawn frames whose runs, directions and blur are known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from datagen.reality.measure import (
    HEIGHT_CM,
    STATISTICS,
    Sampling,
    at_nominal_height,
    chain_points,
    drive_statistics,
    edge_statistics,
    measure_frames,
)
from datagen.world.car.camera import CameraSettings
from lanenet.perception.edges.road import RangeSettings, RoadTable

CAMERA = at_nominal_height(CameraSettings(width=160, height=120, pitch_down_rad=0.6).build(26.0))
TABLE = RoadTable(CAMERA, RangeSettings())


def _line(offset_cm: float = 10.0, angle_rad: float = 0.0, frame: np.ndarray | None = None) -> np.ndarray:
    """A white line of 4 cm on a gray floor, turned about a point 30 cm ahead."""
    image = np.full((120, 160, 3), 80, np.uint8) if frame is None else frame
    y = np.linspace(-10.0, 100.0, 200)
    sides = np.concatenate(
        [np.stack([np.full(200, -2.0), y - 30.0], axis=1), np.stack([np.full(200, 2.0), 30.0 - y], axis=1)]
    )
    sides[200:, 1] = sides[:200, 1][::-1]
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    road = sides @ np.array([[c, s], [-s, c]]) + [offset_cm, 30.0]
    pixels = CAMERA.project_ground(road)
    cv2.fillPoly(image, [np.rint(pixels * 16).astype(np.int32)], (200, 200, 200), cv2.LINE_AA, 4)
    return image


def _figures(frame: np.ndarray):
    return edge_statistics(frame, TABLE, HEIGHT_CM)


@pytest.mark.parametrize("angle_rad", [-0.6, 0.0, 0.4])
def test_a_line_is_two_long_runs_of_one_direction(angle_rad):
    figures = _figures(_line(angle_rad=angle_rad))
    assert figures.long_runs == 2
    # The ends of the polygon are outside of the picture or so far that nothing is left of them.
    assert figures.short_runs <= 1
    assert figures.along_share > 0.95
    assert figures.direction_entropy < 0.45
    assert figures.clutter_by_band.sum() <= 0.05 * figures.points
    assert figures.points > 100 and np.median(figures.run_lengths_px) > 0.3 * figures.points
    assert figures.by_band.sum() == figures.points


def test_two_lines_across_each_other_are_no_single_direction():
    figures = _figures(_line(0.0, 1.4, _line(0.0, 0.0)))
    assert figures.along_share < 0.8
    assert figures.direction_entropy > _figures(_line(0.0, 0.0)).direction_entropy + 0.1


def test_specks_are_short_runs_and_clutter():
    rng = np.random.default_rng(3)
    frame = np.full((120, 160, 3), 80, np.uint8)
    cells = rng.choice(24, 9, replace=False)
    for cell in cells.tolist():
        u, v = 30 + 18 * (cell % 6), 72 + 11 * (cell // 6)
        frame[v : v + 3, u : u + 3] = 220
    figures = _figures(frame)
    assert figures.specks == 9
    # At a square of three pixels nearly every point faces another way.
    assert figures.short_runs >= 4 * 9
    assert figures.long_runs == 0
    np.testing.assert_array_equal(figures.clutter_by_band, figures.by_band)
    assert drive_statistics([figures])["clutter_middle"] == 100.0


def test_mirrored_frames_have_the_same_statistics():
    frame = _line(14.0, 0.3)
    frame[80:84, 40:43] = 10
    one, other = (drive_statistics([_figures(f)]) for f in (frame, np.ascontiguousarray(frame[:, ::-1])))
    for name in STATISTICS:
        assert other[name] == pytest.approx(one[name], rel=0.06, abs=0.06), name


@pytest.mark.parametrize("sigma_px", [0.8, 1.2, 1.8])
def test_the_blur_of_a_step_is_measured(sigma_px):
    frame = np.full((120, 160), 60.0)
    frame[:, 80:] = 180.0
    frame = cv2.GaussianBlur(frame, (0, 0), sigma_px).round().astype(np.uint8)
    figures = _figures(frame)
    # Differences over a pixel blur too, by 1/12 of a square pixel.
    assert figures.edge_blur_px == pytest.approx(np.sqrt(sigma_px**2 + 1 / 12), rel=0.12)
    steepest = 120.0 / np.sqrt(2.0 * np.pi) / np.sqrt(sigma_px**2 + 1 / 12)
    assert figures.edge_slope == pytest.approx(steepest, rel=0.1)


def test_brightness_and_grain():
    noise = np.random.default_rng(5).normal(0.0, 6.0, (120, 160))
    figures = _figures((100.0 + noise).round().astype(np.uint8))
    assert figures.brightness == pytest.approx(100.0, abs=1.0)
    # The 3 x 3 kernel takes off a quarter of the middle pixel and a share of its neighbours.
    kernel = np.outer([0.25, 0.5, 0.25], [0.25, 0.5, 0.25])
    kernel[1, 1] -= 1.0
    assert figures.grain == pytest.approx(6.0 * np.sqrt(np.sum(kernel**2)), rel=0.1)


def test_an_empty_road_has_counts_but_no_directions():
    figures = _figures(np.full((120, 160, 3), 90, np.uint8))
    values = drive_statistics([figures, figures])
    assert values["points"] == 0 and values["short_runs"] == 0 and values["brightness"] == 90
    for name in ("along_share", "direction_entropy", "clutter_far", "run_length_px", "points_change"):
        assert np.isnan(values[name])
    assert list(values) == list(STATISTICS)


def test_runs_end_at_corners_and_keep_a_lines_edges_apart():
    along = np.stack([np.arange(10.0), np.zeros(10)], axis=1)
    up, down, left = np.tile([0.0, 1.0], (10, 1)), np.tile([0.0, -1.0], (10, 1)), np.tile([1.0, 0.0], (10, 1))
    corner = np.stack([np.full(10, 10.0), np.arange(10.0)], axis=1)
    uv = np.concatenate([along, along + [0.0, 1.5], corner])
    runs = chain_points(uv, np.concatenate([up, down, left]), 2.0 * uv)
    assert sorted(runs.points.tolist()) == [10, 10, 10]
    np.testing.assert_allclose(runs.extent_cm, 18.0)
    assert len(set(runs.of_point[:10].tolist())) == 1
    assert not runs.are_short(20.0).any() and runs.are_short(40.0).all()
    outline = chain_points(uv, np.concatenate([up, down, left]), 2.0 * uv, round_corners=True)
    assert outline.points.tolist() == [30]
    nothing = chain_points(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)))
    assert len(nothing.points) == 0


def test_the_height_of_the_camera_does_not_matter():
    frames = [_line(10.0 + k) for k in range(6)]
    low, high = (
        measure_frames("d", frames.__getitem__, 6, CAMERA.with_mounting(height_cm=h), Sampling(6))
        for h in (9.0, 31.0)
    )
    assert low.statistics == high.statistics
    assert low.camera.mounting.height_cm == HEIGHT_CM and low.mask is None
    placed = replace(CAMERA, mounting=replace(CAMERA.mounting, ahead_of_front_axle_cm=7.0))
    assert measure_frames("d", frames.__getitem__, 6, placed, Sampling(6)).statistics == low.statistics
