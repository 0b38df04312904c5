"""What the lane filter asks beyond the paper's distances: direction, agreement, no contradiction."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.lane_filter import PAPER, LaneFilter, LaneFilterSettings, find_row

Edges = tuple[np.ndarray, np.ndarray]


def settings(**changes: Any) -> LaneFilterSettings:
    return LaneFilterSettings(lane_width_cm=40.0, **changes)


def line(
    x_at_0_cm: float,
    slope: float = 0.0,
    *,
    sides: tuple[int, int] = (1, -1),
    start_cm: float = 0.0,
    end_cm: float = 50.0,
    bend: float = 0.0,
) -> Edges:
    """Edges of a marking of 2 cm; ``sides``: to which side, along x, the left and right edge get brighter."""
    y = np.arange(start_cm, end_cm, 0.25)
    middle = x_at_0_cm + slope * y + bend * y * y
    along = slope + 2.0 * bend * y
    across = np.stack([np.ones_like(y), -along], axis=1) / np.hypot(1.0, along)[:, None]
    half = np.hypot(1.0, along)
    points = [np.stack([middle + side * half, y], axis=1) for side in (-1.0, 1.0)]
    return np.concatenate(points), np.concatenate([side * across for side in sides])


def together(*parts: Edges) -> Edges:
    return np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts])


def row(edges: Edges, **changes: Any) -> tuple[float, float] | None:
    return find_row(edges[0], 15.0, settings(**changes), 0.0, edges[1])


BRIGHT, DARK, STEP = (1, -1), (-1, 1), (1, 1)


@pytest.mark.parametrize(
    ("left", "right", "found_by"),
    [
        (BRIGHT, BRIGHT, {"any", "bright", "ignored"}),
        (DARK, DARK, {"any", "dark", "ignored"}),
        (BRIGHT, DARK, {"ignored"}),
        (STEP, BRIGHT, {"ignored"}),
    ],
)
def test_polarity(left: tuple[int, int], right: tuple[int, int], found_by: set[str]) -> None:
    edges = together(line(-20.0, sides=left), line(20.0, sides=right))
    for polarity in ("any", "bright", "dark", "ignored"):
        found = row(edges, polarity=polarity)
        if polarity in found_by:
            assert found == pytest.approx((-20.0, 20.0)), polarity
        else:
            assert found is None, polarity


def test_without_directions_only_distances_count() -> None:
    points, _ = together(line(-20.0, sides=BRIGHT), line(20.0, sides=DARK))
    assert find_row(points, 15.0, settings()) == pytest.approx((-20.0, 20.0))


def test_lines_of_a_lane_are_parallel() -> None:
    # 0.5 rad is a slope of 0.55; both lines pass a lane's width apart at y = 15.
    def leaning(slope: float) -> Edges:
        return together(line(-20.0 + 15.0 * slope, -slope), line(20.0 - 15.0 * slope, slope))

    assert row(leaning(0.2)) == pytest.approx((-20.0, 20.0), abs=0.2)
    assert row(leaning(0.4)) is None
    assert row(leaning(0.4), parallel_rad=0.9) is not None
    assert row(leaning(0.4), **PAPER) is not None


def test_edges_of_a_marking_are_parallel() -> None:
    # The right edge of the left marking turned by 40 degrees against the other one.
    points, normals = together(line(-20.0), line(20.0))
    turned = normals.copy()
    right_edge = points[:, 0] == -19.0
    angle = math.radians(140.0)
    turned[right_edge] = [math.cos(angle), math.sin(angle)]
    assert row((points, turned)) is None
    assert row((points, turned), parallel_rad=0.8) is not None
    assert row((points, turned), **PAPER) == pytest.approx((-20.0, 20.0))


def test_thickness_is_measured_across_the_line() -> None:
    # At 50 degrees a marking of 2 cm is 3.1 cm along the row.
    slope = math.tan(math.radians(50.0))
    half = 20.0 * math.hypot(1.0, slope)
    edges = together(line(-half - 15.0 * slope, slope), line(half - 15.0 * slope, slope))
    assert row(edges, marking_tolerance_cm=0.3) == pytest.approx((-half, half), abs=0.3)
    assert row(edges, marking_tolerance_cm=0.3, marking_cm=3.1) is None


def test_one_edge_is_no_marking() -> None:
    # A tolerance wider than the marking must not pair a point with another of the same place.
    points = np.repeat([[-20.0, 15.0], [20.0, 15.0]], 2, axis=0)
    assert find_row(points, 15.0, settings(marking_cm=1.0, marking_tolerance_cm=2.0, **PAPER)) is None


def test_an_oblique_lane_is_measured_across_its_lines() -> None:
    # At 40 degrees the lane is 52 cm wide along the row, which the paper's filter refuses.
    slope = math.tan(math.radians(40.0))
    half = 20.0 * math.hypot(1.0, slope)
    edges = together(line(-half - 15.0 * slope, slope), line(half - 15.0 * slope, slope))
    assert row(edges) == pytest.approx((-half, half), abs=0.3)
    assert row(edges, **PAPER) is None


@given(st.floats(-0.5, 0.5), st.floats(-8.0, 8.0), st.floats(-0.003, 0.003))
def test_curved_lanes_are_found_to_the_grid(slope: float, shift: float, bend: float) -> None:
    half = 20.0 * math.hypot(1.0, slope + 30.0 * bend)
    edges = together(*(line(shift + side * half, slope, bend=bend) for side in (-1.0, 1.0)))
    found = row(edges)
    assert found is not None
    middle = shift + 15.0 * slope + 225.0 * bend
    assert found == pytest.approx((middle - half, middle + half), abs=0.35)


def test_lines_have_to_go_on() -> None:
    def short(start: float, end: float) -> Edges:
        return together(line(-20.0, start_cm=start, end_cm=end), line(20.0))

    # Of the 16 cm around the row, in steps of 2 cm, four of nine are enough: the end of a dash is a lane.
    assert row(short(14.0, 40.0)) is not None
    assert row(short(0.0, 16.0)) is not None
    assert row(short(14.0, 17.0)) is None
    assert row(short(14.0, 17.0), agreement_share=0.0) is not None
    assert row(short(14.0, 17.0), **PAPER) is not None
    assert row(short(10.0, 20.0), agreement_share=0.8) is None
    # A dark line that goes on where the bright one ends is another line.
    changed = together(short(14.0, 17.0), line(-20.0, sides=DARK, start_cm=0.0, end_cm=13.9))
    assert row(together(changed, line(-20.0, sides=DARK, start_cm=17.1))) is None
    # What goes on elsewhere does not count.
    apart = together(short(14.0, 17.0), line(-26.0, start_cm=0.0, end_cm=13.0))
    assert row(apart) is None


def test_a_lane_is_empty_between_its_lines() -> None:
    rng = np.random.default_rng(0)
    lane = together(line(-20.0), line(20.0))
    # The lines have 4 x 64 points within 8 cm of the row.
    for count, found in ((100, True), (700, False)):
        where = rng.uniform([-16.0, 7.0], [16.0, 23.0], (count, 2))
        turned = rng.uniform(0.0, 2.0 * np.pi, count)
        clutter = where, np.stack([np.cos(turned), np.sin(turned)], axis=1)
        edges = together(lane, clutter)
        assert (row(edges) is not None) == found
        assert row(edges, clear_share=0.0) == pytest.approx((-20.0, 20.0), abs=0.5)
    # The same along an oblique lane: what lies beside it is not taken for its inside.
    slope, half = 1.5, 20.0 * math.hypot(1.0, 1.5)
    oblique = together(line(-half - 15.0 * slope, slope), line(half - 15.0 * slope, slope))
    y = rng.uniform(7.0, 10.0, 300)
    outside = np.stack([half + 5.0 + slope * (y - 15.0) + rng.uniform(0.0, 2.0, 300), y], axis=1)
    level = np.tile([0.0, 1.0], (300, 1))
    assert row(together(oblique, (outside, level))) == pytest.approx((-half, half), abs=0.5)
    # What lies beside the lane does not matter.
    beside = rng.uniform([26.0, 7.0], [60.0, 23.0], (700, 2)), clutter[1]
    assert row(together(lane, beside)) == pytest.approx((-20.0, 20.0), abs=0.5)


def test_many_pairs_are_ambiguous() -> None:
    # Neighbouring lanes of the same width are three pairs, a striped floor is many.
    lanes = together(*(line(x) for x in (-60.0, -20.0, 20.0, 60.0)))
    assert row(lanes) == pytest.approx((-20.0, 20.0))
    assert row(lanes, max_pairs=2) is None
    stripes = together(*(line(x) for x in np.arange(-60.0, 61.0, 5.0)))
    assert row(stripes) is None
    assert row(stripes, clear_share=0.0) is None
    assert row(stripes, clear_share=0.0, max_pairs=None) is not None


def lane_of_rows(near: tuple[float, float], far: tuple[float, float]) -> Edges:
    """A lane whose lines lie at these x for y up to 22 cm and from there on."""
    return together(
        *(line(x, start_cm=0.0, end_cm=22.0) for x in near),
        *(line(x, start_cm=22.25, end_cm=50.0) for x in far),
    )


@pytest.mark.parametrize(
    ("far", "kept"),
    [
        ((-20.0, 20.0), True),
        ((-5.0, 35.0), True),
        ((5.0, 45.0), False),
        ((-45.0, -5.0), False),
        ((-18.2, 18.2), True),
    ],
)
def test_far_row_that_jumps_is_dropped(far: tuple[float, float], kept: bool) -> None:
    points, normals = lane_of_rows((-20.0, 20.0), far)
    estimate = LaneFilter(None, settings()).estimate(points, normals)
    assert estimate.points_cm[[1, 4]] == pytest.approx([-20.0, 20.0])
    assert estimate.mask.tolist() == [kept, True, kept] * 2
    assert estimate.confidence == (1.0 if kept else 0.5)
    # The near row steers.
    assert estimate.steering_rad == pytest.approx(0.0, abs=1e-9)
    plain = LaneFilter(None, settings(max_centre_jump=None)).estimate(points, normals)
    assert plain.mask.all()
    assert plain.points_cm[[2, 5]] == pytest.approx(far)


def test_rows_of_contradicting_width() -> None:
    points, normals = lane_of_rows((-18.4, 18.4), (-21.6, 21.6))
    assert LaneFilter(None, settings()).estimate(points, normals).mask.tolist() == [False, True, False] * 2
    assert LaneFilter(None, settings(max_centre_jump=None)).estimate(points, normals).mask.all()


def test_a_dropped_row_is_not_expected_in_the_next_frame() -> None:
    # Two lanes at the far row; what contradicted the near row must not draw the next frame to the right.
    detector = LaneFilter(None, settings())
    detector.estimate(*lane_of_rows((-20.0, 20.0), (10.0, 50.0)))
    both = lane_of_rows((-20.0, 20.0), (-30.0, 10.0, 50.0))
    assert detector.estimate(*both).points_cm[[2, 5]] == pytest.approx([-30.0, 10.0])


@given(st.integers(0, 2**32 - 1))
def test_mirrored_edges_mirror_the_estimate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 300))
    turned = rng.uniform(0.0, 2.0 * np.pi, count)
    clutter = (
        rng.uniform([-80.0, 0.0], [80.0, 60.0], (count, 2)),
        np.stack([np.cos(turned), np.sin(turned)], axis=1),
    )
    shift, slope = rng.uniform(-5.0, 5.0), rng.uniform(-0.3, 0.3)
    points, normals = together(line(shift - 20.0, slope), line(shift + 20.0, slope), clutter)
    one = LaneFilter(None, settings()).estimate(points, normals)
    other = LaneFilter(None, settings()).estimate(points * [-1.0, 1.0], normals * [-1.0, 1.0])
    assert one.points_cm == pytest.approx(-other.points_cm[[3, 4, 5, 0, 1, 2]], abs=1e-6, nan_ok=True)
    assert one.confidence == other.confidence


def test_level_edges_are_no_lines() -> None:
    # Bars across the way: their normals point along y, up or down to the last bit.
    x = np.concatenate([side + np.array([-1.0, 1.0]) for side in (-20.0, 20.0)])
    points = np.concatenate([np.stack([x, np.full(4, y)], axis=1) for y in np.arange(0.0, 50.0, 0.3)])
    for sign in (1.0, -1.0):
        normals = np.tile([[0.0, sign], [0.0, -sign]], (len(points) // 2, 1))
        assert find_row(points, 15.0, settings(), 0.0, normals) is None
        assert find_row(points, 15.0, settings(**PAPER), 0.0, normals) is not None


def test_points_that_are_no_numbers_do_no_harm() -> None:
    points, normals = together(line(-20.0), line(20.0))
    broken = np.concatenate([points, np.full((9, 2), np.nan)])
    assert LaneFilter(None, settings()).estimate(broken, np.concatenate([normals, normals[:9]])).mask.all()
    assert not LaneFilter(None, settings()).estimate(np.empty((0, 2)), np.empty((0, 2))).mask.any()


def test_the_paper_alone_extrapolates_whatever_it_finds() -> None:
    points, normals = lane_of_rows((-20.0, 20.0), (5.0, 45.0))
    estimate = LaneFilter(None, settings(**PAPER)).estimate(points, normals)
    left = estimate.points_cm[: len(ROWS_CM)]
    assert left == pytest.approx([-45.0, -20.0, 5.0])


def test_settings_are_checked() -> None:
    with pytest.raises(ConfigError, match=r"polarity.*'bright'.*found 'white'"):
        check_settings(LaneFilterSettings, {"lane_width_cm": 40.0, "polarity": "white"}, "test")
    with pytest.raises(ConfigError, match="clear_share"):
        check_settings(LaneFilterSettings, {"lane_width_cm": 40.0, "clear_share": 1.5}, "test")
