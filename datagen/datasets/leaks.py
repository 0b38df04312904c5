"""What must not be: that a network is judged on frames, or on a track, that it has learned from.

Within one recording the gaps of its split keep the parts apart (:mod:`datagen.datasets.splits`). Here it is
about different recordings of a run: copies, copies that were encoded again and cuts that overlap are known by
their images, and drives of one track by what the config calls it.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from datagen.datasets.jobs import RecordedJob
from datagen.datasets.settings import RecordedSettings
from datagen.made import Output, fingerprint, key_of
from lanenet.config import read_yaml
from lanenet.data.drives import open_drive
from lanenet.data.files import write_bytes, write_text
from lanenet.data.label_set import LabelSet, read_labels
from lanenet.data.library.fingerprint import HASH_BYTES, Fingerprint, take_fingerprint
from lanenet.data.library.overlap import Recording, find_overlaps
from lanenet.data.library.relation import relation_sentence
from lanenet.data.maps.folder import read_map
from lanenet.errors import ConfigError, DriveFormatError, counted
from lanenet.outputs import make_folder

#: Called with (stage, done, total).
Progress = Callable[[str, int, int], object]


@dataclass(frozen=True)
class _Entry:
    """A recording of a run that can be compared.

    Attributes:
        job: Its job.
        known: By what its frames are known.
        of_images: Whether by its images; those of a label set are known by their edge points.
    """

    job: RecordedJob
    known: Recording
    of_images: bool


def refuse_leaks(
    jobs: Sequence[RecordedJob], folder: Path, progress: Progress | None = None
) -> tuple[str, ...]:
    """Refuse drives of which one is learned from and another, of the same recording or track, judged by.

    What was compared is not compared again while the recordings and the parts stay the same.

    Args:
        jobs: The recorded drives of a run.
        folder: Keeps fingerprints and the answer.
        progress: Called with (stage, done, total).

    Returns:
        What could not be checked, for people.

    Raises:
        ConfigError: Names both drives, and the frames or the track that they share.
        LanenetError: If a drive, a map or a label set cannot be read.
    """
    _refuse_shared_tracks([job.recording for job in jobs])
    sources = [
        (job, _drive_behind(job))
        for job in jobs
        if any(other is not job and _may_leak(job.recording, other.recording) for other in jobs)
    ]
    unknown = tuple(
        f"{job.title}: its recording {drive} is not here: nobody can say whether other drives share frames "
        "with it"
        for job, drive in sources
        if drive is not None and not drive.exists()
    )
    if len(sources) - len(unknown) < 2:
        return unknown
    there = [(job, drive) for job, drive in sources if drive is None or drive.exists()]
    key = key_of(
        [
            [str(job.recording.path.resolve()), job.recording.parts, job.recording.frames]
            + [fingerprint(path) for path in (job.recording.path, drive) if path is not None]
            for job, drive in there
        ]
    )
    make_folder(folder)
    answer = Output(folder / "leaks.txt", key)
    if not answer.done:
        entries = _known(there, folder, progress)
        found = _shared_frames(entries, progress)
        if found:
            raise ConfigError(
                f"data.drives: {counted(len(found), 'pair')} of drives would leak between training, "
                f"validation and test: {found[0]}; leave one out, give both whole to one part (split: "
                "train), or choose frames that do not overlap"
            )
        compared = [
            f"{entry.job.title}: a label set holds no images: it was compared with other label sets alone"
            for entry in entries
            if not entry.of_images
        ]
        write_text(answer.path, "".join(f"{line}\n" for line in compared))
        answer.mark()
    return (*answer.path.read_text(encoding="utf-8").splitlines(), *unknown)


def _refuse_shared_tracks(drives: Sequence[RecordedSettings]) -> None:
    """Refuse drives of one track in different parts.

    Two drives that are each split by their time are refused, too: the one's test would be on a road that the
    other has learned. Who wants that names no track.
    """
    for one, other in itertools.combinations(drives, 2):
        if one.track and one.track == other.track and _may_leak(one, other):
            parts = ["/".join(drive.parts) for drive in (one, other)]
            raise ConfigError(
                f"data.drives: {one.path} ({parts[0]}) and {other.path} ({parts[1]}) are both of the track "
                f"{one.track!r}, which may be in one part only; give both whole to one part (split: train, "
                "validation or test), or leave out 'track' where a road that was learned may be tested on"
            )


def _may_leak(one: RecordedSettings, other: RecordedSettings) -> bool:
    """Tell whether two drives are not all in one part."""
    return len({*one.parts, *other.parts}) > 1


def _drive_behind(job: RecordedJob) -> Path | None:
    """Return the recording that a drive or a map shows; None for a label set, which names none."""
    if job.is_labels:
        return None
    return Path(read_yaml(job.recording.path / "map.yaml")["drive"]) if job.is_map else job.recording.path


def _known(
    sources: Sequence[tuple[RecordedJob, Path | None]], folder: Path, progress: Progress | None
) -> list[_Entry]:
    entries = []
    for number, (job, path) in enumerate(sources):
        if path is None:
            known = _of_labels(read_labels(job.recording.path))
        else:
            known = _used(job, _taken(path, folder))
        entries.append(_Entry(job, Recording(job.title, known, job.recording.track), path is not None))
        if progress is not None:
            progress("read", number + 1, len(sources))
    return entries


def _taken(path: Path, folder: Path) -> Fingerprint:
    """Return the fingerprint of a recording, which is taken once."""
    name = f"{path.name}-{key_of(str(path.resolve()))[:6]}"
    taken = Output(folder / f"{name}.bin", key_of(fingerprint(path)))
    taken.make_alone(lambda: write_bytes(taken.path, take_fingerprint(open_drive(path))[0].to_bytes()))
    try:
        return Fingerprint.from_bytes(taken.path.read_bytes())
    except (OSError, ValueError) as error:
        raise DriveFormatError(f"{taken.path}: cannot be read ({error}); remove it") from None


def _used(job: RecordedJob, whole: Fingerprint) -> Fingerprint:
    """Return what a drive or a map uses of its recording."""
    frames, chosen = whole.frames, job.recording.frames
    used = np.ones(len(frames), np.bool_)
    if job.is_map:
        mapped = read_map(job.recording.path).frames
        used = (frames >= mapped[0]) & (frames <= mapped[-1])
    elif chosen is not None:
        used = (frames >= chosen[0]) & (frames <= chosen[1])
    return Fingerprint(frames[used], whole.digests[used], whole.hashes[used])


def _of_labels(labels: LabelSet) -> Fingerprint:
    """Know the frames of a label set by their edge points: one image and one camera give the same."""
    digests = [
        int.from_bytes(hashlib.sha256(edges.tobytes()).digest()[:8], "little") if len(edges) else 0
        for edges in labels.edges
    ]
    return Fingerprint(
        labels.frame.astype(np.int64),
        np.array(digests, np.uint64),
        np.zeros((len(labels), HASH_BYTES), np.uint8),
    )


def _shared_frames(entries: Sequence[_Entry], progress: Progress | None) -> list[str]:
    """Return a sentence for each pair that shares frames and is in different parts."""
    pairs = [
        (one, other)
        for one, other in itertools.combinations(entries, 2)
        if _may_leak(one.job.recording, other.job.recording) and one.of_images == other.of_images
    ]
    found = []
    for number, (one, other) in enumerate(pairs):
        overlaps = find_overlaps(one.known, other.known)
        if overlaps:
            found.append(relation_sentence(one.known, other.known, overlaps))
        if progress is not None:
            progress("compare", number + 1, len(pairs))
    return found
