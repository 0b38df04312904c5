"""The road: shape, places along it, paint, truth, file."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_roads import line_xy, mirror_track, move_track

from datagen.world.road.build import random_track
from datagen.world.road.centre_line import comes_near_itself, integrate_curvature
from datagen.world.road.track import Marking, Track, interrupt, paint_dashes, read_track, write_track
from datagen.world.road.track_settings import MarkingSettings, TrackSettings
from lanenet.config import check_settings
from lanenet.errors import ConfigError, DriveFormatError
from lanenet.geometry.lane import mirror_points

WHEELBASE_CM = 26.0


def _draw(seed: int, **changes: object) -> Track:
    return random_track(TrackSettings(length_cm=900.0, **changes), np.random.default_rng(seed))


def _arc(radius_cm: float, length_cm: float) -> Track:
    """A road that is one left-hand arc; lane of 40 cm."""
    line = integrate_curvature(np.full(int(length_cm) + 1, 1.0 / radius_cm))
    painted = np.array([[0.0, length_cm]])
    white = (235.0, 235.0, 235.0)
    return Track(
        s_cm=np.arange(len(line.xy_cm)) * line.step_cm,
        xy_cm=line.xy_cm,
        heading_rad=line.heading_rad,
        curvature_per_cm=line.curvature_per_cm,
        closed=False,
        lane_width_cm=40.0,
        markings=(Marking(20.0, 2.0, white, painted), Marking(-20.0, 2.0, white, painted)),
    )


def test_integration_of_constant_curvature_is_the_circle():
    line = integrate_curvature(np.full(201, 1.0 / 80.0))
    angle = np.arange(201) / 80.0
    np.testing.assert_allclose(line.xy_cm[:, 0], 80.0 * np.sin(angle), atol=1e-6)
    np.testing.assert_allclose(line.xy_cm[:, 1], 80.0 * (1.0 - np.cos(angle)), atol=1e-6)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_random_roads_keep_their_promises(seed, closed):
    track = _draw(seed, closed=closed)
    assert track.length_cm == pytest.approx(900.0, abs=1e-6)
    assert np.max(np.abs(track.curvature_per_cm)) <= 1.0 / 60.0 + 1e-12
    xy = np.concatenate([track.xy_cm, track.xy_cm[:1]]) if closed else track.xy_cm
    # Chords of evenly spaced samples are a hair shorter than the arc.
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    np.testing.assert_allclose(steps, track.step_cm, atol=2e-4)
    # Heading and curvature belong to the positions.
    middle = 0.5 * (track.heading_rad[1:] + track.heading_rad[:-1])
    chord = _angles(track.xy_cm)
    np.testing.assert_allclose(np.cos(chord - middle), 1.0, atol=1e-6)
    turned = np.diff(track.heading_rad)
    mean = 0.5 * (track.curvature_per_cm[1:] + track.curvature_per_cm[:-1]) * track.step_cm
    np.testing.assert_allclose(turned, mean, atol=2e-4)
    # No two stretches 95 cm or more apart along the road come closer than 1.5 lane widths.
    gap = np.abs(track.s_cm[:, None] - track.s_cm)
    gap = np.minimum(gap, track.length_cm - gap) if closed else gap
    distance = np.linalg.norm(track.xy_cm[:, None] - track.xy_cm, axis=2)
    assert distance[gap > 95.0].min() >= 60.0


def _angles(xy: np.ndarray) -> np.ndarray:
    step = np.diff(xy, axis=0)
    return np.arctan2(step[:, 1], step[:, 0])


def test_roads_bend_both_ways_and_differ():
    tracks = [_draw(seed) for seed in range(8)]
    assert sum(t.curvature_per_cm.max() > 0.005 for t in tracks) >= 5
    assert sum(t.curvature_per_cm.min() < -0.005 for t in tracks) >= 5
    both = [t for t in tracks if t.curvature_per_cm.max() > 0.004 and t.curvature_per_cm.min() < -0.004]
    assert len(both) >= 4
    assert not np.allclose(tracks[0].xy_cm, tracks[1].xy_cm)


def test_same_seed_same_road_and_paint_does_not_move_the_shape():
    np.testing.assert_array_equal(_draw(4).xy_cm, _draw(4).xy_cm)
    plain = _draw(4, left=MarkingSettings(kind="solid"), interruptions_per_m=0.0)
    np.testing.assert_array_equal(_draw(4).xy_cm, plain.xy_cm)


def test_self_contact_is_noticed():
    circle = integrate_curvature(np.full(500, 1.0 / 70.0))  # more than once around
    assert comes_near_itself(circle, 60.0, closed=False)
    half = integrate_curvature(np.full(220, 1.0 / 70.0))
    assert not comes_near_itself(half, 60.0, closed=False)


@pytest.mark.parametrize("lanes", [1, 2])
def test_a_road_of_corners_turns_at_right_angles_between_straights(lanes):
    least_cm = (
        50.0,
        50.0 if lanes == 1 else 90.0,
    )  # to the right and to the left, where the other lane is inside
    turns, radii = [], []
    for seed in range(6):
        track = _draw(seed, corners=1.0, min_radius_cm=50.0, lanes=lanes)
        bent = np.abs(track.curvature_per_cm) > 1e-12
        ends = np.flatnonzero(np.diff(bent.astype(int)))
        # From straight to straight; the last piece of a road may be cut short.
        for first, last in zip(ends[::2], ends[1::2], strict=False):
            turns.append(abs(track.heading_rad[last + 1] - track.heading_rad[first]))
            sharpest = track.curvature_per_cm[np.argmax(np.abs(track.curvature_per_cm[first:last])) + first]
            radii.append(1.0 / abs(sharpest) / least_cm[int(sharpest > 0.0)])
            assert last - first < 1.8 * 1.25 * max(least_cm) + 40.0
    assert len(turns) > 12
    # A bend's length is a whole number of centimetres.
    assert np.deg2rad(79.0) < min(turns) and max(turns) < np.deg2rad(101.0)
    assert min(radii) > 0.999 and max(radii) < 1.251 and np.ptp(radii) > 0.1


def test_corners_are_as_many_as_asked_for():
    def sharp_share(corners: float) -> float:
        tracks = [_draw(seed, corners=corners) for seed in range(8)]
        return float(np.mean([np.abs(track.curvature_per_cm) > 1.0 / 75.1 for track in tracks]))

    assert sharp_share(0.0) < 0.5 * sharp_share(0.7)


def test_corners_are_refused_where_they_have_no_effect():
    for changes, kind in (
        ({"closed": True}, "that is a loop"),
        ({"pieces": [{"straight": {"length_cm": 200.0}}]}, "from pieces"),
        ({"preset": "bfmc"}, "that is a loop"),
    ):
        with pytest.raises(ConfigError, match=f"'corners': found 0.5 for a road {kind}, expected 0"):
            check_settings(TrackSettings, {"corners": 0.5, **changes}, "track")


def test_impossible_roads_are_refused():
    with pytest.raises(ConfigError, match="min_radius_cm 15"):
        _draw(0, min_radius_cm=15.0)
    with pytest.raises(ConfigError, match="closed road of 300 cm"):
        random_track(TrackSettings(length_cm=300.0, closed=True), np.random.default_rng(0))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 3),
    closed=st.booleans(),
    share=st.floats(0.02, 0.98),
    offset=st.floats(-28.0, 28.0),
)
def test_point_and_nearest_undo_each_other(seed, closed, share, offset):
    track = _TRACKS[seed, closed]
    s = share * track.length_cm
    xy, _ = track.point(s, offset)
    found_s, found_offset = track.nearest(xy)
    assert found_s == pytest.approx(s, abs=0.02)
    assert found_offset == pytest.approx(offset, abs=0.01)
    assert track.nearest(xy, near_s_cm=s) == (found_s, found_offset)


_TRACKS = {(seed, closed): _draw(seed, closed=closed) for seed in range(4) for closed in (False, True)}


def test_point_goes_on_over_the_seam_of_a_loop():
    track = _TRACKS[0, True]
    ahead, _ = track.point(track.length_cm + 37.3, 5.0)
    again, _ = track.point(37.3, 5.0)
    np.testing.assert_allclose(ahead, again, atol=1e-6)
    before, _ = track.point(track.length_cm - 0.01)
    np.testing.assert_allclose(before, track.xy_cm[0], atol=0.02)


def test_truth_on_an_arc_is_the_circle():
    radius, track = 90.0, _arc(90.0, 250.0)
    rear, heading = track.point(80.0)
    pose = np.array([*rear, heading])
    # Circles about the arc's centre, which lies 90 cm to the left of the rear axle.
    rows = np.array([0.0, 15.0, 30.0]) + WHEELBASE_CM
    expected = [-radius + np.sqrt((radius - side * 20.0) ** 2 - rows**2) for side in (1.0, -1.0)]
    np.testing.assert_allclose(track.truth(pose, WHEELBASE_CM), np.concatenate(expected), atol=0.005)


def test_truth_does_not_answer_with_another_stretch():
    # A half circle of radius 60: after it the road runs back, 120 cm to the left.
    curvature = np.concatenate([np.zeros(150), np.full(188, 1.0 / 60.0), np.zeros(200)])
    line = integrate_curvature(curvature)
    track = Track(np.arange(len(curvature)) * 1.0, line.xy_cm, line.heading_rad, curvature, False, 40.0, ())
    points = track.truth(np.array([40.0, 0.0, 0.0]), WHEELBASE_CM)
    np.testing.assert_allclose(points, [-20.0] * 3 + [20.0] * 3, atol=1e-9)
    # Looking across the end of the road: the rows are not met, which is not a number, not a guess.
    assert np.isnan(track.truth(np.array([*line.xy_cm[-1], line.heading_rad[-1]]), WHEELBASE_CM)).all()


@pytest.mark.parametrize("closed", [False, True])
def test_mirrored_and_moved_worlds(closed):
    track = _TRACKS[2, closed]
    rng = np.random.default_rng(0)
    for s in (80.0, 333.0, 600.0):
        xy, heading = track.point(s, rng.uniform(-6.0, 6.0))
        pose = np.array([*xy, heading + rng.uniform(-0.2, 0.2)])
        points = track.truth(pose, WHEELBASE_CM)
        assert np.isfinite(points).all()
        mirrored = mirror_track(track).truth(pose * [1.0, -1.0, -1.0], WHEELBASE_CM)
        np.testing.assert_allclose(mirrored, mirror_points(points), atol=1e-9)
        shift = np.array([310.0, -95.0, 2.1])
        c, sn = np.cos(2.1), np.sin(2.1)
        moved_pose = np.array([c * xy[0] - sn * xy[1] + 310.0, sn * xy[0] + c * xy[1] - 95.0, pose[2] + 2.1])
        there = move_track(track, shift).truth(moved_pose, WHEELBASE_CM)
        np.testing.assert_allclose(there, points, atol=1e-8)


def test_lane_lines_lie_half_a_lane_from_the_centre():
    track = _TRACKS[1, False]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        line = line_xy(track, side)
        offsets = [track.nearest(line[i])[1] for i in range(0, len(line), 50)]
        np.testing.assert_allclose(offsets, sign * 20.0, atol=1e-6)


def test_dashes_are_periodic_and_close_on_a_loop():
    dashes = paint_dashes(1000.0, False, 20.0, 10.0, 0.0)
    np.testing.assert_allclose(np.diff(dashes, axis=1)[:-1], 20.0)
    np.testing.assert_allclose(np.diff(dashes[:, 0]), 30.0)
    loop = paint_dashes(1000.0, True, 20.0, 10.0, 0.4)
    period = 1000.0 / 33
    inner = loop[(loop[:, 0] > 0.0) & (loop[:, 1] < 1000.0)]
    np.testing.assert_allclose(np.diff(inner[:, 0]), period)
    assert np.diff(loop, axis=1).sum() == pytest.approx(1000.0 * 20.0 / 30.0)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_interruptions_only_take_paint_away(seed):
    painted = paint_dashes(800.0, False, 30.0, 15.0, 0.3)
    left = interrupt(painted, 800.0, 0.5, 100.0, np.random.default_rng(seed))
    assert (left[:, 1] > left[:, 0]).all()
    assert (left[1:, 0] >= left[:-1, 1]).all()
    inside = [((painted[:, 0] <= a) & (b <= painted[:, 1])).any() for a, b in left]
    assert all(inside)
    same = interrupt(painted, 800.0, 0.0, 100.0, np.random.default_rng(seed))
    np.testing.assert_array_equal(same, painted)


def test_track_file_round_trip(tmp_path):
    track = _TRACKS[3, True]
    write_track(tmp_path / "track.json", track)
    again = read_track(tmp_path / "track.json")
    np.testing.assert_array_equal(again.xy_cm, track.xy_cm)
    np.testing.assert_array_equal(again.heading_rad, track.heading_rad)
    assert (again.closed, again.lane_width_cm) == (True, 40.0)
    for a, b in zip(again.markings, track.markings, strict=True):
        assert (a.offset_cm, a.width_cm, a.colour_bgr) == (b.offset_cm, b.width_cm, b.colour_bgr)
        np.testing.assert_array_equal(a.painted_cm, b.painted_cm)


def test_bad_track_files_are_refused(tmp_path):
    path = tmp_path / "track.json"
    with pytest.raises(DriveFormatError, match="no such file"):
        read_track(path)
    path.write_text("{")
    with pytest.raises(DriveFormatError, match="not valid JSON"):
        read_track(path)
    path.write_text('{"format": "lanenet-track/9"}')
    with pytest.raises(DriveFormatError, match="found 'lanenet-track/9'"):
        read_track(path)
    write_track(path, _TRACKS[0, False])
    good = json.loads(path.read_text())
    path.write_text(json.dumps({**good, "s_cm": good["s_cm"][:-1]}))
    with pytest.raises(DriveFormatError, match="of one length"):
        read_track(path)
    path.write_text(json.dumps({k: v for k, v in good.items() if k != "heading_rad"}))
    with pytest.raises(DriveFormatError, match="'heading_rad' is missing"):
        read_track(path)
    path.write_text(json.dumps({**good, "heading_rad": [None] * len(good["heading_rad"])}))
    with pytest.raises(DriveFormatError, match="not finite"):
        read_track(path)
