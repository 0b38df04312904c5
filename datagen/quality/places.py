"""Places of the lane lines that the images contradict: there, labels are withheld.

The frames that pass a place of a line should see the borders of its marking. The place is wrong where they do
not and see a marking of this width beside it instead that runs along the line; where they see its borders,
but off to one side; where they see nothing of either line of the lane over a length that is not usual; or
nothing of this one where the other turns sharply. A gap between two dashes is not wrong, and neither is a
line with something beside it that is also there where the line itself is seen: the other tape of a double
line, or the verge.

Every pass of the car over a place is judged by itself, and half of the passes have to agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy.ndimage import uniform_filter1d

from datagen.quality.residuals import frame_edges, in_view, reference_scale
from datagen.slam.commands import MOST_BRIDGED
from datagen.slam.odometry.scans import lift_tilted
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.line import LaneLine
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.data.segments import true_runs
from lanenet.geometry.frames import car_from_map
from lanenet.geometry.lane import SIDES
from lanenet.perception.edges.road import RoadEdges

#: Length of a place. Chosen: a tenth of a dash.
_PLACE_CM = 2.0
#: Distance between frames that are looked at, along the road. Chosen: ten of them see each place.
_FRAMES_CM = 3.0
#: Distance ahead of the front axle up to which a frame sees a place. Chosen: one row beyond the labels.
_REACH_CM = 45.0
#: Largest distance from its place at which a border counts as met: in cm, and in pixels of an image 160 px
#: wide where that is more. Chosen: three times the residuals of good maps.
_MET_CM, _MET_PX = 1.0, 2.5
#: Largest distance of a border from its place that counts for the offset of the line, and the offset beyond
#: which the line is wrong. Chosen: good maps keep below 0.5 cm, and labels with 1.5 cm are not worth having.
_NEAR_CM, _OFF_CM = 3.5, 1.3
#: Distances beside the line at which a border counts against it: from the first beyond the last one, up to
#: the second, and to the third, in lane widths, where the middle of the lane begins; and the width of a bin.
_CLEAR_CM, _BESIDE_CM, _BESIDE_LANES, _BIN_CM = 0.8, 16.0, 0.4, 1.0
_HALF_BINS = int(_BESIDE_CM / _BIN_CM)
#: Least cosine between line and border if it is met, and if it counts against the line. Chosen: a smooth line
#: on the kink of a tape differs by up to 45 degrees.
_MET_COSINE, _BESIDE_COSINE = 0.64, 0.77
#: Half the number of places that are taken together. Chosen: 10 cm.
_AROUND = 2
#: Least number of frames that look at a place in one pass. Chosen: one frame may be wrong.
_MIN_VIEWS = 3
#: Share of the views of a place below which the line counts as not met, and not seen at all; least share in
#: which a border lies beside it; and least share of passes.
_NOT_MET, _BARE, _BESIDE, _PASSES = 1.0 / 3.0, 0.2, 0.5, 0.5
#: Least share of the views in which both borders of a marking lie beside, relative to the share with both
#: where the line is met. Chosen: half, clutter seldom has the width of the marking.
_PAIRS = 0.5
#: Least share of the views in which a line is met that these shares refer to. Chosen: less is met by chance.
_LEAST_VISIBLE = 0.3
#: Share of the views in which the line is met, within so many places, above which a border beside it is a
#: thing of its own. Chosen: dashes of a double line leave half.
_OTHER, _OTHER_PLACES = 0.25, 30
#: Shortest section that is wrong, and how far apart sections are joined where the line is not met in between,
#: in places. Chosen: 10 cm, and 40 cm, twice the usual gap between dashes.
_SHORTEST, _JOINED = 5, 20
#: Shortest one beside a gap without paint, in which the line is off, too. Chosen: a third of a dash.
_SHORTEST_AT_GAP = 3
#: Longest section without paint: in lane widths, or relative to the usual gap of a line that has at least so
#: many. Chosen: interruptions shorter than the lane is wide are bridged well.
_BARE_LANES, _BARE_GAPS, _MIN_GAPS = 2.5, 1.5, 4
#: Shortest section without paint that hides a corner: where the other line turns by so much within so many
#: centimetres, [rad], this one may turn in a corner or in an arc. Chosen: in a section of length l that turns
#: by a, they are l a / 8 apart, here 0.75 cm; a smooth bend turns by this where its radius is 20 cm.
_HIDDEN_CM, _SHARP_RAD, _WITHIN_CM = 12.0, 0.5, 10.0
#: Length along which one pass sees nothing where most see the line, in lane widths, so that its frames lie
#: elsewhere. Chosen: a lamp's reflection covers less.
_ONE_PASS_LANES = 0.5
#: Offset of the borders beyond which the ends of a section belong to it, as do places where the line is not
#: met, and how far that may go, in places that frames look at.
_END_CM, _END_PLACES = 0.7, 15


@dataclass(frozen=True, eq=False)
class PlaceEvidence:
    """What frames saw at the places of one line, by pass of the car over them.

    Attributes:
        views: Number of frames that looked at the place.
        met: Number of them that saw a border of the line there.
        both: Number of them that saw both.
        near: Number of them that saw a border of the line there or near to it.
        off_cm: Sum of the signed distances of those borders, positive to the right.
        beside: Number of frames that did not meet the line, but saw a border beside it, by distance to the
            right.
        pairs: Number of them that saw both borders of a marking there.
        along: Number of frames that met the line and saw a border beside it, likewise.
        frame: The last frame that looked at the place, as position in the map; -1 for none.
    """

    views: Int[np.ndarray, "v p"]
    met: Int[np.ndarray, "v p"]
    both: Int[np.ndarray, "v p"]
    near: Int[np.ndarray, "v p"]
    off_cm: Float[np.ndarray, "v p"]
    beside: Int[np.ndarray, "v p b"]
    pairs: Int[np.ndarray, "v p b"]
    along: Int[np.ndarray, "v p b"]
    frame: Int[np.ndarray, "v p"]

    @classmethod
    def none(cls, passes: int, places: int) -> PlaceEvidence:
        """Return the evidence of no frames."""
        shape, bins = (passes, places), 2 * _HALF_BINS + 1
        return cls(
            np.zeros(shape, np.int64),
            np.zeros(shape, np.int64),
            np.zeros(shape, np.int64),
            np.zeros(shape, np.int64),
            np.zeros(shape),
            np.zeros((*shape, bins), np.int32),
            np.zeros((*shape, bins), np.int32),
            np.zeros((*shape, bins), np.int32),
            np.full(shape, -1),
        )


@dataclass(frozen=True)
class WrongPlace:
    """A section of a line that the images contradict.

    Attributes:
        segment: Segment of the map.
        index: Number of the line, see :attr:`lanenet.data.maps.line.LaneLine.index`.
        section_cm: From and to along the line.
        beside_cm: Distance of the border beside it, positive to its right; NaN where none was seen.
        frames: Frames that show it, as positions in the map.
    """

    segment: int
    index: int
    section_cm: tuple[float, float]
    beside_cm: float
    frames: tuple[int, ...]

    @property
    def name(self) -> str:
        """Name of the line: that of its side, seen in the path's direction."""
        side, rank = (SIDES[0], -self.index) if self.index <= 0 else (SIDES[1], self.index - 1)
        return f"{side} line" + (" of the adjacent lane" if rank else "")

    @property
    def length_cm(self) -> float:
        """Length of the section."""
        return self.section_cm[1] - self.section_cm[0]


def withhold_wrong_places(mapped: MappedDrive) -> tuple[DriveMap, list[WrongPlace]]:
    """Mark the sections of a map's lines that its frames contradict, and the frames that lie elsewhere.

    Returns:
        The map with these sections and frames, and the sections, the longest first.
    """
    drive_map = mapped.drive_map
    found: list[WrongPlace] = []
    gathered = gather_evidence(mapped)
    for (segment, index), evidence in gathered.items():
        by_index = {line.index: line for line in drive_map.lines[segment]}
        line = by_index[index]
        # The one that the driven lane, or else the adjacent one, has on its other side.
        across = 1 - index if index in (0, 1) else index + (1 if index < 0 else -1)
        other = None
        if (segment, across) in gathered:
            met = met_places(gathered[segment, across], line.period_cm is not None)
            other = OtherLine(met, sharp_places(by_index[across]))
        found += wrong_places(segment, line, evidence, drive_map.meta.mapped_lane_cm, other)
    lines = {
        segment: [
            replace(line, contradicted_cm=_sections(found, segment, line.index))
            for line in drive_map.lines[segment]
        ]
        for segment in drive_map.lines
    }
    misplaced = np.repeat(misplaced_frames(drive_map, gathered)[:, None], 2, axis=1)
    marked = replace(drive_map, lines=lines, contradicted=misplaced)
    return marked, sorted(found, key=lambda place: -place.length_cm)


def misplaced_frames(
    drive_map: DriveMap, gathered: dict[tuple[int, int], PlaceEvidence]
) -> Bool[np.ndarray, "n"]:
    """Return the frames that look at a section of a line that their own pass contradicts, but others do not.

    It is the pose of these frames that is wrong, as behind a gap of the recording: neither line is where the
    map has it in them.

    Args:
        drive_map: The map.
        gathered: What its frames see, see :func:`gather_evidence`.
    """
    passes = _passes(drive_map)
    found = np.zeros(len(drive_map.frames), dtype=bool)
    for (segment, index), evidence in gathered.items():
        line = next(line for line in drive_map.lines[segment] if line.index == index)
        against = sections_against(evidence, drive_map.meta.mapped_lane_cm, line.period_cm is not None)
        for k in np.flatnonzero(drive_map.segment == segment).tolist():
            if index - int(drive_map.lanes.lane[k]) in (0, 1):
                seen = _places_ahead(drive_map, k, line)
                found[k] |= int(against[passes[k] + seen.lap, seen.place].sum()) >= _SHORTEST
    return found


def withheld_figures(drive_map: DriveMap, wrong: list[WrongPlace]) -> dict[str, Any]:
    """Return the report's figures on the sections that are withheld, the longest first.

    The share is that of the supported length of the two lines of the driven lane.
    """
    supported_cm = withheld_cm = 0.0
    for lines in drive_map.lines.values():
        for line in (line for line in lines if line.rank == 0):
            s_cm = np.arange(line.span_cm[0], line.span_cm[0] + _place_count(line) * _PLACE_CM, _PLACE_CM)
            known = line.supported(s_cm)
            supported_cm += float(known.sum()) * _PLACE_CM
            withheld_cm += float((known & line.contradicted(s_cm)).sum()) * _PLACE_CM
    places = [
        {
            "segment": place.segment,
            "line": place.name,
            "from_cm": place.section_cm[0],
            "to_cm": place.section_cm[1],
            "beside_cm": place.beside_cm if np.isfinite(place.beside_cm) else None,
            "frames": [int(drive_map.frames[k]) for k in place.frames],
        }
        for place in wrong
    ]
    return {"share": withheld_cm / max(supported_cm, 1e-9), "places": places}


def _sections(found: list[WrongPlace], segment: int, index: int) -> Float[np.ndarray, "w 2"]:
    own = [place.section_cm for place in found if (place.segment, place.index) == (segment, index)]
    return np.array(sorted(own)).reshape(-1, 2)


def gather_evidence(mapped: MappedDrive) -> dict[tuple[int, int], PlaceEvidence]:
    """Collect what a map's frames see along the lines of their lanes, by segment and index of the line."""
    drive_map = mapped.drive_map
    camera, passes = drive_map.camera, _passes(drive_map)
    found: dict[tuple[int, int], PlaceEvidence] = {}
    for k, edges, keep in frame_edges(mapped, _spread_frames(drive_map)):
        segment, lane = int(drive_map.segment[k]), int(drive_map.lanes.lane[k])
        tilted = drive_map.camera_at(k)
        (road,) = lift_tilted([edges], camera, drive_map.tilt_rad[[k]])
        near = road.points_cm[:, 1] < _REACH_CM + _BESIDE_CM
        road = RoadEdges(road.points_cm[near], road.normals[near])
        for line in drive_map.lines[segment]:
            if line.index not in (lane, lane + 1):
                continue
            seen = _places_ahead(drive_map, k, line)
            if not len(seen.place):
                continue
            uv, beside_uv = (tilted.project_ground(seen.at_cm + by_cm * seen.right) for by_cm in (0.0, 0.2))
            shown = in_view(uv, beside_uv, keep)
            seen = SeenPlaces(*(column[shown] for column in seen))
            widths_cm = line.widths_cm(line.span_cm[0] + (seen.place + 0.5) * _PLACE_CM)
            widths_cm = np.where(np.isfinite(widths_cm), widths_cm, drive_map.meta.tape_cm)
            px_per_cm = np.linalg.norm(beside_uv - uv, axis=1)[shown] / 0.2
            met_px = _MET_PX / reference_scale(camera)
            met_cm = np.maximum(_MET_CM, met_px / np.maximum(px_per_cm, 1e-6))
            most_cm = min(_BESIDE_CM, _BESIDE_LANES * drive_map.meta.mapped_lane_cm)
            off_cm, both, beside, pairs = _borders_beside(
                road.points_cm, road.normals, seen.at_cm, seen.right, met_cm, widths_cm, most_cm
            )
            if not drive_map.lanes.forward[k]:
                off_cm, beside, pairs = -off_cm, beside[:, ::-1], pairs[:, ::-1]
            one = found.get((segment, line.index))
            if one is None:
                most = int(passes[drive_map.segment == segment].max()) + 2
                one = found[segment, line.index] = PlaceEvidence.none(most, _place_count(line))
            at = passes[k] + seen.lap, seen.place
            met = np.abs(np.nan_to_num(off_cm, nan=np.inf)) <= met_cm
            one.views[at] += 1
            one.met[at] += met
            one.both[at] += both
            one.near[at] += np.isfinite(off_cm)
            one.off_cm[at] += np.nan_to_num(off_cm)
            one.beside[at] += beside & ~met[:, None]
            one.pairs[at] += pairs & ~met[:, None]
            one.along[at] += beside & met[:, None]
            one.frame[at] = k
    return found


def wrong_places(
    segment: int,
    line: LaneLine,
    evidence: PlaceEvidence,
    lane_cm: float,
    other: OtherLine | None = None,
) -> list[WrongPlace]:
    """Find the sections of a line that the evidence contradicts.

    Args:
        segment: Segment of the line.
        line: The line.
        evidence: What frames saw of it.
        lane_cm: Lane width of the map.
        other: The other line of the lane; it holds this line in place where it has no paint.
    """
    closed = line.period_cm is not None
    looked, against, bare, beside = _judged(evidence, closed)
    votes = np.maximum(looked.sum(axis=0), 1)
    wrong = against.sum(axis=0) >= np.maximum(_PASSES * votes, 1)
    empty = (against | bare).sum(axis=0) >= np.maximum(_PASSES * votes, 1)
    confirmed = met_places(evidence, closed)
    # A line leaves its marking by degrees: what lies far beside a short section is something else.
    found = [
        run
        for run in _joined(wrong, ~confirmed, closed)
        if len(run) >= (_SHORTEST_AT_GAP if _ends_at_gap(run, confirmed, closed) else _SHORTEST)
        and not abs(_distance_cm(beside[:, run])) > len(run) * _PLACE_CM
    ]
    if other is not None and len(other.met) == len(empty):
        hidden = _hidden_corners(empty | _unpainted(evidence, closed), other, closed)
        # What no frame looks at gives no label.
        found += [run for run in hidden if evidence.views[:, run].any()]
        empty &= ~other.met
    found += _too_long(empty, lane_cm, closed)
    mean_off = evidence.off_cm.sum(axis=0) / np.maximum(evidence.near.sum(axis=0), 1)
    taken = np.zeros(len(wrong), dtype=bool)
    for run in found:
        unseen = _around(evidence.views.sum(axis=0)[None], closed)[0] < 0.5
        taken[_with_ends(run, (np.abs(mean_off) > _END_CM) | ~confirmed, unseen, closed)] = True
    low = line.span_cm[0]
    places = []
    for run in true_runs(taken, closed):
        start = low + float(run[0]) * _PLACE_CM
        frames = evidence.frame[:, run].max(axis=1)
        places.append(
            WrongPlace(
                segment,
                line.index,
                (start, start + len(run) * _PLACE_CM),
                _distance_cm(beside[:, run]),
                tuple(sorted({int(k) for k in frames if k >= 0})),
            )
        )
    return places


class OtherLine(NamedTuple):
    """The line on the other side of the lane, by place.

    Attributes:
        met: Where it is met, see :func:`met_places`.
        sharp: Where it turns sharply, see :func:`sharp_places`.
    """

    met: Bool[np.ndarray, "p"]
    sharp: Bool[np.ndarray, "p"]


def sharp_places(line: LaneLine) -> Bool[np.ndarray, "p"]:
    """Return where a line turns sharply. A line beside it that has no paint there may turn in any way."""
    s_cm = line.span_cm[0] + (np.arange(_place_count(line)) + 0.5) * _PLACE_CM
    before, after = (line.everywhere(s_cm + by_cm, 1) for by_cm in (-0.5 * _WITHIN_CM, 0.5 * _WITHIN_CM))
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    return np.asarray(np.abs(np.arctan2(cross, np.sum(before * after, axis=1))) > _SHARP_RAD)


def _unpainted(evidence: PlaceEvidence, closed: bool) -> Bool[np.ndarray, "p"]:
    """Where hardly a view meets the line, or none looks: all passes together."""
    views, met = _all_views(evidence, closed)
    return np.asarray(met < _BARE * np.maximum(views, 1e-9))


def _hidden_corners(
    empty: Bool[np.ndarray, "p"], other: OtherLine, closed: bool
) -> list[Int[np.ndarray, "_"]]:
    """Runs of places without a border beside a corner of the other line."""
    runs = true_runs(empty, closed)
    return [run for run in runs if len(run) * _PLACE_CM >= _HIDDEN_CM and other.sharp[run].any()]


class _Judged(NamedTuple):
    """What each pass over each place says.

    Attributes:
        looked: Whether enough of its frames looked at the place.
        against: Whether they contradict the line there.
        bare: Whether they see nothing of it there.
        beside: Number of frames that see a border beside the line that is no thing of its own, by distance.
    """

    looked: Bool[np.ndarray, "v p"]
    against: Bool[np.ndarray, "v p"]
    bare: Bool[np.ndarray, "v p"]
    beside: Float[np.ndarray, "v p b"]


def _judged(evidence: PlaceEvidence, closed: bool) -> _Judged:
    """Judge each place of a line by each pass over it."""
    views, met = (_around(a, closed) for a in (evidence.views, evidence.met))
    looked = evidence.views >= _MIN_VIEWS
    share = met / np.maximum(views, 1)
    # A border beside the line that is there also where the line is met is a thing of its own.
    own = _around(evidence.along.sum(axis=0)[None], closed, _OTHER_PLACES)[0]
    own = np.maximum(own, np.maximum(np.roll(own, 1, axis=1), np.roll(own, -1, axis=1)))
    met_near = _around(evidence.met.sum(axis=0)[None], closed, _OTHER_PLACES)[0]
    other = own > _OTHER * np.maximum(met_near, 1)[:, None]
    beside, pairs = (np.where(other, 0, _around(a, closed)) for a in (evidence.beside, evidence.pairs))
    # Beside the line lies what the line is where it is met: a marking with two borders, if those can be seen.
    both = float(evidence.both.sum()) / max(int(evidence.met.sum()), 1)
    # Of a faint line or a dashed one, frames see less, also where it lies beside its place on the map.
    visible = max(float(evidence.met.sum()) / max(int(evidence.views.sum()), 1), _LEAST_VISIBLE)
    enough = visible * views[:, :, None]
    marking = (beside >= _BESIDE * enough) & (pairs >= _PAIRS * both * enough) & (beside >= _MIN_VIEWS)
    against = looked & (share < _NOT_MET * visible) & marking.any(axis=2)
    near, off_cm = _around(evidence.near, closed), _around(evidence.off_cm, closed)
    off_cm = off_cm / np.maximum(near, 1)
    bins = np.clip(np.rint(off_cm / _BIN_CM).astype(int) + _HALF_BINS, 0, 2 * _HALF_BINS)
    off = (
        (np.abs(off_cm) > _OFF_CM) & (near >= _BESIDE * visible * views) & ~other[np.arange(len(other)), bins]
    )
    against |= looked & off
    bare = looked & (share < _BARE) & ~against
    return _Judged(looked, against, bare, beside)


def sections_against(evidence: PlaceEvidence, lane_cm: float, closed: bool) -> Bool[np.ndarray, "v p"]:
    """Return where a pass by itself contradicts a line over a section: its frames lie elsewhere on the map.

    It sees a marking beside the line, or for a while nothing where most passes see the line.
    """
    judged, confirmed = _judged(evidence, closed), met_places(evidence, closed)
    # Where most passes contradict it, it is the line that is wrong.
    alone = judged.against.sum(axis=0) <= _PASSES * judged.looked.sum(axis=0)
    found = np.zeros_like(judged.against)
    for one in range(len(found)):
        against, bare = judged.against[one], judged.bare[one] & confirmed
        for run in true_runs(against, closed):
            far_cm = abs(_distance_cm(judged.beside[one : one + 1, run]))
            # As for all passes together.
            if len(run) >= _SHORTEST and not far_cm > len(run) * _PLACE_CM:
                found[one, run] = True
        for run in true_runs(against | bare, closed):
            if len(run) * _PLACE_CM >= _ONE_PASS_LANES * lane_cm:
                found[one, run] = True
    return found & alone


def _distance_cm(beside: Float[np.ndarray, "v r b"]) -> float:
    """Distance at which most borders lie beside a run of places; NaN without one."""
    counts = beside.sum(axis=(0, 1))
    return float(int(counts.argmax()) - _HALF_BINS) * _BIN_CM if counts.any() else float("nan")


def _all_views(
    evidence: PlaceEvidence, closed: bool
) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """Views around each place, and those that meet the line, of all passes together."""
    views, met = (_around(a.sum(axis=0)[None], closed)[0] for a in (evidence.views, evidence.met))
    return views, met


def met_places(evidence: PlaceEvidence, closed: bool) -> Bool[np.ndarray, "p"]:
    """Return where most views meet the line."""
    views, met = _all_views(evidence, closed)
    return np.asarray((met >= 0.5 * views) & (views > 0.5))


def _joined(
    mask: Bool[np.ndarray, "p"], open_: Bool[np.ndarray, "p"], closed: bool
) -> list[Int[np.ndarray, "_"]]:
    """Runs of a mask, joined across short sections that are open."""
    joined = mask.copy()
    for run in true_runs(~mask, closed):
        if len(run) <= _JOINED and open_[run].all() and len(run) < len(mask):
            inner = closed or (run[0] > 0 and run[-1] < len(mask) - 1)
            joined[run] = inner
    return list(true_runs(joined, closed))


def _ends_at_gap(run: Int[np.ndarray, "r"], confirmed: Bool[np.ndarray, "p"], closed: bool) -> bool:
    """Whether the line is not met over the places before a run, or behind it: there it is off as well."""
    before = np.arange(run[0] - _SHORTEST, run[0])
    behind = np.arange(run[-1] + 1, run[-1] + 1 + _SHORTEST)
    n = len(confirmed)
    sides = [side for side in (before, behind) if closed or (side[0] >= 0 and side[-1] < n)]
    return any(not confirmed[side % n].any() for side in sides)


def _too_long(empty: Bool[np.ndarray, "p"], lane_cm: float, closed: bool) -> list[Int[np.ndarray, "_"]]:
    """Runs of places without a border that are longer than the gaps that this line usually has."""
    runs = true_runs(empty, closed)
    lengths = np.array([len(run) for run in runs]) * _PLACE_CM
    bound = _BARE_LANES * lane_cm
    if len(runs) >= _MIN_GAPS:
        bound = max(bound, _BARE_GAPS * float(np.median(lengths)))
    return [run for run, length in zip(runs, lengths, strict=True) if length > bound]


def _with_ends(
    run: Int[np.ndarray, "r"], off: Bool[np.ndarray, "p"], unseen: Bool[np.ndarray, "p"], closed: bool
) -> Int[np.ndarray, "_"]:
    """Extend a run over the places at its ends where the line is off or not met, and by one more.

    Places that no frame looks at, as where the line runs out of view in a bend, are no end of it.
    """
    n = len(off)
    first, last = int(run[0]), int(run[0]) + len(run) - 1
    for step in (-1, 1):
        looked = 0
        while looked < _END_PLACES and last - first < n:
            following = (first if step < 0 else last) + step
            if not closed and not 0 <= following < n:
                break
            if step < 0:
                first = following
            else:
                last = following
            if not off[following % n]:
                break
            looked += not unseen[following % n]
    return np.unique(np.arange(first, min(last, first + n - 1) + 1) % n)


def _around(counts: np.ndarray, closed: bool, around: int = _AROUND) -> np.ndarray:
    """Sum counts over the places around each one."""
    size = 2 * around + 1
    mean = uniform_filter1d(
        counts.astype(np.float64), min(size, counts.shape[1]), axis=1, mode="wrap" if closed else "constant"
    )
    return np.asarray(mean * size)


class SeenPlaces(NamedTuple):
    """Places of a line ahead of a frame.

    Attributes:
        place: Number of the place.
        lap: 1 where it lies in the lap after the frame's own, else 0; -1 behind a car that drives backwards.
        at_cm: Its middle, frame car.
        right: Unit vector to the right of the line in the direction of travel.
    """

    place: Int[np.ndarray, "m"]
    lap: Int[np.ndarray, "m"]
    at_cm: Float[np.ndarray, "m 2"]
    right: Float[np.ndarray, "m 2"]


def _places_ahead(drive_map: DriveMap, k: int, line: LaneLine) -> SeenPlaces:
    """The places of a line that the map's k-th frame may look at and that the line knows."""
    wheelbase_cm, forward = drive_map.camera.wheelbase_cm, bool(drive_map.lanes.forward[k])
    low, count = line.span_cm[0], _place_count(line)
    steps = np.arange(1, int((wheelbase_cm + _REACH_CM + 10.0) / _PLACE_CM))
    cell = int(np.floor((drive_map.s_cm[k] - low) / _PLACE_CM)) + (steps if forward else -steps)
    if line.period_cm is None:
        cell = cell[(cell >= 0) & (cell < count)]
    s_cm = low + (cell + 0.5) * _PLACE_CM
    known = line.supported(s_cm) if len(s_cm) else np.zeros(0, dtype=bool)
    cell, s_cm = cell[known], s_cm[known]
    pose = drive_map.poses[k]
    ends = [car_from_map(line.everywhere(s_cm + by_cm), pose, wheelbase_cm) for by_cm in (-0.5, 0.0, 0.5)]
    ahead = ends[2] - ends[0] if forward else ends[0] - ends[2]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    right = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    inside = (ends[1][:, 1] >= 0.0) & (ends[1][:, 1] < _REACH_CM)
    lap = cell // count
    return SeenPlaces((cell % count)[inside], lap[inside], ends[1][inside], right[inside])


def _place_count(line: LaneLine) -> int:
    """Number of whole places along a line; the rest at its end is shorter than one."""
    low, high = line.span_cm
    return max(1, int((high - low) / _PLACE_CM))


def _spread_frames(drive_map: DriveMap) -> Int[np.ndarray, "m"]:
    """Frames about evenly along the road, so that neither a slow nor a fast car shows places more often."""
    step = np.hypot(*np.diff(drive_map.poses[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(np.minimum(step, _FRAMES_CM))])
    return np.flatnonzero(np.diff(np.floor(along / _FRAMES_CM), prepend=-1.0) > 0.0)


def _passes(drive_map: DriveMap) -> Int[np.ndarray, "n"]:
    """Pass of each frame over its segment's lap, from 1, so that those before and after it have numbers."""
    passes = np.ones(len(drive_map.frames), dtype=np.int64)
    for segment, lines in drive_map.lines.items():
        rows = np.flatnonzero(drive_map.segment == segment)
        period = lines[0].period_cm
        if period is not None and rows.size:
            seams = np.cumsum(
                -np.rint(np.diff(drive_map.s_cm[rows], prepend=drive_map.s_cm[rows[0]]) / period)
            )
            # Behind a long gap another pass begins, with numbers of its own before and after it.
            step_s = np.diff(drive_map.t_s[rows], prepend=drive_map.t_s[rows[0]])
            seams += 3.0 * np.cumsum(step_s > MOST_BRIDGED * np.median(step_s))
            passes[rows] = (seams - seams.min()).astype(np.int64) + 1
    return passes


@njit(cache=True)
@no_type_check
def _borders_beside(points, normals, at, right, met_cm, widths_cm, most_cm):
    """Find the borders at and beside each place.

    Args:
        points: Edge points, frame car.
        normals: Their unit normals, into the marking.
        at: The places.
        right: Unit vectors to the right of the line there.
        met_cm: Largest distance at which a border is met.
        widths_cm: Width of the marking there.
        most_cm: Largest distance of a border beside the line.

    Returns:
        Distance of the nearest border, positive to the right, NaN without one; whether both borders are met;
        and by bin of distance whether there is a border beside, and both.
    """
    off = np.full(len(at), np.nan)
    both = np.zeros(len(at), np.bool_)
    beside = np.zeros((len(at), 2 * _HALF_BINS + 1), np.bool_)
    pairs = np.zeros((len(at), 2 * _HALF_BINS + 1), np.bool_)
    borders = np.zeros((2, 2 * _HALF_BINS + 1), np.bool_)
    for i in range(len(at)):
        borders[:] = False
        left_met = right_met = False
        best, clear = max(met_cm[i], _NEAR_CM), met_cm[i] + _CLEAR_CM
        for j in range(len(points)):
            dx, dy = points[j, 0] - at[i, 0], points[j, 1] - at[i, 1]
            if abs(dy * right[i, 0] - dx * right[i, 1]) > 0.5 * _PLACE_CM:
                continue
            agree = normals[j, 0] * right[i, 0] + normals[j, 1] * right[i, 1]
            if abs(agree) < _MET_COSINE:
                continue
            # The left border brightens to the right.
            d = dx * right[i, 0] + dy * right[i, 1] + (0.5 if agree > 0.0 else -0.5) * widths_cm[i]
            if abs(d) <= best:
                off[i], best = d, abs(d)
            if abs(d) <= met_cm[i]:
                left_met, right_met = left_met or agree > 0.0, right_met or agree < 0.0
            if clear < abs(d) < most_cm and abs(agree) >= _BESIDE_COSINE:
                # A border near the edge of a bin belongs to both.
                side = 0 if agree > 0.0 else 1
                borders[side, int(np.floor(d / _BIN_CM + 0.25)) + _HALF_BINS] = True
                borders[side, int(np.floor(d / _BIN_CM + 0.75)) + _HALF_BINS] = True
        both[i] = left_met and right_met
        for b in range(2 * _HALF_BINS + 1):
            beside[i, b] = borders[0, b] or borders[1, b]
            low, high = max(0, b - 1), min(2 * _HALF_BINS, b + 1)
            for c in range(low, high + 1):
                pairs[i, b] |= (borders[0, b] and borders[1, c]) or (borders[1, b] and borders[0, c])
    return off, both, beside, pairs
