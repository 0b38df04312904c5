"""The road of a synthetic drive: one object that is painted and that gives the ground truth.

Its lines are painted in sections: intervals along the road. On disk, as ``track.json``, it is the truth that
a map is compared with.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from lanenet.data.files import write_json
from lanenet.data.tables import MAX_PLACE
from lanenet.errors import DriveFormatError
from lanenet.geometry.frames import car_from_map, map_from_car, wrap_angle
from lanenet.geometry.lane import rows_of_polyline
from lanenet.geometry.poses import arc_chord
from lanenet.reading import parsing, read_json

Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")
Bgr = tuple[float, float, float]

#: Section of the lines that is given around the car: what labels and pictures of them need.
_BEHIND_CM, _AHEAD_CM = 60.0, 150.0
#: Least turn between two samples, beyond that of the bend, by which a kink is known. Chosen: half a degree;
#: bends whose curvature changes leave a hundredth of it.
_KINK_RAD = 0.5 * np.pi / 180.0
#: Shortest random interruption of a line.
_MIN_INTERRUPTION_CM = 10.0
#: Mean length of what flakes off a worn line; chosen: about the width of the tape.
_FLAKE_CM = 1.5
FORMAT = "lanenet-track/2"
_COLUMNS = ("s_cm", "xy_cm", "heading_rad", "curvature_per_cm")


@dataclass(frozen=True, eq=False)
class Marking:
    """One painted line, parallel to the centre line.

    Attributes:
        offset_cm: Of its middle, left of the centre line positive.
        width_cm: Of the tape.
        colour_bgr: Nominal colour, 0..255.
        painted_cm: Start and end of each painted section along the centre line, ascending.
    """

    offset_cm: float
    width_cm: float
    colour_bgr: Bgr
    painted_cm: Float[np.ndarray, "k 2"]


@dataclass(frozen=True, eq=False)
class Track:
    """A road: the centre line of the driven lane and the markings beside it.

    Attributes:
        s_cm: Distance along the centre line, evenly spaced, about 1 cm.
        xy_cm: Centre line, frame map.
        heading_rad: Direction of travel, unwrapped.
        curvature_per_cm: Positive to the left.
        closed: Whether the last sample is followed by the first.
        lane_width_cm: Of the driven lane, between the middles of its two lines.
        markings: What is painted along the road.
        boxes: Painted rectangles (stop lines, bars, arrows, side roads, bays): x, y, cos and sin of the
            direction, half length, half width, blue, green, red; frame map.
        oncoming_cm: Offset of the middle of the oncoming lane, left positive; None on a road of one lane.
        widths: Width of the lane at each sample, in ``lane_width_cm``; None where it is the same everywhere.
            The lines of a lane that widens are among the boxes.
    """

    s_cm: Float[np.ndarray, "n"]
    xy_cm: Float[np.ndarray, "n 2"]
    heading_rad: Float[np.ndarray, "n"]
    curvature_per_cm: Float[np.ndarray, "n"]
    closed: bool
    lane_width_cm: float
    markings: tuple[Marking, ...]
    boxes: Float[np.ndarray, "b 9"] = field(default_factory=lambda: np.empty((0, 9)))
    oncoming_cm: float | None = None
    widths: Float[np.ndarray, "n"] | None = None

    @property
    def width_factors(self) -> Float[np.ndarray, "n"]:
        """``widths`` in any case: ones where the lane is the same everywhere."""
        return np.ones(len(self.s_cm)) if self.widths is None else self.widths

    @property
    def step_cm(self) -> float:
        """Distance between samples, [cm]."""
        return float(self.s_cm[1] - self.s_cm[0])

    @property
    def length_cm(self) -> float:
        """Length of the centre line, [cm]; of a loop, once around."""
        return float(self.s_cm[-1]) + (self.step_cm if self.closed else 0.0)

    @property
    def middle_cm(self) -> float:
        """Offset of the middle of the whole road from the centre line of the driven lane, left positive."""
        return 0.5 * (self.oncoming_cm or 0.0)

    @property
    def half_width_cm(self) -> float:
        """Half the width of the whole road, between the middles of its outer lines."""
        return 0.5 * (self.lane_width_cm + abs(self.oncoming_cm or 0.0))

    def line_offset_cm(self, side: Side) -> float:
        """Offset of a line of the driven lane, left positive, [cm]."""
        return 0.5 * self.lane_width_cm if side == "left" else -0.5 * self.lane_width_cm

    def beside(
        self, index: Int[np.ndarray, "m"], offset_cm: float | Float[np.ndarray, "m"]
    ) -> Float[np.ndarray, "m 2"]:
        """Return points beside the given samples, [cm], frame map; offsets are left positive."""
        heading, offset_cm = self.heading_rad[index], np.asarray(offset_cm)[..., None]
        return self.xy_cm[index] + offset_cm * np.stack([-np.sin(heading), np.cos(heading)], axis=1)

    @cached_property
    def kinks_rad(self) -> Float[np.ndarray, "n"]:
        """Turn of the kink between each sample and the next one, positive left; 0 where there is none."""
        following = np.roll(self.heading_rad, -1)
        per_cm = 0.5 * (self.curvature_per_cm + np.roll(self.curvature_per_cm, -1))
        turn = wrap_angle(following - self.heading_rad - per_cm * self.step_cm)
        if not self.closed:
            turn[-1] = 0.0
        return np.where(np.abs(turn) > _KINK_RAD, turn, 0.0)

    def line_beside(self, from_cm: float, to_cm: float, offset_cm: float) -> Float[np.ndarray, "k 2"]:
        """Return the line beside a section of the road, with its corners at kinks, [cm], frame map."""
        index = self._samples(from_cm, to_cm)
        points = self.beside(index, offset_cm * self.width_factors[index])
        keep = np.ones(len(index), dtype=bool)
        corners = []
        for k in np.flatnonzero(self.kinks_rad[index[:-1]]).tolist():
            i, half_rad = index[k], 0.5 * float(self.kinks_rad[index[k]])
            ahead, middle = self.heading_rad[i], self.heading_rad[i] + half_rad
            corner = self.xy_cm[i] + 0.5 * self.step_cm * np.array([np.cos(ahead), np.sin(ahead)])
            aside_cm = offset_cm / np.cos(half_rad)
            corners.append((k, corner + aside_cm * np.array([-np.sin(middle), np.cos(middle)])))
            # On the inside, the lines beside the two straights cross before they end.
            cut = int(max(0.0, offset_cm * np.tan(half_rad) / self.step_cm + 0.5))
            keep[max(0, k + 1 - cut) : k + 1 + cut] = False
        for k, corner in reversed(corners):
            points, keep = np.insert(points, k + 1, corner, axis=0), np.insert(keep, k + 1, True)
        return points[keep]

    def curvature(self, s_cm: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """Return the curvature of the centre line at places along it, [1/cm], positive left."""
        return self.curvature_per_cm[self._nearest_samples(s_cm)[1]]

    def point(self, s_cm: float, offset_cm: float = 0.0) -> tuple[Float[np.ndarray, "2"], float]:
        """Return the point at a distance along the road and the road's heading there, [cm], [rad], frame map.

        A loop takes any distance, over any number of laps; an open road continues beyond its ends along the
        circle of its last sample.
        """
        xy_cm, heading = self.points(np.array([s_cm]), offset_cm)
        return xy_cm[0], float(heading[0])

    def points(
        self, s_cm: Float[np.ndarray, "m"], offset_cm: float = 0.0
    ) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m"]]:
        """Return many points at once; see :meth:`point`."""
        lap, index = self._nearest_samples(s_cm)
        along_cm = s_cm - lap * self.length_cm - self.s_cm[index]
        turn = self.curvature_per_cm[index] * along_cm
        heading = self.heading_rad[index] + turn
        xy_cm = self.xy_cm[index] + arc_chord(self.heading_rad[index], along_cm, turn)
        return xy_cm + offset_cm * np.stack([-np.sin(heading), np.cos(heading)], axis=1), heading

    def nearest(
        self, xy_cm: Float[np.ndarray, "2"], near_s_cm: float | None = None, reach_cm: float = 60.0
    ) -> tuple[float, float]:
        """Find a point's place along the road.

        Args:
            xy_cm: The point, [cm], frame map.
            near_s_cm: Search only within ``reach_cm`` of this distance along the road.
            reach_cm: Half the length of that section.

        Returns:
            Distance along the centre line and offset from it (left positive), [cm]. Beyond the ends of an
            open road both continue along the circle of its last sample.
        """
        if near_s_cm is None:
            index = np.arange(len(self.s_cm))
        else:
            index = self._samples(near_s_cm - reach_cm, near_s_cm + reach_cm)
        i = index[np.argmin(np.sum((self.xy_cm[index] - xy_cm) ** 2, axis=1))]
        (dx, dy), k = xy_cm - self.xy_cm[i], float(self.curvature_per_cm[i])
        c, s = np.cos(self.heading_rad[i]), np.sin(self.heading_rad[i])
        ahead, left = dx * c + dy * s, -dx * s + dy * c
        # The foot of the perpendicular on the circle through the sample, not on the polyline and its corners.
        inward = 1.0 - k * left
        along_cm = np.arctan2(k * ahead, inward) / k if abs(k) > 1e-9 else ahead
        offset_cm = (2.0 * left - k * (ahead**2 + left**2)) / (1.0 + np.hypot(k * ahead, inward))
        return float(self.s_cm[i] + along_cm), float(offset_cm)

    def lines_car(
        self,
        pose: Float[np.ndarray, "3"],
        wheelbase_cm: float,
        near_s_cm: float | None = None,
        lane_cm: float = 0.0,
    ) -> tuple[Float[np.ndarray, "l 2"], Float[np.ndarray, "r 2"]]:
        """Return the left and right line around the car, [cm], frame car, in the direction of travel.

        Only the section from 60 cm behind the front axle to 150 cm ahead along the road, so that no other
        section of the road answers.

        Args:
            pose: Rear-axle centre x, y and heading, frame map.
            wheelbase_cm: Distance between the axles.
            near_s_cm: Roughly where along the road the car is, if it may have left its lane.
            lane_cm: Offset of the lane whose lines are wanted, left positive; 0 for the driven one.
        """
        front = map_from_car(np.zeros((1, 2)), pose, wheelbase_cm)[0]
        s_cm, _ = self.nearest(front, near_s_cm)
        span_cm = s_cm - _BEHIND_CM, s_cm + _AHEAD_CM
        left, right = (self.line_beside(*span_cm, self.line_offset_cm(side) + lane_cm) for side in SIDES)
        return car_from_map(left, pose, wheelbase_cm), car_from_map(right, pose, wheelbase_cm)

    def truth(
        self,
        pose: Float[np.ndarray, "3"],
        wheelbase_cm: float,
        near_s_cm: float | None = None,
        lane_cm: float = 0.0,
    ) -> Float[np.ndarray, "6"]:
        """Return the six points of the label contract, [cm], frame car; NaN where a line misses a row.

        The points follow the road, also where its paint is interrupted; arguments as :meth:`lines_car`.
        """
        left, right = self.lines_car(pose, wheelbase_cm, near_s_cm, lane_cm)
        return np.concatenate([rows_of_polyline(left), rows_of_polyline(right)])

    def reversed(self) -> Track:
        """Return the road in the opposite direction: on two lanes the other lane, with the same paint."""
        offset_cm = self.oncoming_cm or 0.0
        end = [self.length_cm] if self.closed else []
        s_cm = np.append(self.s_cm, end)
        # The other lane is longer in one bend and shorter in the next.
        per_cm = np.append(self.curvature_per_cm, self.curvature_per_cm[: len(end)])
        along_cm = length_beside(s_cm, per_cm, offset_cm)
        length_cm = float(along_cm[-1])
        n = len(s_cm) - 1 if offset_cm == 0.0 else max(2, round(length_cm / self.step_cm))
        new_s_cm = np.arange(n if self.closed else n + 1) * (length_cm / n)
        places_cm = np.interp(length_cm - new_s_cm, along_cm, s_cm)
        xy_cm, heading_rad = self.points(places_cm, offset_cm)
        curvature = np.interp(places_cm, s_cm, per_cm)
        return replace(
            self,
            s_cm=new_s_cm,
            xy_cm=xy_cm,
            heading_rad=np.unwrap(heading_rad + np.pi),
            curvature_per_cm=-curvature / (1.0 - offset_cm * curvature),
            widths=None if self.widths is None else np.interp(places_cm, self.s_cm, self.widths),
            markings=tuple(
                replace(
                    m,
                    offset_cm=offset_cm - m.offset_cm,
                    painted_cm=length_cm - np.interp(m.painted_cm[::-1, ::-1], s_cm, along_cm),
                )
                for m in self.markings
            ),
        )

    def _nearest_samples(
        self, s_cm: Float[np.ndarray, "m"]
    ) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
        """Lap and sample nearest to each distance along the road."""
        n, i = len(self.s_cm), np.rint(s_cm / self.step_cm).astype(int)
        lap = i // n if self.closed else np.zeros_like(i)
        return lap, np.clip(i - lap * n, 0, n - 1)

    def _samples(self, from_cm: float, to_cm: float) -> Int[np.ndarray, "m"]:
        """Indices of a section in the direction of travel; cut at the ends of an open road."""
        first, last = int(np.floor(from_cm / self.step_cm)), int(np.ceil(to_cm / self.step_cm))
        n = len(self.s_cm)
        if self.closed:
            return np.arange(first, min(last, first + n - 1) + 1) % n
        # Never empty: beyond an end the last two samples stand for the road.
        first = min(max(first, 0), n - 2)
        return np.arange(first, min(max(last, first + 1), n - 1) + 1)


def length_beside(
    s_cm: Float[np.ndarray, "n"], curvature_per_cm: Float[np.ndarray, "n"], offset_cm: float
) -> Float[np.ndarray, "n"]:
    """Return the length up to each sample of a line beside the centre line: shorter inside bends, [cm]."""
    scale = 1.0 - offset_cm * curvature_per_cm
    return np.concatenate([[0.0], np.cumsum(0.5 * (scale[1:] + scale[:-1]) * np.diff(s_cm))])


def paint_dashes(
    length_cm: float, closed: bool, dash_cm: float, gap_cm: float, phase: float
) -> Float[np.ndarray, "k 2"]:
    """Return the painted sections of a dashed line.

    Args:
        length_cm: Length of the road.
        closed: On a loop the period is scaled a little, so that a whole number of dashes fits.
        dash_cm: Painted length.
        gap_cm: Unpainted length.
        phase: Where the pattern starts, 0..1 of a period.

    Returns:
        Start and end of each dash within 0..length, [cm], ascending.
    """
    period_cm = dash_cm + gap_cm
    if closed:
        period_cm = length_cm / max(1, round(length_cm / period_cm))
    start = (np.arange(int(length_cm / period_cm) + 2) + phase - 1.0) * period_cm
    end = start + period_cm * dash_cm / (dash_cm + gap_cm)
    return _without_slivers(np.clip(np.stack([start, end], axis=1), 0.0, length_cm))


def interrupt(
    painted_cm: Float[np.ndarray, "k 2"],
    length_cm: float,
    per_m: float,
    max_cm: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "m 2"]:
    """Remove random sections of the paint.

    Args:
        painted_cm: Painted sections, ascending.
        length_cm: Length of the road.
        per_m: Expected number of interruptions per metre.
        max_cm: Longest interruption; the shortest is 10 cm.
        rng: Source of randomness.

    Returns:
        What is left of the paint, ascending.
    """
    for _ in range(rng.poisson(per_m * length_cm / 100.0)):
        start_cm = rng.uniform(0.0, length_cm)
        painted_cm = cut(painted_cm, start_cm, start_cm + rng.uniform(_MIN_INTERRUPTION_CM, max_cm))
    return painted_cm


def wear_off(
    painted_cm: Float[np.ndarray, "k 2"], length_cm: float, share: float, rng: np.random.Generator
) -> Float[np.ndarray, "m 2"]:
    """Let short sections flake off.

    Args:
        painted_cm: Painted sections, ascending.
        length_cm: Length of the road.
        share: Of the paint that is lost, on average.
        rng: Source of randomness.
    """
    if share <= 0.0:
        return painted_cm
    n = int(2.0 * length_cm * share / _FLAKE_CM) + 20
    lost = rng.exponential(_FLAKE_CM, n)
    kept = rng.exponential(_FLAKE_CM * (1.0 - share) / share, n)
    holes = np.cumsum(np.stack([kept, lost], axis=1).ravel()).reshape(-1, 2)
    return subtract(painted_cm, holes[holes[:, 0] < length_cm])


def cut(painted_cm: Float[np.ndarray, "k 2"], from_cm: float, to_cm: float) -> Float[np.ndarray, "m 2"]:
    """Remove one section of the paint."""
    return subtract(painted_cm, np.array([[from_cm, to_cm]]))


def subtract(
    painted_cm: Float[np.ndarray, "k 2"], holes_cm: Float[np.ndarray, "h 2"]
) -> Float[np.ndarray, "m 2"]:
    """Remove many sections of the paint; both lists are ascending and without overlap."""
    bounds = np.unique(np.concatenate([painted_cm.ravel(), holes_cm.ravel()]))
    middle = 0.5 * (bounds[1:] + bounds[:-1])
    keep = is_painted(painted_cm, middle) & ~is_painted(holes_cm, middle)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], keep, [False]]).astype(np.int8)))
    return _without_slivers(bounds[edges].reshape(-1, 2))


def is_painted(painted_cm: Float[np.ndarray, "k 2"], s_cm: Float[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
    """Return for each distance along the road whether it lies on a painted section."""
    if not len(painted_cm):
        return np.zeros(len(s_cm), bool)
    i = np.searchsorted(painted_cm[:, 0], s_cm, side="right") - 1
    return (i >= 0) & (s_cm < painted_cm[np.maximum(i, 0), 1])


def _without_slivers(sections_cm: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, "m 2"]:
    return sections_cm[sections_cm[:, 1] - sections_cm[:, 0] > 1e-9]


def write_track(path: Path, track: Track) -> None:
    """Write a track; lengths in cm, angles in rad, frame map."""
    data = {
        "format": FORMAT,
        "closed": track.closed,
        "lane_width_cm": track.lane_width_cm,
        "oncoming_cm": track.oncoming_cm,
        **{name: getattr(track, name) for name in _COLUMNS},
        "markings": [vars(marking) for marking in track.markings],
        "boxes": track.boxes,
    }
    if track.widths is not None:
        data["widths"] = track.widths
    write_json(path, data)


def read_track(path: Path) -> Track:
    """Read a track.

    Raises:
        DriveFormatError: If the file is missing, is not a track of this version, or its columns do not fit.
    """
    data = read_json(path, DriveFormatError)
    found = data.get("format") if isinstance(data, dict) else type(data).__name__
    if found != FORMAT:
        raise DriveFormatError(f"{path}: expected format {FORMAT!r}, found {found!r}")
    with parsing(f"{path}: not the numbers of a track", DriveFormatError):
        return _track_of(path, data)


def _track_of(path: Path, data: dict[str, Any]) -> Track:
    columns: dict[str, Any] = {name: np.asarray(data[name], dtype=np.float64) for name in _COLUMNS}
    columns["xy_cm"] = columns["xy_cm"].reshape(-1, 2)
    markings = []
    for m in data["markings"]:
        blue, green, red = map(float, m["colour_bgr"])
        painted_cm = np.asarray(m["painted_cm"], dtype=np.float64).reshape(-1, 2)
        markings.append(Marking(float(m["offset_cm"]), float(m["width_cm"]), (blue, green, red), painted_cm))
    if not isinstance(data["closed"], bool):
        raise ValueError(f"key 'closed': expected true or false, found {data['closed']!r}")
    rest: dict[str, Any] = {
        "closed": data["closed"],
        "lane_width_cm": float(data["lane_width_cm"]),
        "boxes": np.asarray(data["boxes"], dtype=np.float64).reshape(-1, 9),
        "oncoming_cm": None if data["oncoming_cm"] is None else float(data["oncoming_cm"]),
    }
    if data.get("widths") is not None:  # older files have none
        columns["widths"] = np.asarray(data["widths"], dtype=np.float64)
    lengths = [len(column) if column.ndim else 0 for column in columns.values()]
    if min(lengths) < 2 or len(set(lengths)) > 1:
        raise DriveFormatError(
            f"{path}: expected {', '.join(columns)} of one length of at least 2, "
            f"found {', '.join(map(str, lengths))}"
        )
    painted = [np.array([m.offset_cm, m.width_cm, *m.colour_bgr, *m.painted_cm.ravel()]) for m in markings]
    sizes = np.array([rest["lane_width_cm"], rest["oncoming_cm"] or 0.0])
    if not all((np.abs(v) <= MAX_PLACE).all() for v in (*columns.values(), rest["boxes"], *painted, sizes)):
        raise ValueError(f"a number is missing, not finite or above {MAX_PLACE:g}")
    steps_cm = np.diff(columns["s_cm"])
    # Evenly spaced, but for the digits of the file.
    if columns["s_cm"][0] != 0.0 or not (steps_cm > 0.0).all() or np.ptp(steps_cm) > 0.01 * steps_cm[0]:
        raise ValueError("key 's_cm': expected evenly spaced distances from 0")
    if not (rest["lane_width_cm"] > 0.0 and all(m.width_cm > 0.0 for m in markings)):
        raise ValueError("keys 'lane_width_cm' and 'width_cm': expected more than 0")
    return Track(**columns, markings=tuple(markings), **rest)
