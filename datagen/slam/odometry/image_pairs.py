"""Images of a drive in pairs: how well a step and a turn carry the edges of one onto those of the next."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from copy import copy
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from pydantic import Field

from datagen.slam.commands import MOST_BRIDGED
from lanenet.config import Settings
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.pixels import EdgePixels

#: Directions that edges are told apart by; each edge counts for the two nearest.
SECTORS = 8
#: Pixels around an edge in which it is found: four standard deviations of its place.
REACH = 2
#: Spacing of the grid of road points whose pixels are looked up instead of projected, in camera heights, and
#: its reach. Chosen: 7 camera heights are 1 to 1.5 m; further away a pixel spans too much road.
_CELL_HEIGHTS, _REACH_HEIGHTS = 0.05, 7.0
#: Directions on the road of which equal numbers of points are drawn: along, across and both diagonals.
_DIRECTIONS = 4
#: Sigmas that a far edge moves from one turn of the grid to the next. Chosen: about the width of a peak.
_TURN_SIGMAS = 1.2
#: Share of an image's points that must stay in view for their match to count. Chosen: few points fit
#: anywhere.
_LEAST_SEEN = 0.5
#: Entries per pixel in the table of gains, and the longest distance from an edge in it: within ``REACH`` of
#: the edge's pixel in either direction, and half a pixel on either side. Chosen: between entries, a line is
#: 2e-5 off.
_PER_PX, _FARTHEST_PX = 256.0, 1.5 * (REACH + 1.0)
#: Type of an index: unsigned, so that numba need not check for indices from the end.
U = np.uint32
#: Image width up to which an edge's place is known to the same fraction of a pixel; beyond, blur grows with
#: it.
_FINE_WIDTH = 320


class OdometrySettings(Settings):
    """How images are compared, and what is assumed of the motion between them.

    Values were chosen on ``donkey_circuit``, ``usi_mat`` and ``garage_tape`` and on simulated drives
    (docs/mapping.md) unless another source is named.

    Attributes:
        lags: Frames between the images of a pair. Dashes resolve motion between close frames only.
        points: Edge points of the earlier image that are compared.
        sigma_px: Standard deviation of an edge's place across itself, for images up to 320 px wide.
        gain: How much likelier a point of the road falls on an edge of the later image than off it.
        unseen_share: Match of a point that leaves the view, as a share of the best mean match of its pair of
            images with the same step. With less, short steps win, since they lose fewer points; with more,
            sharp turns in blurred images are lost.
        temper: Power of the likelihood, since neighbouring points and the lags share their errors.
        known_spread: Spread of the speed about the recorded one times its gain, as a logarithm.
        known_keep: Share of that deviation which stays until the next frame.
        unknown_spread: The same where no speed was recorded.
        unknown_keep: The same where no speed was recorded.
        turn_walk_rad: Standard deviation of the change of turn from frame to frame.
        steering_heights: Standard deviation of the curvature about the steering's prediction, times camera
            height.
        jump: Probability that the step changes to any other.
        max_curvature_heights: Tightest curve times camera height.
    """

    lags: tuple[int, ...] = (1, 2, 4)
    points: int = Field(default=80, ge=20)
    sigma_px: float = Field(default=0.5, gt=0.0)
    gain: float = Field(default=10.0, gt=0.0)
    unseen_share: float = Field(default=0.6, ge=0.0, le=1.0)
    temper: float = Field(default=0.02, gt=0.0)
    known_spread: float = Field(default=0.05, gt=0.0)
    known_keep: float = Field(default=0.95, gt=0.0, lt=1.0)
    unknown_spread: float = Field(default=0.2, gt=0.0)
    unknown_keep: float = Field(default=0.99, gt=0.0, lt=1.0)
    turn_walk_rad: float = Field(default=0.008, gt=0.0)
    steering_heights: float = Field(default=0.03, gt=0.0)
    jump: float = Field(default=0.01, gt=0.0, lt=1.0)
    max_curvature_heights: float = Field(default=0.6, gt=0.0)


class Image(NamedTuple):
    """Edges of a frame, and the points among them that are compared with later frames.

    Attributes:
        points: Points ahead and left of the rear axle, camera heights.
        sector: Sector of each.
        uv: Edge pixels.
        lines: The line along each edge: unit gradient n and n . uv.
        edge_sector: Direction of each in sectors, as a real number.
    """

    points: Float[np.ndarray, "m 2"]
    sector: Int[np.ndarray, "m"]
    uv: Float[np.ndarray, "e 2"]
    lines: Float[np.ndarray, "e 3"]
    edge_sector: Float[np.ndarray, "e"]


class RoadGrid(NamedTuple):
    """Pixels of road points, to be looked up instead of projected; lengths in camera heights.

    Attributes:
        pixel_of: Pixel of each point of a grid on the road, NaN where the camera does not see it.
        origin: Ahead and left of the grid's first point.
        cell: Its spacing.
    """

    pixel_of: Float[np.ndarray, "a l 2"]
    origin: Float[np.ndarray, "2"]
    cell: float


class _EdgeIndex(threading.local):
    """See :func:`index_edges`; each thread compares frames of its own."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.nearest, self.distance = np.empty(shape, np.int32), np.empty(shape, np.float32)
        self.frame: int | None = None


class ImagePairs:
    """The edges of a drive, ready to be compared in pairs; lengths are in camera heights."""

    def __init__(
        self,
        edges: Sequence[EdgePixels],
        camera: Camera,
        settings: OdometrySettings,
        rng: np.random.Generator,
        periods: Float[np.ndarray, "n"] | None = None,
    ) -> None:
        """Draw the points that are compared.

        Args:
            edges: Edge pixels per frame, only such that see the road.
            camera: The camera.
            settings: How images are compared.
            rng: Draws the points.
            periods: Time from the frame before to each frame, in typical time steps; None for a drive without
                gaps.
        """
        self.periods = np.ones(len(edges)) if periods is None else periods
        self.settings, self._camera = settings, camera
        self._sigma_px = settings.sigma_px * max(1.0, camera.width / _FINE_WIDTH)
        m = camera.mounting
        ahead = np.arange(0.0, _REACH_HEIGHTS + m.lead_cm / m.height_cm, _CELL_HEIGHTS)
        left = np.arange(-_REACH_HEIGHTS, _REACH_HEIGHTS, _CELL_HEIGHTS)
        grid_cm = camera.mounting.height_cm * np.stack(np.meshgrid(ahead, left, indexing="ij"), -1)
        car_cm = np.stack([-grid_cm[..., 1], grid_cm[..., 0] - camera.wheelbase_cm], axis=-1)
        pixel_of = camera.project_ground(car_cm.reshape(-1, 2)).reshape(car_cm.shape)
        self._grid = RoadGrid(pixel_of, np.array([ahead[0], left[0]]), _CELL_HEIGHTS)
        self.height_cm = camera.mounting.height_cm
        self._images = self._drawn(edges, rng)
        self._gain_at = gains(self._sigma_px, settings.gain)
        self._index = _EdgeIndex((SECTORS, camera.height, camera.width))

    def __len__(self) -> int:
        return len(self._images)

    def with_periods(self, periods: Float[np.ndarray, "n"]) -> ImagePairs:
        """Return the same images with other times between them, in typical time steps."""
        other = copy(self)
        other.periods = periods
        return other

    @property
    def points_per_frame(self) -> float:
        """Mean number of points in the comparison of a frame with those before it, where there are any."""
        drawn = [len(image.points) for image in self._images if len(image.points)]
        return max(len(self.settings.lags) * sum(drawn) / max(len(drawn), 1), 1.0)

    @property
    def turn_step_rad(self) -> float:
        """Difference of two turns that the images can just tell apart."""
        return float(_TURN_SIGMAS * self._sigma_px / self._camera.K[0, 0])

    def _drawn(self, edges: Sequence[EdgePixels], rng: np.random.Generator) -> list[Image]:
        """Draw equal numbers of points of every direction on the road from each frame.

        Source:
            Rusinkiewicz and Levoy 2001, "Efficient variants of the ICP algorithm", section 3.1 (normal-space
            sampling): lines along the road are most of the edges and say nothing about the distance along it.
        """
        # All frames at once: a call costs as much as hundreds of points.
        uv = np.concatenate([np.empty((0, 2)), *(pixels.uv_px for pixels in edges)])
        normals = np.concatenate([np.empty((0, 2)), *(pixels.normals for pixels in edges)])
        lines = np.column_stack([normals, np.sum(uv * normals, axis=1)])
        sector = np.arctan2(normals[:, 1], normals[:, 0]) * (SECTORS / (2.0 * np.pi)) % SECTORS
        along = np.stack([-normals[:, 1], normals[:, 0]], axis=1)
        road, beside = self._camera.intersect_ground(np.concatenate([uv, uv + 0.5 * along])).reshape(2, -1, 2)
        tangent = beside - road
        good = np.isfinite(road).all(axis=1) & np.isfinite(tangent).all(axis=1)
        angle = np.arctan2(tangent[good, 1], tangent[good, 0])
        direction = np.full(len(uv), -1)
        direction[good] = np.rint(angle * (_DIRECTIONS / np.pi)).astype(np.int64) % _DIRECTIONS
        points = np.stack([road[:, 1] + self._camera.wheelbase_cm, -road[:, 0]], axis=1) / self.height_cm
        whole_sector = np.rint(sector).astype(np.int64) % SECTORS
        each = self.settings.points // _DIRECTIONS
        images, start = [], 0
        for pixels in edges:
            frame = slice(start, start + len(pixels.uv_px))
            start = frame.stop
            drawn = []
            for number in range(_DIRECTIONS):
                candidates = np.flatnonzero(direction[frame] == number)
                drawn.append(rng.choice(candidates, min(each, len(candidates)), replace=False))
            chosen = frame.start + np.concatenate(drawn)
            images.append(Image(points[chosen], whole_sector[chosen], uv[frame], lines[frame], sector[frame]))
        return images

    def fit(
        self,
        k: int,
        steps: Float[np.ndarray, "w"],
        turns_rad: Float[np.ndarray, "t"] | Float[np.ndarray, "w t"],
        relative: Float[np.ndarray, "n"],
        lags: Sequence[int] | None = None,
        typical_turns_rad: Float[np.ndarray, "n"] | None = None,
    ) -> Float[np.ndarray, "w t"]:
        """Compare frame k with those before it, for every step and turn.

        Frames beyond what images bridge are not compared.

        Args:
            k: Frame.
            steps: Typical step lengths to try.
            turns_rad: Turns in a typical time step before frame k, the same for every step or others; NaN for
                none, with a fit of 0.
            relative: Step length of each frame relative to the typical one.
            lags: Frames between the images of a pair; None for those of the settings.
            typical_turns_rad: About the turn in a typical time step before each frame, for the differences
                between frame k and the frames before it. None where all turns are alike.

        Returns:
            Log likelihood up to a constant, not tempered.
        """
        s, later = self.settings, self._images[k]
        tried_rad = np.array(np.broadcast_to(turns_rad, (len(steps), turns_rad.shape[-1])))
        out, seen_fit, unseen = (np.zeros(tried_rad.shape) for _ in range(3))
        index = self._index
        if index.frame != k:
            index_edges(later.uv, later.edge_sector, index.nearest, index.distance)
            index.frame = k
        for lag in s.lags if lags is None else lags:
            if lag > k:
                continue
            between = slice(k - lag + 1, k + 1)
            time = self.periods[between]
            if time.sum() > MOST_BRIDGED:
                continue
            earlier = self._images[k - lag]
            turned = 0.0
            if typical_turns_rad is not None:
                turned = float(np.sum(time * (typical_turns_rad[between] - typical_turns_rad[k])))
            distances = relative[between].sum() * steps
            turns = time.sum() * tried_rad + turned
            fit_of_motions(
                earlier,
                later,
                index.nearest,
                self._grid,
                distances,
                turns,
                self._gain_at,
                seen_fit,
                unseen,
            )
            count = len(earlier.points)
            seen = count - unseen
            enough = seen >= max(_LEAST_SEEN * count, 1.0)
            best = np.where(enough, seen_fit / np.maximum(seen, 1.0), 0.0).max(axis=1, keepdims=True)
            out += seen_fit + s.unseen_share * best * unseen
        return out


def turns_up_to(most_rad: float, step_rad: float) -> Float[np.ndarray, "t"]:
    """Return evenly spaced turns, as many to the left as to the right."""
    half = int(np.ceil(most_rad / step_rad))
    return step_rad * np.arange(-half, half + 1)


def gains(sigma_px: float, gain: float) -> Float[np.ndarray, "g 2"]:
    """Tabulate the log likelihood ratio of a point on and off an edge, by its distance from the edge.

    Args:
        sigma_px: Standard deviation of an edge's place across itself.
        gain: How much likelier a place is on an edge than off it.

    Returns:
        The value at every ``1 / _PER_PX`` pixels, and by how much the next one exceeds it.
    """
    off_px = np.arange(int(_FARTHEST_PX * _PER_PX) + 2) / _PER_PX
    values = np.log1p(gain * np.exp(-0.5 * (off_px / sigma_px) ** 2))
    return np.column_stack([values[:-1], np.diff(values)])


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def index_edges(uv, sector, nearest, distance):
    """Find for each pixel and sector the nearest edge around it.

    Args:
        uv: Edge pixels of a frame.
        sector: Direction of each in sectors, as a real number.
        nearest: Filled: index of the edge, -1 without one.
        distance: Filled: of the same shape, squared distances.
    """
    nearest[:] = -1
    distance[:] = 1e9
    _, height, width = nearest.shape
    for q in range(uv.shape[0]):
        u0, v0 = int(np.rint(uv[q, 0])), int(np.rint(uv[q, 1]))
        first = int(np.floor(sector[q]))
        for v in range(max(v0 - REACH, 0), min(v0 + REACH + 1, height)):
            for u in range(max(u0 - REACH, 0), min(u0 + REACH + 1, width)):
                d = (u - uv[q, 0]) ** 2 + (v - uv[q, 1]) ** 2
                for s in (first % SECTORS, (first + 1) % SECTORS):
                    if d < distance[s, v, u]:
                        distance[s, v, u] = d
                        nearest[s, v, u] = q


@njit(cache=True, error_model="numpy", nogil=True)
@no_type_check
def fit_of_motions(earlier, later, nearest, grid, distances, turns, gain_at, out, unseen):
    """Add up how well each motion carries the points of one frame onto the edges of a later one.

    Args:
        earlier: Frame whose points are moved.
        later: Frame whose edges they should meet.
        nearest: See :func:`index_edges`, of the later frame.
        grid: Pixels of road points.
        distances: Distances of the rear axle to try.
        turns: Turns to try with each of them, positive left; NaN for none.
        gain_at: Gain of a point at each distance from its edge, see :func:`gains`.
        out: Filled: sums over the points that stay in view, a row per distance and a column per turn.
        unseen: Filled: of the same shape, number of points that leave the view.
    """
    points, sector, lines = earlier.points, earlier.sector, later.lines
    pixel_of, per_cell = grid.pixel_of, 1.0 / grid.cell
    last_u, last_v = nearest.shape[2] - 1.0, nearest.shape[1] - 1.0
    last_row, last_column = pixel_of.shape[0] - 1.0, pixel_of.shape[1] - 1.0
    x0, y0 = grid.origin[0] * per_cell, grid.origin[1] * per_cell
    one, count = U(1), turns.shape[1]
    #: By turn: its column, cosine and sine, where the car comes from, the sum so far, and points out of view.
    tried, columns = np.empty((6, count)), np.empty(count, np.int64)
    cosines, sines, from_x, from_y, totals, lost = tried[0], tried[1], tried[2], tried[3], tried[4], tried[5]
    for a in range(distances.shape[0]):
        there = 0
        for b in range(count):
            turn = turns[a, b]
            if np.isnan(turn):
                continue
            c, s = np.cos(turn) * per_cell, np.sin(turn) * per_cell
            dx, dy = distances[a] * np.cos(0.5 * turn), distances[a] * np.sin(0.5 * turn)
            from_x[there], from_y[there] = c * dx + s * dy + x0, c * dy - s * dx + y0
            cosines[there], sines[there], columns[there] = c, s, b
            totals[there] = lost[there] = 0.0
            there += 1
        # Point by point: with the next turn, it is near to where it was, and so is what is looked up.
        for p in range(points.shape[0]):
            x, y, facing = points[p, 0], points[p, 1], U(sector[p])
            for b in range(there):
                c, s = cosines[b], sines[b]
                gx, gy = c * x + s * y - from_x[b], c * y - s * x - from_y[b]
                if not (0.0 <= gx < last_row and 0.0 <= gy < last_column):
                    lost[b] += 1.0
                    continue
                ix, iy = np.int32(gx), np.int32(gy)
                tx, ty, i, j = gx - ix, gy - iy, U(ix), U(iy)
                u = pixel_of[i, j, 0] + ty * (pixel_of[i, j + one, 0] - pixel_of[i, j, 0])
                v = pixel_of[i, j, 1] + ty * (pixel_of[i, j + one, 1] - pixel_of[i, j, 1])
                i += one
                far_u = pixel_of[i, j, 0] + ty * (pixel_of[i, j + one, 0] - pixel_of[i, j, 0])
                far_v = pixel_of[i, j, 1] + ty * (pixel_of[i, j + one, 1] - pixel_of[i, j, 1])
                u, v = u + tx * (far_u - u), v + tx * (far_v - v)
                if not (0.0 <= u <= last_u and 0.0 <= v <= last_v):
                    lost[b] += 1.0
                    continue
                q = nearest[facing, U(np.int32(v + 0.5)), U(np.int32(u + 0.5))]
                if q >= 0:
                    off = _PER_PX * abs(u * lines[U(q), 0] + v * lines[U(q), 1] - lines[U(q), 2])
                    entry = np.int32(off)
                    totals[b] += gain_at[U(entry), 0] + (off - entry) * gain_at[U(entry), 1]
        for b in range(there):
            out[a, columns[b]], unseen[a, columns[b]] = totals[b], lost[b]
