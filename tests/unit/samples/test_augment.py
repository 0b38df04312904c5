import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from synthetic_labels import WINDOW, make_label_set

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera, Mounting
from lanenet.geometry.frames import car_from_map, map_from_car
from lanenet.geometry.lane import mirror_points, rows_of_polyline
from lanenet.perception.edges.raster import MIDDLE, STEPS, fill_raster, new_raster
from lanenet.perception.edges.road import RoadEdges
from lanenet.samples.augment import augment_batch, join_frames, plain_batch
from lanenet.samples.kernels import misplace
from lanenet.samples.settings import AugmentSettings

NOTHING = AugmentSettings.only()
LABELS = make_label_set(12, seed=5)
EDGES = LABELS.edges
FRAMES = join_frames(EDGES, LABELS.lines, LABELS.points_cm)
ALL = np.arange(12)


def augment(changes, window=WINDOW, seed=0):
    batch = augment_batch(FRAMES, ALL, window, NOTHING.model_copy(update=changes), seed, 0)
    return batch.rasters[:, :1], batch.points_cm


def lines_present(edges, lines_cm, window):
    frames = join_frames([np.asarray(edges, np.float32)], [lines_cm], np.full((1, 6), np.nan))
    return plain_batch(frames, np.zeros(1, np.int64), window).present[0]


def labels_of_view(points, lines, mirror, shift, turn):
    """Slow and obvious: the polylines as a moved car sees them, asked for their rows."""
    # In the map: a car at the origin that heads along +x, with no wheelbase, so that pose = front axle.
    sign = np.array([-1.0 if mirror else 1.0, 1.0])
    in_map = [map_from_car(line * sign, np.zeros(3), 0.0) for line in (lines[::-1] if mirror else lines)]
    moved = [car_from_map(line, np.array([0.0, -shift, turn]), 0.0) for line in in_map]
    known = np.isfinite(mirror_points(points) if mirror else points)
    return np.where(known, np.concatenate([rows_of_polyline(line) for line in moved]), np.nan)


def misplaced(points, camera_cm, height=0.0, pitch_rad=0.0, roll_rad=0.0):
    found = [misplace(x, y, *camera_cm, 1.0 + height, pitch_rad, roll_rad) for x, y in points.tolist()]
    return np.array(found)


@given(
    st.lists(st.tuples(st.floats(-90, 90, width=32), st.floats(-20, 110, width=32)), max_size=60),
    st.sampled_from([WINDOW, BirdseyeWindow(), BirdseyeWindow(-33.3, 1.7, 0.7, 50, 60)]),
)
@settings(max_examples=60, deadline=None)
def test_rasters_are_those_of_the_window_byte_for_byte(points, window):
    # Borders of cells, where rounding decides, and points that are not there.
    border = [
        [window.left_cm + k * window.cell_cm, window.far_cm - k * window.cell_cm] for k in range(-1, 52)
    ]
    edges = np.array([*points, *border, [np.nan, 3.0], [3.0, np.inf]], np.float32)
    angle = np.arange(len(edges), dtype=np.float32)
    looks = np.stack([np.cos(angle), np.sin(angle), np.cos(2.0 * angle), np.sin(3.0 * angle)], axis=1)
    rows = np.hstack([edges, looks]).astype(np.float32)
    frames = join_frames([rows], [(np.empty((0, 2)), np.empty((0, 2)))], np.full((1, 6), np.nan))
    expected = fill_raster(window, RoadEdges.of_rows(rows), new_raster(window))
    np.testing.assert_array_equal(expected[0], window.rasterise(edges))
    np.testing.assert_array_equal(plain_batch(frames, np.array([0]), window).rasters[0], expected)
    unchanged = augment_batch(frames, np.array([0]), window, NOTHING, 0, 0).rasters[0]
    np.testing.assert_array_equal(unchanged, expected)


@pytest.mark.parametrize("mirror", [0.0, 1.0])
def test_normals_turn_with_the_points(mirror):
    y = np.arange(10.0, 60.0, 0.5)
    rows = np.stack([0.0 * y - 20.0, y, 0.0 * y + 0.8, 0.0 * y - 0.6, 0.0 * y, 0.0 * y], axis=1)
    frames = join_frames([rows.astype(np.float32)], LABELS.lines[:1], LABELS.points_cm[:1])
    changes = {"mirror": mirror, "rotate_rad": 0.2, "draw": "limit"}
    raster = augment_batch(frames, ALL[:1], WINDOW, NOTHING.model_copy(update=changes), 0, 0).rasters[0]
    at = np.nonzero(raster[0])
    ahead = WINDOW.points(np.argwhere(raster[0]).astype(float))
    x, along = np.polyfit(ahead[:, 1], ahead[:, 0], 1)[0], -0.2
    turn = 0.2 if x < 0.0 else along
    normal = np.array([-0.8 if mirror else 0.8, -0.6])
    c, s = np.cos(turn), np.sin(turn)
    expected = np.array([c * normal[0] - s * normal[1], s * normal[0] + c * normal[1]])
    found = (raster[1:3, at[0], at[1]].astype(float) - MIDDLE) / STEPS
    np.testing.assert_allclose(found.T, np.tile(expected, (len(at[0]), 1)), atol=0.02)


def test_light_and_colours_change_as_they_are_told():
    rows = EDGES[0] + np.float32([0.0, 0.0, 0.0, 0.0, 0.4, -0.2])
    frames = join_frames([rows], LABELS.lines[:1], LABELS.points_cm[:1])

    def looks(**changes):
        changed = NOTHING.model_copy(update=changes)
        raster = augment_batch(frames, ALL[:1], WINDOW, changed, 0, 0).rasters[0]
        return (raster[1:, raster[0] > 0].astype(float) - MIDDLE).mean(axis=1) / STEPS

    np.testing.assert_allclose(looks(), [1.0, 0.0, 0.4, -0.2], atol=0.01)
    np.testing.assert_allclose(looks(inverted=1.0), [-1.0, 0.0, 0.4, -0.2], atol=0.01)
    np.testing.assert_allclose(looks(colourless=1.0), [1.0, 0.0, 0.0, 0.0], atol=0.01)
    gain = looks(hue_gain=0.5, draw="limit")[2:] / [0.4, -0.2]
    assert gain[0] == pytest.approx(gain[1], abs=0.05) and abs(np.log(gain[0])) == pytest.approx(
        0.405, abs=0.04
    )
    np.testing.assert_allclose(np.abs(looks(hue_cast=0.1, draw="limit")[2:] - [0.4, -0.2]), 0.1, atol=0.01)


def test_without_changes_the_sample_stays():
    rasters, points = augment({})
    np.testing.assert_array_equal(rasters[3], LABELS.raster(3)[:1])
    np.testing.assert_allclose(points, LABELS.points_cm, atol=1e-4)


def test_mirror_flips_raster_and_labels():
    rasters, points = augment({"mirror": 1.0})
    np.testing.assert_allclose(points, mirror_points(LABELS.points_cm), atol=1e-4)
    # A point on the border of two cells may fall into either.
    different = rasters[:, 0] != np.stack([LABELS.raster(i)[0, :, ::-1] for i in range(12)])
    assert different.sum() <= 0.01 * np.count_nonzero(rasters)


@pytest.mark.parametrize("draw", ["even", "limit"])
def test_rasters_and_labels_are_those_of_one_view(draw):
    wide = BirdseyeWindow(left_cm=-120.0, near_cm=-20.0, cell_cm=0.5, rows=280, columns=480)
    changes = {"mirror": 0.5, "shift_cm": 8.0, "rotate_rad": 0.26, "scale": 0.3, "draw": draw}
    rasters, points = augment(changes, wide)
    for i in ALL:
        x = points[i].astype(float)
        # Undo what the labels tell of the view: parallel lines, 40 cm apart before the scaling.
        assert np.isfinite(x).all() and (x[3:] > x[:3]).all()
        cells = np.argwhere(rasters[i, 0])
        seen = wide.points(cells.astype(float))
        for side in (0, 1):
            # Both edges of the tape lie on either side of the label, half a tape away.
            near = seen[np.abs(seen[:, 1] - 30.0) < 0.5]
            gap = np.abs(near[:, 0] - x[3 * side + 2])
            assert gap.min() > 0.3 and np.sort(gap)[1] < 3.0
    if draw == "limit":
        plain = augment({}, wide)[1]
        assert (np.abs(points - plain).max(axis=1) > 3.0).all()


@given(shift=st.floats(-6, 6), turn=st.floats(-0.2, 0.2), mirror=st.booleans())
@settings(max_examples=50, deadline=None)
def test_labels_of_straight_lines_are_exact(shift, turn, mirror):
    y = np.linspace(-80.0, 200.0, 30)
    lines = (np.stack([-20.0 + 0.0 * y, y], 1), np.stack([20.0 + 0.0 * y, y], 1))
    points = labels_of_view(np.repeat([-20.0, 20.0], 3), lines, mirror, shift, turn)
    # x = +-20 becomes a line at distance +-20 - shift, seen under the angle `turn`.
    rows = np.array([0.0, 15.0, 30.0])
    expected = [(side - shift) / np.cos(turn) + rows * np.tan(turn) for side in (-20.0, 20.0)]
    np.testing.assert_allclose(points, np.concatenate(expected), atol=1e-9)


def test_labels_are_those_of_the_moved_polylines():
    y = np.arange(-50.0, 22.0, 2.0)
    lines = (np.stack([-20.0 + 0.01 * y * y, y], 1), np.stack([20.0 + 0.3 * y, y], 1))
    lines[1][30] = np.nan
    points = np.array([-20.0, -20.0, np.nan, 20.0, 20.0, np.nan])
    frames = join_frames([np.empty((0, 6), np.float32)], [lines], points[None])
    window = BirdseyeWindow()
    for mirror, shift, turn in product((0.0, 1.0), (-5.0, 5.0), (-0.1, 0.0, 0.1)):
        # With no other change, "limit" leaves two shifts and two turns to draw from.
        changes = {"mirror": mirror, "shift_cm": abs(shift), "rotate_rad": abs(turn), "draw": "limit"}
        expected = labels_of_view(points, lines, bool(mirror), shift, turn)
        fixed = NOTHING.model_copy(update=changes)
        found = [augment_batch(frames, ALL[:1], window, fixed, k, 0)[1][0] for k in range(20)]
        assert any(np.allclose(f, window.labelled(expected), atol=1e-4, equal_nan=True) for f in found)
    assert np.isnan(found[0][[2, 5]]).all()


def test_what_lies_across_a_missing_line_goes_with_it():
    # The ends of a tape lie across it: they would tell where the line was.
    across = [edge * np.float32([1, 1, 0, 0, 0, 0]) + np.float32([0, 0, 0, 1, 0, 0]) for edge in EDGES]
    frames = join_frames(across, LABELS.lines, LABELS.points_cm)
    gone = NOTHING.model_copy(update={"missing_both": 1.0})
    assert not augment_batch(frames, ALL, WINDOW, gone, 0, 0)[0][:, 0].any()


def test_the_next_lane_goes_with_a_missing_line_and_what_lies_about_stays():
    y = np.arange(-60.0, 120.0, 2.0)
    lines = tuple(np.stack([np.full(len(y), x), y], 1) for x in (-20.0, 20.0))

    def column(x, normal):
        edge = np.stack([np.full(120, x), np.linspace(4.0, 64.0, 120)], 1)
        return RoadEdges(edge, np.tile(normal, (120, 1))).rows()

    # Left line, the next lane's border, a scratch between them, and the right line.
    parts = [column(-20.0, (1.0, 0.0)), column(-40.0, (1.0, 0.1)), column(-30.0, (0.0, 1.0))]
    right = column(20.0, (1.0, 0.0))
    frames = join_frames([np.concatenate([*parts, right])], [lines], np.repeat([-20.0, 20.0], 3)[None])
    fine, seen = BirdseyeWindow(), set()
    for seed in range(8):
        gone = NOTHING.model_copy(update={"missing_line": 1.0})
        rasters, _, present, _ = augment_batch(frames, ALL[:1], fine, gone, seed, 0)
        kept = [parts[2], right] if present[0, 0] == 0.0 else parts
        np.testing.assert_array_equal(rasters[0, 0], fine.rasterise(np.concatenate(kept)[:, :2]))
        seen.add(tuple(present[0].tolist()))
    assert seen == {(0.0, 1.0), (1.0, 0.0)}
    # A border farther out is not the line itself.
    beyond = lines_present(np.concatenate([parts[1], right]), lines, fine)
    np.testing.assert_array_equal(beyond, [0.0, 1.0])


def test_scaling_scales_the_labels():
    points = augment({"scale": 0.25, "draw": "limit"}, BirdseyeWindow(-90.0, 0.0, 1.0, 100, 180))[1]
    # The curve itself scales, so that its rows are those of other stretches; the lane's width tells.
    widths = points[:, 3] - points[:, 0]
    assert set(np.round(widths, 2)) == {50.0, 32.0}


# A roll about a tilted axis would turn the car, too.
@pytest.mark.parametrize(
    ("pitch_deg", "height", "pitch", "roll"),
    [(0.0, 0.1, 0.0, 0.0), (25.0, 0.0, 0.02, 0.0), (25.0, -0.1, -0.02, 0.0), (0.0, 0.0, 0.0, 0.03)],
)
def test_wrong_calibration_is_what_two_cameras_disagree_by(pitch_deg, height, pitch, roll):
    mounting = Mounting(20.0, math.radians(pitch_deg), 0.0, 0.0, -3.0, 1.5)
    K = np.array([[120.0, 0, 160], [0, 120.0, 120], [0, 0, 1]])
    true = Camera("fisheye", 320, 240, K, np.zeros(4), mounting, 26.0)
    wrong = true.with_mounting(
        height_cm=20.0 * (1.0 + height), pitch_down_rad=mounting.pitch_down_rad + pitch, roll_rad=roll
    )
    points = np.array([[0.0, 10.0], [-30.0, 20.0], [25.0, 60.0]])
    seen = wrong.intersect_ground(true.project_ground(points))
    found = misplaced(points, mounting.position_car_cm, height=height, pitch_rad=pitch, roll_rad=roll)
    np.testing.assert_allclose(found, seen, atol=1e-6)
    assert np.abs(found - points).max() > 0.5


def test_rays_that_miss_the_road_have_no_point():
    far = np.array([[0.0, 3000.0]])
    assert np.isnan(misplaced(far, np.array([0.0, 0.0, 20.0]), pitch_rad=-0.02)).all()
    assert np.isfinite(misplaced(far, np.array([0.0, 0.0, 20.0]), pitch_rad=0.02)).all()


def test_a_wrong_calibration_moves_the_raster_and_not_the_labels():
    rasters, points = augment({"pitch_rad": 0.0175, "draw": "limit"}, BirdseyeWindow())
    np.testing.assert_allclose(points, LABELS.points_cm, atol=1e-4)
    for i in ALL:
        edges = [
            misplaced(EDGES[i][:, :2], np.array([0.0, 0.0, 18.0]), pitch_rad=p) for p in (-0.0175, 0.0175)
        ]
        expected = [BirdseyeWindow().rasterise(e.astype(np.float32)) for e in edges]
        different = [np.count_nonzero(rasters[i, 0] != e) for e in expected]
        assert min(different) <= 2 < max(different)


def test_objects_hide_the_road_and_leave_the_labels():
    fine = BirdseyeWindow()
    full = augment({}, fine)[0]
    rasters, points = augment({"objects": 3, "draw": "limit"}, fine)
    np.testing.assert_allclose(points, LABELS.points_cm, atol=1e-4)
    assert (np.count_nonzero(rasters & ~full, axis=(1, 2, 3)) > 0).sum() >= 10
    assert (np.count_nonzero(full & ~rasters, axis=(1, 2, 3)) > 0).sum() >= 3


def test_clutter_adds_the_share_that_was_asked_for():
    fine = BirdseyeWindow()
    full = np.count_nonzero(augment({}, fine)[0], axis=(1, 2, 3))
    more = np.count_nonzero(augment({"clutter_share": 0.3, "draw": "limit"}, fine)[0], axis=(1, 2, 3))
    np.testing.assert_allclose(more / full - 1.0, 0.3, atol=0.05)


def test_doubled_points_lie_beside_the_others():
    fine = BirdseyeWindow()
    full = augment({}, fine)[0]
    rasters = augment({"double_points": 1.0, "draw": "limit"}, fine)[0]
    assert not np.any(rasters < full)
    grown = np.zeros_like(full)
    for row in range(-3, 4):
        for column in range(-3, 4):
            grown |= np.roll(full, (row, column), axis=(2, 3))
    assert np.count_nonzero(rasters) > 1.2 * np.count_nonzero(full) and not np.any(rasters & ~grown)


def test_missing_lines_are_not_present_and_the_labels_stay():
    fine = BirdseyeWindow()
    for changes, expected in (({}, [2.0]), ({"missing_line": 1.0}, [1.0]), ({"missing_both": 1.0}, [0.0])):
        rasters, points, present, _ = augment_batch(
            FRAMES, ALL, fine, NOTHING.model_copy(update=changes), 0, 0
        )
        np.testing.assert_array_equal(np.unique(present.sum(axis=1)), expected)
        assert np.isfinite(points).all()
        if changes == {"missing_both": 1.0}:
            assert not rasters[:, 0].any()
        if changes == {"missing_line": 1.0}:
            assert set(map(tuple, present)) == {(0.0, 1.0), (1.0, 0.0)}
            for raster, (left, _) in zip(rasters, present, strict=True):
                seen = fine.points(np.argwhere(raster[0]).astype(float))
                near = seen[seen[:, 1] < 20.0]
                # The lane leans by at most 0.15, so that its lines stay on their sides near the car.
                assert (near[:, 0] > 0.0).mean() > 0.9 if left == 0.0 else (near[:, 0] < 0.0).mean() > 0.9


def test_mirroring_swaps_which_line_is_there():
    left_only = EDGES[0][EDGES[0][:, 0] < LABELS.points_cm[0, 1] + 10.0]
    frames = join_frames([left_only], LABELS.lines[:1], LABELS.points_cm[:1])
    one = np.array([0])
    for mirror, expected in ((0.0, [1.0, 0.0]), (1.0, [0.0, 1.0])):
        changed = NOTHING.model_copy(update={"mirror": mirror})
        np.testing.assert_array_equal(augment_batch(frames, one, WINDOW, changed, 0, 0)[2][0], expected)


def test_presence_needs_enough_edges_near_the_line():
    fine, lines = BirdseyeWindow(), LABELS.lines[0]
    near = EDGES[0][: 144 * 2]  # both edges of the left tape, 8 to 80 cm ahead
    np.testing.assert_array_equal(lines_present(near, lines, fine), [1.0, 0.0])
    np.testing.assert_array_equal(lines_present(EDGES[0], lines, fine), [1.0, 1.0])
    # 1.5 cm of one edge are nothing, 10 cm could be anything, 25 cm are a line.
    for points, expected in ((3, 0.0), (20, np.nan), (50, 1.0)):
        np.testing.assert_array_equal(lines_present(near[:points], lines, fine), [expected, 0.0])
    beside = near + np.float32([5.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert lines_present(beside, lines, fine)[0] == 0.0
    # As many edges, but across the road: the shadow of something, no tape.
    for lean_deg, expected in ((20.0, 1.0), (45.0, 0.0), (90.0, 0.0)):
        lean, turned = math.radians(lean_deg), near.copy()
        turned[:, 2:4] = math.cos(lean), math.sin(lean)
        np.testing.assert_array_equal(lines_present(turned, lines, fine), [expected, 0.0])
    nowhere = (np.full((3, 2), np.nan), np.empty((0, 2)))
    assert np.isnan(lines_present(near, nowhere, fine)).all()


def test_dropping_keeps_a_share_of_the_points():
    fine = BirdseyeWindow()
    full = np.count_nonzero(augment({}, fine)[0])
    rasters, points = augment({"drop_points": 0.5}, fine)
    left = np.count_nonzero(rasters) / full
    assert 0.6 < left < 0.95  # a mean share of a quarter is dropped
    np.testing.assert_allclose(points, LABELS.points_cm, atol=1e-4)


def test_missing_stretch_takes_a_part():
    full = augment({}, BirdseyeWindow())[0]
    part = augment({"missing_stretch": 1.0}, BirdseyeWindow())[0]
    assert not np.any(part > full)
    gone = 1.0 - np.count_nonzero(part, axis=(1, 2, 3)) / np.count_nonzero(full, axis=(1, 2, 3))
    # A point beyond the window takes little or nothing from it.
    assert (gone > 0.0).sum() >= 10 and (gone < 0.9).all()


def test_clutter_only_adds():
    clean = augment({})[0]
    cluttered = augment({"clutter_segments": 5, "clutter_points": 30})[0]
    assert not np.any(cluttered < clean)
    assert np.count_nonzero(cluttered) > np.count_nonzero(clean)


def test_an_empty_frame_can_be_augmented():
    edges, lines = np.empty((0, 6), np.float32), (np.empty((0, 2)), np.full((3, 2), np.nan))
    frames = join_frames([edges], [lines], np.full((1, 6), np.nan))
    changes = {"missing_stretch": 1.0, "missing_line": 1.0, "jitter_cm": 1.0, "clutter_share": 1.0}
    one = np.array([0])
    rasters, points, present, _ = augment_batch(frames, one, WINDOW, NOTHING.model_copy(update=changes), 0, 0)
    assert not rasters[:, 0].any() and np.isnan(points).all() and np.isnan(present).all()


def test_lines_cannot_be_missing_more_than_always():
    with pytest.raises(ValidationError, match="sum to at most 1"):
        AugmentSettings(missing_line=0.8, missing_both=0.3)


def test_the_width_to_tell_grows_with_the_scale_and_is_kept_from_some():
    frames = join_frames(EDGES, LABELS.lines, LABELS.points_cm, lane_cm=np.full(len(EDGES), 40.0))
    assert (plain_batch(frames, ALL, WINDOW).lane_cm == 40.0).all()
    wide = augment_batch(
        frames, ALL, WINDOW, NOTHING.model_copy(update={"scale": 0.2, "draw": "limit"}), 0, 0
    )
    # Lanes of 40 cm that have become wider or narrower: what is told is what the labels show.
    np.testing.assert_allclose(np.unique(wide.lane_cm), (40.0 / 1.2, 48.0), rtol=1e-5)
    for told, points in zip(wide.lane_cm, wide.points_cm, strict=True):
        assert points[4] - points[1] == pytest.approx(told * lane_over_cosine(points), rel=0.02)
    many = np.zeros(4000, np.int64)
    changed = NOTHING.model_copy(update={"untold_width": 0.3, "width_error": 0.05})
    told = augment_batch(frames, many, WINDOW, changed, 0, 0, streams=np.arange(4000)).lane_cm
    assert (told == 0.0).mean() == pytest.approx(0.3, abs=0.03)
    assert told[told > 0.0].min() == pytest.approx(38.0, abs=0.1)
    assert told.max() == pytest.approx(42.0, abs=0.1)


def lane_over_cosine(points):
    """How much longer the way across a lane along x is than its width, from the slope of its middle."""
    slope = (points[2] + points[5] - points[0] - points[3]) / 60.0
    return np.hypot(1.0, slope)


@pytest.mark.parametrize("mirror", [0.0, 1.0])
@pytest.mark.parametrize("draw", ["even", "limit"])
def test_the_car_is_not_put_into_the_next_lane(mirror, draw):
    divides = np.tile([True, False], (len(EDGES), 1))
    frames = join_frames(
        EDGES, LABELS.lines, LABELS.points_cm, lane_cm=np.full(len(EDGES), 40.0), divides=divides
    )
    many, streams = np.tile(ALL, 40), np.arange(40 * len(ALL))
    changes = NOTHING.model_copy(update={"shift_cm": 30.0, "mirror": mirror, "draw": draw})
    points = augment_batch(frames, many, BirdseyeWindow(), changes, 0, 0, streams)[1]
    left, right = points[:, 0], points[:, 3]
    divider, border = (left, right) if mirror == 0.0 else (-right, -left)
    # A twentieth of the lane stays between car and divider, and no more; the other line is crossed.
    assert np.nanmax(divider) == pytest.approx(-2.0, abs=0.01 if draw == "limit" else 0.3)
    assert np.nanmin(border) < -5.0
    if draw == "even":
        assert np.histogram(divider, bins=[-60, -30, -20, -10, 0])[0].min() > 20


def test_middle_dashes_lie_between_the_lines_and_change_nothing_else():
    fine = BirdseyeWindow()
    frames = join_frames(EDGES, LABELS.lines, LABELS.points_cm, lane_cm=np.full(len(EDGES), 40.0))
    many, streams = np.tile(ALL, 10), np.arange(10 * len(ALL))
    dashed = NOTHING.model_copy(update={"middle_dashes": 1.0})
    plain = augment_batch(frames, many, fine, NOTHING, 0, 0, streams)
    rasters, points, present, told = augment_batch(frames, many, fine, dashed, 0, 0, streams)
    np.testing.assert_array_equal(points, plain.points_cm)
    np.testing.assert_array_equal(present, plain.present)
    added = (rasters[:, :1] > 0) & (plain.rasters[:, :1] == 0)
    assert not np.any(rasters[:, 0] < plain.rasters[:, 0])
    painted = []
    for i, new in zip(many, added[:, 0], strict=True):
        seen = fine.points(np.argwhere(new).astype(float))
        middle = 0.5 * (LABELS.lines[i][0] + LABELS.lines[i][1])
        off_cm = np.abs(seen[:, 0] - np.interp(seen[:, 1], middle[:, 1], middle[:, 0]))
        # 4 % of 40 cm off the middle, and half a tape of 2 cm; a cell may round by one.
        assert off_cm.max(initial=0.0) < 1.6 + 1.0 + fine.cell_cm
        rows = np.unique(np.argwhere(new)[:, 0])
        painted.append(len(rows) * fine.cell_cm / 64.0)  # of 8 to 72 cm ahead
    # Dashes and gaps of 5 to 30 cm: half of the way on average, never all of it.
    assert 0.35 < np.mean(painted) < 0.75 and np.max(painted) < 1.0
    untold = dashed.model_copy(update={"untold_width": 1.0})
    np.testing.assert_array_equal(
        augment_batch(frames, many, fine, untold, 0, 0, streams).rasters, plain.rasters
    )
    assert (told == 40.0).all()
