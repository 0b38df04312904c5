"""Two lanes, both directions, furniture, loops: the truth of richer roads."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_roads import line_painted, mirror_track, move_track
from typer.testing import CliRunner

from datagen.world.render.ground import NearestGrid
from datagen.world.road.build import random_track
from datagen.world.road.furniture import Furniture, Junction, StopLine
from datagen.world.road.track import Track, is_painted, read_track, subtract, wear_off, write_track
from datagen.world.road.track_picture import draw_track, picture_scale
from datagen.world.road.track_settings import MarkingSettings, TrackSettings, preset
from lanenet.cli.app import app
from lanenet.geometry.lane import mirror_points

WHEELBASE_CM = 26.0
RATES = {f"{kind}_per_m": 0.3 for kind in ("stop_line", "zebra", "arrow", "junction", "parking")}


def _draw(seed: int, **changes: object) -> Track:
    return random_track(TrackSettings(**changes), np.random.default_rng(seed))


KINDS = [(closed, lanes) for closed in (False, True) for lanes in (1, 2)]


@functools.cache
def _track(closed: bool, lanes: int) -> Track:
    return _draw(3, closed=closed, lanes=lanes, length_cm=1800.0, random_furniture=RATES)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), lanes=st.sampled_from([1, 2]), length=st.floats(900.0, 4000.0))
def test_random_loops_close_and_keep_their_radius(seed, lanes, length):
    track = _draw(seed, closed=True, lanes=lanes, length_cm=length)
    assert track.length_cm == pytest.approx(length, rel=1e-9)
    ends = np.concatenate([track.xy_cm, track.xy_cm[:1]])
    np.testing.assert_allclose(np.linalg.norm(np.diff(ends, axis=0), axis=1), track.step_cm, atol=2e-4)
    turn = track.heading_rad[-1] + track.step_cm * track.curvature_per_cm[-1] - track.heading_rad[0]
    assert abs(turn) == pytest.approx(2.0 * np.pi, abs=0.02)
    assert np.max(np.abs(track.curvature_per_cm)) <= 1.0 / 60.0 + 1e-9
    back = track.reversed()
    # In the other lane too, up to the joint of a bend, where curvature is that of the nearest sample.
    assert np.max(np.abs(back.curvature_per_cm)) <= 1.0 / 60.0 + 2e-4


def test_loops_have_straights_and_bend_both_ways():
    tracks = [_draw(seed, closed=True, length_cm=2500.0) for seed in range(10)]
    assert np.mean([np.mean(np.abs(t.curvature_per_cm) < 1e-9) for t in tracks]) > 0.2
    both = [t for t in tracks if t.curvature_per_cm.max() > 0.004 and t.curvature_per_cm.min() < -0.004]
    assert len(both) >= 6
    assert len({bool(t.heading_rad[-1] > 0.0) for t in tracks}) == 2


@pytest.mark.parametrize("key", KINDS)
def test_reversing_twice_gives_the_same_road(key):
    track = _track(*key)
    again = track.reversed().reversed()
    assert again.length_cm == pytest.approx(track.length_cm, abs=0.05)
    places = np.linspace(5.0, track.length_cm - 5.0, 80)
    for s in places:
        np.testing.assert_allclose(again.point(s)[0], track.point(s)[0], atol=0.15)
    for a, b in zip(again.markings, track.markings, strict=True):
        assert a.offset_cm == pytest.approx(b.offset_cm)
        np.testing.assert_allclose(a.painted_cm, b.painted_cm, atol=0.2)


@pytest.mark.parametrize("key", KINDS)
def test_the_reversed_road_is_painted_in_the_same_places(key):
    track, back = _track(*key), _track(*key).reversed()
    np.testing.assert_array_equal(back.boxes, track.boxes)
    for m, n in zip(track.markings, back.markings, strict=True):
        assert len(m.painted_cm) == len(n.painted_cm)
        for (start, end), (other_end, other_start) in zip(
            m.painted_cm[:20], n.painted_cm[::-1, ::-1][:20], strict=True
        ):
            for place, other in ((start, other_end), (end, other_start)):
                here, _ = track.point(place, m.offset_cm)
                there, _ = back.point(other, n.offset_cm)
                np.testing.assert_allclose(there, here, atol=0.3)


@pytest.mark.parametrize("closed", [False, True])
def test_two_lanes_share_their_middle_line(closed):
    track = _track(closed, 2)
    back = track.reversed()
    steps = np.linalg.norm(np.diff(back.xy_cm, axis=0), axis=1)
    np.testing.assert_allclose(steps, back.step_cm, atol=0.06)
    # Keep right: what lies left of one lane lies left of the other.
    for s in np.linspace(50.0, back.length_cm - 50.0, 40):
        xy, heading = back.point(s, back.line_offset_cm("left"))
        place, offset = track.nearest(xy)
        assert offset == pytest.approx(track.line_offset_cm("left"), abs=0.02)
        assert np.cos(heading - track.point(place)[1]) == pytest.approx(-1.0, abs=1e-3)
    assert {round(m.offset_cm, 6) for m in track.markings} == {20.0, -20.0, 60.0}


@pytest.mark.parametrize("key", KINDS)
def test_mirrored_and_moved_roads_answer_alike(key):
    track = _track(*key)
    rng = np.random.default_rng(1)
    mirrored, moved = mirror_track(track), move_track(track, np.array([30.0, -80.0, 1.3]))
    c, s = np.cos(1.3), np.sin(1.3)
    for place in rng.uniform(100.0, track.length_cm - 200.0, 5):
        xy, heading = track.point(place, rng.uniform(-5.0, 5.0))
        pose = np.array([*xy, heading + rng.uniform(-0.1, 0.1)])
        points = track.truth(pose, WHEELBASE_CM)
        assert np.isfinite(points[[0, 3]]).all()
        np.testing.assert_allclose(
            mirrored.truth(pose * [1.0, -1.0, -1.0], WHEELBASE_CM), mirror_points(points), atol=1e-8
        )
        there = np.array([c * xy[0] - s * xy[1] + 30.0, s * xy[0] + c * xy[1] - 80.0, pose[2] + 1.3])
        np.testing.assert_allclose(moved.truth(there, WHEELBASE_CM), points, atol=1e-8)
    np.testing.assert_allclose(mirror_track(mirrored).boxes, track.boxes)
    assert mirrored.oncoming_cm == (None if track.oncoming_cm is None else -track.oncoming_cm)
    np.testing.assert_allclose(np.hypot(*moved.boxes[:, 2:4].T), 1.0, atol=1e-12)
    # A corner of a box moves like any point.
    corner = track.boxes[:, :2] + track.boxes[:, 2:4] * track.boxes[:, 4:5]
    expected = corner @ np.array([[c, s], [-s, c]]) + [30.0, -80.0]
    np.testing.assert_allclose(moved.boxes[:, :2] + moved.boxes[:, 2:4] * moved.boxes[:, 4:5], expected)


@pytest.mark.parametrize("key", KINDS)
def test_painted_stretches_are_disjoint_and_on_the_road(key):
    for marking in _track(*key).markings:
        painted = marking.painted_cm
        assert (painted[:, 1] > painted[:, 0]).all()
        assert (painted[1:, 0] >= painted[:-1, 1]).all()
        assert painted.min() >= 0.0 and painted.max() <= _track(*key).length_cm + 1e-9


def test_dashes_have_their_length_along_the_line_itself():
    arc = {"arc": {"radius_cm": 100, "angle_deg": 170, "direction": "left"}}
    dashed = MarkingSettings(kind="dashed", dash_cm=12, gap_cm=8)
    track = _draw(0, pieces=[arc], left=dashed, right=dashed, interruptions_per_m=0.0)
    for marking in track.markings:
        radius = 100.0 - marking.offset_cm
        inner = marking.painted_cm[1:-1]
        np.testing.assert_allclose(np.diff(inner, axis=1) * radius / 100.0, 12.0, atol=0.02)
        np.testing.assert_allclose(np.diff(inner[:, 0]) * radius / 100.0, 20.0, atol=0.02)


def test_visibility_curvature_and_lap_are_answered():
    plain = MarkingSettings(interruptions=((50.0, 80.0),), interruptions_per_m=0.0)
    half = {"arc": {"radius_cm": 80, "angle_deg": 180, "direction": "left"}}
    straight = {"straight": {"length_cm": 200}}
    track = _draw(
        0,
        closed=True,
        pieces=[straight, half, straight, half],
        left=plain,
        right=MarkingSettings(kind="none"),
    )
    s = np.array([49.0, 51.0, 79.0, 81.0])
    np.testing.assert_array_equal(line_painted(track, "left", s), [True, False, False, True])
    np.testing.assert_array_equal(
        line_painted(track, "left", s + track.length_cm), [True, False, False, True]
    )
    assert not line_painted(track, "right", s).any()
    np.testing.assert_allclose(track.curvature(np.array([300.0, 100.0])), [1.0 / 80.0, 0.0])
    # The lines are where the road has them, painted or not.
    assert np.isfinite(track.truth(np.array([60.0, 0.0, 0.0]), WHEELBASE_CM)).all()


def test_a_double_line_is_two_tapes_about_its_place():
    track = _draw(0, length_cm=500, left=MarkingSettings(kind="double", double_gap_cm=3.0, colour="black"))
    left = [m for m in track.markings if m.offset_cm > 0.0]
    assert sorted(m.offset_cm for m in left) == [17.5, 22.5]
    np.testing.assert_array_equal(left[0].painted_cm, left[1].painted_cm)
    assert max(left[0].colour_bgr) < 40.0


@pytest.mark.parametrize("sides", ["left", "right", "both"])
def test_a_junction_opens_the_lines_at_its_mouth(sides):
    item = Furniture(junction=Junction(at_cm=300, sides=sides, width_cm=60, corner_radius_cm=20))
    track = _draw(0, lanes=2, pieces=[{"straight": {"length_cm": 600}}], furniture=[item.model_dump()],
                  interruptions_per_m=0.0, middle={"kind": "solid"})  # fmt: skip
    mouth = np.array([251.0, 300.0, 349.0])
    by_offset = {m.offset_cm: m for m in track.markings}
    assert is_painted(by_offset[-20.0].painted_cm, mouth).any() == (sides == "left")
    assert is_painted(by_offset[60.0].painted_cm, mouth).any() == (sides == "right")
    assert is_painted(by_offset[20.0].painted_cm, mouth).any() == (sides != "both")
    for marking in track.markings:
        assert is_painted(marking.painted_cm, np.array([249.0, 351.0])).all()
    ys = track.boxes[:, 1]
    assert (ys.min() < -90.0) == (sides != "left")
    assert (ys.max() > 130.0) == (sides != "right")
    # Nothing of it is painted on the road itself, except beside its outer lines.
    assert not ((ys > -18.0) & (ys < 58.0)).any()


def test_a_stop_line_crosses_the_driven_lane_only():
    item = Furniture(stop_line=StopLine(at_cm=150, thickness_cm=4))
    track = _draw(0, lanes=2, pieces=[{"straight": {"length_cm": 300}}], furniture=[item.model_dump()])
    np.testing.assert_allclose(track.boxes[:, :6], [[150.0, 0.0, 1.0, 0.0, 2.0, 20.0]], atol=1e-9)


def test_random_furniture_does_not_move_the_road():
    plain, rich = _draw(7, closed=True, lanes=2), _draw(7, closed=True, lanes=2, random_furniture=RATES)
    np.testing.assert_array_equal(plain.xy_cm, rich.xy_cm)
    assert len(plain.boxes) == 0 and len(rich.boxes) > 20
    assert [m.colour_bgr for m in plain.markings] == [m.colour_bgr for m in rich.markings]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.floats(0.05, 0.8))
def test_wear_takes_about_its_share(seed, share):
    left = wear_off(np.array([[0.0, 5000.0]]), 5000.0, share, np.random.default_rng(seed))
    assert (left[1:, 0] > left[:-1, 1]).all()
    assert np.diff(left, axis=1).sum() == pytest.approx(5000.0 * (1.0 - share), rel=0.15, abs=150.0)


@settings(max_examples=50, deadline=None)
@given(
    a=st.lists(st.integers(0, 100), min_size=2, max_size=12, unique=True),
    b=st.lists(st.integers(0, 100), min_size=2, max_size=12, unique=True),
)
def test_subtraction_agrees_with_a_count(a, b):
    first, second = (np.sort(np.array(v[: len(v) // 2 * 2], float)).reshape(-1, 2) for v in (a, b))
    places = np.arange(100) + 0.5
    expected = is_painted(first, places) & ~is_painted(second, places)
    np.testing.assert_array_equal(is_painted(subtract(first, second), places), expected)


@pytest.mark.parametrize("key", KINDS)
def test_the_grid_answers_with_the_nearest_sample(key):
    track = _track(*key)
    grid = NearestGrid(track)
    rng = np.random.default_rng(2)
    reach_cm = grid.reach_cm
    whole, frame = grid.around(track.xy_cm.min(axis=0) - reach_cm, track.xy_cm.max(axis=0) + reach_cm)
    for s in rng.uniform(0.0, track.length_cm, 20):
        xy, _ = track.point(s, rng.uniform(-20.0, 20.0))
        window, origin = grid.around(xy - 200.0, xy + 200.0)
        column, row = np.floor((xy - origin[:2]) / origin[2]).astype(int)
        centre = origin[:2] + (np.array([column, row]) + 0.5) * origin[2]
        d = np.linalg.norm(track.xy_cm - centre, axis=1)
        assert d[window[row, column]] == pytest.approx(d.min(), abs=1e-9)
        column, row = np.floor((xy - frame[:2]) / frame[2]).astype(int)
        assert d[whole[row, column]] == pytest.approx(d.min(), abs=1e-9)
        far, _ = grid.around(xy + 1e5, xy + 1e5 + 100.0)
        assert (far == -1).all()


def test_a_long_road_costs_its_length_only():
    track = _draw(1, closed=True, length_cm=20_000.0)
    grid = NearestGrid(track)
    window, _ = grid.around(track.xy_cm[500] - 280.0, track.xy_cm[500] + 280.0)
    assert window.size <= (5 * 128) ** 2
    first = window.copy()
    for xy in track.xy_cm[::400]:
        grid.around(xy - 280.0, xy + 280.0)
    assert 5 <= len(grid._blocks) <= 32  # the rest was let go, and comes back as it was
    np.testing.assert_array_equal(grid.around(track.xy_cm[500] - 280.0, track.xy_cm[500] + 280.0)[0], first)


def test_track_files_keep_boxes_and_the_oncoming_lane(tmp_path):
    track = _track(True, 2)
    path = tmp_path / "track.json"
    write_track(path, track)
    again = read_track(path)
    np.testing.assert_array_equal(again.boxes, track.boxes)
    assert again.oncoming_cm == 40.0
    np.testing.assert_array_equal(again.xy_cm, track.xy_cm)


def test_the_picture_shows_lines_and_boxes_where_they_are():
    item = Furniture(stop_line=StopLine(at_cm=150, thickness_cm=6))
    track = _draw(0, pieces=[{"straight": {"length_cm": 300}}], furniture=[item.model_dump()],
                  left={"kind": "solid"}, interruptions_per_m=0.0)  # fmt: skip
    image = draw_track(track, 2.0, (10.0, 10.0, 10.0))
    white = image[..., 1] > 200
    columns = np.nonzero(white)[1]
    # Lines of 300 cm, 40 cm apart, at two pixels per centimetre.
    assert abs((columns.max() - columns.min()) - 600) < 4
    across = np.flatnonzero(white[:, image.shape[1] // 2 - 150])
    assert abs((across.max() - across.min()) - 84) < 3
    assert white[image.shape[0] // 2, columns.min() + 300]
    assert not white[image.shape[0] // 2, columns.min() + 270]
    with pytest.raises(ValueError, match="expected at most"):
        draw_track(track, 1000.0)


def test_the_verb_draws_presets_and_files(tmp_path):
    out = tmp_path / "road.png"
    result = CliRunner().invoke(app, ["track", "bfmc", "--out", str(out), "--seed", "2", "--size", "400"])
    assert result.exit_code == 0, result.output
    assert "2 lane(s) of 37 cm" in result.output
    image = cv2.imread(str(out))
    assert max(image.shape) in range(399, 402)
    expected = random_track(preset("bfmc"), np.random.default_rng(2))
    np.testing.assert_array_equal(
        image, draw_track(expected, picture_scale(expected, 400), preset("bfmc").floor_bgr)
    )
    road = tmp_path / "mine.yaml"
    road.write_text("lane_width_cm: 0\n")
    result = CliRunner().invoke(app, ["track", str(road), "--out", str(out)])
    assert result.exit_code == 1 and "mine.yaml: key 'lane_width_cm'" in result.output
    result = CliRunner().invoke(app, ["track", "bmfc", "--out", str(out)])
    assert result.exit_code == 1 and "found neither" in result.output
    assert CliRunner().invoke(app, ["track", "bfmc", "--out", "x.jpg"]).exit_code == 1
