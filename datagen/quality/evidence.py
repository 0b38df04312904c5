"""What is known locally about each label of a map: the evidence from which its error is predicted.

The edges of the frames are expressed in the coordinates of the lines: the place along a line, and the
distance d to the right of its middle, seen in the path's direction. A *hit* at d is a border that the marking
would have if its middle were at d. The share of hits in the views of some places is their *profile*: a right
line has its hits at 0, one that is off has them beside it, and one that follows something else, as the rim of
a carpet, has those of one border only.

All features are local and free of units that tell one drive or one kind of road from another.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from numba import njit

from datagen.quality.residuals import COSINE, REACH_CM, frame_edges, in_view, reference_scale
from datagen.slam.camera.coarse import nudged
from datagen.slam.commands import GAP_PERIODS, LONGEST_STEP, MOST_BRIDGED
from datagen.slam.odometry.scans import lift_tilted
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.frame_lines import BEHIND_CM, SAMPLE_CM
from lanenet.data.maps.line import LaneLine
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.geometry.frames import car_from_map
from lanenet.geometry.lane import N_POINTS, ROWS_CM, row_crossings
from lanenet.geometry.poses import path_lengths

#: Length of a place, and width of a bin across. Chosen: a tenth of a dash, a quarter of a narrow line.
PLACE_CM, _BIN_CM = 2.0, 0.5
#: Distance along the road between frames that are looked at. Chosen: ten of them see each place.
_FRAMES_CM = 3.0
#: Largest distance across that is looked at: in cm, and in lane widths, where the lane's middle begins.
_BESIDE_CM, _BESIDE_LANES = 16.0, 0.4
#: Largest distance of a border that is met: in cm, and in pixels of an image 160 px wide where that is more.
#: Chosen: two to three times the residuals of good maps.
_MET_CM, _MET_PX = 0.75, 2.0
#: Least distance of a border that rivals the line, and largest one that counts for the line's offset. Chosen:
#: labels with 1.5 cm are not worth having, and a line that is off by more has lost its marking.
_RIVAL_CM, _OFFSET_CM = 1.5, 3.5
#: Half the windows, in places: of one frame, of a pass, of what lies beside the line everywhere, and of the
#: places where it is met. Chosen: what is seen 7 or 10 cm from a label is of the same piece of tape.
_OWN, _PASS, _AROUND, _NEAR = 3, 5, 30, 2
#: Distances along the line beyond this are alike, [cm]. Chosen: two lane widths.
_FAR_CM = 100.0
#: Half the length over which the turn of a line is taken. Chosen: a place in the middle of a corner.
_TURN_CM = 8.0
#: How far ahead of the front axle a line is followed, [cm]: a label further along it cannot be judged.
_AHEAD_CM = 60.0
#: A small step on the road, for the size of a pixel there, [cm].
_SMALL_CM = 0.2


#: By label; features by name; sums of hits by label, see :class:`_Line`.
_Ints = Int[np.ndarray, "..."]
_Floats = Float[np.ndarray, "..."]
_Features = dict[str, Float[np.ndarray, "..."]]
_Sums = Int[np.ndarray, "_ _"]


@dataclass(frozen=True, eq=False)
class LabelFeatures:
    """Features of each label of a map.

    Attributes:
        names: Names of the features.
        values: Per frame, label and feature; NaN where unknown.
        line: Number of the line that each label is of, see :attr:`lanenet.data.maps.line.LaneLine.index`.
        s_cm: Position of the label along this line, not wrapped; NaN where there is none.
    """

    names: tuple[str, ...]
    values: Float32[np.ndarray, "n 6 f"]
    line: Int[np.ndarray, "n 6"]
    s_cm: Float[np.ndarray, "n 6"]


class _Profile(NamedTuple):
    """What the views of some places show of a line; NaN without views.

    Attributes:
        met: Share of the borders that are met.
        both: The same for the border that is met less often.
        offset_cm: Mean distance of the hits close to the line, positive to the right; NaN without any.
        apart_cm: By how much the right border lies further from its place than the left one, to the right.
        rival: Share of the hits at the distance beside the line where most are, less what is usual there.
        views: Number of views.
    """

    met: _Floats
    both: _Floats
    offset_cm: _Floats
    apart_cm: _Floats
    rival: _Floats
    views: _Floats

    def features(self, whose: str) -> _Features:
        """Return the columns by name; distances without their sign."""
        return {f"{whose}_{name}": np.abs(x) if "_cm" in name else x for name, x in self._asdict().items()}


class _Labels(NamedTuple):
    """Where a line crosses the label rows of its frames.

    Attributes:
        frame: Position in the line's frames.
        row: Number of the label row.
        s_cm: Position along the line, not wrapped.
        x_cm: The label.
        slope: Centimetres across for one along the car.
    """

    frame: _Ints
    row: _Ints
    s_cm: _Floats
    x_cm: _Floats
    slope: _Floats


@dataclass(frozen=True, eq=False)
class _Line:
    """A line with the frames of whose lane it is one.

    Attributes:
        line: The line.
        across: The other line of their lane, as most have it; None if unknown.
        rows: These frames, as positions in the map.
        side: Whether it is the left (0) or the right (1) line of each, in its direction of travel.
        sign: 1 if the frame drives in the path's direction, else -1.
        s_cm: Position of the rear axle of each along the path.
        looked: Those of the frames that are looked at, as positions in ``rows``.
        hits: Of each of them, by step ahead: whether there is a left border, by distance across, whether a
            right one, likewise, and whether the place is in view.
    """

    line: LaneLine
    across: LaneLine | None
    rows: Int[np.ndarray, "r"]
    side: Int[np.ndarray, "r"]
    sign: Int[np.ndarray, "r"]
    s_cm: Float[np.ndarray, "r"]
    looked: Int[np.ndarray, "l"]
    hits: UInt8[np.ndarray, "l t b"]

    @property
    def closed(self) -> bool:
        """Whether the line is a lap."""
        return self.line.period_cm is not None

    @property
    def count(self) -> int:
        """Number of places along the line."""
        return max(1, round((self.line.span_cm[1] - self.line.span_cm[0]) / PLACE_CM))

    def cell(self, s_cm: Float[np.ndarray, "*m"]) -> Int[np.ndarray, "*m"]:
        """Places of positions along the line, not wrapped; on a lap, a whole number of them fits."""
        low, high = self.line.span_cm
        return np.floor((s_cm - low) / (high - low) * self.count).astype(np.int64)

    @property
    def borders(self) -> tuple[int, int]:
        """Columns of the hits that say that the left, the right border is met."""
        bins = self.hits.shape[2] // 2
        return bins // 2, bins + bins // 2

    @property
    def cells(self) -> Int[np.ndarray, "l t"]:
        """Places ahead of the frames that are looked at, not wrapped: one for each step from 1."""
        steps = np.arange(1, self.hits.shape[1] + 1)
        return self.cell(self.s_cm[self.looked, None]) + self.sign[self.looked, None] * steps

    def middle_cm(self, cells: Int[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
        """Positions of the middles of places along the line."""
        low, high = self.line.span_cm
        return low + (cells + 0.5) * (high - low) / self.count

    def in_car(
        self, drive_map: DriveMap, rows: Int[np.ndarray, "r"], s_cm: Float[np.ndarray, "r m"]
    ) -> Float[np.ndarray, "r m 2"]:
        """Points of the line in the car frames of some frames, given as positions in the map."""
        points = self.line.points(s_cm.ravel()).reshape(*s_cm.shape, 2)
        return car_from_map(points, drive_map.poses[rows][:, None], drive_map.camera.wheelbase_cm)


def label_features(mapped: MappedDrive, figures: dict[str, Any] | None = None) -> LabelFeatures:
    """Collect the features of a map's labels.

    Args:
        mapped: The map and its drive.
        figures: Of the map's report, for the sigmas of a camera that was found; None for a given camera.
    """
    drive_map, n = mapped.drive_map, len(mapped.rows)
    run, periods = _runs(mapped)
    looked, near = _looked_frames(drive_map, run)
    lines = list(_lines(drive_map, looked))
    _look(mapped, looked, lines)
    passes = _passes(drive_map)
    known = figures or {}
    sigma = (known.get("calibration") or {}).get("sigma") or known.get("camera_sigma", {})
    found: dict[str, Float[np.ndarray, "n 6"]] = {}
    whole = np.full((n, 2, len(_Profile._fields)), np.nan)
    index, s_cm = np.zeros((n, N_POINTS), np.int64), np.full((n, N_POINTS), np.nan)
    for one in lines:
        labels = _labels(drive_map, one)
        columns = _evidence(one, labels, near, passes, whole) | _geometry(one, labels)
        at = one.rows[labels.frame], len(ROWS_CM) * one.side[labels.frame] + labels.row
        index[at], s_cm[at] = one.line.index, labels.s_cm
        for name, values in (columns | _camera(drive_map, labels, sigma)).items():
            found.setdefault(name, np.full((n, N_POINTS), np.nan))[at] = values
    of_frame = {name: values[:, None] for name, values in _pose(mapped, run, periods).items()}
    for name, values in (_both_lines(whole[near]) | of_frame).items():
        found[name] = np.repeat(values, N_POINTS // values.shape[1], axis=1)
    found["row_cm"] = np.tile(ROWS_CM, (n, 2))
    values = np.stack(list(found.values()), axis=-1).astype(np.float32)
    return LabelFeatures(tuple(found), values, index, s_cm)


def _runs(mapped: MappedDrive) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Number of each frame's run between gaps of the recording, and typical steps from the frame before."""
    t_s = mapped.drive.driven_s[mapped.rows]
    step_s = np.diff(t_s, prepend=t_s[0])
    periods = np.minimum(step_s / max(float(np.median(step_s)), 1e-6), LONGEST_STEP)
    periods[mapped.starts] = LONGEST_STEP
    return np.cumsum(periods > GAP_PERIODS), periods


def _looked_frames(drive_map: DriveMap, run: _Ints) -> tuple[_Ints, _Ints]:
    """Frames to look at, and the nearest of them in the run of each frame.

    They lie about evenly along the road; those at gaps of the recording, whose poses may be wrong, are added.
    """
    way_cm = path_lengths(drive_map.poses)
    even = np.cumsum(np.minimum(np.diff(way_cm, prepend=0.0), _FRAMES_CM)) // _FRAMES_CM
    starts = np.diff(run, prepend=-1) != 0
    looked = np.flatnonzero((np.diff(even, prepend=-1.0) > 0.0) | starts | np.append(starts[1:], True))
    # Runs are set apart, so that a frame of another one is never the nearest.
    way_cm = way_cm + 1e6 * run
    return looked, looked[np.searchsorted(0.5 * (way_cm[looked][1:] + way_cm[looked][:-1]), way_cm)]


def _passes(drive_map: DriveMap) -> Int[np.ndarray, "n"]:
    """Pass of each frame over its segment's lap, so that those of the lap before and after have numbers."""
    passes = np.ones(len(drive_map.frames), dtype=np.int64)
    for segment, lines in drive_map.lines.items():
        rows = np.flatnonzero(drive_map.segment == segment)
        if lines[0].period_cm is not None and rows.size:
            s_cm, t_s = drive_map.s_cm[rows], drive_map.t_s[rows]
            seams = np.cumsum(-np.rint(np.diff(s_cm, prepend=s_cm[0]) / lines[0].period_cm))
            # Behind a long gap another pass begins.
            step_s = np.diff(t_s, prepend=t_s[0])
            passes[rows] = seams + 3.0 * np.cumsum(step_s > MOST_BRIDGED * np.median(step_s))
    return passes


def _lines(drive_map: DriveMap, looked: Int[np.ndarray, "m"]) -> Iterator[_Line]:
    """The lines of a map with the frames between whose lines they are, not looked at yet."""
    most_cm = min(_BESIDE_CM, _BESIDE_LANES * drive_map.meta.mapped_lane_cm)
    columns = 2 * (2 * int(most_cm / _BIN_CM) + 1) + 1
    steps = int((drive_map.camera.wheelbase_cm + REACH_CM + 10.0) / PLACE_CM)
    for segment, lines in drive_map.lines.items():
        by_index = {line.index: line for line in lines}
        for line in lines:
            step = line.index - drive_map.lanes.lane
            rows = np.flatnonzero((drive_map.segment == segment) & ((step == 0) | (step == 1)))
            mine = np.flatnonzero(np.isin(rows, looked))
            if mine.size:
                forward, right = drive_map.lanes.forward[rows], step[rows] == 1
                across = by_index.get(line.index + (-1 if right.mean() > 0.5 else 1))
                hits = np.zeros((len(mine), steps, columns), np.uint8)
                side, sign = (right == forward).astype(np.int64), np.where(forward, 1, -1)
                yield _Line(line, across, rows, side, sign, drive_map.s_cm[rows], mine, hits)


def _look(mapped: MappedDrive, looked: Int[np.ndarray, "m"], lines: list[_Line]) -> None:
    """Fill in what the frames that are looked at show of their lines."""
    drive_map = mapped.drive_map
    met_px = _MET_PX / reference_scale(drive_map.camera)
    views: dict[int, list[tuple[UInt8[np.ndarray, "t b"], Float[np.ndarray, "t 5"]]]] = {}
    for one in lines:
        s_cm, rows = one.middle_cm(one.cells), one.rows[one.looked]
        at, after = (one.in_car(drive_map, rows, s_cm + by_cm) for by_cm in (0.0, 0.5))
        along = (after - at) / np.linalg.norm(after - at, axis=-1, keepdims=True)
        widths = one.line.widths_cm(s_cm.ravel()).reshape(*s_cm.shape, 1)
        widths = np.where(np.isfinite(widths), widths, drive_map.meta.tape_cm)
        places = np.concatenate([at, along, widths], axis=-1)
        for k, hits, own in zip(rows.tolist(), one.hits, places, strict=True):
            views.setdefault(k, []).append((hits, own))
    for k, edges, keep in frame_edges(mapped, looked):
        tilted = drive_map.camera_at(k)
        (road,) = lift_tilted([edges], drive_map.camera, drive_map.tilt_rad[[k]])
        near = road.points_cm[:, 1] < REACH_CM + _BESIDE_CM
        for hits, own in views.get(k, []):
            at, along, widths = own[:, :2], own[:, 2:4], own[:, 4]
            right = np.stack([along[:, 1], -along[:, 0]], axis=1)
            corners = np.concatenate([at, at + _SMALL_CM * right, at + _SMALL_CM * along])
            uv, beside, ahead = tilted.project_ground(corners).reshape(3, -1, 2)
            shown = (at[:, 1] >= 0.0) & (at[:, 1] < REACH_CM) & in_view(uv, beside, keep)
            # Of a pixel, across the line and along it.
            across_cm, along_cm = (_SMALL_CM / np.hypot(*(end - uv).T) for end in (beside, ahead))
            met_cm = np.maximum(_MET_CM, met_px * across_cm)
            # Far ahead, rows of pixels are further apart than places: half of that, and a little more.
            reach_cm = np.maximum(0.5 * PLACE_CM, 0.6 * along_cm)
            places = np.column_stack([at, right, widths, met_cm, reach_cm])[shown]
            hits[shown] = _hits(road.points_cm[near], road.normals[near], places, hits.shape[1])


@njit(cache=True)
@no_type_check
def _hits(points, normals, places, columns):
    """Find where a marking would lie at each place that has a point as its left, its right border."""
    found = np.zeros((len(places), columns), np.uint8)
    found[:, -1] = 1
    half = columns // 4
    for i in range(len(places)):
        x, y, right_x, right_y, width, met_cm, reach_cm = places[i]
        for j in range(len(points)):
            dx, dy = points[j, 0] - x, points[j, 1] - y
            agree = normals[j, 0] * right_x + normals[j, 1] * right_y
            if abs(dy * right_x - dx * right_y) > reach_cm or abs(agree) < COSINE:
                continue
            # The left border brightens to the right.
            d = dx * right_x + dy * right_y + (0.5 if agree > 0.0 else -0.5) * width
            first = max(int(np.ceil((d - met_cm) / _BIN_CM)), -half)
            last = min(int(np.floor((d + met_cm) / _BIN_CM)), half)
            for b in range(first, last + 1):
                # A border that the line meets is no rival.
                if abs(d) > met_cm or abs(b) * _BIN_CM <= _RIVAL_CM:
                    found[i, b + (half if agree > 0.0 else columns // 2 + half)] = 1
    return found


def _labels(drive_map: DriveMap, one: _Line) -> _Labels:
    ahead = np.arange(-BEHIND_CM, drive_map.camera.wheelbase_cm + _AHEAD_CM, SAMPLE_CM)
    s_cm = one.s_cm[:, None] + one.sign[:, None] * ahead
    points = one.in_car(drive_map, one.rows, s_cm)
    point, share = row_crossings(points[..., 1])
    frame, row = np.nonzero(np.isfinite(share))
    at, share = (frame, point[frame, row]), share[frame, row]
    x, dx = points[at][:, 0], np.diff(points, axis=1)[at]
    return _Labels(
        frame, row, s_cm[at] + share * np.diff(s_cm)[at], x + share * dx[:, 0], dx[:, 0] / dx[:, 1]
    )


def _profile(sums: Int[np.ndarray, "m b"], usual: Float[np.ndarray, "m d"]) -> _Profile:
    """Sum up a profile, given sums of hits; ``usual`` is the share of hits where the line is met."""
    views, sides = sums[:, -1], sums[:, :-1].reshape(len(sums), 2, sums.shape[1] // 2).astype(np.float64)
    d_cm = (np.arange(sides.shape[2]) - sides.shape[2] // 2) * _BIN_CM
    close = np.abs(d_cm) <= _OFFSET_CM
    # Squared, so that the peak counts.
    weights = np.stack([*sides.swapaxes(0, 1), sides.sum(axis=1)])[..., close] ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        left_cm, right_cm, offset_cm = weights @ d_cm[close] / weights.sum(axis=2)
        share = sides / views[:, None, None]
    rival = (share.mean(axis=1) - usual)[:, np.abs(d_cm) > _RIVAL_CM].max(axis=1)
    met = share[..., len(d_cm) // 2]
    return _Profile(met.mean(axis=1), met.min(axis=1), offset_cm, right_cm - left_cm, rival, views)


def _seen(hits: UInt8[np.ndarray, "l t b"], row: _Ints, centre: _Ints, half: int) -> _Sums:
    """Sum the hits of some rows over the places around some centres."""
    running = np.cumsum(np.pad(hits, ((0, 0), (1, 0), (0, 0))), axis=1, dtype=np.int32)
    first, last = (np.clip(centre + by, 0, hits.shape[1]) for by in (-half, half + 1))
    return np.asarray(running[row, last] - running[row, first])


def _evidence(
    one: _Line, labels: _Labels, near: _Ints, passes: _Ints, whole: Float[np.ndarray, "n 2 p"]
) -> _Features:
    """What this frame, its pass and the other ones show of a line at the places of its labels.

    Args:
        one: The line.
        labels: Its labels.
        near: The frame looked at that answers for each frame of the map.
        passes: Pass of each frame of the map.
        whole: Profile of the whole line ahead by frame looked at and side; filled in.
    """
    # What was seen, a row for each view of a place.
    i, step = np.nonzero(one.hits[..., -1])
    cells, rows, hits = one.cells, one.rows[one.looked], one.hits[i, step]
    place, view_pass = cells[i, step] % one.count, passes[rows[i]] + cells[i, step] // one.count
    total = _raster(place, hits, one.count)
    met = hits[:, one.borders].any(axis=1)
    with_it = around(_raster(place[met], hits[met], one.count), one.closed, _AROUND)
    usual = 0.5 * with_it[:, :-1].reshape(one.count, 2, -1).sum(axis=1) / np.maximum(with_it[:, -1:], 1e-9)
    middle = cells[:, cells.shape[1] // 2] % one.count
    ahead = _profile(one.hits.sum(axis=1, dtype=np.int32), usual[middle])
    whole[rows, one.side[one.looked]] = np.stack(ahead, axis=1)
    # The nearest frame that is looked at, as row of the hits; none where it has another line.
    k = one.rows[labels.frame]
    of_row = np.full(len(near), -1)
    of_row[rows] = np.arange(len(rows))
    j = of_row[near[k]]
    cell = one.cell(labels.s_cm)
    at, label_pass = cell % one.count, passes[k] + cell // one.count
    beyond = cell - one.cell(one.s_cm[one.looked[j]])
    if one.closed:  # the nearest frame may be beyond the seam
        beyond -= one.count * np.rint(beyond / one.count).astype(np.int64)
    centre = one.sign[one.looked[j]] * beyond - 1
    apart = np.abs(np.arange(cells.shape[1]) - centre[:, None]) + 1e6 * (one.hits[j, :, -1] == 0)
    gap, unseen = apart.min(axis=1), (j < 0) | (apart.min(axis=1) > 1e5)
    own_sums = _seen(one.hits, j, np.where(gap > _OWN, apart.argmin(axis=1), centre), _OWN)
    own_sums[unseen] = 0
    # Its pass, and all of them.
    pass_sums = np.zeros_like(own_sums)
    for number in np.unique(label_pass):
        now, then = label_pass == number, view_pass == number
        raster = _raster(place[then], hits[then], one.count)
        pass_sums[now] = around(raster, one.closed, _PASS)[at[now]]
    all_sums = around(total, one.closed, _PASS)[at]
    of_frame = np.where(j[:, None] < 0, 0, _seen(one.hits, j, centre, _PASS))
    own = _profile(own_sums, usual[at])
    mine = _profile(np.maximum(pass_sums - of_frame, 0), usual[at])
    others = _profile(all_sums - pass_sums, usual[at])
    # A line on one border only: that may be another edge, in the marking's middle.
    one_border = np.abs(np.diff(all_sums[:, one.borders], axis=1)[:, 0]) / np.maximum(all_sums[:, -1], 1)
    near_sums = around(total, one.closed, _NEAR)
    borders = near_sums[:, one.borders].mean(axis=1)
    met_cm = one.middle_cm(np.flatnonzero((borders >= 0.5 * near_sums[:, -1]) & (near_sums[:, -1] > 0)))
    return {
        **own.features("own"),
        **mine.features("pass"),
        **others.features("others"),
        "own_shift_cm": np.abs(own.offset_cm - others.offset_cm),
        "passes_shift_cm": np.abs(mine.offset_cm - others.offset_cm),
        "one_border_cm": 0.5 * one.line.widths_cm(labels.s_cm) * one_border,
        "bridged_cm": _distance_cm(one.line, labels.s_cm, met_cm),
        "visible": np.full(len(k), total[:, one.borders].mean() / max(total[:, -1].mean(), 1e-9)),
    }


def _raster(place: _Ints, hits: UInt8[np.ndarray, "m b"], count: int) -> _Sums:
    """Add up hits by place."""
    raster = np.zeros((count, hits.shape[1]), np.int32)
    np.add.at(raster, place, hits)
    return raster


def around(sums: Int[np.ndarray, "p b"], closed: bool, half: int) -> Int[np.ndarray, "p b"]:
    """Sum over the places around each one, of a lap also across its seam."""
    padded = np.pad(sums, ((half, half), (0, 0)), mode="wrap" if closed else "constant")
    running = np.cumsum(np.pad(padded, ((1, 0), (0, 0))), axis=0)
    return np.asarray(running[2 * half + 1 :] - running[: -2 * half - 1])


def _distance_cm(line: LaneLine, s_cm: _Floats, to_cm: Float[np.ndarray, "q"]) -> _Floats:
    """Distance along a line to the nearest of some positions, at most :data:`_FAR_CM`."""
    if line.period_cm is not None:
        s_cm = line.span_cm[0] + np.mod(s_cm - line.span_cm[0], line.period_cm)
        to_cm = np.concatenate([to_cm - line.period_cm, to_cm, to_cm + line.period_cm])
    to_cm = np.concatenate([[-np.inf], np.sort(to_cm), [np.inf]])
    after = np.searchsorted(to_cm, s_cm)
    return np.asarray(np.minimum(np.minimum(s_cm - to_cm[after - 1], to_cm[after] - s_cm), _FAR_CM))


def _turn(line: LaneLine, s_cm: _Floats) -> _Floats:
    """Angle by which a line turns around some positions."""
    before, after = (line.everywhere(s_cm + by_cm, 1) for by_cm in (-_TURN_CM, _TURN_CM))
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.asarray(np.abs(np.arctan2(cross, np.sum(before * after, axis=1))))


def _geometry(one: _Line, labels: _Labels) -> _Features:
    """What the lines themselves say at the labels."""
    line, s_cm = one.line, labels.s_cm
    found = {"sigma_cm": line.sigma_cm(s_cm), "turn_rad": _turn(line, s_cm), "slope": np.abs(labels.slope)}
    if one.across is not None:
        everywhere = one.middle_cm(np.arange(one.count))
        apart = [np.hypot(*(line.everywhere(s) - one.across.everywhere(s)).T) for s in (s_cm, everywhere)]
        found["width_off"] = np.abs(apart[0] / np.median(apart[1]) - 1.0)
        # Where this line has no paint, it may turn in any way if the other one turns.
        found["other_turn_rad"] = _turn(one.across, s_cm)
    return found


def _camera(drive_map: DriveMap, labels: _Labels, sigma: dict[str, float]) -> _Features:
    """By how much what the camera leaves open moves the labels, [cm]; 0 for a given one."""
    camera = drive_map.camera
    places = np.stack([labels.x_cm, np.take(ROWS_CM, labels.row)], axis=1)
    found = {"ahead_cm": drive_map.meta.ahead_sigma_cm * np.abs(labels.slope)}
    for name in ("focal", "pitch"):
        pixels, other = camera.project_ground(places), nudged(camera, name, sigma.get(name, 0.0))
        moved = other.intersect_ground(pixels) - places if sigma.get(name) else np.zeros_like(places)
        found[f"{name}_cm"] = np.abs(moved[:, 0] - labels.slope * moved[:, 1])
    return found


def _both_lines(whole: Float[np.ndarray, "n 2 p"]) -> dict[str, Float[np.ndarray, "n 2"]]:
    """What each frame shows of the whole line, of the other one, and of both."""
    line, other = _Profile(*np.moveaxis(whole, 2, 0)), _Profile(*np.moveaxis(whole[:, ::-1], 2, 0))
    found = line.features("line") | {"other_met": other.met, "other_offset_cm": np.abs(other.offset_cm)}
    found["common_offset_cm"] = 0.5 * np.abs(line.offset_cm + other.offset_cm)
    return found


def _pose(mapped: MappedDrive, run: _Ints, periods: _Floats) -> _Features:
    """What is known about the pose of each frame."""
    drive_map, way_cm = mapped.drive_map, path_lengths(mapped.drive_map.poses)
    first, last = np.searchsorted(run, run), np.searchsorted(run, run, "right") - 1
    # Between its neighbours, by the clock.
    clock, k = np.cumsum(periods), np.arange(len(run))
    before, after = np.maximum(k - 1, 0), np.minimum(k + 1, k[-1])
    share = ((clock - clock[before]) / np.maximum(clock[after] - clock[before], 1e-9))[:, None]
    off = drive_map.poses - (1.0 - share) * drive_map.poses[before] - share * drive_map.poses[after]
    off[mapped.starts | np.append(mapped.starts[1:], True)] = np.nan
    heading = drive_map.poses[:, 2]
    return {
        "gap_before_cm": np.minimum(way_cm - way_cm[first], _FAR_CM),
        "gap_after_cm": np.minimum(way_cm[last] - way_cm, _FAR_CM),
        "gap_before_periods": periods[first],
        "gap_after_periods": np.append(periods, LONGEST_STEP)[last + 1],
        "sideways_cm": np.abs(off[:, 1] * np.cos(heading) - off[:, 0] * np.sin(heading)),
    }
