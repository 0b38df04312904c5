"""Kinks: a line that cuts the corners of its tape goes through them; bends and gaps get none."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from datagen.lanes.kinks import with_kinks
from datagen.lanes.offset import CubicBasis
from datagen.lanes.path import MapEdges
from lanenet.data.maps.line import LaneLine

HEIGHT_CM, TAPE_CM, SIDE_CM, LANE_CM = 18.0, 2.4, 160.0, 40.0
#: How far a smooth line cuts a corner.
CUT_CM = 30.0


def _corners(angle_deg: float) -> np.ndarray:
    """Corners of an open course of four pieces that turns left, right and left."""
    turns = np.deg2rad(angle_deg) * np.array([0.0, 1.0, 0.0, 1.0])
    steps = SIDE_CM * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def _square() -> np.ndarray:
    """A closed course with a corner of 90 degrees at its seam."""
    return SIDE_CM * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])


def _along(course_cm: np.ndarray, s_cm: np.ndarray) -> np.ndarray:
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(course_cm, axis=0).T))])
    return np.stack([np.interp(s_cm, lengths, course_cm[:, i]) for i in range(2)], axis=1)


def _borders(course_cm: np.ndarray, seed: int = 0, every_cm: float = 0.1) -> MapEdges:
    """Edge points on both borders of tape along a course."""
    rng = np.random.default_rng(seed)
    points, normals = [], []
    for start, end in itertools.pairwise(course_cm):
        length = float(np.linalg.norm(end - start))
        along = (end - start) / length
        left = np.array([-along[1], along[0]])
        for side in (1.0, -1.0):
            at = rng.uniform(0.0, length, int(length / every_cm))
            off = side * 0.5 * TAPE_CM + rng.normal(0.0, 0.15, len(at))
            points.append(start + at[:, None] * along + off[:, None] * left)
            normals.append(np.tile(-side * left, (len(at), 1)))
    xy, n = np.concatenate(points), sum(map(len, points))
    return MapEdges(xy, np.concatenate(normals), np.zeros(n, np.int64), np.arange(n), np.zeros(n))


def _smooth(course_cm: np.ndarray, closed: bool = False, cut_cm: float = CUT_CM) -> LaneLine:
    """A cubic that is rounded at the corners of a course."""
    length = float(np.hypot(*np.diff(course_cm, axis=0).T).sum())
    s_cm = np.arange(0.0, length, 1.0)
    around = s_cm[:, None] + np.linspace(-cut_cm, cut_cm, 21)
    around = np.mod(around, length) if closed else np.clip(around, 0.0, length)
    xy = _along(course_cm, around.ravel()).reshape(*around.shape, 2).mean(axis=1)
    basis = CubicBasis(np.linspace(0.0, length, int(length / 8.0) + 1), closed)
    return LaneLine(
        "left",
        basis.knots_cm,
        basis.unfolded(basis.fitted(s_cm, xy)),
        np.array([[0.0, length]]),
        0.1,
        period_cm=length if closed else None,
        sigma_s_cm=s_cm,
        sigma_at_cm=np.full(len(s_cm), 0.1),
        marking_cm=TAPE_CM,
    )


def _off_cm(line: LaneLine, course_cm: np.ndarray) -> float:
    """Largest distance of a line from a course, but for the ends of an open one."""
    low, high = line.knots_cm[3] + 40.0, line.knots_cm[-4] - 40.0
    s_cm = np.arange(low, high if line.period_cm is None else high + 80.0, 0.5)
    course = _along(course_cm, np.arange(0.0, len(course_cm) * SIDE_CM, 0.1))
    return float(cKDTree(course).query(line.everywhere(line.with_corners(s_cm)))[0].max())


@pytest.mark.parametrize("angle_deg", [30.0, 60.0, 90.0])
def test_a_line_goes_through_the_corners_of_its_tape(angle_deg):
    course = _corners(angle_deg)
    line = _smooth(course)
    assert _off_cm(line, course) > 1.5
    found = with_kinks(line, _borders(course), HEIGHT_CM, LANE_CM)
    assert len(found.kinks_cm) == 3
    at = found.everywhere(found.kinks_cm)
    np.testing.assert_allclose(at, course[1:-1], atol=0.4)
    assert _off_cm(found, course) < 0.4
    # Elsewhere it is what it was.
    away = np.array([10.0, 80.0, 240.0, 400.0, 560.0])
    np.testing.assert_allclose(found.everywhere(away), line.everywhere(away), atol=0.05)


@pytest.mark.parametrize("half_cm", [15.0, 30.0, 60.0])
@pytest.mark.parametrize("past_cm", [0.0, 40.0])
def test_a_line_goes_back_to_its_tape_wherever_the_chain_of_pieces_begins(half_cm, past_cm):
    # The chain of a closed course begins in the middle of a side.
    course = _square()
    line = _smooth(course, closed=True)
    period_cm = float(line.period_cm or 0.0)
    s_cm = np.linspace(0.0, period_cm, 2000, endpoint=False)
    for middle_cm in 0.5 * SIDE_CM + SIDE_CM * np.arange(4):
        aside_cm = np.mod(s_cm - middle_cm - past_cm + 0.5 * period_cm, period_cm) - 0.5 * period_cm
        hump_cm = 4.0 * (1.0 + np.cos(np.pi * np.clip(aside_cm / half_cm, -1.0, 1.0)))
        ahead = line.everywhere(s_cm, 1)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.hypot(*ahead.T)[:, None]
        basis = CubicBasis(line.knots_cm[3:-3], True)
        moved = basis.fitted(s_cm, line.everywhere(s_cm) + hump_cm[:, None] * left)
        wrong = replace(line, coefficients_cm=basis.unfolded(moved))
        assert _off_cm(wrong, course) > 6.0
        found = with_kinks(wrong, _borders(course), HEIGHT_CM, LANE_CM)
        assert _off_cm(found, course) < 0.5
        assert len(found.kinks_cm) == 4


def test_a_short_piece_of_clutter_does_not_lead_a_line_away():
    # Dashes, and the edge of something beside one of them, three quarters of the height long.
    course = np.array([[0.0, 0.0], [4.0 * SIDE_CM, 0.0]])
    tape = _borders(course)
    dashes = tape.select(np.mod(tape.xy_cm[:, 0], 40.0) < 22.0)
    angle = np.deg2rad(58.0)
    way = np.array([[300.0, 0.0], [300.0 + 14.0 * np.cos(angle), 14.0 * np.sin(angle)]])
    clutter = _borders(way, seed=1)
    edges = MapEdges(
        *(
            np.concatenate([getattr(one, item.name) for one in (dashes, clutter)])
            for item in dataclasses.fields(MapEdges)
        )
    )
    line = _smooth(course)
    found = with_kinks(line, edges, HEIGHT_CM, LANE_CM)
    s_cm = np.arange(20.0, 4.0 * SIDE_CM - 20.0, 0.5)
    assert np.abs(found.everywhere(s_cm)[:, 1]).max() < 1.0


def test_a_corner_at_the_seam_of_a_lap_is_found():
    course = _square()
    found = with_kinks(_smooth(course, closed=True), _borders(course), HEIGHT_CM, LANE_CM)
    assert len(found.kinks_cm) == 4
    assert _off_cm(found, course) < 0.4
    period = float(found.period_cm or 0.0)
    around = found.with_corners(np.array([-20.0, 20.0]))
    assert len(around) == 3
    np.testing.assert_allclose(found.everywhere(around[1:2]), [[0.0, 0.0]], atol=0.4)
    np.testing.assert_allclose(
        found.everywhere(np.array([0.0])), found.everywhere(np.array([period - 1e-9])), atol=1e-6
    )


def test_what_was_not_supported_at_a_corner_is_once_it_is_seen():
    course = _corners(90.0)
    line = _smooth(course)
    line = replace(line, supported_cm=np.array([[0.0, 140.0], [180.0, 640.0]]))
    found = with_kinks(line, _borders(course), HEIGHT_CM, LANE_CM)
    assert found.supported(np.array([150.0, 160.0, 170.0])).all()


@pytest.mark.parametrize("radius_cm", [55.0, 90.0])
@pytest.mark.parametrize("off_cm", [0.0, 2.0])
def test_a_bend_gets_no_kink_even_where_the_line_leaves_it(radius_cm, off_cm):
    turn = np.linspace(0.0, 0.5 * np.pi, 60)
    bend = np.array([SIDE_CM, radius_cm]) + radius_cm * np.stack([np.sin(turn), -np.cos(turn)], axis=1)
    course = np.concatenate([[[0.0, 0.0]], bend, [bend[-1] + [0.0, SIDE_CM]]])
    line = _smooth(course, cut_cm=5.0)
    s_cm = np.linspace(0.0, line.knots_cm[-4] - 1e-9, 600)
    hump = off_cm * np.exp(-0.5 * ((s_cm - SIDE_CM - 0.8 * radius_cm) / 8.0) ** 2)
    ahead = line.everywhere(s_cm, 1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
    basis = CubicBasis(line.knots_cm[3:-3], False)
    moved = basis.fitted(s_cm, line.everywhere(s_cm) + hump[:, None] * left)
    line = replace(line, coefficients_cm=moved)
    assert not len(with_kinks(line, _borders(course), HEIGHT_CM, LANE_CM).kinks_cm)


def test_a_corner_that_was_not_seen_gets_no_kink():
    course, edges = _corners(60.0), _borders(_corners(60.0))
    hidden = np.min([np.hypot(*(edges.xy_cm - corner).T) for corner in course[1:-1]], axis=0) < 15.0
    kept = MapEdges(*(column[~hidden] for column in vars(edges).values()))
    assert not len(with_kinks(_smooth(course), kept, HEIGHT_CM, LANE_CM).kinks_cm)


def test_a_line_that_followed_something_else_beyond_a_corner_comes_back_to_its_tape():
    course = _corners(60.0)
    line = _smooth(course)
    s_cm = np.linspace(0.0, line.knots_cm[-4] - 1e-9, 800)
    ahead = line.everywhere(s_cm, 1)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
    # From the first corner to the second it lies 8 cm beside the tape, a fifth of the lane.
    aside = 8.0 * np.clip(np.minimum(s_cm - SIDE_CM + 20.0, 2.0 * SIDE_CM - s_cm + 20.0) / 20.0, 0.0, 1.0)
    basis = CubicBasis(line.knots_cm[3:-3], False)
    wrong = replace(line, coefficients_cm=basis.fitted(s_cm, line.everywhere(s_cm) + aside[:, None] * left))
    assert _off_cm(wrong, course) > 7.0
    found = with_kinks(wrong, _borders(course), HEIGHT_CM, LANE_CM)
    assert len(found.kinks_cm) == 3
    assert _off_cm(found, course) < 0.6


def test_tape_half_a_lane_away_is_something_else():
    course = _corners(60.0)
    line = _smooth(course)
    beside = _smooth(course + [0.0, 0.5 * LANE_CM])
    assert with_kinks(beside, _borders(course), HEIGHT_CM, LANE_CM) is beside
    assert len(with_kinks(line, _borders(course), HEIGHT_CM, LANE_CM).kinks_cm) == 3


def test_dark_tape_has_the_same_corners():
    course = _corners(60.0)
    edges = _borders(course)
    dark = replace(edges, normals=-edges.normals)
    assert len(with_kinks(_smooth(course), dark.towards_dark(), HEIGHT_CM, LANE_CM).kinks_cm) == 3
