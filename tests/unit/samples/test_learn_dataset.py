from dataclasses import replace

import numpy as np
import pytest
from synthetic_labels import WINDOW, make_label_set

from lanenet.errors import LabelFormatError
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.samples.dataset import LaneSamples, hash_files
from lanenet.samples.settings import AugmentSettings


def other_edges():
    labels = make_label_set(2, 0)
    perception = PerceptionSettings.model_validate({"edges": {"method": "canny"}})
    return replace(labels, meta=replace(labels.meta, perception=perception))


def samples(n=50, seed=0):
    return LaneSamples([make_label_set(n, seed)], ["a.parquet"])


def test_frames_of_two_sets_stay_in_order():
    a, b = make_label_set(3, 0, source="truth"), make_label_set(4, 1, camera_hash="cam1", source="map")
    both = LaneSamples([a, b], ["a", "b"])
    assert len(both) == 7
    assert both.camera_hashes == ["cam0", "cam1"]
    assert both.reference == "map and truth"
    rasters, points, present, _ = both.plain_batch(np.array([5, 0]))
    np.testing.assert_array_equal(rasters[0], b.raster(2))
    np.testing.assert_allclose(points[1], a.points_cm[0], atol=1e-4)
    np.testing.assert_array_equal(present, np.ones((2, 2)))
    assert both.lane_widths_cm == (40.0, 40.0)


@pytest.mark.parametrize(
    ("other", "what"),
    [
        (make_label_set(2, 0, window=replace(WINDOW, cell_cm=2.0)), "window"),
        (other_edges(), r"its edges were found .*\(edges\.method canny, not directional\)"),
    ],
)
def test_sets_that_disagree_are_both_named(other, what):
    with pytest.raises(LabelFormatError, match=what) as caught:
        LaneSamples([make_label_set(2, 0), other], ["one.parquet", "two.parquet"])
    assert "one.parquet" in str(caught.value) and "two.parquet" in str(caught.value)


def test_frames_without_labels_or_quality_are_left_out():
    labels = make_label_set(4, 0)
    points = labels.points_cm.copy()
    points[1] = np.nan
    labels = replace(labels, points_cm=points, quality=np.array([1.0, 1.0, 0.2, 0.9]))
    kept = LaneSamples([labels], ["a"], min_quality=0.5)
    np.testing.assert_array_equal(kept.points_cm, labels.points_cm[[0, 3]])
    with pytest.raises(LabelFormatError, match="no frame has a label"):
        LaneSamples([replace(labels, points_cm=points * np.nan)], ["a"])
    with pytest.raises(LabelFormatError, match="no label set"):
        LaneSamples([], [])


def test_a_sample_depends_on_seed_epoch_and_index_alone():
    data, settings = samples(), AugmentSettings()
    together = data.augmented_batch(np.array([4, 9, 2]), settings, 1, 2)
    alone = data.augmented_batch(np.array([9]), settings, 1, 2)
    np.testing.assert_array_equal(together[0][1], alone[0][0])
    np.testing.assert_array_equal(together[1][1], alone[1][0])
    for seed, epoch in ((1, 3), (0, 2)):
        other = data.augmented_batch(np.array([9]), settings, seed, epoch)
        assert not np.array_equal(alone[1], other[1])


def test_workers_do_not_change_an_epoch():
    data, settings = samples(), AugmentSettings()
    runs = [list(data.epoch(settings, 0, 0, 8, workers)) for workers in (1, 3)]
    for run in runs[1:]:
        assert len(run) == len(runs[0]) == data.steps_per_epoch(8) == 7
        for batch, batch0 in zip(run, runs[0], strict=True):
            for part, part0 in zip(batch, batch0, strict=True):
                np.testing.assert_array_equal(part, part0)


def test_an_epoch_shows_each_sample_once_in_an_order_of_its_own():
    data = samples(49)
    plain = AugmentSettings(mirror=0.0, shift_cm=0.0, rotate_rad=0.0)
    first, second = (
        np.concatenate([batch.points_cm for batch in data.epoch(plain, 0, epoch, 8)]) for epoch in (0, 1)
    )
    # 49 = 6 x 8 + 1: the single last sample is left out.
    assert len(first) == 48 and data.steps_per_epoch(8) == 6
    assert len(np.unique(first[:, 0])) == 48
    assert not np.array_equal(first, second)


def test_cars_and_their_rows_may_differ():
    a, b = make_label_set(3, 0, wheelbase_cm=20.0), make_label_set(1, 1, wheelbase_cm=28.0, camera_hash="c")
    rows = PerceptionSettings.model_validate({"range": {"bottom_rows": 12}})
    b = replace(b, meta=replace(b.meta, perception=rows, lane_width_cm=60.0, camera_cm=(1.0, 2.0, 15.0)))
    both = LaneSamples([a, b], ["a", "b"])
    assert both.wheelbase_cm == pytest.approx(22.0) and both.lane_width_cm == pytest.approx(45.0)
    assert both.lane_widths_cm == (40.0, 60.0)
    np.testing.assert_array_equal(both.plain_batch(np.array([0, 3])).lane_cm, (40.0, 60.0))
    # Only where all leave out the same rows the network may, too.
    assert both.perception.range.bottom_rows == 0
    assert LaneSamples([b, b], ["b", "b"]).perception.range.bottom_rows == 12
    np.testing.assert_array_equal(both.frames.camera_cm[[0, 3]], [(0.0, 0.0, 18.0), (1.0, 2.0, 15.0)])


def test_many_cameras_are_any_camera():
    sets = [make_label_set(1, k, camera_hash=f"cam{k}") for k in range(9)]
    few, many = LaneSamples(sets[:8], ["x"] * 8), LaneSamples(sets, ["x"] * 9)
    assert few.camera_hashes == [f"cam{k}" for k in range(8)]
    assert many.camera_hashes == ["any"]


def test_balance_shows_every_drive_equally_often():
    data = LaneSamples([make_label_set(n, n) for n in (90, 7, 3)], ["a", "b", "c"])
    order, streams = data.order(0, 4, "drive")
    assert len(order) == 100 and data.steps_per_epoch(10) == 10
    sets = np.searchsorted(data.set_start, order, side="right") - 1
    np.testing.assert_array_equal(np.bincount(sets), [34, 33, 33])
    # Within a set no frame is shown twice more than another, and no two showings are the same draw.
    for number, (a, b) in enumerate(((0, 90), (90, 97), (97, 100))):
        shown = np.bincount(order[sets == number] - a, minlength=b - a)
        assert shown.max() - shown.min() <= 1
    assert len(np.unique(streams)) == 100
    batches = list(data.epoch(AugmentSettings(), 0, 4, 10, balance="drive"))
    rasters = np.concatenate([batch[0] for batch in batches])
    assert len(np.unique(rasters.reshape(100, -1), axis=0)) == 100
    plain, numbers = data.order(0, 4)
    np.testing.assert_array_equal(np.sort(plain), np.arange(100))
    np.testing.assert_array_equal(plain, numbers)


@pytest.mark.parametrize(
    ("balance", "weights", "shown"),
    [
        ("none", (1.0, 1.0, 1.0), [90, 7, 3]),
        ("none", (2.5, 2.5, 2.5), [90, 7, 3]),
        # 27, 7 and 3 of 37.
        ("none", (0.3, 1.0, 1.0), [73, 19, 8]),
        ("drive", (0.5, 1.0, 0.5), [25, 50, 25]),
        ("drive", (1e-3, 1.0, 1.0), [0, 50, 50]),
    ],
)
def test_sets_are_shown_as_often_as_their_weights_say(balance, weights, shown):
    sets = [make_label_set(n, n) for n in (90, 7, 3)]
    data = LaneSamples(sets, ["a", "b", "c"], weights=weights)
    order, streams = data.order(0, 4, balance)
    found = np.bincount(np.searchsorted(data.set_start, order, side="right") - 1, minlength=3)
    np.testing.assert_array_equal(found, shown)
    assert len(order) == 100 and len(np.unique(streams)) == 100


def test_an_epoch_can_be_left_early():
    batches = samples().epoch(AugmentSettings(), 0, 0, 8)
    next(batches)
    batches.close()


def test_normalisation_counts_known_points_and_mirrors():
    labels = make_label_set(3, 0)
    points = np.array([[-10.0, np.nan, -20.0, 10.0, 30.0, 20.0], [-30.0, np.nan, -20.0, 10.0, 30.0, 20.0]])
    data = LaneSamples([replace(make_label_set(2, 0), points_cm=points)], ["a"])
    mean, scale = data.normalisation(mirrored=False)
    np.testing.assert_allclose(mean, [-20.0, 0.0, -20.0, 10.0, 30.0, 20.0])
    np.testing.assert_allclose(scale, [10.0, 2.0, 2.0, 2.0, 2.0, 2.0])
    mean, _ = LaneSamples([labels], ["a"]).normalisation(mirrored=True)
    np.testing.assert_allclose(mean[:3], -mean[3:])


def test_file_hash_is_of_contents(tmp_path):
    for name, text in (("a", "1"), ("b", "1"), ("c", "2")):
        (tmp_path / name).write_text(text)
    a, b, c = (tmp_path / name for name in "abc")
    assert hash_files([a, c]) == hash_files([b, c]) != hash_files([c, a])
    with pytest.raises(LabelFormatError, match="missing"):
        hash_files([tmp_path / "missing"])
