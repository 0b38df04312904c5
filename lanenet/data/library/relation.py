"""What two drives are to each other that share frames: a copy, a cut, or two cuts that overlap; in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lanenet.data.library.overlap import Overlap, Recording

#: Share of a drive's frames that make it all of it. Chosen: a run may end a few frames before the drive does.
_ALL = 0.95


def relation_sentence(one: Recording, other: Recording, overlaps: Sequence[Overlap]) -> str:
    """Say in words what two drives share.

    Args:
        one: A drive; the sentence is about it.
        other: Another.
        overlaps: The runs that they share, with the one's frames first; at least one.
    """
    all_of_one, all_of_other = (
        _share(recording, runs) >= _ALL
        for recording, runs in ((one, overlaps), (other, [overlap.swapped for overlap in overlaps]))
    )
    same_bytes = all(overlap.same_bytes for overlap in overlaps)
    if all_of_one and all_of_other:
        what = (
            f"has the same images as {other.name}" if same_bytes else f"is a re-encoded copy of {other.name}"
        )
    elif all_of_one:
        what = f"is a cut of {other.name}"
    elif all_of_other:
        what = f"holds all of {other.name}, which is a cut of it"
    else:
        what = f"overlaps with {other.name}: both are cuts of one recording"
    return f"{one.name} {what}: {'; '.join(_run_words(overlap, other.name) for overlap in overlaps)}"


def _run_words(overlap: Overlap, other: str) -> str:
    (first, last), (other_first, other_last) = overlap.frames, overlap.other_frames
    how = (
        f"{overlap.matched} images are equal byte by byte"
        if overlap.same_bytes
        else f"encoded again: of {overlap.matched} frames compared, {100.0 * overlap.difference:.2f} % of "
        "the signs differ; of another lap, 5 % or more"
    )
    return f"its frames {first} to {last} are {other_first} to {other_last} of {other} ({how})"


def _share(recording: Recording, overlaps: Sequence[Overlap]) -> float:
    """Return the share of a drive's frames that lie in runs."""
    frames = recording.fingerprint.frames
    inside = np.zeros(len(frames), np.bool_)
    for overlap in overlaps:
        inside |= (frames >= overlap.frames[0]) & (frames <= overlap.frames[1])
    return float(inside.mean()) if len(frames) else 0.0
