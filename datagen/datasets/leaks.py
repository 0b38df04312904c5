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
from lanenet.data.library import Library
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


@dataclass(frozen=True)
class _Source:
    """Where a recording of a run can be known from.

    Attributes:
        job: Its job.
        path: The recording; None for a label set, which names none.
        remembered: What a library remembers of a recording that is not there any more.
    """

    job: RecordedJob
    path: Path | None
    remembered: Fingerprint | None = None

    @property
    def lost(self) -> bool:
        """Whether nothing is known of it."""
        return self.path is not None and self.remembered is None and not self.path.exists()

    @property
    def key(self) -> list[object]:
        """What changes when what is known of it does."""
        recording = self.job.recording
        known = [fingerprint(recording.path)]
        if self.remembered is not None:
            known.append(hashlib.sha256(self.remembered.to_bytes()).hexdigest())
        elif self.path is not None:
            known.append(fingerprint(self.path))
        return [str(recording.path.resolve()), recording.parts, recording.frames, *known]


def refuse_leaks(
    jobs: Sequence[RecordedJob],
    folder: Path,
    progress: Progress | None = None,
    library: Path | None = None,
) -> tuple[str, ...]:
    """Refuse drives of which one is learned from and another, of the same recording or track, judged by.

    What was compared is not compared again while the recordings and the parts stay the same.

    Args:
        jobs: The recorded drives of a run.
        folder: Keeps fingerprints and the answer.
        progress: Called with (stage, done, total).
        library: Asked for recordings that are not where their maps say; None asks none.

    Returns:
        What could not be checked, for people.

    Raises:
        ConfigError: Names both drives, and the frames or the track that they share.
        LanenetError: If a drive, a map, a label set or the library cannot be read.
    """
    _refuse_shared_tracks(jobs)
    sources = [
        _source(job, library)
        for job in jobs
        if any(other is not job and _may_leak(job.recording, other.recording) for other in jobs)
    ]
    unknown = tuple(
        f"{source.job.title}: its recording {source.path} is not here: nobody can say whether other drives "
        "share frames with it"
        for source in sources
        if source.lost
    )
    there = [source for source in sources if not source.lost]
    if len(there) < 2:
        return unknown
    key = key_of([source.key for source in there])
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


def _refuse_shared_tracks(jobs: Sequence[RecordedJob]) -> None:
    """Refuse drives of one track in different parts: one of a name, or one whose maps were joined.

    Two drives that are each split by their time are refused, too: the one's test would be on a road that the
    other has learned. Who wants that names no track, and lists joined maps by their folder.
    """
    for first, second in itertools.combinations(jobs, 2):
        one, other = first.recording, second.recording
        if not _may_leak(one, other):
            continue
        if one.track and _spelt(one.track) == _spelt(other.track):
            shared, instead = f"of the track {one.track!r}", "leave out 'track'"
        elif first.joined_in is not None and first.joined_in == second.joined_in:
            shared, instead = f"joined in {first.joined_in}", "list that folder"
        else:
            continue
        parts = ["/".join(drive.parts) for drive in (one, other)]
        raise ConfigError(
            f"data.drives: {first.title} ({parts[0]}) and {second.title} ({parts[1]}) are both {shared}, and "
            "a track may be in one part only; give both whole to one part (split: train, validation or "
            f"test), or {instead} where a road that was learned may be tested on"
        )


def _spelt(track: str) -> str:
    """Return the name of a track without what is typed in one way or another: capitals and spaces."""
    return " ".join(track.casefold().split())


def _may_leak(one: RecordedSettings, other: RecordedSettings) -> bool:
    """Tell whether two drives are not all in one part."""
    return len({*one.parts, *other.parts}) > 1


def _drive_behind(job: RecordedJob) -> Path | None:
    """Return the recording that a drive or a map shows; None for a label set, which names none."""
    if job.is_labels:
        return None
    return Path(read_yaml(job.recording.path / "map.yaml")["drive"]) if job.is_map else job.recording.path


def _source(job: RecordedJob, library: Path | None) -> _Source:
    path = _drive_behind(job)
    if path is None or path.exists() or library is None:
        return _Source(job, path)
    known = Library.open(library)
    # A name is chosen freely, and may be that of another drive: the place decides where it is known.
    named = (entry for entry in known.entries() if entry.name == job.recording.name)
    entry = known.find(path) or next(named, None)
    return _Source(job, path, None if entry is None else known.recording(entry.name).fingerprint)


def _known(sources: Sequence[_Source], folder: Path, progress: Progress | None) -> list[_Entry]:
    entries = []
    for number, source in enumerate(sources):
        job = source.job
        if source.path is None:
            known = _of_labels(read_labels(job.recording.path))
        else:
            known = _used(job, source.remembered or _taken(source.path, folder))
        entries.append(_Entry(job, Recording(job.title, known, job.recording.track), source.path is not None))
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
