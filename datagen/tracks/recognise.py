"""Whether two maps are of one track: their lines decide, and where these leave more than one way, looks do.

A wrong join spoils two good maps, a refused one costs a command: what is not certain is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from datagen.slam.loops.revisits import similarities, thumbnails
from datagen.tracks.align import Alignment, alignments
from datagen.tracks.shape import TrackShape, longest_segment
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.geometry.frames import wrap_angle

Answer = Literal["same", "different", "ambiguous", "undetermined"]

#: Lines agree where they are this close, in lane widths: maps of one track bend by 2 cm against each other.
#: Share of the lines that must agree. Measured on 3540 pairs of different closed roads of one lane width and
#: of lengths within 10 %: 0.81 at most; on 80 pairs of maps of one road, bent at random by 1.5 cm and with
#: gaps, 0.92 at least, on three pairs of halves of ``garage_tape`` 1.00. The rest may have been laid anew.
AGREE_LANES, _AGREE = 0.1, 0.86
#: Another alignment is a rival unless it leaves so many times as much of the lines unexplained as the best
#: one, and this share more. Chosen: a symmetric track leaves about the same twice.
_RIVAL_TIMES, _RIVAL_SHARE = 3.0, 0.08
#: Share of the smaller and of the larger map's lines that both must know. Chosen: a drive of half a lap is
#: joined to one of a whole lap; two drives that only share a corner are not.
_SHARED = (0.7, 0.3)
#: Sigma to which the lines must leave every place, in lane widths. Chosen: less than a line's own marking.
_SLACK_LANES = 0.08
#: Marks of both maps are the same if they are this close, [cm], and face the same way (cosine). Chosen: twice
#: the scatter of two maps about each other.
_MARK_CM, _MARK_COSINE = 3.0, 0.8
#: Side of the squares of floor of which each counts as one witness, [cm]: edges of one thing go together.
_WITNESS_CM = 12.0
#: Looks decide if they favour one alignment by so many sigmas of chance. Chosen: a wrong join is the worst
#: fault, and true ones reach more.
_SIGMAS = 4.0
#: Least difference of the mean correlation of images, and least number of frames that are compared. Measured
#: on two halves of ``garage_tape``: 0.5 at the same places, 0 elsewhere.
_LIKER, _LEAST_IMAGES, _IMAGE_EVERY = 0.1, 20, 5
#: Looks confirm an alignment if this share of the marks is there, of so many witnesses, or if images are this
#: much alike. Measured there: 0.96 and 0.5 where it is right, 0 turned by half a turn.
_CONFIRMED_MARKS, _LEAST_WITNESSES, _CONFIRMED_LIKE = 0.4, 8, 0.3
#: Frames show the same place if the cars stood this close, in lane widths, and looked the same way, [rad].
_NEAR_LANES, _NEAR_RAD = 0.35, 0.3


@dataclass(frozen=True)
class Recognised:
    """Whether two maps are of one track.

    Attributes:
        answer: ``same``, ``different``; ``ambiguous`` where they fit in more than one way; ``undetermined``
            where the shape leaves open where one lies on the other, as on a straight road.
        sentence: What that comes from.
        alignment: How the first map lies on the second; None where none was found.
    """

    answer: Answer
    sentence: str
    alignment: Alignment | None = None


def recognise(
    first: TrackShape,
    second: TrackShape,
    drives: tuple[MappedDrive, MappedDrive] | None = None,
) -> Recognised:
    """Decide whether two maps are of one track.

    Args:
        first: Shape of one map.
        second: Shape of the other one.
        drives: The maps with their drives, whose images may decide; None if they are not there.
    """
    found = alignments(first, second)
    lane_cm = second.lane_cm
    fitting = sorted(
        (one for one in found if _overlap(one)), key=lambda one: -one.agreeing(AGREE_LANES * lane_cm)
    )
    if not fitting or fitting[0].agreeing(AGREE_LANES * lane_cm) < _AGREE:
        return Recognised("different", _unlike(found, lane_cm), found[0] if found else None)
    best = fitting[0]
    left = _RIVAL_TIMES * (1.0 - best.agreeing(AGREE_LANES * lane_cm)) + _RIVAL_SHARE
    likely = [one for one in fitting if 1.0 - one.agreeing(AGREE_LANES * lane_cm) < left]
    if len(likely) > 1:
        chosen = _by_looks(first, second, likely, drives)
        if chosen is None:
            sentence = (
                f"the lines fit in {len(likely)} ways, and neither marks beside them nor the images tell "
                "which is right"
            )
            return Recognised("ambiguous", sentence, best)
        best = chosen
        if best.agreeing(AGREE_LANES * lane_cm) < _AGREE:
            return Recognised("different", _unlike([best], lane_cm), best)
    if best.slack_cm > _SLACK_LANES * lane_cm:
        sentence = (
            f"the lines can be shifted along each other by {best.slack_cm:.1f} cm (sigma): the road that "
            "both drives have in common has too few bends"
        )
        return Recognised("undetermined", sentence, best)
    if not (first.closed and second.closed) and not _confirmed(first, second, best, drives):
        sentence = (
            "the lines agree, but not both maps hold a whole lap, of parts there are many alike, and neither "
            "marks beside the lines nor the images confirm that these are the same"
        )
        return Recognised("undetermined", sentence, best)
    return Recognised("same", agreement_text(best, lane_cm), best)


def agreement_text(one: Alignment, lane_cm: float) -> str:
    """Say how two maps lie on each other."""
    opposite = ", driven in opposite directions" if one.opposite else ""
    agree = 100.0 * one.agreeing(AGREE_LANES * lane_cm)
    return (
        f"{agree:.0f} % of the lines that both maps know agree within {AGREE_LANES * lane_cm:.1f} cm "
        f"(95 % within {one.p95_cm:.1f} cm), scale {one.move.scale:.3f}{opposite}"
    )


def _overlap(one: Alignment) -> bool:
    return max(one.shared) >= _SHARED[0] and min(one.shared) >= _SHARED[1]


def _unlike(found: Sequence[Alignment], lane_cm: float) -> str:
    if not found:
        return "the lines have different shapes"
    one = found[0]
    if not _overlap(one):
        return f"at best {100.0 * min(one.shared):.0f} % of the lines lie where the other map has any"
    agree = 100.0 * one.agreeing(AGREE_LANES * lane_cm)
    return f"at best {agree:.0f} % of the lines agree, expected {100.0 * _AGREE:.0f} %"


def _confirmed(
    first: TrackShape,
    second: TrackShape,
    one: Alignment,
    drives: tuple[MappedDrive, MappedDrive] | None,
) -> bool:
    """Whether marks or images say that two maps that lie like this show the same place."""
    share, witnesses = _marks(first, second, one)
    if share >= _CONFIRMED_MARKS and witnesses >= _LEAST_WITNESSES:
        return True
    if drives is None:
        return False
    like = _likeness(drives, one, [thumbnails(mapped.drive) for mapped in drives])
    return len(like) >= _LEAST_IMAGES and float(np.mean(like)) >= _CONFIRMED_LIKE


def _by_looks(
    first: TrackShape,
    second: TrackShape,
    rivals: list[Alignment],
    drives: tuple[MappedDrive, MappedDrive] | None,
) -> Alignment | None:
    """Choose between alignments by marks beside the lines and by images; None where these do not decide."""
    votes = [_sigmas(*(_marks(first, second, one) for one in rivals))]
    if drives is not None:
        votes.append(_image_sigmas(drives, rivals))
    total = np.sum(votes, axis=0)
    best = int(np.argmax(total))
    others = np.delete(total, best)
    if total[best] - others.max() < _SIGMAS or any(vote[best] < vote.max() - 1.0 for vote in votes):
        return None
    return rivals[best]


def _marks(first: TrackShape, second: TrackShape, one: Alignment) -> tuple[float, int]:
    """Share of the first map's marks near the second one's path that it has, and their witnesses."""
    if not len(first.marks_cm) or not len(second.marks_cm):
        return 0.0, 0
    at, facing = one.move.points(first.marks_cm), one.move.directions(first.mark_normals)
    near = second.surveyed(at, 0.5)
    if not near.any():
        return 0.0, 0
    tree = cKDTree(second.marks_cm)
    around = tree.query_ball_point(at[near], _MARK_CM)
    met = [
        bool(len(rows)) and bool((second.mark_normals[rows] @ normal).max() > _MARK_COSINE)
        for rows, normal in zip(around, facing[near], strict=True)
    ]
    witnesses = len(np.unique(np.floor(at[near] / _WITNESS_CM).astype(np.int64), axis=0))
    return float(np.mean(met)), witnesses


def _sigmas(*shares: tuple[float, int]) -> Float[np.ndarray, "r"]:
    """By how many sigmas of chance each share exceeds their mean."""
    share = np.array([one[0] for one in shares])
    count = max(min(one[1] for one in shares), 1)
    mean = float(share.mean())
    sigma = np.sqrt(max(mean * (1.0 - mean), 0.01) * 2.0 / count)
    return np.asarray((share - mean) / sigma)


def _image_sigmas(
    drives: tuple[MappedDrive, MappedDrive], rivals: Sequence[Alignment]
) -> Float[np.ndarray, "r"]:
    """By how many sigmas the images speak for each alignment; they say nothing of opposite directions."""
    thumbs = [thumbnails(mapped.drive) for mapped in drives]
    likes = [_likeness(drives, rival, thumbs) for rival in rivals]
    if min(len(like) for like in likes) < _LEAST_IMAGES:
        return np.zeros(len(rivals))
    means = [float(np.mean(like)) for like in likes]
    # Frames of one place count once: a quarter of them stands for all.
    sigma = [float(np.std(like)) / np.sqrt(0.25 * len(like)) for like in likes]
    mean = np.array(means)
    if mean.max() - np.sort(mean)[-2] < _LIKER:
        return np.zeros(len(rivals))
    return np.asarray((mean - mean.mean()) / max(*sigma, 0.01))


def _likeness(
    drives: tuple[MappedDrive, MappedDrive], one: Alignment, thumbs: list[Float[np.ndarray, "n d"]]
) -> list[float]:
    """Correlation of the images that an alignment has at one place; none of opposite directions."""
    if one.opposite:
        return []
    a, b = drives
    return [
        float(similarities(thumbs[0][a.rows[[i]]], thumbs[1][b.rows[[j]]])[0, 0])
        for i, j in same_places(a, b, one)
    ]


def same_places(a: MappedDrive, b: MappedDrive, one: Alignment) -> list[tuple[int, int]]:
    """Pairs of frames, as positions in the maps, that an alignment has at one place and heading."""
    (rows_a, poses_a), (rows_b, poses_b) = (_longest(mapped) for mapped in (a, b))
    moved = one.move.poses(poses_a)[::_IMAGE_EVERY]
    pairs = []
    near_cm = _NEAR_LANES * b.drive_map.meta.mapped_lane_cm
    for row, pose in zip(rows_a[::_IMAGE_EVERY], moved, strict=True):
        apart = np.hypot(*(poses_b[:, :2] - pose[:2]).T)
        apart = np.where(np.abs(wrap_angle(poses_b[:, 2] - pose[2])) < _NEAR_RAD, apart, np.inf)
        k = int(np.argmin(apart))
        if apart[k] < near_cm:
            pairs.append((int(row), int(rows_b[k])))
    return pairs


def _longest(mapped: MappedDrive) -> tuple[np.ndarray, np.ndarray]:
    """Frames of the longest segment, as positions in the map, and their poses."""
    rows = np.flatnonzero(mapped.drive_map.segment == longest_segment(mapped.drive_map))
    return rows, mapped.drive_map.poses[rows]
