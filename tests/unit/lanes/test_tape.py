"""Straight pieces of tape are found where they lie, with their widths; arcs and single borders make none."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.lanes.path import MapEdges
from datagen.lanes.tape import straight_pieces

HEIGHT_CM = 15.0


def _borders(at_cm: np.ndarray, left: np.ndarray, width_cm: float, sides: tuple[float, ...]) -> MapEdges:
    """Edge points on the borders of tape along a course."""
    rng = np.random.default_rng(5)
    points = [
        at_cm + (side * 0.5 * width_cm + rng.normal(0.0, 0.1, (len(at_cm), 1))) * left for side in sides
    ]
    xy, n = np.concatenate(points), len(points) * len(at_cm)
    normals = np.concatenate([-side * left for side in sides])
    return MapEdges(xy, normals, np.zeros(n, np.int64), np.arange(n), np.zeros(n))


def _straight(angle_rad: float, length_cm: float) -> tuple[np.ndarray, np.ndarray]:
    """Places along a straight line from (10, -5), and the unit vector to its left at each."""
    along = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    at = np.array([10.0, -5.0]) + np.arange(0.0, length_cm, 0.1)[:, None] * along
    return at, np.tile([-along[1], along[0]], (len(at), 1))


@pytest.mark.parametrize("angle_deg", [0.0, 50.0, 90.0, 179.0])
def test_a_piece_of_another_width_than_usual_lies_in_the_middle_of_its_borders(angle_deg):
    at, left = _straight(np.deg2rad(angle_deg), 60.0)
    pieces = straight_pieces(_borders(at, left, 5.0, (-1.0, 1.0)), 4.2, HEIGHT_CM)
    assert len(pieces) == 1
    ends = np.stack([pieces[0].begin_cm, pieces[0].end_cm])
    off = (ends - at[0]) @ left[0]
    np.testing.assert_allclose(off, 0.0, atol=0.1)
    assert pieces[0].length_cm == pytest.approx(60.0, abs=3.0)
    assert pieces[0].marking_cm == pytest.approx(5.0, abs=0.1)
    assert abs(pieces[0].bend_rad) < np.deg2rad(2.0)
    assert pieces[0].turned().along == pytest.approx(-pieces[0].along)


def test_one_border_is_no_tape():
    at, left = _straight(0.3, 60.0)
    assert straight_pieces(_borders(at, left, 4.0, (1.0,)), 4.0, HEIGHT_CM) == []


def test_pieces_of_an_arc_bend_as_it_does():
    angle = np.arange(0.0, 2.0, 0.001)
    left = -np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    pieces = straight_pieces(_borders(-60.0 * left, left, 4.0, (-1.0, 1.0)), 4.0, HEIGHT_CM)
    assert pieces
    for piece in pieces:
        assert piece.length_cm < 2.0 * HEIGHT_CM
        assert abs(piece.bend_rad) == pytest.approx(piece.length_cm / 60.0, rel=0.5)
