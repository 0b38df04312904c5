"""The driven lane among edges: dashes, wanderings, clutter, gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.lanes.path import Path, PathEdges
from datagen.lanes.profile import EdgeProfile, edge_profile
from datagen.lanes.trace import TracedLane, TraceSettings, _without_bulges, has_dark_markings, trace_lane
from lanenet.errors import TrackingLostError

HEIGHT_CM = 15.0
STEP_CM = 1.8
TAPE_CM = 2.4
LANE_CM = 36.0
FRAMES = 120
SETTINGS = TraceSettings()
CELL_CM = SETTINGS.cell_heights * HEIGHT_CM


def _path() -> Path:
    """A straight path: in its own coordinates, every path is straight."""
    s = np.arange(0.0, 3.0 * FRAMES + 75.0, STEP_CM)
    xy = np.column_stack([s, np.zeros_like(s)])
    return Path(STEP_CM, xy, np.tile([0.0, 1.0], (len(s), 1)), 3.0 * np.arange(FRAMES))


def _tape(
    rng: np.random.Generator,
    middle: np.ndarray,
    seen: np.ndarray,
    tape_cm: float = TAPE_CM,
    noise_cm: float = 0.2,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both edges of a tape, as if six frames had seen each place; s, d and side."""
    rows = np.repeat(np.flatnonzero(seen), 6)
    s = rows * STEP_CM + rng.uniform(-0.9, 0.9, len(rows))
    noise = noise_cm * rng.normal(size=(2, len(rows)))
    left = middle[rows] + 0.5 * tape_cm + noise[0]
    right = middle[rows] - 0.5 * tape_cm + noise[1]
    # The left edge brightens towards the tape, to the right.
    side = np.concatenate([np.full(len(rows), -1.0), np.full(len(rows), 1.0)])
    return np.concatenate([s, s]), np.concatenate([left, right]), side


def _clutter(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    s = rng.uniform(0.0, 3.0 * FRAMES + 75.0, count)
    return s, rng.uniform(-100.0, 100.0, count), np.cos(rng.uniform(-np.pi, np.pi, count))


def _edges(*parts: tuple[np.ndarray, np.ndarray, np.ndarray]) -> PathEdges:
    return _path_edges(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _path_edges(s: np.ndarray, d: np.ndarray, side: np.ndarray) -> PathEdges:
    along = np.sqrt(np.maximum(0.0, 1.0 - side**2))
    frame = np.maximum(0, (s / 3.0).astype(np.int64) - 6)
    return PathEdges(s, d, side, along, np.ones(len(s)), np.full(len(s), 20.0), frame)


def _profile(path: Path, edges: PathEdges) -> EdgeProfile:
    half = int(SETTINGS.side_heights / SETTINGS.cell_heights)
    return edge_profile(path, edges, CELL_CM, half, 0.25 * HEIGHT_CM, SETTINGS.min_side)


def _dashed(path: Path, dash_cm: float = 15.0, period_cm: float = 30.0) -> np.ndarray:
    return np.mod(path.s_cm, period_cm) < dash_cm


def _wandering(path: Path, amplitude_cm: float = 5.0) -> np.ndarray:
    """Offset of the lane's centre from the driven path."""
    return amplitude_cm * np.sin(2.0 * np.pi * path.s_cm / 170.0)


def _lane(
    seed: int, lane_width_cm: float | None, lane_cm: float = LANE_CM, clutter: int = 2500
) -> tuple[TracedLane, np.ndarray, Path]:
    rng = np.random.default_rng(seed)
    path = _path()
    centre = _wandering(path)
    everywhere = np.ones(len(path.s_cm), dtype=bool)
    edges = _edges(
        _tape(rng, centre + 0.5 * lane_cm, _dashed(path)),
        _tape(rng, centre - 0.5 * lane_cm, everywhere),
        _clutter(rng, clutter),
    )
    return trace_lane(path, edges, HEIGHT_CM, lane_width_cm, SETTINGS), centre, path


@pytest.mark.parametrize("given", [LANE_CM, 0.94 * LANE_CM, None])
@pytest.mark.parametrize("seed", range(3))
def test_lines_of_a_wandering_drive_among_clutter(seed, given):
    lane, centre, path = _lane(seed, given)
    dashes = _dashed(path)
    left_error = lane.left_cm - (centre + 0.5 * LANE_CM)
    right_error = lane.right_cm - (centre - 0.5 * LANE_CM)
    # Solid line: everywhere. Dashed line: on the dashes.
    assert np.isfinite(right_error).mean() > 0.97
    assert np.isfinite(left_error[dashes]).mean() > 0.85
    for error in (right_error, left_error[dashes]):
        assert np.nanmedian(np.abs(error)) < 0.2
        assert np.nanpercentile(np.abs(error), 95) < 0.6
        assert np.nanmax(np.abs(error)) < 0.1 * HEIGHT_CM
    assert np.abs(lane.centre_cm - centre).max() < 0.1 * HEIGHT_CM
    assert lane.tape_cm == pytest.approx(TAPE_CM, abs=CELL_CM)
    assert lane.lane_cm == pytest.approx(LANE_CM, abs=1.5)


@pytest.mark.parametrize("lane_cm", [24.0, 45.0, 60.0])
def test_the_lane_width_is_found(lane_cm):
    lane, _, _ = _lane(0, None, lane_cm)
    assert lane.lane_cm == pytest.approx(lane_cm, abs=2.0 * CELL_CM)


def _road_of_two_lanes(
    seed: int,
    middle: np.ndarray,
    dashed: bool = True,
    specks: int = 120,
    least: tuple[float, float] = (0.0, 0.0),
) -> TracedLane:
    """Two lines 60 cm apart, with dashes in the middle or none, on a mottled floor; nobody says how wide."""
    rng = np.random.default_rng(seed)
    path = _path()
    everywhere = np.ones(len(path.s_cm), dtype=bool)
    parts = [_tape(rng, middle + side, everywhere) for side in (30.0, -30.0)]
    parts.append(_clutter(rng, 1500))
    if dashed:
        parts.append(_tape(rng, middle, _dashed(path, 22.0)))
    places = zip(rng.uniform(0.0, path.s_cm[-1], specks), rng.uniform(-27.0, 27.0, specks), strict=True)
    parts += [_tape(rng, middle + d, np.abs(path.s_cm - s) < 2.5) for s, d in places]
    return trace_lane(path, _edges(*parts), HEIGHT_CM, None, SETTINGS, least)


@pytest.mark.parametrize("seed", range(2))
def test_specks_on_the_floor_are_no_line_in_the_middle(seed):
    """Three lines make two lanes, two lines on a mottled floor do not."""
    lane = _road_of_two_lanes(seed, _wandering(_path()), dashed=False, specks=250)
    assert lane.lane_cm == pytest.approx(60.0, abs=2.0 * CELL_CM)


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(2))
def test_a_car_that_keeps_to_one_half_of_a_road_has_it_for_its_lane(seed, side):
    # Once it swerves over the middle line.
    swerve = -25.0 * np.exp(-0.5 * ((_path().s_cm - 200.0) / 25.0) ** 2)
    middle = side * (15.0 + _wandering(_path(), 3.0) + swerve)
    lane = _road_of_two_lanes(seed, middle)
    assert lane.lane_cm == pytest.approx(30.0, abs=1.5)
    assert np.median(np.abs(lane.centre_cm - (middle - side * 15.0))) < 1.0
    # Unless the told width would make a camera or tape of it that cannot be.
    for least in ((33.0 / HEIGHT_CM, 0.0), (0.0, 33.0 / lane.tape_cm)):
        assert _road_of_two_lanes(seed, middle, least=least).lane_cm == pytest.approx(60.0, abs=1.5)


@pytest.mark.parametrize("amplitude_cm", [0.0, 12.0, 25.0])
@pytest.mark.parametrize("seed", range(2))
def test_a_car_that_drives_on_the_middle_line_has_the_whole_road_for_its_lane(seed, amplitude_cm):
    middle = amplitude_cm * np.sin(2.0 * np.pi * _path().s_cm / 300.0)
    lane = _road_of_two_lanes(seed, middle)
    assert lane.lane_cm == pytest.approx(60.0, abs=1.5)
    # The dashes bound nothing.
    for line, off in ((lane.left_cm, 30.0), (lane.right_cm, -30.0)):
        assert np.isfinite(line).mean() > 0.95
        assert np.nanmedian(np.abs(line - middle - off)) < 0.3


@pytest.mark.parametrize(("backward", "lane_cm"), [(True, 30.0), (False, 60.0)])
def test_a_half_is_on_the_side_on_which_the_car_drives_there_and_back(backward, lane_cm):
    """Keeping to the right there and back is keeping to a lane; changing sides in one direction is not."""
    rng = np.random.default_rng(0)
    straight = _path()
    everywhere, middle = np.ones(len(straight.s_cm), dtype=bool), np.full(len(straight.s_cm), 15.0)
    first = np.arange(FRAMES) < FRAMES // 2
    path = replace(
        straight,
        s_frames_cm=6.0 * np.concatenate([np.arange(FRAMES // 2), np.arange(FRAMES // 2)[::-1]]),
        d_frames_cm=np.where(first, 0.0, 30.0),
        forward=first if backward else np.ones(FRAMES, dtype=bool),
        closed=True,
    )
    parts = [_tape(rng, middle + side, everywhere) for side in (30.0, -30.0)]
    edges = _edges(*parts, _tape(rng, middle, _dashed(path, 22.0)))
    assert trace_lane(path, edges, HEIGHT_CM, None, SETTINGS).lane_cm == pytest.approx(lane_cm, abs=1.0)


@pytest.mark.parametrize("tape_cm", [1.5, 7.5])
def test_markings_are_light_or_dark_whatever_their_width(tape_cm):
    """On a mottled floor, after many laps; the left line is dashed."""
    rng = np.random.default_rng(2)
    path = _path()
    centre, everywhere = _wandering(path), np.ones(len(path.s_cm), dtype=bool)
    lines = [(0.5, _dashed(path)), (-0.5, everywhere)]
    light = _edges(
        *[_tape(rng, centre + k * LANE_CM, seen, tape_cm) for k, seen in lines for _ in range(5)],
        _clutter(rng, 1500),
    )
    assert not has_dark_markings(path, light, HEIGHT_CM, SETTINGS)
    dark = light.towards_dark()
    np.testing.assert_array_equal((dark.side, dark.along), (-light.side, -light.along))
    assert has_dark_markings(path, dark, HEIGHT_CM, SETTINGS)


def test_left_and_right_are_mirror_images():
    rng = np.random.default_rng(4)
    path = _path()
    centre = _wandering(path)
    edges = _edges(
        _tape(rng, centre + 0.5 * LANE_CM, _dashed(path)),
        _tape(rng, centre - 0.5 * LANE_CM, np.ones(len(path.s_cm), dtype=bool)),
        _clutter(rng, 1500),
    )
    mirrored = _path_edges(edges.s_cm, -edges.d_cm, -edges.side)
    here = trace_lane(path, edges, HEIGHT_CM, LANE_CM, SETTINGS)
    there = trace_lane(path, mirrored, HEIGHT_CM, LANE_CM, SETTINGS)
    np.testing.assert_array_equal(np.isfinite(here.left_cm), np.isfinite(there.right_cm))
    both = np.isfinite(here.left_cm)
    np.testing.assert_allclose(there.right_cm[both], -here.left_cm[both], atol=0.1)
    assert there.lane_cm == pytest.approx(here.lane_cm)


def test_a_missing_stretch_stays_unknown_and_the_other_line_carries_the_lane():
    rng = np.random.default_rng(1)
    path = _path()
    centre = _wandering(path)
    gap = (path.s_cm > 120.0) & (path.s_cm < 200.0)
    edges = _edges(
        _tape(rng, centre + 0.5 * LANE_CM, ~gap),
        _tape(rng, centre - 0.5 * LANE_CM, np.ones(len(path.s_cm), dtype=bool)),
    )
    lane = trace_lane(path, edges, HEIGHT_CM, LANE_CM, SETTINGS)
    # The profile is smoothed by a quarter of a camera height along the path.
    inner = (path.s_cm > 132.0) & (path.s_cm < 188.0)
    assert np.isnan(lane.left_cm[inner]).all()
    assert np.isfinite(lane.right_cm[inner]).all()
    assert np.abs(lane.centre_cm - centre)[inner].max() < 0.1 * HEIGHT_CM
    outside = (path.s_cm < 110.0) | (path.s_cm > 210.0)
    assert np.isfinite(lane.left_cm[outside]).mean() > 0.97


def test_one_edge_of_a_marking_is_no_middle():
    rng = np.random.default_rng(2)
    path = _path()
    everywhere = np.ones(len(path.s_cm), dtype=bool)
    s, d, side = _tape(rng, np.full(len(path.s_cm), 18.0), everywhere)
    # From 150 to 230 cm only the tape's left edge was seen.
    keep = ~((s > 150.0) & (s < 230.0) & (side > 0.0))
    edges = _edges((s[keep], d[keep], side[keep]), _tape(rng, np.full(len(path.s_cm), -18.0), everywhere))
    lane = trace_lane(path, edges, HEIGHT_CM, LANE_CM, SETTINGS)
    assert np.isnan(lane.left_cm[(path.s_cm > 162.0) & (path.s_cm < 218.0)]).all()
    known = lane.left_cm[np.isfinite(lane.left_cm)]
    # Not pulled towards the edge that was seen, at 19.2, where the other one fades.
    assert np.median(np.abs(known - 18.0)) < 0.15


def _cutting(path: Path) -> np.ndarray:
    """Offset of the lane from a car that cuts a corner: for a metre it is in the other lane."""
    return -45.0 * np.exp(-0.5 * ((path.s_cm - 200.0) / 50.0) ** 2)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_lane_is_the_one_that_the_car_started_in(side):
    rng = np.random.default_rng(3)
    path = _path()
    everywhere = np.ones(len(path.s_cm), dtype=bool)
    centre = side * _cutting(path)
    # The neighbouring lane is painted as well as ours, and the car visits it.
    edges = _edges(
        _tape(rng, centre + side * 18.0, _dashed(path)),
        _tape(rng, centre + side * 54.0, everywhere),
        _tape(rng, centre - side * 18.0, everywhere),
    )
    lane = trace_lane(path, edges, HEIGHT_CM, LANE_CM, SETTINGS)
    assert np.abs(lane.centre_cm - centre).max() < 0.1 * HEIGHT_CM


def test_without_lines_the_drive_cannot_be_mapped():
    rng = np.random.default_rng(0)
    path = _path()
    with pytest.raises(TrackingLostError, match="no pair of lines"):
        trace_lane(path, _edges(_clutter(rng, 150)), HEIGHT_CM, LANE_CM, SETTINGS)
    nothing = _path_edges(*(np.empty(0) for _ in range(3)))
    with pytest.raises(TrackingLostError):
        trace_lane(path, nothing, HEIGHT_CM, LANE_CM, SETTINGS)
    with pytest.raises(TrackingLostError):
        trace_lane(path, nothing, HEIGHT_CM, None, SETTINGS)


def test_the_profile_keeps_directions_apart_and_saturates():
    path = _path()
    n = 400
    at = np.full(n, 90.0)
    edges = _path_edges(at, np.full(n, 10.0), np.full(n, -1.0))
    profile = _profile(path, edges)
    row, column = round(90.0 / STEP_CM), profile.half_cells + round(10.0 / profile.cell_cm)
    assert profile.left[row, column] > 0.95
    assert profile.left.max() < 1.0
    assert profile.left[row].argmax() == column
    assert not profile.right.any()
    # An edge across the path belongs to neither.
    across = _path_edges(at, np.full(n, 10.0), np.full(n, 0.3))
    assert not _profile(path, across).left.any()


def test_a_tape_is_supported_at_its_middle():
    path = _path()
    s = np.repeat(path.s_cm, 4)
    one = np.ones(len(s))
    edges = _path_edges(
        np.concatenate([s, s]), np.concatenate([11.2 * one, 8.8 * one]), np.concatenate([-one, one])
    )
    profile = _profile(path, edges)
    tapes = profile.tapes(2.4)
    middle = (tapes[50].argmax() - profile.half_cells) * profile.cell_cm
    assert middle == pytest.approx(10.0, abs=profile.cell_cm)
    # Of the wrong width, or with its edges swapped (a dark gap between tapes), it is none.
    assert profile.tapes(6.0)[50].max() < 0.1
    dark = _path_edges(edges.s_cm, edges.d_cm, -edges.side)
    assert _profile(path, dark).tapes(2.4)[50].max() < 0.5 * tapes[50].max()


@pytest.mark.parametrize("closed", [False, True])
def test_a_strip_of_tape_where_the_line_is_hidden_is_not_the_line(closed):
    path = replace(_path(), closed=closed)
    n = len(path.xy_cm)
    centre, s = np.zeros(n), np.arange(n)
    line = np.full(n, -18.0) + 0.2 * np.sin(s / 7.0)
    line[60:100] = np.nan
    line[70:84] = -12.0
    found = _without_bulges(path, line, centre, LANE_CM)
    assert np.isnan(found[60:100]).all()
    rest = np.setdiff1d(s, np.arange(60, 100))
    np.testing.assert_array_equal(found[rest], line[rest])


@pytest.mark.parametrize("middle", [0, 3, 6])
def test_a_strip_across_the_seam_of_a_lap_is_judged_as_one(middle):
    """A bulge that is hardly off before the seam goes with its other half, as it does elsewhere."""
    path = replace(_path(), closed=True)
    n = len(path.xy_cm)
    line = np.full(n, -18.0)
    # Off by 0.04 to 0.08 of the lane on one side of its middle, by more on the other.
    bulge = np.concatenate([np.full(6, -16.0), np.full(6, -13.0)])
    rows = (middle - 6 + np.arange(12)) % n
    line[rows] = bulge
    found = _without_bulges(path, line, np.zeros(n), LANE_CM)
    assert np.isnan(found[rows]).all()
    rest = np.setdiff1d(np.arange(n), rows)
    np.testing.assert_array_equal(found[rest], line[rest])


def test_dashes_stay_also_beside_a_strip_and_where_the_lane_becomes_wider():
    path = _path()
    n = len(path.xy_cm)
    s = np.arange(n)
    line = np.where(s % 20 < 10, -18.0 - 8.0 / (1.0 + np.exp(-(s - 100) / 15.0)), np.nan)
    np.testing.assert_array_equal(_without_bulges(path, line, np.zeros(n), LANE_CM), line)
    astray = line.copy()
    astray[200:210] += 7.0
    found = _without_bulges(path, astray, np.zeros(n), LANE_CM)
    assert np.isnan(found[200:210]).all()
    kept = np.setdiff1d(s, np.arange(200, 210))
    np.testing.assert_array_equal(found[kept], line[kept])
    # A single section, or none, is left as it is; so is a bulge that lasts.
    bay = np.where((s > 60) & (s < 160), -24.0, -18.0)
    for alone in (np.full(n, np.nan), np.where(s < 15, -18.0, np.nan), bay):
        np.testing.assert_array_equal(_without_bulges(path, alone, np.zeros(n), LANE_CM), alone)


def _wider(over_cm: float, by_lanes: float) -> np.ndarray:
    """Share of a lane by which it is wider in the middle of the path, and as wide as ever at its ends."""
    away = np.abs(_path().s_cm - 200.0) / over_cm
    return np.asarray(by_lanes * np.cos(0.5 * np.pi * np.clip(away, 0.0, 1.0)) ** 2)


@pytest.mark.parametrize("by_lanes", [0.25, 0.45])
def test_a_line_is_followed_where_it_moves_away_from_the_other(by_lanes):
    rng, path = np.random.default_rng(3), _path()
    everywhere = np.ones(len(path.s_cm), dtype=bool)
    left = np.full(len(path.s_cm), 0.5 * LANE_CM)
    right = -0.5 * LANE_CM - _wider(90.0, by_lanes) * LANE_CM
    edges = _edges(_tape(rng, left, everywhere), _tape(rng, right, everywhere))
    lane = trace_lane(path, edges, HEIGHT_CM, LANE_CM, SETTINGS)
    inner = (path.s_cm > 20.0) & (path.s_cm < 380.0)
    assert np.isfinite(lane.right_cm[inner]).mean() > 0.95
    assert np.nanmax(np.abs(lane.right_cm - right)) < 2.0 * CELL_CM


def test_a_strip_beside_a_gap_is_not_the_line():
    rng, path = np.random.default_rng(4), _path()
    left = np.full(len(path.s_cm), 0.5 * LANE_CM)
    gap = np.abs(path.s_cm - 200.0) < 40.0
    edges = _edges(
        _tape(rng, left, gap | ~gap),
        _tape(rng, -left, ~gap),
        _tape(rng, -left - 0.3 * LANE_CM, gap),
    )
    lane = trace_lane(path, edges, HEIGHT_CM, LANE_CM, SETTINGS)
    assert not np.isfinite(lane.right_cm[np.abs(path.s_cm - 200.0) < 30.0]).any()
