"""Widths along a line: tape that changes its width is measured where it does, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.lanes.offset import CubicBasis
from datagen.lanes.path import MapEdges
from datagen.lanes.widths import marking_widths
from lanenet.data.maps.line import LaneLine

HEIGHT_CM, TAPE_CM, RADIUS_CM = 18.0, 4.0, 100.0
LAP_CM = 2.0 * np.pi * RADIUS_CM


def _ring(off_cm: float = 0.0) -> LaneLine:
    """A circle, driven to the left, that lies beside the middle of its tape."""
    s_cm = np.arange(0.0, LAP_CM, 1.0)
    angle = s_cm / RADIUS_CM
    xy = (RADIUS_CM - off_cm) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    basis = CubicBasis(np.linspace(0.0, LAP_CM, 41), True)
    control = basis.unfolded(basis.fitted(s_cm, xy))
    known = np.array([[0.0, LAP_CM]])
    sigma = {"sigma_s_cm": s_cm, "sigma_at_cm": np.full(len(s_cm), 0.1)}
    return LaneLine("left", basis.knots_cm, control, known, 0.1, 0, LAP_CM, marking_cm=TAPE_CM, **sigma)


def _edges(width_cm: np.ndarray, s_cm: np.ndarray, rng: np.random.Generator, right: bool = True) -> MapEdges:
    """Edges on the left border, and on the right one, of tape of given widths at given places."""
    angle = s_cm / RADIUS_CM
    outwards = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    parts = []
    for side in (-1.0, 1.0) if right else (-1.0,):
        radius = RADIUS_CM + side * 0.5 * width_cm + rng.normal(0.0, 0.15, len(s_cm))
        parts.append((radius[:, None] * outwards, -side * outwards))
    xy, normals = (np.concatenate([part[i] for part in parts]) for i in range(2))
    n = len(xy)
    return MapEdges(xy, normals, np.zeros(n, np.int64), np.arange(n), np.zeros(n))


@pytest.mark.parametrize("off_cm", [0.0, 0.4])
def test_a_wider_section_is_measured_wherever_the_line_lies_on_the_tape(off_cm):
    rng = np.random.default_rng(1)
    s_cm = rng.uniform(0.0, LAP_CM, 12_000)
    # Across the seam of the lap.
    wide = np.abs(np.mod(s_cm + 100.0, LAP_CM) - 100.0) < 60.0
    line = _ring(off_cm)
    found = marking_widths(line, _edges(np.where(wide, 5.5, TAPE_CM), s_cm, rng), HEIGHT_CM)
    at = line.sigma_s_cm
    inside = np.abs(np.mod(at + 100.0, LAP_CM) - 100.0)
    np.testing.assert_allclose(found[inside < 45.0], 5.5, atol=0.15)
    np.testing.assert_allclose(found[inside > 75.0], TAPE_CM, atol=0.15)


def test_what_shows_one_border_only_has_the_usual_width():
    rng = np.random.default_rng(2)
    s_cm = rng.uniform(0.0, LAP_CM, 12_000)
    line = _ring()
    one_border = _edges(np.full(len(s_cm), 5.5), s_cm, rng, right=False)
    nothing = _edges(np.empty(0), np.empty(0), rng)
    for edges in (one_border, nothing):
        found = replace(line, marking_at_cm=marking_widths(line, edges, HEIGHT_CM))
        np.testing.assert_array_equal(found.widths_cm(np.array([0.0, 50.0])), TAPE_CM)
    assert not len(marking_widths(replace(line, marking_cm=np.nan), one_border, HEIGHT_CM))


def test_a_line_tells_its_width_along_itself_and_keeps_it_in_another_scale():
    line = _ring()
    np.testing.assert_array_equal(line.widths_cm(np.array([0.0, 50.0])), TAPE_CM)
    widths_cm = np.where(line.sigma_s_cm < 100.0, 5.0, TAPE_CM)
    line = replace(line, marking_at_cm=widths_cm)
    assert line.widths_cm(np.array([50.0, 200.0, 50.0 + LAP_CM])) == pytest.approx([5.0, TAPE_CM, 5.0])
    assert line.scaled(2.0).widths_cm(np.array([100.0])) == pytest.approx([10.0])
