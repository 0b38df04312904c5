"""Frames that two drives share: copies, copies encoded again, and cuts of one recording that overlap.

Two laps of one track look alike, too, but never frame by frame: it is a run of frames in the same order, each
as good as equal to one of the other drive at a steady rate, that shows a copy. A car that stands shows the
same frame again and again, in every drive that begins there: only frames count that differ from those before.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.data.library.fingerprint import HASH_BYTES, Fingerprint

#: Bits of a byte.
_ONES = np.array([value.bit_count() for value in range(256)], np.uint8)
_HALF = HASH_BYTES // 2
#: So many signs have to count in both frames; chosen. Usual frames share some 150 of their 191.
_LEAST_BITS = 64
#: A frame differs from one before it where more than this share of the signs does. Chosen: far more than what
#: encoding changes; on the tubs every second frame does.
_MOVED = 0.08
#: Share of the signs that may differ in the mean of a run. Measured over runs of 32 frames: copies of four
#: tubs, encoded again in six ways, differ by 0.1 % at most; their laps, as well aligned as can be, by 5.5 to
#: 18 %.
_SAME = 0.015
#: Frames that differ from each other that a run has at least: 40 to 70 of all on the tubs.
LEAST_FRAMES = 32
#: Images with the same bytes, different ones, that a run has at least; chosen: no camera gives one twice.
_LEAST_SAME = 8
#: One in so many of the frames that differ is looked for in the other drive. Chosen: a run has five or more.
_SAMPLED = 6
#: The golden ratio's fraction: its multiples are spread evenly in no step.
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
#: Samples between the ends of a line that is tried. With several, a drive that was thinned is found, too.
_APART = (4, 5, 6)
#: Frames of the other drive that a sample is compared with: the nearest by all their signs, strong and weak,
#: of which at most so many differ. Measured: up to 30 of a copy of a quarter of the size.
_NEAREST, _FAR_BITS = 4, 32
#: Share of the signs that may differ at both ends of a line, and of frames beyond.
_ALIKE = 0.03
#: Frames of one drive to one of the other: it may have been thinned so often. Chosen.
_STEEPEST = 5.0
#: Below so many frames of the other for one, the other is the thinner drive, whose frames are compared.
#: Chosen: a video may lose a frame now and then.
_THINNER = 0.9
#: How far a line may be off another that it goes on from; chosen: its ends are so exact.
_OFF_ROWS = 2.0
#: How far from the end of a line one may begin that goes on from it, and how far beyond its end frames are
#: compared, in lengths; chosen: frames between may be blurred.
_FARTHEST, _BEYOND = 4, 2
#: After so many frames that are not alike, a run has ended; chosen: above the most that thinning leaves out.
_LOST_ROWS = 6


@dataclass(frozen=True)
class Overlap:
    """A run of frames that two drives share.

    Attributes:
        frames: Numbers of its first and last frame in the one.
        other_frames: In the other.
        matched: Frames that were compared.
        same_bytes: Whether the images are the same byte by byte.
        difference: Share of the compared signs that differ; of other laps, 0.05 or more.
    """

    frames: tuple[int, int]
    other_frames: tuple[int, int]
    matched: int
    same_bytes: bool
    difference: float

    @property
    def swapped(self) -> Overlap:
        """The same, seen from the other drive."""
        return Overlap(self.other_frames, self.frames, self.matched, self.same_bytes, self.difference)


@dataclass(frozen=True)
class _Line:
    """A stretch of two drives, by rows: ``i`` of the one is ``j`` of the other, evenly between the ends."""

    i: tuple[int, int]
    j: tuple[int, int]

    @property
    def slope(self) -> float:
        return (self.j[1] - self.j[0]) / (self.i[1] - self.i[0])

    @property
    def turned(self) -> _Line:
        return _Line(self.j, self.i)

    def at(self, i: Any) -> Any:
        """Return the place in the other drive of a row, or of several, of the one."""
        return self.j[0] + self.slope * (i - self.i[0])


@dataclass(frozen=True, eq=False)
class Recording:
    """A drive to be compared with others.

    Attributes:
        name: What messages call it.
        fingerprint: By what its frames are known again.
        track: Which track; empty if unknown.
    """

    name: str
    fingerprint: Fingerprint
    track: str = ""

    @cached_property
    def signs(self) -> UInt8[np.ndarray, "n b"]:
        """The signs of the frames, without what counts of them."""
        return np.ascontiguousarray(self.fingerprint.hashes[:, :_HALF])

    @cached_property
    def moved(self) -> Int[np.ndarray, "k"]:
        """Rows that differ from the one of them before."""
        return _moved_rows(self.fingerprint.hashes)


def find_overlaps(one: Recording, other: Recording) -> list[Overlap]:
    """Find the runs of frames that two drives share.

    Args:
        one: Any drive.
        other: Another.

    Returns:
        The runs, in the order of the one's frames; those whose images are the same byte by byte, and those
        that go on beyond them or lie elsewhere: a copy may hold some of the images as they were.
    """
    same, frames = _same_images(one.fingerprint, other.fingerprint), one.fingerprint.frames
    left = ~np.any([_inside(frames, run) for run in same], axis=0) if same else np.ones(len(frames), np.bool_)
    if left.sum() < LEAST_FRAMES:
        return same
    more = [
        run
        for run in _same_pictures(one, other)
        if (_inside(frames, run) & left).sum() >= LEAST_FRAMES or not same
    ]
    others = [run for run in same if not any(_inside(np.array(run.frames), larger).all() for larger in more)]
    return sorted([*others, *more], key=lambda run: run.frames)


def _inside(frames: Int[np.ndarray, "n"], run: Overlap) -> Bool[np.ndarray, "n"]:
    return (frames >= run.frames[0]) & (frames <= run.frames[1])


def _same_images(one: Fingerprint, other: Fingerprint) -> list[Overlap]:
    """Find runs of images with the same bytes, in the same order; frames may be missing in either.

    Images that are the same in another order are one more run, from the first of them to the last.
    """
    _, rows, others = np.intersect1d(one.digests, other.digests, return_indices=True)
    rows, others = rows[one.digests[rows] != 0], others[one.digests[rows] != 0]
    order = np.argsort(rows)
    rows, others = rows[order], others[order]
    cuts = np.flatnonzero(np.diff(others) < 0) + 1
    pieces = list(zip(np.split(rows, cuts), np.split(others, cuts), strict=True))
    runs = [(i, j) for i, j in pieces if len(i) >= _LEAST_SAME]
    short = [(i, j) for i, j in pieces if len(i) < _LEAST_SAME]
    if short and sum(len(i) for i, _ in short) >= _LEAST_SAME:
        i, j = (np.sort(np.concatenate(parts)) for parts in zip(*short, strict=True))
        runs = sorted([*runs, (i, j)], key=lambda run: int(run[0][0]))
    return [Overlap(_ends(one, i), _ends(other, j), len(i), True, 0.0) for i, j in runs]


def _ends(fingerprint: Fingerprint, rows: Int[np.ndarray, "k"]) -> tuple[int, int]:
    return int(fingerprint.frames[rows[0]]), int(fingerprint.frames[rows[-1]])


def _same_pictures(one: Recording, other: Recording) -> list[Overlap]:
    """Find runs of frames that show the same."""
    # How much the other moves is found only where it is needed: it is one of many.
    if min(len(one.moved), len(other.fingerprint)) < LEAST_FRAMES:
        return []
    runs: list[list[_Line]] = []
    for line in _tried_lines(one, other):
        run = next((run for run in runs if _goes_on(run[-1], line)), None)
        if run is None:
            runs.append([line])
        else:
            run.append(line)
    best: list[Overlap] = []
    found = [overlap for run in runs if (overlap := _overlap_of(one, other, run)) is not None]
    for overlap in sorted(found, key=lambda overlap: (-overlap.matched, overlap.difference)):
        if all(overlap.frames[0] > b.frames[1] or overlap.frames[1] < b.frames[0] for b in best):
            best.append(overlap)
    return sorted(best, key=lambda overlap: overlap.frames)


def _overlap_of(one: Recording, other: Recording, lines: list[_Line]) -> Overlap | None:
    """Return what lines that go on from each other say together; None if that is no copy."""
    first, last = lines[0], lines[-1]
    begin, end = _beyond(one, other, first, -1), _beyond(one, other, last, 1)
    lines = [_Line((begin[0], first.i[1]), (begin[1], first.j[1])), *lines]
    lines.append(_Line((last.i[0], end[0]), (last.j[0], end[1])))
    frames, others = (
        _ends(each.fingerprint, np.array(rows))
        for each, rows in zip((one, other), zip(begin, end, strict=True), strict=True)
    )
    if _Line((begin[0], end[0]), (begin[1], end[1])).slope < _THINNER:
        one, other, lines = other, one, [line.turned for line in lines]
    differences = np.full(len(one.fingerprint), np.inf)
    for line in lines:
        rows = _moved_on(one, line)
        differences[rows] = np.minimum(differences[rows], _near(one, other, rows, line))
    compared = differences[np.isfinite(differences)]
    if len(compared) < LEAST_FRAMES or compared.mean() > _SAME:
        return None
    return Overlap(frames, others, len(compared), False, float(compared.mean()))


def _tried_lines(one: Recording, other: Recording) -> Iterator[_Line]:
    """Yield the lines between two samples that hold for all frames between."""
    # One of each few, at uneven steps: even ones would all miss a drive of every second frame.
    blocks = np.arange(len(one.moved) // _SAMPLED)
    samples = one.moved[_SAMPLED * blocks + (_SAMPLED * np.mod(_GOLDEN * blocks, 1.0)).astype(np.int64)]
    bits, nearest = cv2.batchDistance(
        one.signs[samples], other.signs, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=_NEAREST
    )
    alike = (bits <= _FAR_BITS) & (nearest >= 0)
    alike &= _differences(one, other, samples[:, None], np.maximum(nearest, 0)) <= _ALIKE
    hits = [
        list(zip(b[good].tolist(), rows[good].tolist(), strict=True))
        for b, rows, good in zip(bits, nearest, alike, strict=True)
    ]
    for k, begin in enumerate(hits):
        ends = [(last, end) for apart in _APART if (last := k + apart) < len(hits) for end in hits[last]]
        # The nearest first: where the car is slow, frames beside the right one are alike, too.
        pairs = sorted(itertools.product(begin, ends), key=lambda pair: pair[0][0] + pair[1][1][0])
        lines = (_Line((int(samples[k]), int(samples[last])), (j, end[1])) for (_, j), (last, end) in pairs)
        if (line := next((line for line in lines if _holds(one, other, line)), None)) is not None:
            yield line


def _holds(one: Recording, other: Recording, line: _Line) -> bool:
    """Tell whether all frames on a line are alike; a few of them first, since most lines fail there."""
    if not 1.0 / _STEEPEST <= line.slope <= _STEEPEST:
        return False
    if line.slope < _THINNER:
        one, other, line = other, one, line.turned
    rows = _moved_on(one, line)
    return rows.size > 1 and all(
        bool(_near(one, other, some, line).mean() <= _SAME) for some in (rows[::_SAMPLED], rows)
    )


def _goes_on(last: _Line, line: _Line) -> bool:
    """Tell whether a line goes on where the last one ended, or is part of it."""
    apart = max(0, line.i[0] - last.i[1])
    # Between two of its rows that were found, a line is known to one row at either end.
    off = _OFF_ROWS * max(1.0, last.slope) * (1.0 + apart / (last.i[1] - last.i[0]))
    return (
        abs(last.at(line.i[0]) - line.j[0]) <= off
        and apart <= _FARTHEST * (last.i[1] - last.i[0])
        and line.j[1] >= last.j[0]
    )


def _beyond(one: Recording, other: Recording, line: _Line, way: Literal[-1, 1]) -> tuple[int, int]:
    """Return the last rows beyond the end of a line that are still alike."""
    i, j = (line.i[0], line.j[0]) if way < 0 else (line.i[1], line.j[1])
    length = _BEYOND * (line.i[1] - line.i[0])
    rows = np.arange(i, max(-1, i - length) if way < 0 else min(len(one.signs), i + length), way)
    others = np.rint(line.at(rows)).astype(np.int64)
    rows = rows[(others >= 0) & (others < len(other.signs))]
    alike = _near(one, other, rows, line) <= _ALIKE
    lost = np.convolve(~alike, np.ones(_LOST_ROWS), "valid") == _LOST_ROWS
    end = int(np.argmax(lost)) if lost.any() else len(rows)
    good = np.flatnonzero(alike[:end])
    row = int(rows[good[-1]]) if good.size else i
    return row, round(line.at(row)) if row != i else j


def _moved_on(one: Recording, line: _Line) -> Int[np.ndarray, "k"]:
    """Return the rows on a line that have moved."""
    first, last = np.searchsorted(one.moved, (line.i[0], line.i[1] + 1)).tolist()
    return one.moved[first:last]


def _near(
    one: Recording, other: Recording, rows: Int[np.ndarray, "k"], line: _Line
) -> Float[np.ndarray, "k"]:
    """Compare frames with those on a line and beside it: the rate may not be quite even."""
    on_line = np.rint(line.at(rows)).astype(np.int64)
    others = np.clip(on_line[:, None] + np.array([-1, 0, 1]), 0, len(other.signs) - 1)
    return _differences(one, other, rows[:, None], others).min(axis=1)


def _differences(
    one: Recording, other: Recording, rows: Int[np.ndarray, "k l"], others: Int[np.ndarray, "k m"]
) -> Float[np.ndarray, "k m"]:
    """Return the share of the strong signs that differ; a half where few are strong."""
    return _share(one.fingerprint.hashes[rows], other.fingerprint.hashes[others])


def _share(one: UInt8[np.ndarray, "*n b"], other: UInt8[np.ndarray, "*m b"]) -> Float[np.ndarray, "*k"]:
    both = one[..., _HALF:] & other[..., _HALF:]
    strong = _ONES[both].sum(axis=-1, dtype=np.int64)
    differ = _ONES[(one[..., :_HALF] ^ other[..., :_HALF]) & both].sum(axis=-1, dtype=np.int64)
    return np.where(strong >= _LEAST_BITS, differ / np.maximum(strong, 1), 0.5)


def _moved_rows(hashes: UInt8[np.ndarray, "n b"]) -> Int[np.ndarray, "k"]:
    """Return the rows that differ from the one before them in the list, without those that show nothing."""
    shows = np.flatnonzero(hashes[:, _HALF:].any(axis=1))
    moved: list[int] = []
    k = 0
    while k < len(shows):
        moved.append(int(shows[k]))
        # As many at a time as usually do for the next; a car may stand for long.
        step, found = 8, np.zeros(0, bool)
        while not found.any() and k + 1 < len(shows):
            rows = shows[k + 1 : k + 1 + step]
            found = _share(hashes[moved[-1]], hashes[rows]) > _MOVED
            k, step = (k + int(np.argmax(found)) if found.any() else k + len(rows)), 2 * step
        k += 1
    return np.array(moved, np.int64)
