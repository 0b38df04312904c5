"""Shapes of tracks from known curves, as a map would have them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from datagen.tracks.shape import STEP_CM, SampledLine, TrackShape

LANE_CM = 40.0


def bean(phase: float = 0.6, size_cm: float = 150.0) -> np.ndarray:
    """A closed centre line without any symmetry, 8 to 10 m long."""
    at = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
    radius = size_cm * (1.0 + 0.25 * np.cos(2.0 * at) + 0.12 * np.cos(3.0 * at + phase))
    return np.stack([radius * np.cos(at), radius * np.sin(at)], axis=1)


def oval(long_cm: float = 220.0, short_cm: float = 130.0) -> np.ndarray:
    """A closed centre line that fits itself turned by half a turn."""
    at = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
    return np.stack([long_cm * np.cos(at), short_cm * np.sin(at)], axis=1)


def track(
    centre_cm: np.ndarray,
    start: float = 0.0,
    laps: float = 1.0,
    opposite: bool = False,
    marks_cm: np.ndarray | None = None,
    bend: Callable[[np.ndarray], np.ndarray] | None = None,
) -> TrackShape:
    """A map of a closed track.

    Args:
        centre_cm: Its centre line.
        start: Where the drive begins, as a share of the lap.
        laps: How far it goes; 1 is the whole lap.
        opposite: Drive the other way, in the same lane.
        marks_cm: Marks beside the lines, with normals along x.
        bend: Moves points, as a map that is not quite right.
    """
    closed = laps >= 1.0
    first = round(start * len(centre_cm))
    rows = (first + np.arange(round(min(laps, 1.0) * len(centre_cm)))) % len(centre_cm)
    along = np.roll(centre_cm, -1, axis=0) - np.roll(centre_cm, 1, axis=0)
    along /= np.hypot(*along.T)[:, None]
    xy, tangent = centre_cm[rows], along[rows]
    if opposite:
        xy, tangent = xy[::-1], -tangent[::-1]
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    lines = tuple(
        _line(index, _bent(xy + aside * LANE_CM * left, bend), closed)
        for index, aside in enumerate((0.5, -0.5))
    )
    marks = np.empty((0, 2)) if marks_cm is None else _bent(marks_cm, bend)
    return TrackShape(
        "known", LANE_CM, lines, _bent(xy[::10], bend), marks, np.tile([1.0, 0.0], (len(marks), 1))
    )


def _bent(xy: np.ndarray, bend: Callable[[np.ndarray], np.ndarray] | None) -> np.ndarray:
    return xy if bend is None else bend(xy)


def _line(index: int, xy: np.ndarray, closed: bool) -> SampledLine:
    ends = np.concatenate([xy, xy[:1]]) if closed else xy
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ends, axis=0).T))])
    s = np.arange(0.0, along[-1], STEP_CM)
    points = np.stack([np.interp(s, along, axis) for axis in ends.T], axis=1)
    tangent = np.gradient(points, axis=0)
    tangent /= np.hypot(*tangent.T)[:, None]
    return SampledLine(index, points, tangent, np.ones(len(s), dtype=bool), closed, np.full(len(s), 0.2))
