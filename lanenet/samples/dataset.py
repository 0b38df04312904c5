"""Label sets in memory, and the seeded batches of rasters and labels that are drawn from them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from lanenet.data.label_set import LabelMeta, LabelSet, read_labels
from lanenet.errors import LabelFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import mirror_points
from lanenet.perception.network.model_file import ANY_CAMERA
from lanenet.samples.augment import TYPICAL_CAMERA_CM, Batch, augment_batch, join_frames, plain_batch
from lanenet.samples.settings import AugmentSettings, Balance

#: A network that learned from more cameras than this is for any camera. Chosen.
_MANY_CAMERAS = 8


class LaneSamples:
    """The frames of several label sets, flattened into a few arrays.

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
        points_cm: Labels of each frame, NaN where masked, n x 6.
        frames: Edge points, lane lines and labels, as the compiled loops take them.
        set_start: Set i owns the frames ``set_start[i]`` to ``set_start[i + 1]``.
    """

    def __init__(
        self, label_sets: Sequence[LabelSet], names: Sequence[str], min_quality: float = 0.0
    ) -> None:
        """Join label sets.

        Args:
            label_sets: Returned by :func:`read_labels`.
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
        same = all(labels.meta.perception == first.perception for labels in label_sets)
        self.perception = first.perception if same else first.perception.of_all_rows()
        self.reference = " and ".join(sorted({labels.meta.source for labels in label_sets}))
        kept = [
            np.flatnonzero((labels.quality >= min_quality) & np.isfinite(labels.points_cm).any(axis=1))
            for labels in label_sets
        ]
        self.set_start: Int[np.ndarray, "_"] = np.concatenate([[0], np.cumsum([len(rows) for rows in kept])])
        pairs = [(labels, i) for labels, rows in zip(label_sets, kept, strict=True) for i in rows]
        if not pairs:
            raise LabelFormatError(
                f"{', '.join(names)}: no frame has a label and a quality of at least {min_quality:g}"
            )
        metas = [labels.meta for labels in label_sets]
        hashes = sorted({meta.camera_hash for meta in metas})
        self.camera_hashes = [ANY_CAMERA] if len(hashes) > _MANY_CAMERAS else hashes
        self.lane_widths_cm = (min(m.lane_width_cm for m in metas), max(m.lane_width_cm for m in metas))
        self.lane_width_cm = float(np.mean([labels.meta.lane_width_cm for labels, _ in pairs]))
        self.wheelbase_cm = float(np.mean([labels.meta.wheelbase_cm for labels, _ in pairs]))
        self.points_cm: Float[np.ndarray, "n 6"] = np.array([labels.points_cm[i] for labels, i in pairs])
        self.frames = join_frames(
            [labels.edges[i] for labels, i in pairs],
            [labels.lines[i] for labels, i in pairs],
            self.points_cm,
            np.array([labels.meta.camera_cm or TYPICAL_CAMERA_CM for labels, _ in pairs]),
            np.array([labels.meta.lane_width_cm for labels, _ in pairs]),
            np.array([labels.divides[i] for labels, i in pairs]),
        )

    def __len__(self) -> int:
        return len(self.points_cm)

    def plain_batch(self, indices: Int[np.ndarray, "b"]) -> Batch:
        """Return frames as they are, with their lane width."""
        return plain_batch(self.frames, indices, self.window)

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
            balance: ``none`` shows each frame once; ``drive`` shows each label set equally often, and a frame
                again only after all others of its set.
        """
        n = len(self)
        # A stream of its own: the number after the last sample's.
        rng = np.random.default_rng((seed, epoch, n))
        if balance == "none":
            frames = rng.permutation(n)
            return frames, frames
        sets = [np.arange(a, b) for a, b in pairwise(self.set_start.tolist()) if b > a]
        shown, streams = [], []
        # The first sets get the remainder of the division.
        for number, rows in enumerate(sets):
            wanted = n // len(sets) + (number < n % len(sets))
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
    ) -> Iterator[Batch]:
        """Yield the augmented batches of one epoch in a shuffled order that (seed, epoch) decides.

        A last batch of a single sample is left out: batch normalisation cannot use it.

        Args:
            settings: Changes of the samples.
            seed: Of the run.
            epoch: Counted from 0.
            batch_size: Samples per batch.
            workers: Threads that prepare batches ahead.
            balance: How often each label set is shown, see :meth:`order`.
        """
        order, streams = self.order(seed, epoch, balance)
        slices = [slice(k, k + batch_size) for k in range(0, len(order), batch_size)]
        jobs = [(order[k], settings, seed, epoch, streams[k]) for k in slices if len(order[k]) > 1]
        with ThreadPoolExecutor(workers) as pool:
            ahead: list[Future[Batch]] = []
            try:
                for job in jobs:
                    ahead.append(pool.submit(self.augmented_batch, *job))
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
        """Return mean and standard deviation of each label, [cm]; they scale the outputs to order one.

        Args:
            mirrored: Count each frame once more with left and right swapped.
        """
        points = self.points_cm
        if mirrored:
            points = np.concatenate([points, mirror_points(points)])
        known = np.isfinite(points)
        count = np.maximum(known.sum(axis=0), 1)
        # Robust against the few frames in sharp bends whose line lies a metre to the side.
        clipped = np.where(known, np.clip(points, -200.0, 200.0), 0.0)
        mean = clipped.sum(axis=0) / count
        variance = (np.where(known, clipped - mean, 0.0) ** 2).sum(axis=0) / count
        return mean, np.maximum(np.sqrt(variance), 2.0)


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
