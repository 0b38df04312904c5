"""Label sets in memory, and the seeded batches of rasters and labels that are drawn from them."""

from __future__ import annotations

import functools
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.data.label_set import LabelMeta, LabelSet, read_labels
from lanenet.errors import LabelFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import mirror_points
from lanenet.perception.network.model_file import ANY_CAMERA
from lanenet.samples.augment import (
    TYPICAL_CAMERA_CM,
    Batch,
    augment_batch,
    concat_frames,
    join_frames,
    plain_batch,
)
from lanenet.samples.kernels import Frames
from lanenet.samples.settings import AugmentSettings, Balance

#: A network that learned from more cameras than this is for any camera. Chosen.
_MANY_CAMERAS = 8
#: Outputs are scaled by at least this, [cm]. Chosen: labels that hardly differ are not blown up.
LEAST_SCALE_CM = 2.0


@dataclass(frozen=True)
class Cut:
    """Which parts of every batch are drawn, where several processes share a training.

    Attributes:
        parts: Of a batch, of equal size but for one sample.
        first: The first one of them, from 0.
        count: How many.
    """

    parts: int = 1
    first: int = 0
    count: int = 1

    def bounds(self, size: int) -> list[int]:
        """Return where its parts of a batch begin, and where the last one ends."""
        each, more = divmod(size, self.parts)
        return [k * each + min(k, more) for k in range(self.first, self.first + self.count + 1)]


WHOLE = Cut()


class Samples(ABC):
    """The frames of several label sets, as what trains and judges a network needs them.

    Attributes:
        window: The bird's-eye window that all sets share.
        wheelbase_cm: Mean wheelbase over the frames; labels are in the frame of the front axle, so that it
            matters for steering only.
        perception: How all sets' edge points were found; without hidden rows where these differ between sets,
            since cars see different parts of themselves.
        lane_width_cm: Mean lane width over the frames.
        lane_widths_cm: Narrowest and widest lane of a set.
        camera_hashes: Of the cameras that took the frames, sorted; ``any`` alone where they are so many that
            the network is for any calibrated camera.
        reference: Where the labels come from: ``truth``, ``map`` or ``map and truth``.
        set_start: Set i owns the frames ``set_start[i]`` to ``set_start[i + 1]``.
        weights: How often each set is shown beside the others, see :meth:`shown`.
    """

    def __init__(
        self,
        metas: Sequence[LabelMeta],
        names: Sequence[str],
        kept: Sequence[int],
        least_quality: float,
        weights: Sequence[float] = (),
    ) -> None:
        """Describe what the sets share.

        Args:
            metas: Of each set.
            names: Where each set came from, for messages.
            kept: Frames of each set that are used.
            least_quality: That these have, for messages.
            weights: Of each set; none weighs all alike.

        Raises:
            LabelFormatError: If there is no set, no frame is left, or two sets cannot be learned together.
        """
        if not metas:
            raise LabelFormatError("no label set was given, expected at least one")
        for other, name in zip(metas[1:], names[1:], strict=True):
            check_same(metas[0], other, names[0], name)
        first = metas[0]
        self.window: BirdseyeWindow = first.window
        same = all(meta.perception == first.perception for meta in metas)
        self.perception = first.perception if same else first.perception.of_all_rows()
        self.reference = " and ".join(sorted({meta.source for meta in metas}))
        self.set_start: Int[np.ndarray, "_"] = np.concatenate([[0], np.cumsum(kept)])
        self.weights = tuple(weights) or (1.0,) * len(metas)
        if not self.set_start[-1]:
            raise LabelFormatError(
                f"{', '.join(names)}: no frame has a label and a quality of at least {least_quality:g}"
            )
        hashes = sorted({meta.camera_hash for meta in metas})
        self.camera_hashes = [ANY_CAMERA] if len(hashes) > _MANY_CAMERAS else hashes
        self.lane_widths_cm = (min(m.lane_width_cm for m in metas), max(m.lane_width_cm for m in metas))
        self.lane_width_cm = float(np.mean(np.repeat([meta.lane_width_cm for meta in metas], kept)))
        self.wheelbase_cm = float(np.mean(np.repeat([meta.wheelbase_cm for meta in metas], kept)))

    def __len__(self) -> int:
        return int(self.set_start[-1])

    @property
    @abstractmethod
    def points_cm(self) -> Float[np.ndarray, "n 6"]:
        """Labels of each frame, NaN where masked."""

    @abstractmethod
    def plain_batch(self, indices: Int[np.ndarray, "b"]) -> Batch:
        """Return frames as they are, with their lane width."""

    @abstractmethod
    def plain_batches(self, size: int) -> Iterator[Batch]:
        """Yield all frames as they are, in their order."""

    @abstractmethod
    def changed_batches(self, settings: AugmentSettings, seed: int, size: int) -> Iterator[Batch]:
        """Yield all frames in their order, each changed by its draw of the first epoch."""

    @abstractmethod
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
        """Yield the augmented batches of one epoch in a shuffled order that (seed, epoch) decides.

        A last batch that is too small is left out, see :meth:`steps_per_epoch`.

        Args:
            settings: Changes of the samples.
            seed: Of the run.
            epoch: Counted from 0.
            batch_size: Samples per batch.
            workers: Threads that prepare batches ahead.
            balance: How often each label set is shown, see :meth:`shown`.
            first_step: Batches to leave out, of a run that goes on.
            cut: Which parts of each batch are drawn; those of a small last batch may be empty.
        """

    @abstractmethod
    def normalisation(self, mirrored: bool) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"]]:
        """Return mean and standard deviation of each label, [cm]; they scale the outputs to order one.

        Args:
            mirrored: Count each frame once more with left and right swapped.
        """

    def steps_per_epoch(self, batch_size: int) -> int:
        """Number of batches that :meth:`epoch` yields.

        A last batch of a single sample is none, since batch normalisation cannot use it.
        """
        full, rest = divmod(len(self), batch_size)
        return full + (rest >= 2)

    def batch_length(self, step: int, batch_size: int) -> int:
        """Number of samples of a batch of an epoch, all parts together."""
        return min(batch_size, len(self) - step * batch_size)

    def each_once(self, balance: Balance) -> bool:
        """Tell whether an epoch shows every frame once."""
        return balance == "none" and len(set(self.weights)) == 1

    def shown(self, balance: Balance) -> list[tuple[int, int]]:
        """Return the sets that an epoch shows, and how many samples of each.

        An epoch has as many samples as there are frames. ``drive`` shows each label set as often as its
        weight says, whatever its length, ``none`` each of its frames; a frame is shown again only after all
        others of its set.
        """
        sizes = np.diff(self.set_start)
        share = np.array(self.weights) * (sizes > 0 if balance == "drive" else sizes)
        exact = len(self) * share / share.sum()
        counts = np.floor(exact).astype(np.int64)
        # What is left goes to those that lack most of a sample, the first sets first.
        left = len(self) - int(counts.sum())
        counts[np.argsort(counts - exact, kind="stable")[:left]] += 1
        return [(k, int(count)) for k, count in enumerate(counts) if count]


class LaneSamples(Samples):
    """The frames of several label sets in memory, flattened into a few arrays.

    Attributes:
        frames: Edge points, lane lines and labels, as the compiled loops take them.
    """

    def __init__(
        self,
        label_sets: Sequence[LabelSet],
        names: Sequence[str],
        min_quality: float = 0.0,
        weights: Sequence[float] = (),
    ) -> None:
        """Join label sets.

        Args:
            label_sets: Returned by :func:`read_labels`.
            names: Where each set came from, for messages.
            min_quality: Frames of a lower quality are left out, and so are frames without any label.
            weights: How often each set is shown, see :meth:`Samples.shown`; none weighs all alike.

        Raises:
            LabelFormatError: If there is no set, no frame is left, or two sets cannot be learned together.
        """
        kept = [usable(labels.points_cm, labels.quality, min_quality) for labels in label_sets]
        metas = [labels.meta for labels in label_sets]
        super().__init__(metas, names, [len(rows) for rows in kept], min_quality, weights)
        self.frames = concat_frames(
            [frames_of(labels.subset(rows)) for labels, rows in zip(label_sets, kept, strict=True)]
        )

    @property
    def points_cm(self) -> Float[np.ndarray, "n 6"]:
        """Labels of each frame, NaN where masked."""
        return self.frames.points_cm

    def plain_batch(self, indices: Int[np.ndarray, "b"]) -> Batch:
        """Return frames as they are, with their lane width."""
        return plain_batch(self.frames, indices, self.window)

    def plain_batches(self, size: int) -> Iterator[Batch]:
        """Yield all frames as they are, in their order."""
        # A batch at a time: the rasters of many frames take more memory than the frames.
        for rows in self._in_order(size):
            yield self.plain_batch(rows)

    def changed_batches(self, settings: AugmentSettings, seed: int, size: int) -> Iterator[Batch]:
        """Yield all frames in their order, each changed by its draw of the first epoch."""
        for rows in self._in_order(size):
            yield self.augmented_batch(rows, settings, seed, epoch=0)

    def _in_order(self, size: int) -> Iterator[Int[np.ndarray, "_"]]:
        for start in range(0, len(self), size):
            yield np.arange(start, min(start + size, len(self)))

    def augmented_batch(
        self,
        indices: Int[np.ndarray, "b"],
        settings: AugmentSettings,
        seed: int,
        epoch: int,
        streams: Int[np.ndarray, "b"] | None = None,
    ) -> Batch:
        """Return frames, each changed by its own random draw.

        The draw depends only on ``seed``, ``epoch`` and the index of the frame (or its stream in
        ``streams``): a sample is the same whatever the batch, the order and the number of workers.
        """
        return augment_batch(self.frames, indices, self.window, settings, seed, epoch, streams)

    def order(
        self, seed: int, epoch: int, balance: Balance = "none"
    ) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Return the frames of an epoch in a shuffled order, and the number of each one's random stream.

        Args:
            seed: Of the run.
            epoch: Counted from 0.
            balance: See :meth:`shown`; ``none`` shows each frame once if all sets weigh the same.
        """
        n = len(self)
        # A stream of its own: the number after the last sample's.
        rng = np.random.default_rng((seed, epoch, n))
        if self.each_once(balance):
            frames = rng.permutation(n)
            return frames, frames
        shown, streams = [], []
        for number, wanted in self.shown(balance):
            rows = np.arange(self.set_start[number], self.set_start[number + 1])
            rounds = -(-wanted // len(rows))
            shown.append(np.concatenate([rng.permutation(rows) for _ in range(rounds)])[:wanted])
            streams.append(shown[-1] + n * (np.arange(wanted) // len(rows)))
        mixed = rng.permutation(n)
        return np.concatenate(shown)[mixed], np.concatenate(streams)[mixed]

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
        order, streams = self.order(seed, epoch, balance)

        def jobs() -> Iterator[Callable[[], Batch]]:
            for step in range(first_step, self.steps_per_epoch(batch_size)):
                start, bounds = step * batch_size, cut.bounds(self.batch_length(step, batch_size))
                own = slice(start + bounds[0], start + bounds[-1])
                yield functools.partial(self.augmented_batch, order[own], settings, seed, epoch, streams[own])

        yield from ahead(jobs(), workers)

    def normalisation(self, mirrored: bool) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"]]:
        """Return mean and standard deviation of each label, see :meth:`Samples.normalisation`."""
        points = self.points_cm
        if mirrored:
            points = np.concatenate([points, mirror_points(points)])
        known, clipped = clip_labels(points)
        count = np.maximum(known.sum(axis=0), 1)
        mean = clipped.sum(axis=0) / count
        variance = (np.where(known, clipped - mean, 0.0) ** 2).sum(axis=0) / count
        return mean, np.maximum(np.sqrt(variance), LEAST_SCALE_CM)


def usable(
    points_cm: Float[np.ndarray, "n 6"], quality: Float[np.ndarray, "n"], min_quality: float
) -> Int[np.ndarray, "_"]:
    """Return the rows that have a label and enough quality."""
    return np.flatnonzero((quality >= min_quality) & np.isfinite(points_cm).any(axis=1))


def frames_of(labels: LabelSet) -> Frames:
    """Return the frames of a label set, as the compiled loops take them."""
    meta, size = labels.meta, len(labels)
    return join_frames(
        labels.edges,
        labels.lines,
        labels.points_cm,
        np.tile(np.array(meta.camera_cm or TYPICAL_CAMERA_CM, np.float64), (size, 1)),
        np.full(size, meta.lane_width_cm),
        labels.divides,
    )


def clip_labels(
    points_cm: Float[np.ndarray, "n 6"],
) -> tuple[Bool[np.ndarray, "n 6"], Float[np.ndarray, "n 6"]]:
    """Return which labels are known, and their values; 0 for the others.

    Values are clipped, against the few frames in sharp bends whose line lies a metre to the side.
    """
    known = np.isfinite(points_cm)
    return known, np.where(known, np.clip(points_cm, -200.0, 200.0), 0.0)


def ahead(calls: Iterator[Callable[[], Batch]], workers: int) -> Iterator[Batch]:
    """Yield what calls return, in their order; threads make some of it before it is asked for."""
    with ThreadPoolExecutor(workers) as pool:
        waiting: list[Future[Batch]] = []
        try:
            for call in calls:
                waiting.append(pool.submit(call))
                if len(waiting) > workers + 1:
                    yield waiting.pop(0).result()
            for future in waiting:
                yield future.result()
        finally:
            for future in waiting:
                future.cancel()


def compile_kernels(path: Path) -> None:
    """Draw one sample of a label set, so that numba caches what the training needs."""
    samples = LaneSamples([read_labels(path)], [str(path)])
    samples.augmented_batch(np.arange(1), AugmentSettings(), 0, 0)


def check_same(a: LabelMeta, b: LabelMeta, name_a: str, name_b: str) -> None:
    """Refuse two label sets that do not describe the same raster.

    Raises:
        LabelFormatError: Naming both files and what differs.
    """
    if a.window != b.window:
        raise LabelFormatError(
            f"{name_b}: window {b.window}, but {name_a} has {a.window}; label both with the same window"
        )
    unlike = b.perception.unlike(a.perception)
    if unlike:
        raise LabelFormatError(
            f"{name_b}: its edges were found with other settings than those of {name_a} ({unlike}); label "
            "both with the same settings"
        )


def hash_files(paths: Sequence[Path]) -> str:
    """Return a hash of the contents of files, in their order; their names do not count.

    Raises:
        LabelFormatError: If a file cannot be read.
    """
    total = hashlib.sha256()
    for path in paths:
        try:
            with path.open("rb") as file:
                total.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise LabelFormatError(f"{path}: cannot be read ({error.strerror})") from None
    return total.hexdigest()[:16]
