"""A line lies at the middle of its marking; what is no marking is no line."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from lane_frames import CAMERA, lane_frame

from lanenet.perception.hough.detector import HoughSettings, HoughTracker
from lanenet.perception.hough.edges import Contours, HoughEdgeSettings, binarise, crowded_share, gray_of
from lanenet.perception.hough.lines import (
    HoughLineSettings,
    Segment,
    centre_on_marking,
    find_lane_segments,
    length_along,
    x_at,
)

LINES = HoughLineSettings()
ROWS = np.array([0.0, 15.0, 30.0])


def painted(lines: list[tuple[float, float, float]], rows: tuple[int, int] = (0, 70)) -> Contours:
    """Contours of bright markings |x - (p y + q)| <= width / 2 on dark ground, sharp edges made soft."""
    fine = 8
    x = (np.arange(160 * fine) + 0.5) / fine - 0.5
    y = np.arange(70)[:, None]
    on = np.zeros((70, x.size), bool)
    for p, q, width in lines:
        on |= np.abs(x - (p * y + q)) <= 0.5 * width
    on &= (y >= rows[0]) & (y < rows[1])
    gray = np.where(on, 200.0, 60.0).reshape(70, 160, fine).mean(axis=2).astype(np.uint8)
    response = np.asarray(cv2.Sobel(cv2.GaussianBlur(gray, (5, 5), 0), cv2.CV_16S, 1, 0))
    return Contours(response, binarise(response, 100.0))


@pytest.mark.parametrize("channel", ["hue", "value"])
@pytest.mark.parametrize(
    ("centre", "slope"), [(0.0, 0.0), (4.0, 0.1), (-5.0, -0.1), (6.0, -0.1), (0.0, 0.15), (-6.0, -0.15)]
)
def test_lines_lie_at_the_middle_of_the_markings(channel: str, centre: float, slope: float) -> None:
    frame = lane_frame(centre, slope)
    settings = HoughSettings.model_validate({"edges": {"channel": channel}})
    estimate = HoughTracker(CAMERA, settings).detect(frame)
    assert estimate.confidence == 1.0 and estimate.mask.all()
    truth = np.concatenate([side + centre + slope * ROWS for side in (-20.0, 20.0)])
    assert np.abs(estimate.points_cm - truth).max() < 0.5
    # The paper's line is an edge of the 3 cm marking.
    plain = HoughSettings.model_validate({"edges": {"channel": channel}, "lines": {"middle": False}})
    edge = np.abs(HoughTracker(CAMERA, plain).detect(frame).points_cm - truth)
    assert np.nanmax(edge) > 1.0


@pytest.mark.parametrize("width", [3.0, 6.0, 12.0])
@pytest.mark.parametrize("side", [-0.5, 0.5])
def test_from_either_edge_to_the_middle(width: float, side: float) -> None:
    contours = painted([(-0.8, 90.0, width)])
    # Near an edge of x = 90 - 0.8 y, from row 20 to 40 only.
    near = [90.0 + side * width - 0.8 * y for y in (40.0, 20.0)]
    found = centre_on_marking(Segment(near[0] + 0.6, 40.0, near[1] - 0.6, 20.0), contours, 100.0, LINES)
    assert found.y1 > 60.0 and found.y2 < 10.0
    for y in (0.0, 35.0, 69.0):
        assert x_at(found.line, y) == pytest.approx(90.0 - 0.8 * y, abs=0.15)


def test_a_single_edge_stays_an_edge() -> None:
    # 40 px wide: the other edge lies beyond the widest marking.
    contours = painted([(-0.8, 90.0, 40.0)])
    found = centre_on_marking(Segment(38.5, 40.0, 53.5, 20.0), contours, 100.0, LINES)
    assert x_at(found.line, 30.0) == pytest.approx(90.0 - 24.0 - 20.0, abs=0.3)
    nothing = Contours(np.zeros((70, 160), np.int16), np.zeros((70, 160), np.uint8))
    segment = Segment(38.0, 40.0, 54.0, 20.0)
    assert centre_on_marking(segment, nothing, 100.0, LINES) == segment


def test_the_stretch_that_is_seen_ends_where_the_marking_does() -> None:
    contours = painted([(-0.8, 90.0, 6.0)], rows=(15, 50))
    found = centre_on_marking(Segment(61.0, 40.0, 77.0, 20.0), contours, 100.0, LINES)
    assert found.y1 == pytest.approx(49.0, abs=2.0) and found.y2 == pytest.approx(15.0, abs=2.0)


def test_a_line_over_contours_of_both_signs_is_none() -> None:
    # Bright pillars; a flat line over all of them is contour nearly everywhere, rising and falling.
    contours = painted([(0.0, 8.0 + 8.0 * k, 4.0) for k in range(18)])
    assert find_lane_segments(contours, HoughLineSettings(by_sign=False, crowded_length_px=0.0))
    assert not find_lane_segments(contours, HoughLineSettings(crowded_length_px=0.0))


def test_length_along_counts_all_dashes_of_a_line() -> None:
    binary = np.zeros((70, 160), np.uint8)
    for k in [*range(5, 25), *range(40, 60)]:
        binary[k, 100 - k] = 1
    # 40 pixels on a diagonal.
    assert length_along(Segment(60.0, 40.0, 80.0, 20.0), binary) == pytest.approx(40.0 * np.sqrt(2.0))
    assert length_along(Segment(60.0, 30.0, 80.0, 30.0), binary) == 0.0


def test_crowded_share_counts_blocks() -> None:
    binary = np.zeros((70, 160), np.uint8)
    binary[0, :40] = 1
    # 4 of 7 * 16 blocks; a remainder that fills no block is left out.
    assert crowded_share(binary) == pytest.approx(4.0 / 112.0)
    assert crowded_share(np.ones((25, 33), np.uint8)) == 1.0


def test_hue_of_gray_and_of_dark_is_not_looked_at() -> None:
    # Yellow, nearly gray yellow, nearly black yellow.
    roi = np.array([[[0, 200, 200], [180, 200, 200], [0, 20, 20]]], np.uint8)
    assert gray_of(roi, HoughEdgeSettings()).tolist() == [[30, 179, 179]]
    plain = HoughEdgeSettings(min_saturation=0, min_value=0)
    assert gray_of(roi, plain).tolist() == [[30, 30, 30]]
