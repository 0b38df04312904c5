"""Label sets in memory, and the seeded batches of rasters and labels drawn from them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from lanenet.data.label_set import LabelMeta, LabelSet, read_labels
from lanenet.errors import LabelFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import mirror_points
from lanenet.learn.augment import augment_batch, lines_present
from lanenet.learn.config import AugmentSettings

#: Rasters, labels in cm (NaN where masked) and, per line, 1 if it can be seen (0 if not, NaN if unknown).
Batch = tuple[UInt8[np.ndarray, "b 1 r c"], Float[np.ndarray, "b 6"], Float[np.ndarray, "b 2"]]


class LaneSamples:
    """The frames of several label sets, flattened into a few arrays.

    Attributes:
        window: The bird's-eye window that all sets share.
        wheelbase_cm: The wheelbase that all sets share.
        perception: How all sets' edge points were found.
        lane_width_cm: Mean lane width over the frames.
        lane_widths_cm: Narrowest and widest lane of a set.
        camera_hashes: Of the cameras that took the frames, sorted.
        reference: Where the labels come from: ``truth``, ``map`` or ``map and truth``.
        points_cm: Labels of each frame, NaN where masked, n x 6.
        edges_cm: Edge points of all frames, one after the other, frame car.
        edge_start: Frame i owns edge points ``edge_start[i]`` to ``edge_start[i + 1]``.
        lines: Left and right polyline of each frame, frame car.
    """

    def __init__(
        self, label_sets: Sequence[LabelSet], names: Sequence[str], min_quality: float = 0.0
    ) -> None:
        """Join label sets.

        Args:
            label_sets: What :func:`read_labels` answers.
            names: Where each set came from, for messages.
            min_quality: Frames of a lower quality are left out, and so are frames without any label.

        Raises:
            LabelFormatError: If there is no set, no frame is left, or two sets cannot be learned together.
        """
        if not label_sets:
            raise LabelFormatError("no label set was given, expected at least one")
        for other, name in zip(label_sets[1:], names[1:], strict=True):
            check_same(label_sets[0].meta, other.meta, names[0], name)
        first = label_sets[0].meta
        self.window: BirdseyeWindow = first.window
        self.wheelbase_cm = first.wheelbase_cm
        self.perception = first.perception
        self.camera_hashes = sorted({labels.meta.camera_hash for labels in label_sets})
        self.reference = reference_of(label_sets)
        kept = [
            np.flatnonzero((labels.quality >= min_quality) & np.isfinite(labels.points_cm).any(axis=1))
            for labels in label_sets
        ]
        pairs = [(labels, i) for labels, rows in zip(label_sets, kept, strict=True) for i in rows]
        if not pairs:
            raise LabelFormatError(
                f"{', '.join(names)}: no frame has a label and a quality of at least {min_quality:g}"
            )
        widths = [labels.meta.lane_width_cm for labels, _ in pairs]
        self.lane_width_cm = float(np.mean(widths))
        self.lane_widths_cm = (float(min(widths)), float(max(widths)))
        self.points_cm: Float[np.ndarray, "n 6"] = np.array([labels.points_cm[i] for labels, i in pairs])
        edges = [np.asarray(labels.edges[i][:, :2], np.float32) for labels, i in pairs]
        self.edges_cm = np.concatenate(edges)
        self.edge_start: Int[np.ndarray, "_"] = np.concatenate([[0], np.cumsum([len(e) for e in edges])])
        self.lines = [
            (np.asarray(labels.lines[i][0], np.float64), np.asarray(labels.lines[i][1], np.float64))
            for labels, i in pairs
        ]

    def __len__(self) -> int:
        return len(self.points_cm)

    def edges_of(self, index: int) -> Float[np.ndarray, "m 2"]:
        """Return the edge points of one frame, [cm], frame car."""
        return self.edges_cm[self.edge_start[index] : self.edge_start[index + 1]]

    def plain_batch(self, indices: Int[np.ndarray, "b"]) -> Batch:
        """Return rasters, labels and presence of the lines of frames as they are."""
        rasters = np.empty((len(indices), 1, self.window.rows, self.window.columns), np.uint8)
        for slot, index in enumerate(indices):
            self.window.rasterise(self.edges_of(int(index)), out=rasters[slot, 0])
        present = [lines_present(self.edges_of(int(i)), self.lines[i], self.window) for i in indices]
        return rasters, self.points_cm[indices].astype(np.float32), np.array(present, np.float32)

    def augmented_batch(
        self, indices: Int[np.ndarray, "b"], settings: AugmentSettings, seed: int, epoch: int
    ) -> Batch:
        """Return rasters, labels and presence of the lines of frames, each changed by its own draw.

        The draw depends on ``seed``, ``epoch`` and the index of the frame alone, so a sample is the same
        whatever the batch, the order and the number of workers.
        """
        return augment_batch(
            [self.edges_of(int(i)) for i in indices],
            [self.lines[i] for i in indices],
            self.points_cm[indices],
            [np.random.default_rng((seed, epoch, int(i))) for i in indices],
            self.window,
            settings,
        )

    def epoch(
        self, settings: AugmentSettings, seed: int, epoch: int, batch_size: int, workers: int = 1
    ) -> Iterator[Batch]:
        """Yield the augmented batches of one epoch in a shuffled order that (seed, epoch) decides.

        A last batch of a single sample is left out: batch normalisation cannot use it.

        Args:
            settings: Changes of the samples.
            seed: Of the run.
            epoch: Counted from 0.
            batch_size: Samples per batch.
            workers: Threads that prepare batches ahead; 0 prepares each when it is asked for.
        """
        # The number after the last sample's: a stream of its own.
        order = np.random.default_rng((seed, epoch, len(self))).permutation(len(self))
        chunks = [order[k : k + batch_size] for k in range(0, len(order), batch_size)]
        chunks = [chunk for chunk in chunks if len(chunk) > 1]
        if workers == 0:
            for chunk in chunks:
                yield self.augmented_batch(chunk, settings, seed, epoch)
            return
        with ThreadPoolExecutor(workers) as pool:
            ahead: list[Future[Batch]] = []
            try:
                for chunk in chunks:
                    ahead.append(pool.submit(self.augmented_batch, chunk, settings, seed, epoch))
                    if len(ahead) > workers + 1:
                        yield ahead.pop(0).result()
                for future in ahead:
                    yield future.result()
            finally:
                for future in ahead:
                    future.cancel()

    def steps_per_epoch(self, batch_size: int) -> int:
        """Number of batches that :meth:`epoch` yields."""
        full, rest = divmod(len(self), batch_size)
        return full + (rest > 1)

    def normalisation(self, mirrored: bool) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"]]:
        """Return mean and spread of each label, [cm], so that the network's outputs are of order one.

        Args:
            mirrored: Count each frame once more with left and right swapped.
        """
        points = self.points_cm
        if mirrored:
            points = np.concatenate([points, mirror_points(points)])
        known = np.isfinite(points)
        count = np.maximum(known.sum(axis=0), 1)
        # Robust against the few frames of a sharp bend whose line lies a metre to the side.
        clipped = np.where(known, np.clip(points, -200.0, 200.0), 0.0)
        mean = clipped.sum(axis=0) / count
        variance = (np.where(known, clipped - mean, 0.0) ** 2).sum(axis=0) / count
        return mean, np.maximum(np.sqrt(variance), 2.0)


def read_samples(paths: Sequence[Path], min_quality: float = 0.0) -> LaneSamples:
    """Read label sets into memory.

    Raises:
        LabelFormatError: If a file cannot be read, or two files cannot be learned together (names both).
    """
    return LaneSamples([read_labels(p) for p in paths], [str(p) for p in paths], min_quality)


def check_same(a: LabelMeta, b: LabelMeta, name_a: str, name_b: str) -> None:
    """Refuse two label sets that do not describe the same raster and car.

    Raises:
        LabelFormatError: Naming both files and what differs.
    """
    if a.window != b.window:
        raise LabelFormatError(
            f"{name_b}: window {b.window}, but {name_a} has {a.window}; label both with the same window"
        )
    if a.perception != b.perception:
        raise LabelFormatError(
            f"{name_b}: its edges were found with {b.perception}, those of {name_a} with {a.perception}; "
            "label both with the same settings"
        )
    if abs(a.wheelbase_cm - b.wheelbase_cm) > 1e-6 * abs(a.wheelbase_cm):
        raise LabelFormatError(
            f"{name_b}: wheelbase_cm {b.wheelbase_cm:g}, but {name_a} has {a.wheelbase_cm:g}; "
            "learn one car at a time"
        )


def reference_of(label_sets: Sequence[LabelSet]) -> str:
    """Say where labels come from: ``truth``, ``map`` or ``map and truth``."""
    return " and ".join(sorted({labels.meta.source for labels in label_sets}))


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
