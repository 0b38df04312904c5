from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.data.camera_file import write_camera
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.error_analysis import (
    AnalysisSettings,
    analyse_errors,
    draw_analysis,
    figures,
    sideways_cm_per_px,
)

DOWN = Camera(
    "pinhole",
    320,
    240,
    np.array([[100.0, 0.0, 159.5], [0.0, 100.0, 119.5], [0.0, 0.0, 1.0]]),
    np.zeros(5),
    # Straight down from 50 cm: 0.5 cm per pixel everywhere, 160 cm x 120 cm of road.
    Mounting(50.0, math.pi / 2, ahead_of_front_axle_cm=60.0),
    26.0,
)
#: The paper's camera, as far as it is stated, 20 cm up, 25 degrees down, at the rear of the car.
PAPER = Camera(
    "fisheye",
    320,
    240,
    np.array(
        [[320.0 / math.radians(170.0), 0.0, 159.5], [0.0, 320.0 / math.radians(170.0), 119.5], [0, 0, 1]]
    ),
    np.zeros(4),
    Mounting(20.0, math.radians(25.0), ahead_of_front_axle_cm=-40.0),
    26.0,
)


def test_a_camera_that_looks_straight_down_has_one_scale() -> None:
    found = analyse_errors(DOWN, AnalysisSettings(cell_cm=5.0))
    road_cm = np.array([[x, y] for x in (-45.0, 0.0, 30.0) for y in (5.0, 60.0, 95.0)])
    np.testing.assert_allclose(sideways_cm_per_px(DOWN, road_cm), 0.5, atol=1e-9)
    assert found.line_cm_per_px == pytest.approx((0.5, 0.5))
    # 5 cm are 10 pixels, and pixel centres lie between the borders of cells.
    assert found.pixels.shape == (20, 20)
    np.testing.assert_array_equal(found.pixels, 100)
    assert found.line_pixels == (100, 100)
    assert found.position_error_cm == pytest.approx(0.7)
    assert found.steering_error_rad == pytest.approx(math.atan(0.7 / 15.0))


def test_every_pixel_that_sees_the_grid_is_counted_once() -> None:
    found = analyse_errors(PAPER)
    v, u = np.mgrid[:240, :320].astype(np.float64)
    road = PAPER.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1))
    half, far = 5.26 * 10, 5.26 * 19
    with np.errstate(invalid="ignore"):
        inside = (road[:, 0] >= -half) & (road[:, 0] < half) & (road[:, 1] >= 0.0) & (road[:, 1] < far)
    assert found.pixels.sum() == np.count_nonzero(inside) > 1000
    np.testing.assert_allclose(found.pixels, found.pixels[:, ::-1], atol=2)  # The camera is in the middle.


def test_the_papers_own_figures() -> None:
    # Kozlowski et al. 2024, section 2.3: 10 mm at 150 mm are 3.8 degrees.
    found = analyse_errors(PAPER)
    tenth = dataclasses.replace(found, position_error_cm=1.0)
    assert math.degrees(tenth.steering_error_rad) == pytest.approx(3.8, abs=0.05)
    assert max(found.line_cm_per_px) == pytest.approx(0.6, abs=0.05)
    assert found.position_error_cm <= 1.0
    assert math.degrees(found.steering_error_rad) <= 3.8
    assert [row[2] for row in figures(found)] == ["10, 24", "6", "<= 10", "3.8"]


def test_lines_outside_the_picture_are_unknown_and_no_road_is_an_error() -> None:
    far = analyse_errors(DOWN, AnalysisSettings(lane_width_cm=400.0))
    assert far.line_pixels == (0, 0)
    assert math.isnan(far.position_error_cm) and math.isnan(far.steering_error_rad)
    with pytest.raises(CalibrationError, match="no pixel sees the road within"):
        analyse_errors(DOWN.with_mounting(pitch_down_rad=-1.5))


def test_the_command_shows_the_figures_and_writes_the_picture(tmp_path: Path) -> None:
    camera, picture = tmp_path / "camera.yaml", tmp_path / "density.png"
    write_camera(camera, PAPER, "nominal values")
    result = CliRunner().invoke(app, ["analyse", str(camera), "--out", str(picture)])
    assert result.exit_code == 0, result.output
    assert "<= 10" in result.output and "lanenet doctor" in result.output
    np.testing.assert_array_equal(cv2.imread(str(picture)), draw_analysis(analyse_errors(PAPER)))
    wrong = CliRunner().invoke(app, ["analyse", str(camera), "--out", str(tmp_path / "x.jpg")])
    assert wrong.exit_code != 0


def test_figures_where_one_or_both_lines_are_not_seen() -> None:
    nan = math.nan
    full = analyse_errors(DOWN)
    one = dataclasses.replace(full, line_cm_per_px=(nan, 0.5), position_error_cm=0.7)
    assert [row[1] for row in figures(one)[1:3]] == ["-, 5.0", "7.0"]
    none = dataclasses.replace(full, line_cm_per_px=(nan, nan), position_error_cm=nan)
    assert [row[1] for row in figures(none)[1:]] == ["-, -", "-", "-"]
    assert draw_analysis(none).shape == draw_analysis(full).shape
