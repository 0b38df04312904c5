from dataclasses import replace

import numpy as np
import pytest
from synthetic_labels import make_label_set

from lanenet.data import label_set
from lanenet.data.label_set import read_label_group, read_label_index, read_labels, write_labels
from lanenet.errors import LabelFormatError
from lanenet.reading import MEBIBYTE
from lanenet.samples.dataset import Cut, LaneSamples
from lanenet.samples.settings import AugmentSettings
from lanenet.samples.shards import StreamedSamples, read_shards

SIZES = (21, 9, 12)
ROWS = 4


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Three label sets of small row groups; some frames have no label or a low quality."""
    folder = tmp_path_factory.mktemp("shards")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(label_set, "GROUP_ROWS", ROWS)
        for k, n in enumerate(SIZES):
            labels = make_label_set(n, k)
            points = labels.points_cm.copy()
            points[5] = np.nan
            quality = np.where(np.arange(n) == 2, 0.2, 0.9)
            write_labels(folder / f"{k}.parquet", replace(labels, points_cm=points, quality=quality))
    return [folder / f"{k}.parquet" for k in range(len(SIZES))]


def in_memory(files):
    return LaneSamples([read_labels(path) for path in files], [str(path) for path in files], 0.5)


def streamed(files, groups=3):
    """Samples in windows of so many row groups."""
    shards = read_shards(files)
    largest = max(size for index in shards.indices for size in index.group_bytes)
    return StreamedSamples(shards, 4 * groups * largest, 0.5)


def test_a_label_set_is_written_in_row_groups(files):
    index, labels = read_label_index(files[0]), read_labels(files[0])
    assert index.group_rows == (4, 4, 4, 4, 4, 1) and index.meta == labels.meta
    group = read_label_group(files[0], 2)
    np.testing.assert_array_equal(group.points_cm, labels.points_cm[8:12])
    np.testing.assert_array_equal(group.edges[3], labels.edges[11])
    assert len({read_label_index(path).hash for path in files}) == 3


def test_a_stream_describes_its_samples_as_memory_does(files):
    stream, memory = streamed(files), in_memory(files)
    assert len(stream) == len(memory) == sum(SIZES) - 2 * len(SIZES)
    np.testing.assert_array_equal(stream.set_start, memory.set_start)
    np.testing.assert_array_equal(stream.points_cm, memory.points_cm)
    for name in ("window", "perception", "reference", "camera_hashes", "lane_width_cm", "lane_widths_cm"):
        assert getattr(stream, name) == getattr(memory, name)
    for mirrored in (False, True):
        for a, b in zip(stream.normalisation(mirrored), memory.normalisation(mirrored), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_a_stream_gives_the_same_batches_in_order(files):
    stream, memory = streamed(files), in_memory(files)
    changed = AugmentSettings.only(missing_line=0.5, jitter_cm=0.2)
    for a, b in (
        (stream.plain_batches(7), memory.plain_batches(7)),
        (stream.changed_batches(changed, 3, 7), memory.changed_batches(changed, 3, 7)),
        ([stream.plain_batch(np.array([30, 2, 17]))], [memory.plain_batch(np.array([30, 2, 17]))]),
    ):
        for one, other in zip(a, b, strict=True):
            for part, expected in zip(one, other, strict=True):
                np.testing.assert_array_equal(part, expected)


def numbered(stream, balance="none", **options):
    """The frames of an epoch, by the labels that only one frame has."""
    known = {tuple(row): k for k, row in enumerate(stream.points_cm.astype(np.float32).tolist())}
    batches = list(stream.epoch(AugmentSettings.only(), 1, 2, 8, balance=balance, **options))
    return [[known[tuple(row)] for row in batch.points_cm.tolist()] for batch in batches], batches


def test_an_epoch_of_a_stream_shows_each_frame_once_in_an_order_of_its_own(files):
    stream = streamed(files)
    shown, _ = numbered(stream)
    assert [len(batch) for batch in shown] == [8, 8, 8, 8, 4] and stream.steps_per_epoch(8) == 5
    flat = [k for batch in shown for k in batch]
    assert sorted(flat) == list(range(36)) != flat
    other = np.concatenate([b.points_cm for b in stream.epoch(AugmentSettings.only(), 1, 3, 8)])
    assert not np.array_equal(other[:, 0], stream.points_cm[flat, 0].astype(np.float32))
    # Neighbours in a row group are spread over a window, and the draws are those of memory.
    assert np.mean(np.abs(np.diff(flat)) == 1) < 0.3
    settings = AugmentSettings()
    for batch, frames in zip(stream.epoch(settings, 1, 2, 8), shown, strict=True):
        same = in_memory(files).augmented_batch(np.array(frames), settings, 1, 2)
        np.testing.assert_array_equal(batch.rasters, same.rasters)


def test_an_epoch_goes_on_at_any_step_and_reads_no_window_before_it(files, monkeypatch):
    stream = streamed(files)
    _, whole = numbered(stream)
    read = []
    monkeypatch.setattr(stream, "_read", lambda *a, of=stream._read: (read.append(a[0]), of(*a))[1])
    for first in (1, 3, 4):
        read.clear()
        rest = list(stream.epoch(AugmentSettings.only(), 1, 2, 8, first_step=first))
        assert len(rest) == len(whole) - first
        for batch, expected in zip(rest, whole[first:], strict=True):
            np.testing.assert_array_equal(batch.rasters, expected.rasters)
    assert len(read) <= 3


# With five, one of them has none of the last batch of four.
@pytest.mark.parametrize("parts", [2, 3, 5])
@pytest.mark.parametrize("source", [streamed, in_memory])
def test_the_parts_of_a_batch_are_the_batch(files, source, parts):
    samples = source(files)
    whole = list(samples.epoch(AugmentSettings(), 1, 2, 8, balance="drive"))
    drawn = [
        list(samples.epoch(AugmentSettings(), 1, 2, 8, balance="drive", cut=Cut(parts, k)))
        for k in range(parts)
    ]
    assert all(len(part) == len(whole) for part in drawn)
    for batch, *pieces in zip(whole, *drawn, strict=True):
        np.testing.assert_array_equal(batch.rasters, np.concatenate([piece.rasters for piece in pieces]))


def test_balance_shows_every_drive_of_a_stream_equally_often(files):
    stream = streamed(files)
    shown, _ = numbered(stream, "drive")
    flat = np.array([k for batch in shown for k in batch])
    sets = np.searchsorted(stream.set_start, flat, side="right") - 1
    np.testing.assert_array_equal(np.bincount(sets), [12, 12, 12])
    for number in range(3):
        times = np.bincount(flat[sets == number], minlength=36)
        assert times.max() - times[stream.set_start[number] : stream.set_start[number + 1]].min() <= 1
    changed = np.concatenate([b.rasters for b in stream.epoch(AugmentSettings(), 1, 2, 8, balance="drive")])
    assert len(np.unique(changed.reshape(36, -1), axis=0)) == 36


@pytest.mark.parametrize("source", [streamed, in_memory])
@pytest.mark.parametrize(("balance", "shown"), [("none", [57, 7, 10]), ("drive", [45, 15, 14])])
def test_a_set_that_counts_as_several_drives_is_shown_as_often(files, source, balance, shown):
    # As data.drives.counts_as lists it; the second and the third may be synthetic.
    samples = source([files[0], files[0], files[0], *files[1:]])
    points = [part.points_cm for part in (read_labels(path) for path in files)]
    known = {tuple(row): k for k, rows in enumerate(points) for row in rows.astype(np.float32).tolist()}
    batches = list(samples.epoch(AugmentSettings.only(), 1, 2, 2, balance=balance))
    sets = [known[tuple(row)] for batch in batches for row in batch.points_cm.tolist()]
    assert np.bincount(sets).tolist() == shown
    # Each time by a draw of its own.
    changed = np.concatenate([b.rasters for b in samples.epoch(AugmentSettings(), 1, 2, 2, balance=balance)])
    assert len(np.unique(changed.reshape(len(sets), -1), axis=0)) == len(sets)


@pytest.mark.parametrize("balance", ["none", "drive"])
def test_weights_show_a_stream_as_often_as_sets_in_memory(files, balance):
    weights = (0.3, 2.0, 1.0)
    shards, labels = read_shards(files), [read_labels(path) for path in files]
    stream = StreamedSamples(shards, 2**40, 0.5, weights)
    whole = LaneSamples(labels, [str(path) for path in files], 0.5, weights)
    assert stream.shown(balance) == whole.shown(balance)
    batches, _ = numbered(stream, balance)
    flat = np.array([k for batch in batches for k in batch])
    counts = np.bincount(np.searchsorted(stream.set_start, flat, side="right") - 1, minlength=3)
    assert [(k, n) for k, n in enumerate(counts.tolist()) if n] == whole.shown(balance)
    assert counts.sum() == len(stream) and counts.tolist() != np.diff(stream.set_start).tolist()


def test_no_more_is_in_memory_than_a_window_and_the_next(files):
    stream = streamed(files, groups=3)
    windows = stream.windows(1, 2)
    assert [window.start for window in windows[1:]] == [window.end for window in windows[:-1]]
    assert all(1 <= len(window.visits) <= 3 or window.visits[:, 2].sum() <= 12 for window in windows)
    assert len(windows) >= 4 and windows[-1].end == 36


def test_a_row_group_that_is_too_large_is_named(files):
    with pytest.raises(LabelFormatError, match=r"0\.parquet: row group 0 has .* raise learn\.memory_mb"):
        StreamedSamples(read_shards(files), MEBIBYTE // 64)
    with pytest.raises(LabelFormatError, match="no frame has a label"):
        StreamedSamples(read_shards(files), 2**40, min_quality=1.0)


def test_an_epoch_of_a_stream_can_be_left_early(files):
    batches = streamed(files).epoch(AugmentSettings(), 0, 0, 8)
    next(batches)
    batches.close()
