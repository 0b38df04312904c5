import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_labels import WINDOW, make_label_set

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.frames import car_from_map, map_from_car
from lanenet.geometry.lane import mirror_points
from lanenet.learn.augment import _near_line, augment_batch, labels_of_view, lines_present, make_view
from lanenet.learn.config import AugmentSettings

NOTHING = AugmentSettings(
    mirror=0.0,
    shift_cm=0.0,
    rotate_rad=0.0,
    drop_points=0.0,
    jitter_cm=0.0,
    missing_stretch=0.0,
    missing_line=0.0,
    clutter_segments=0,
    clutter_points=0,
)
LABELS = make_label_set(12, seed=5)
EDGES = [e[:, :2] for e in LABELS.edges]


def augment_all(changes, window=WINDOW, seed=0):
    rngs = [np.random.default_rng((seed, i)) for i in range(len(EDGES))]
    chosen = NOTHING.model_copy(update=changes)
    return augment_batch(EDGES, LABELS.lines, LABELS.points_cm, rngs, window, chosen)


def augment(changes, window=WINDOW, seed=0):
    return augment_all(changes, window, seed)[:2]


def test_a_dropped_line_is_told_as_absent():
    *_, both = augment_all({})
    assert (both == 1.0).all()
    rasters, _, present = augment_all({"missing_line": 1.0})
    assert (present.sum(axis=1) == 1.0).all() and len(np.unique(present[:, 0])) == 2
    # Cells of the right half, in which the right line lies, are marked if it is there.
    right = rasters[:, 0, :, 16:].any(axis=(1, 2))
    np.testing.assert_array_equal(right, present[:, 1] == 1.0)


def test_presence_counts_points_beside_the_line():
    window = BirdseyeWindow()
    y = np.linspace(1.0, 60.0, 12)
    lines = tuple(np.stack([np.full(2, x), [-10.0, 90.0]], axis=1) for x in (-20.0, 20.0))
    left = np.stack([np.full(12, -22.0), y], axis=1)
    np.testing.assert_array_equal(lines_present(left, lines, window), [1.0, 0.0])
    np.testing.assert_array_equal(lines_present(left[1:], lines, window), [0.0, 0.0])
    np.testing.assert_array_equal(lines_present(left + [6.0, 0.0], lines, window), [0.0, 0.0])
    np.testing.assert_array_equal(lines_present(-left * [1.0, -1.0], lines, window), [0.0, 1.0])


def test_without_changes_the_sample_stays():
    rasters, points = augment({})
    np.testing.assert_array_equal(rasters[3, 0], LABELS.raster(3))
    np.testing.assert_allclose(points, LABELS.points_cm, atol=1e-4)


def test_mirror_flips_raster_and_labels():
    rasters, points = augment({"mirror": 1.0})
    np.testing.assert_allclose(points, mirror_points(LABELS.points_cm), atol=1e-4)
    # A point on the border of two cells may fall into either.
    different = rasters[:, 0] != np.stack([LABELS.raster(i)[:, ::-1] for i in range(12)])
    assert different.sum() <= 0.01 * np.count_nonzero(rasters)


@given(shift=st.floats(-6, 6), turn=st.floats(-0.2, 0.2), mirror=st.booleans())
@settings(max_examples=50, deadline=None)
def test_a_view_is_what_a_moved_car_sees(shift, turn, mirror):
    # In the map: a car at the origin that heads along +x, with no wheelbase, so that pose = front axle.
    points = np.array([[3.0, 40.0], [-20.0, 15.0], [0.0, 0.0]])
    seen = points * [-1.0, 1.0] if mirror else points
    in_map = map_from_car(seen, np.zeros(3), 0.0)
    moved_pose = np.array([0.0, -shift, turn])
    np.testing.assert_allclose(
        make_view(mirror, shift, turn).move(points), car_from_map(in_map, moved_pose, 0.0), atol=1e-9
    )


@given(shift=st.floats(-6, 6), turn=st.floats(-0.2, 0.2), mirror=st.booleans())
@settings(max_examples=50, deadline=None)
def test_labels_of_straight_lines_are_exact(shift, turn, mirror):
    y = np.linspace(-80.0, 200.0, 30)
    lines = (np.stack([-20.0 + 0.0 * y, y], 1), np.stack([20.0 + 0.0 * y, y], 1))
    points = labels_of_view(np.repeat([-20.0, 20.0], 3), lines, make_view(mirror, shift, turn))
    # x = +-20 becomes a line at distance +-20 - shift, seen under the angle `turn`.
    rows = np.array([0.0, 15.0, 30.0])
    expected = [(side - shift) / np.cos(turn) + rows * np.tan(turn) for side in (-20.0, 20.0)]
    np.testing.assert_allclose(points, np.concatenate(expected), atol=1e-9)


def test_masked_points_and_ended_lines_stay_unknown():
    y = np.arange(-50.0, 22.0, 2.0)
    lines = (np.stack([-20.0 + 0.0 * y, y], 1), np.stack([20.0 + 0.0 * y, y], 1))
    points = np.array([-20.0, -20.0, np.nan, np.nan, 20.0, np.nan])
    plain = labels_of_view(points, lines, make_view(False, 1.0, 0.0))
    np.testing.assert_allclose(plain, [-21.0, -21.0, np.nan, np.nan, 19.0, np.nan])
    mirrored = labels_of_view(points, lines, make_view(True, 0.0, 0.0))
    np.testing.assert_allclose(mirrored, mirror_points(points))


def test_dropping_keeps_a_share_of_the_points():
    fine = BirdseyeWindow()
    full = np.count_nonzero(augment({}, fine)[0])
    rasters, points = augment({"drop_points": 0.5}, fine)
    left = np.count_nonzero(rasters) / full
    assert 0.6 < left < 0.95  # a mean share of a quarter is dropped
    np.testing.assert_allclose(points, LABELS.points_cm, atol=1e-4)


def test_missing_line_takes_one_line_and_leaves_the_other():
    rasters, points = augment({"missing_line": 1.0})
    for i in range(12):
        kept = WINDOW.points(np.argwhere(rasters[i, 0]).astype(float))
        middle = LABELS.points_cm[i].reshape(2, 3)[:, 1].mean()
        near = kept[kept[:, 1] < 24.0]
        left = int((near[:, 0] < middle).sum())
        assert 0 in (left, len(near) - left) and len(near) > 0
    assert np.isfinite(points).all()  # the map still knows the line


def test_missing_stretch_takes_a_part():
    full = augment({}, BirdseyeWindow())[0]
    part = augment({"missing_stretch": 1.0}, BirdseyeWindow())[0]
    assert not np.any(part > full)
    gone = 1.0 - np.count_nonzero(part, axis=(1, 2, 3)) / np.count_nonzero(full, axis=(1, 2, 3))
    assert (gone > 0.0).all() and (gone < 0.9).all()


def test_clutter_only_adds():
    clean = augment({})[0]
    cluttered = augment({"clutter_segments": 5, "clutter_points": 30})[0]
    assert not np.any(cluttered < clean)
    assert np.count_nonzero(cluttered) > np.count_nonzero(clean)


def test_an_empty_frame_can_be_augmented():
    edges, lines = np.empty((0, 2), np.float32), (np.empty((0, 2)), np.full((3, 2), np.nan))
    rasters, points, present = augment_batch(
        [edges],
        [lines],
        np.full((1, 6), np.nan),
        [np.random.default_rng(0)],
        WINDOW,
        NOTHING.model_copy(update={"missing_stretch": 1.0, "missing_line": 1.0, "jitter_cm": 1.0}),
    )
    assert not rasters.any() and np.isnan(points).all() and np.isnan(present).all()


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_near_line_agrees_with_the_distance(turn):
    rng = np.random.default_rng(1)
    window = BirdseyeWindow()
    y = np.linspace(-30.0, 120.0, 8)
    line = make_view(False, 0.0, turn).move(np.stack([5.0 + 0.0 * y, y], 1))
    line = np.concatenate([line, [[np.nan, np.nan]]])
    points = np.stack([rng.uniform(-40, 40, 3000), rng.uniform(2, 70, 3000)], 1)
    distance = np.abs(make_view(False, 0.0, -turn).move(points)[:, 0] - 5.0)
    near = _near_line(points, line, window)
    assert near[distance < 3.0].all()
    assert not near[distance > 5.5].any()
