"""Edges of tape that is as bright as the floor."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lanenet.perception.edges.canny import EdgeSettings, find_edges
from lanenet.perception.edges.road import PerceptionSettings

GRAY_ALONE, COLOURS = EdgeSettings(), PerceptionSettings().with_colours().edges
#: The strip from the left border to the right one, px.
STRIP = slice(30, 50)


def strip(tape_bgr, floor_bgr) -> np.ndarray:
    frame = np.full((60, 80, 3), floor_bgr, np.uint8)
    frame[:, STRIP] = tape_bgr
    return frame


def gray_of(bgr) -> int:
    return int(cv2.cvtColor(np.full((1, 1, 3), bgr, np.uint8), cv2.COLOR_BGR2GRAY)[0, 0])


@pytest.mark.parametrize("tape_bgr", [(40, 190, 200), (50, 60, 230)], ids=["yellow", "red"])
def test_tape_as_bright_as_the_floor_shows_both_borders(tape_bgr):
    frame = strip(tape_bgr, (gray_of(tape_bgr),) * 3)
    assert len(find_edges(frame, GRAY_ALONE).uv_px) == 0
    found = find_edges(frame, COLOURS)
    left = found.uv_px[:, 0] < 40.0
    for side, border_px, inwards in ((left, 29.5, 1.0), (~left, 49.5, -1.0)):
        assert side.sum() >= 55
        np.testing.assert_allclose(found.uv_px[side, 0], border_px, atol=0.5)
        # As with white tape: the direction is to the inside.
        np.testing.assert_allclose(found.normals[side, 0], inwards, atol=1e-6)


@pytest.mark.parametrize(
    "floor_bgr", [(60, 60, 60), (60, 100, 150), (150, 120, 40)], ids=["gray", "brown", "blue"]
)
def test_white_tape_is_seen_by_its_brightness_on_floors_that_are_not_yellow(floor_bgr):
    frame = strip((235, 235, 235), floor_bgr)
    with_hues, gray = find_edges(frame, COLOURS), find_edges(frame, GRAY_ALONE)
    np.testing.assert_array_equal(with_hues.uv_px, gray.uv_px)
    np.testing.assert_array_equal(with_hues.normals, gray.normals)
    assert len(gray.uv_px) >= 110


def test_white_tape_on_a_yellow_floor_keeps_its_borders():
    frame = strip((235, 235, 235), (100, 180, 220))
    with_hues, gray = find_edges(frame, COLOURS), find_edges(frame, GRAY_ALONE)
    assert len(with_hues.uv_px) >= 110
    np.testing.assert_allclose(with_hues.uv_px, gray.uv_px, atol=0.5)


def test_a_gray_picture_has_no_hues():
    rng = np.random.default_rng(0)
    gray = cv2.GaussianBlur(rng.integers(0, 256, (60, 80), np.uint8), (5, 5), 0)
    for frame in (gray, np.repeat(gray[:, :, None], 3, axis=2)):
        np.testing.assert_array_equal(find_edges(frame, COLOURS).uv_px, find_edges(gray, GRAY_ALONE).uv_px)


def test_what_was_written_before_there_were_hues_looks_at_gray_alone():
    older = GRAY_ALONE.model_dump(mode="json")
    del older["colour_weight"]
    assert EdgeSettings.model_validate(older).colour_weight == 0.0
