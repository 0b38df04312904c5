"""Seeded changes of samples on their edge points, in cm, with labels that stay exact.

The points are moved, dropped and joined by clutter before they become a raster, so that a turned road has
edges as sharp as a straight one, and the labels of the moved car follow from the lane lines themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import mirror_points, rows_of_polyline
from lanenet.learn.config import AugmentSettings

Lines = tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 2"]]

_SEGMENT_CM = (4.0, 40.0)
_STRETCH_CM = (4.0, 20.0)
#: Both edges of a wide tape, and what a blurred frame puts beside them.
_LINE_REACH_CM = 4.0
#: A line is seen if at least this many edge points lie this close to it.
_PRESENT_POINTS = 12
_PRESENT_REACH_CM = 3.0


@dataclass(frozen=True)
class _View:
    """Where the car of a changed sample stands: new point = point @ matrix + offset."""

    mirror: bool
    matrix: Float[np.ndarray, "2 2"]
    offset_cm: Float[np.ndarray, "2"]

    def move(self, points_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Express points of the recorded car frame in the frame of the moved car, [cm]."""
        return points_cm @ self.matrix + self.offset_cm


def make_view(mirror: bool, shift_cm: float, turn_rad: float) -> _View:
    """Place the car anew: the road is mirrored, then the car is moved to the right and turned to the left.

    Args:
        mirror: Swap left and right.
        shift_cm: Way of the front axle to the right, [cm].
        turn_rad: Turn about the front axle, [rad], positive left.
    """
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    sign = -1.0 if mirror else 1.0
    matrix = np.array([[sign * c, -sign * s], [s, c]])
    return _View(mirror, matrix, np.array([-shift_cm * c, shift_cm * s]))


def augment_batch(
    edges_cm: Sequence[Float[np.ndarray, "_ 2"]],
    lines_cm: Sequence[Lines],
    points_cm: Float[np.ndarray, "b 6"],
    rngs: Sequence[np.random.Generator],
    window: BirdseyeWindow,
    settings: AugmentSettings,
) -> tuple[UInt8[np.ndarray, "b 1 r c"], Float[np.ndarray, "b 6"], Float[np.ndarray, "b 2"]]:
    """Change each sample of a batch by its own draw.

    Args:
        edges_cm: Edge points of each sample, frame car.
        lines_cm: Left and right lane line of each sample, in the direction of travel, frame car.
        points_cm: Labels of each sample; a point that is masked here stays masked.
        rngs: One generator per sample.
        window: Grid of the rasters.
        settings: What is changed, and how much.

    Returns:
        Rasters of 0 and 255; labels, [cm], NaN where masked; 1 for each line that can be seen, else 0.
    """
    size = len(edges_cm)
    present = np.empty((size, 2), np.float32)
    rasters = np.zeros((size, 1, window.rows, window.columns), np.uint8)
    labels = np.empty((size, 6), np.float32)
    for i in range(size):
        rng = rngs[i]
        view = _draw_view(settings, rng)
        labels[i] = window.labelled(labels_of_view(points_cm[i], lines_cm[i], view))
        keep = _draw_kept(edges_cm[i], lines_cm[i], window, settings, rng)
        moved = view.move(edges_cm[i][keep])
        left, right = (view.move(line) for line in (lines_cm[i][::-1] if view.mirror else lines_cm[i]))
        present[i] = lines_present(moved, (left, right), window)
        if settings.jitter_cm > 0.0:
            moved += settings.jitter_cm * rng.standard_normal(moved.shape, dtype=np.float32)
        extra = _draw_clutter(window, settings, rng)
        window.rasterise(np.concatenate([moved, extra]), out=rasters[i, 0])
    return rasters, labels, present


def labels_of_view(points_cm: Float[np.ndarray, "6"], lines_cm: Lines, view: _View) -> Float[np.ndarray, "6"]:
    """Return the labels that a moved car has, from the lane lines, [cm].

    A point that the label set masks stays masked: its map does not vouch for that stretch of the line.
    """
    moved = [view.move(line) for line in (lines_cm[::-1] if view.mirror else lines_cm)]
    known = np.isfinite(mirror_points(points_cm) if view.mirror else points_cm)
    labels = np.concatenate([rows_of_polyline(line) for line in moved])
    return np.where(known, labels, np.nan)


def _draw_view(settings: AugmentSettings, rng: np.random.Generator) -> _View:
    mirror, shift, turn = rng.random(3).tolist()
    return make_view(
        mirror < settings.mirror,
        (2.0 * shift - 1.0) * settings.shift_cm,
        (2.0 * turn - 1.0) * settings.rotate_rad,
    )


def _draw_kept(
    edges_cm: Float[np.ndarray, "m 2"],
    lines_cm: Lines,
    window: BirdseyeWindow,
    settings: AugmentSettings,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "m"]:
    """Decide which edge points stay: some drop singly, some by a stretch, some with their line."""
    share, stretch, line, side = rng.random(4).tolist()
    keep: np.ndarray = rng.random(len(edges_cm), dtype=np.float32) >= share * settings.drop_points
    if stretch < settings.missing_stretch and len(edges_cm):
        centre = edges_cm[rng.integers(len(edges_cm))]
        radius = rng.uniform(*_STRETCH_CM)
        # A ring about the car hides a band of road right across; a disc hides a piece of one line.
        if rng.random() < 0.5:
            distance = np.hypot(edges_cm[:, 0] - centre[0], edges_cm[:, 1] - centre[1])
        else:
            distance = np.abs(np.hypot(edges_cm[:, 0], edges_cm[:, 1]) - np.hypot(centre[0], centre[1]))
            radius *= 0.5
        keep &= distance > radius
    if line < settings.missing_line:
        keep &= ~_near_line(edges_cm, lines_cm[int(side < 0.5)], window)
    return keep


def lines_present(
    edges_cm: Float[np.ndarray, "m 2"], lines_cm: Lines, window: BirdseyeWindow
) -> Float[np.ndarray, "2"]:
    """Tell which lines can be seen: 1 for a line with enough edge points along it in the window, else 0.

    NaN for a line whose course is not known, as in labels from a simulator's truth.

    Args:
        edges_cm: Edge points of the road, without those of other things, frame car.
        lines_cm: Left and right lane line, frame car.
        window: Grid of the raster.
    """
    near = [_near_line(edges_cm, line, window, _PRESENT_REACH_CM) for line in lines_cm]
    known = [np.isfinite(line).all(axis=1).sum() > 1 for line in lines_cm]
    seen = [n.sum() >= _PRESENT_POINTS for n in near]
    return np.where(known, seen, np.nan).astype(np.float32)


def _near_line(
    edges_cm: Float[np.ndarray, "m 2"],
    line_cm: Float[np.ndarray, "k 2"],
    window: BirdseyeWindow,
    reach_cm: float = _LINE_REACH_CM,
) -> Bool[np.ndarray, "m"]:
    """True for points inside the window within about ``reach_cm`` of a polyline.

    The line is painted as a band on the window's grid and each point looks up its cell: a frame has some
    hundred points and segments, and comparing all pairs costs a thousand times as much.
    """
    band = np.zeros((window.rows, window.columns), np.uint8)
    whole = np.isfinite(line_cm).all(axis=1)
    pieces = np.split(line_cm, np.flatnonzero(~whole))
    # OpenCV takes (column, row) in whole numbers; four fractional bits keep a sixteenth of a cell.
    for piece in pieces:
        cells = window.cells(piece[np.isfinite(piece).all(axis=1)])
        corners = np.rint(np.clip(cells[:, ::-1], -1e4, 1e4) * 16.0).astype(np.int32)
        thickness = max(1, round(2.0 * reach_cm / window.cell_cm))
        cv2.polylines(band, [corners.reshape(-1, 1, 2)], False, 255, thickness, cv2.LINE_8, 4)
    row, column = np.rint(window.cells(edges_cm)).astype(np.intp).T
    inside = (row >= 0) & (row < window.rows) & (column >= 0) & (column < window.columns)
    near = np.zeros(len(edges_cm), bool)
    near[inside] = band[row[inside], column[inside]] > 0
    return near


def _draw_clutter(
    window: BirdseyeWindow, settings: AugmentSettings, rng: np.random.Generator
) -> Float[np.ndarray, "m 2"]:
    """Draw edge points of things that are not lanes: straight edges and single points, [cm], frame car."""
    n_segments = int(rng.integers(settings.clutter_segments + 1))
    n_points = int(rng.integers(settings.clutter_points + 1))
    low = np.array([window.left_cm, window.near_cm])
    size = np.array([window.right_cm, window.far_cm]) - low
    ends = low + rng.random((n_segments + n_points, 2)) * size
    centre, single = ends[:n_segments], ends[n_segments:]
    if n_segments:
        direction = rng.random(n_segments) * np.pi
        half = 0.5 * rng.uniform(*_SEGMENT_CM, n_segments)
        # As dense as the raster: no holes in the segment.
        t = np.linspace(-1.0, 1.0, int(_SEGMENT_CM[1] / window.cell_cm))
        along = np.stack([np.cos(direction), np.sin(direction)], axis=1) * half[:, None]
        segments = centre[:, None, :] + t[None, :, None] * along[:, None, :]
        single = np.concatenate([segments.reshape(-1, 2), single])
    return single.astype(np.float32)
