"""Label sets that are streamed: row groups are read as an epoch needs them, in a bounded part of the memory.

The row groups of all files are the shards. First the footers are read, then the labels (a hundredth of the
data), for the number of usable frames in each group and for the normalisation. An epoch visits the groups in
an order of its own and takes as many at a time as a *window* of memory holds. Frames are shuffled over a
window; the next one is read by one thread meanwhile. What the k-th window holds follows from the seed and the
epoch alone, so that a run that was stopped reads on where it was.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.data.label_set import LabelIndex, read_label_group, read_label_index, read_label_points
from lanenet.errors import LabelFormatError
from lanenet.geometry.lane import N_POINTS, mirror_points
from lanenet.reading import MEBIBYTE
from lanenet.samples.augment import Batch, augment_batch, concat_batches, concat_frames, plain_batch
from lanenet.samples.dataset import (
    LEAST_SCALE_CM,
    WHOLE,
    Cut,
    Samples,
    ahead,
    clip_labels,
    frames_of,
    usable,
)
from lanenet.samples.kernels import Frames
from lanenet.samples.settings import AugmentSettings, Balance

#: Parts of the memory that a stream needs at a time, each as large as a window: the one in use, the last one
#: while batches of it wait, and the next one twice while its row groups are joined.
_WINDOWS = 4


@dataclass(frozen=True)
class Shards:
    """The row groups of several label sets.

    Attributes:
        paths: Files, one per set; a set that counts as several is listed as often.
        indices: What each file says about itself.
    """

    paths: tuple[Path, ...]
    indices: tuple[LabelIndex, ...]

    @property
    def unpacked_bytes(self) -> int:
        """What all of them unpack to, as they are encoded: 37 bytes an edge point on 400 label sets.

        As much as reading them into memory takes; samples themselves have 13 bytes an edge point.
        """
        return sum(sum(index.group_bytes) for index in self.indices)


def read_shards(paths: Sequence[Path]) -> Shards:
    """Read the footers of label sets.

    Raises:
        LabelFormatError: If a file is missing or has another format.
    """
    found = {path: read_label_index(path) for path in dict.fromkeys(paths)}
    return Shards(tuple(paths), tuple(found[path] for path in paths))


@dataclass(frozen=True)
class Window:
    """Samples of an epoch that are in memory together.

    Attributes:
        start: Number of its first sample in the epoch.
        end: Number after its last.
        visits: Row groups that it visits: group, how often the epoch visited it before, and samples of it.
        seed: Of the order of its samples.
    """

    start: int
    end: int
    visits: Int[np.ndarray, "v 3"]
    seed: tuple[int, ...]


class _Loaded(NamedTuple):
    """A window in memory: the numbers of its samples in the epoch, their frames, rows there, and streams."""

    numbers: np.ndarray
    frames: Frames
    rows: np.ndarray
    streams: np.ndarray


class _Piece(NamedTuple):
    """What one window gives to a batch."""

    frames: Frames
    rows: np.ndarray
    streams: np.ndarray


class StreamedSamples(Samples):
    """The frames of label sets that do not fit into memory together."""

    def __init__(
        self, shards: Shards, memory_bytes: int, min_quality: float = 0.0, weights: Sequence[float] = ()
    ) -> None:
        """Read which frames can be used.

        Args:
            shards: The label sets.
            memory_bytes: What samples may take in memory.
            min_quality: Frames of a lower quality are left out, and so are frames without any label.
            weights: How often each set is shown, see :meth:`shown`; none weighs all alike.

        Raises:
            LabelFormatError: As :class:`LaneSamples`, and if a row group alone is larger than a window.
        """
        self._shards, self._min_quality = shards, min_quality
        self._window_bytes = memory_bytes // _WINDOWS
        counts = [len(index.group_rows) for index in shards.indices]
        self._group_set: Int[np.ndarray, "g"] = np.repeat(np.arange(len(counts)), counts)
        self._group_number = np.concatenate([np.empty(0, np.int64), *(np.arange(n) for n in counts)])
        self._group_bytes = np.array([b for index in shards.indices for b in index.group_bytes], np.int64)
        self._check_groups()
        self._sums = np.zeros((2, 3, N_POINTS))
        seen: dict[tuple[Path, int], tuple[int, np.ndarray]] = {}
        kept = np.zeros(len(self._group_set), np.int64)
        for group in range(len(kept)):
            key = self._place(group)
            if key not in seen:
                seen[key] = self._count(*key)
            kept[group], sums = seen[key]
            self._sums += sums
        self._kept = kept
        self._group_start: Int[np.ndarray, "_"] = np.concatenate([[0], np.cumsum(kept)])
        sizes = np.bincount(self._group_set, weights=kept, minlength=len(counts)).astype(np.int64)
        names = [str(path) for path in shards.paths]
        super().__init__(
            [index.meta for index in shards.indices], names, sizes.tolist(), min_quality, weights
        )

    def _place(self, group: int) -> tuple[Path, int]:
        """File of a row group, and its number there."""
        return self._shards.paths[self._group_set[group]], int(self._group_number[group])

    def _check_groups(self) -> None:
        large = np.flatnonzero(self._group_bytes > self._window_bytes)
        if large.size:
            path, number = self._place(int(large[0]))
            size, most = (v / MEBIBYTE for v in (self._group_bytes[large[0]], self._window_bytes))
            raise LabelFormatError(
                f"{path}: row group {number} has {size:.0f} MB, expected at most {most:.0f} MB in a "
                "stream; raise learn.memory_mb, or label the drive again, which makes smaller groups"
            )

    def _count(self, path: Path, number: int) -> tuple[int, Float[np.ndarray, "2 3 6"]]:
        """Usable frames of a group; and number, sum and sum of squares of its labels, as is and mirrored."""
        points_cm, quality = read_label_points(path, number)
        points_cm = points_cm[usable(points_cm, quality, self._min_quality)]
        sums = []
        for points in (points_cm, mirror_points(points_cm)):
            known, clipped = clip_labels(points)
            sums.append([known.sum(axis=0), clipped.sum(axis=0), (clipped**2).sum(axis=0)])
        return len(points_cm), np.array(sums, np.float64)

    def _read(self, group: int, rows: Int[np.ndarray, "_"] | None = None) -> Frames:
        """Read usable rows of a group; None for all."""
        labels = read_label_group(*self._place(group))
        kept = usable(labels.points_cm, labels.quality, self._min_quality)
        return frames_of(labels.subset(kept if rows is None else kept[rows]))

    @property
    def points_cm(self) -> Float[np.ndarray, "n 6"]:
        """Labels of each frame, NaN where masked; 48 bytes a frame, read anew each time."""
        parts = [np.empty((0, N_POINTS))]
        for group in range(len(self._kept)):
            points_cm, quality = read_label_points(*self._place(group))
            parts.append(points_cm[usable(points_cm, quality, self._min_quality)])
        return np.concatenate(parts)

    def plain_batch(self, indices: Int[np.ndarray, "b"]) -> Batch:
        """Return a few frames as they are; each row group is read once."""
        groups = np.searchsorted(self._group_start, indices, side="right") - 1
        parts, places = [], []
        for group in np.unique(groups):
            at = np.flatnonzero(groups == group)
            frames = self._read(int(group), np.asarray(indices)[at] - self._group_start[group])
            parts.append(plain_batch(frames, np.arange(len(at)), self.window))
            places.append(at)
        whole, back = concat_batches(parts), np.argsort(np.concatenate(places))
        return Batch(*(values[back] for values in whole))

    def plain_batches(self, size: int) -> Iterator[Batch]:
        """Yield all frames as they are, in their order."""
        return self._in_order(size, lambda frames, rows, _: plain_batch(frames, rows, self.window))

    def changed_batches(self, settings: AugmentSettings, seed: int, size: int) -> Iterator[Batch]:
        """Yield all frames in their order, each changed by its draw of the first epoch."""
        return self._in_order(
            size,
            lambda frames, rows, start: augment_batch(
                frames, rows, self.window, settings, seed, 0, streams=start + rows
            ),
        )

    def _in_order(
        self, size: int, draw: Callable[[Frames, Int[np.ndarray, "_"], int], Batch]
    ) -> Iterator[Batch]:
        """Yield what a function of a group's frames, rows and first number draws, in batches of one size."""
        parts: list[Batch] = []
        missing = size
        for group in np.flatnonzero(self._kept):
            frames, row = self._read(int(group)), 0
            while row < len(frames.points_cm):
                rows = np.arange(row, min(row + missing, len(frames.points_cm)))
                parts.append(draw(frames, rows, int(self._group_start[group])))
                row, missing = row + len(rows), missing - len(rows)
                if not missing:
                    yield concat_batches(parts)
                    parts, missing = [], size
        if parts:
            yield concat_batches(parts)

    def windows(self, seed: int, epoch: int, balance: Balance = "none") -> list[Window]:
        """Return the windows of an epoch, in their order.

        Args:
            seed: Of the run.
            epoch: Counted from 0.
            balance: See :meth:`shown`. A row group that is shown twice is visited twice; where a set is shown
                less often than it has frames, some of its groups are left out, others each epoch.
        """
        rng = np.random.default_rng((seed, epoch, len(self)))
        visits = self._visits(rng, balance)
        visits = visits[rng.permutation(len(visits))]
        # All of a group is read, however few of its rows are shown.
        size = np.cumsum(self._group_bytes[visits[:, 0]])
        cuts, last = [0], 0
        for k in range(len(visits)):
            if size[k] - last > self._window_bytes:
                cuts.append(k)
                last = int(size[k - 1])
        starts = np.concatenate([[0], np.cumsum(visits[:, 2])])
        return [
            Window(int(starts[a]), int(starts[b]), visits[a:b], (seed, epoch, len(self), number))
            for number, (a, b) in enumerate(pairwise([*cuts, len(visits)]))
        ]

    def _visits(self, rng: np.random.Generator, balance: Balance) -> Int[np.ndarray, "v 3"]:
        """Return which groups an epoch visits: group, how often it was visited before, and samples of it."""
        if self.each_once(balance):
            groups = np.flatnonzero(self._kept)
            return np.stack([groups, np.zeros_like(groups), self._kept[groups]], axis=1)
        visits = []
        for number, wanted in self.shown(balance):
            own = np.flatnonzero((self._group_set == number) & (self._kept > 0))
            rounds = 0
            while wanted:
                some = rng.permutation(own)
                before = np.cumsum(self._kept[some]) - self._kept[some]
                some = some[before < wanted]
                counts = np.minimum(self._kept[some], wanted - before[: len(some)])
                visits.append(np.stack([some, np.full_like(some, rounds), counts], axis=1))
                wanted, rounds = wanted - int(counts.sum()), rounds + 1
        return np.concatenate(visits)

    def epoch(
        self,
        settings: AugmentSettings,
        seed: int,
        epoch: int,
        batch_size: int,
        workers: int = 1,
        balance: Balance = "none",
        first_step: int = 0,
        cut: Cut = WHOLE,
    ) -> Iterator[Batch]:
        """Yield the batches of one epoch, see :meth:`Samples.epoch`."""

        def draw(pieces: Sequence[_Piece]) -> Batch:
            return concat_batches(
                [
                    augment_batch(piece.frames, piece.rows, self.window, settings, seed, epoch, piece.streams)
                    for piece in pieces
                ]
            )

        steps = range(first_step, self.steps_per_epoch(batch_size))
        with closing(self._pieces(self.windows(seed, epoch, balance), steps, batch_size, cut)) as pieces:
            yield from ahead((functools.partial(draw, batch) for batch in pieces), workers)

    def _pieces(
        self, windows: Sequence[Window], steps: range, batch_size: int, cut: Cut
    ) -> Generator[list[_Piece]]:
        """Yield for each batch the pieces of its own parts: one of each window that it lies in."""
        first, end = steps.start * batch_size, min(steps.stop * batch_size, len(self))
        windows = [window for window in windows if window.start < end and window.end > first]

        def own(numbers: Int[np.ndarray, "_"]) -> Bool[np.ndarray, "_"]:
            """Tell which samples of the epoch are in the process's own parts of these batches."""
            mine = np.zeros(len(numbers), np.bool_)
            for step in range(
                max(steps.start, numbers[0] // batch_size), min(steps.stop, numbers[-1] // batch_size + 1)
            ):
                bounds = cut.bounds(self.batch_length(step, batch_size))
                low, high = np.searchsorted(numbers - step * batch_size, (bounds[0], bounds[-1]))
                mine[low:high] = True
            return mine

        pieces: list[_Piece] = []
        with ThreadPoolExecutor(1) as reader:
            loading = [reader.submit(self._load, window, own) for window in windows[:1]]
            for k, window in enumerate(windows):
                loaded = loading.pop().result()
                loading = [reader.submit(self._load, later, own) for later in windows[k + 1 : k + 2]]
                for step in range(
                    max(first, window.start) // batch_size, -(-min(end, window.end) // batch_size)
                ):
                    bounds = (step * batch_size, (step + 1) * batch_size)
                    a, b = np.searchsorted(loaded.numbers, bounds)
                    ends = min(bounds[1], end) <= window.end
                    # An empty part of a batch is a piece, too.
                    if b > a or (ends and not pieces):
                        pieces.append(_Piece(loaded.frames, loaded.rows[a:b], loaded.streams[a:b]))
                    if ends:
                        yield pieces
                        pieces = []

    def _load(self, window: Window, own: Callable[[Int[np.ndarray, "_"]], Bool[np.ndarray, "_"]]) -> _Loaded:
        """Read the samples of a window of which a function of their numbers in the epoch says so."""
        rng = np.random.default_rng(window.seed)
        group, rounds = (np.repeat(window.visits[:, k], window.visits[:, 2]) for k in (0, 1))
        row = np.concatenate([rng.permutation(self._kept[g])[:count] for g, _, count in window.visits])
        mixed = rng.permutation(len(row))
        numbers = np.arange(window.start, window.end)
        mine = own(numbers)
        mixed = mixed[mine]
        frame = self._group_start[group[mixed]] + row[mixed]
        # A frame that is shown twice is read once.
        known, rows = np.unique(frame, return_inverse=True)
        cuts = np.searchsorted(known, self._group_start)
        # A small window may lie between the process's own samples, and then has none: no row of a group.
        groups = np.flatnonzero(np.diff(cuts)) if len(known) else window.visits[:1, 0]
        parts = [self._read(int(g), known[cuts[g] : cuts[g + 1]] - self._group_start[g]) for g in groups]
        return _Loaded(numbers[mine], concat_frames(parts), rows, frame + len(self) * rounds[mixed])

    def normalisation(self, mirrored: bool) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"]]:
        """Return mean and standard deviation of each label, see :meth:`Samples.normalisation`."""
        known, total, squares = self._sums.sum(axis=0) if mirrored else self._sums[0]
        count = np.maximum(known, 1.0)
        mean = total / count
        variance = np.maximum(squares / count - mean**2, 0.0)
        return mean, np.maximum(np.sqrt(variance), LEAST_SCALE_CM)
