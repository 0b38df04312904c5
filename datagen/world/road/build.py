"""From settings to a road: its centre line, its painted lines, and the things on it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from datagen.world.road.centre_line import (
    CentreLine,
    closed_centre_line,
    comes_near_itself,
    open_centre_line,
)
from datagen.world.road.furniture import COLOURS, Colour, Painted, listed_furniture, random_furniture
from datagen.world.road.pieces import lay_out, length_of
from datagen.world.road.track import Marking, Track, cut, interrupt, length_beside, paint_dashes, wear_off
from datagen.world.road.track_settings import LOOP_CM, MarkingSettings, TrackSettings
from lanenet.errors import ConfigError

#: Between the outer lines of two sections of a random road, in lane widths: no line is near another road's.
_CLEARANCE_LANES = 0.5
#: Stretch over which a lane widens before a bend; chosen: a wide lane begins a little before the bend.
_WIDENS_OVER_CM = 40.0
#: Length of the pieces of tape that make up a line beside a lane that widens: a bend of 40 cm leaves them by
#: 0.03 cm.
_TAPE_PIECE_CM = 3.0


def random_track(settings: TrackSettings, rng: np.random.Generator) -> Track:
    """Build the road that settings stand for, and draw what they leave open.

    Args:
        settings: What is fixed; ``length_cm`` None means ``LOOP_CM`` here.
        rng: Source of randomness; shape, markings, interruptions, wear and furniture draw from
            children of their own.

    Returns:
        The road, from the origin of the map along +x.

    Raises:
        ConfigError: If the settings leave no road that keeps clear of itself, or the pieces or the furniture
            do not fit.
    """
    # The order is part of the format: a new part of the road takes a new child at the end.
    shape_rng, kind_rng, interruption_rng, wear_rng, furniture_rng = rng.spawn(5)
    _check_widths(settings)
    _check_radii(settings)
    line = _centre_line(settings, shape_rng)
    n = len(line.xy_cm)
    track = Track(
        s_cm=np.arange(n) * line.step_cm,
        xy_cm=line.xy_cm,
        heading_rad=line.heading_rad,
        curvature_per_cm=line.curvature_per_cm,
        closed=settings.closed,
        lane_width_cm=settings.lane_width_cm,
        markings=(),
        oncoming_cm=settings.lane_width_cm if settings.lanes == 2 else None,
    )
    width_cm, items = settings.line_width_cm, settings.furniture
    things = listed_furniture(track, items, width_cm, settings.origin)
    # In the colour of the line on the right, except that a yellow road has white bars.
    right = settings.right.colour
    colour: Colour = right if right in ("black", "blue", "red") else "white"
    middle = None if settings.middle is None or settings.middle.colour == "random" else settings.middle.colour
    things += random_furniture(
        track, settings.random_furniture, items, width_cm, colour, furniture_rng, middle
    )
    markings = [
        marking
        for name in settings.lines
        for marking in _line(settings, name, track, kind_rng, interruption_rng, wear_rng)
    ]
    markings = [_without_cuts(marking, things, track) for marking in markings]
    if settings.crosses:
        markings = [_open_at_crossings(marking, track) for marking in markings]
    boxes = [np.empty((0, 9)), *(thing.boxes for thing in things)]
    if settings.widening > 0.0:
        track = replace(track, widths=_widths(track, settings.widening))
        boxes += [_pieces_of_tape(marking, track) for marking in markings]
        markings = []
    return replace(track, markings=tuple(markings), boxes=np.concatenate(boxes))


def check_drivable(
    track: Track,
    min_radius_cm: float,
    settings: TrackSettings | None = None,
    car: str = "the car",
    backward: bool = False,
) -> None:
    """Refuse a road with bends that are too tight for a car.

    Args:
        track: The road, in the direction in which it is driven.
        min_radius_cm: Of the car: wheelbase over the tangent of the largest steering angle.
        settings: What the road was built from; the error names its file and piece.
        car: What the error calls the car.
        backward: Whether the road is driven against the order of its pieces.

    Raises:
        ConfigError: With the tightest bend and its place.
    """
    i = int(np.argmax(np.abs(track.curvature_per_cm)))
    tightest = abs(float(track.curvature_per_cm[i]))
    if tightest * min_radius_cm > 1.001:
        where, s_cm = "track", float(track.s_cm[i])
        place = f"at {s_cm:.0f} cm"
        if settings is not None:
            where = settings.origin
            # The pieces are listed in the direction of the file.
            if settings.pieces and abs(track.length_cm - length_of(settings.pieces)) < 1.0:
                place = f"in {_piece_at(settings, track.length_cm - s_cm if backward else s_cm)}"
        raise ConfigError(
            f"{where}: found a bend of radius {1.0 / tightest:.1f} cm {place}, expected at least "
            f"{min_radius_cm:.1f}, which is what {car} turns"
        )


def _check_widths(settings: TrackSettings) -> None:
    """Refuse lines that leave no lane between them."""
    for name, (_, marking) in settings.lines.items():
        width_cm = settings.line_width_cm if marking.width_cm is None else marking.width_cm
        whole_cm = 2.0 * width_cm + marking.double_gap_cm if marking.kind == "double" else width_cm
        if whole_cm >= settings.lane_width_cm:
            raise ConfigError(
                f"{settings.origin}: key '{name}': found a line {whole_cm:g} cm wide, expected less than the "
                f"lane_width_cm {settings.lane_width_cm:g}"
            )


def _check_radii(settings: TrackSettings) -> None:
    """Refuse bends whose inner line would have no radius left."""
    width_cm, tape_cm = settings.lane_width_cm, settings.line_width_cm
    if not settings.pieces:
        if settings.min_radius_cm <= 0.5 * width_cm + tape_cm:
            raise ConfigError(
                f"{settings.origin}: min_radius_cm {settings.min_radius_cm:g} must exceed half the "
                f"lane_width_cm {width_cm:g} and the line_width_cm {tape_cm:g}"
            )
        return
    low_cm, high_cm = _reach_cm(settings)
    inside_cm = {"right": tape_cm - low_cm, "left": high_cm + tape_cm}
    for number, piece in enumerate(settings.pieces):
        for key, radius_cm, direction in piece.bends():
            if radius_cm <= inside_cm[direction]:
                raise ConfigError(
                    f"{settings.origin}: key 'pieces.{number}.{piece.kind}.{key}': found {radius_cm:g}, "
                    f"expected more than {inside_cm[direction]:g}: the road reaches that far to the "
                    f"{direction} of its centre line"
                )


def _reach_cm(settings: TrackSettings) -> tuple[float, float]:
    """Offsets of the outermost lines on the right and on the left."""
    offsets_cm = [offset_cm for offset_cm, _ in settings.lines.values()]
    return min(offsets_cm), max(offsets_cm)


def _centre_line(settings: TrackSettings, rng: np.random.Generator) -> CentreLine:
    road_cm = settings.lanes * settings.lane_width_cm
    middle_cm = 0.5 * (road_cm - settings.lane_width_cm)
    if settings.pieces:
        if settings.lanes == 2 and any(piece.kind == "kink" for piece in settings.pieces):
            raise ConfigError(f"{settings.origin}: key 'lanes': found 2, expected 1 on a road with kinks")
        line = lay_out(settings.pieces, settings.closed, settings.origin, settings.crosses)
        low_cm, high_cm = _reach_cm(settings)
        found = comes_near_itself(
            line,
            high_cm - low_cm + settings.line_width_cm,
            settings.closed,
            middle_cm=0.5 * (low_cm + high_cm),
            crosses=settings.crosses,
        )
        if found is not None:
            first, second, distance, least_cm = found
            raise ConfigError(
                f"{settings.origin}: pieces: the road meets itself: {_piece_at(settings, first)} and "
                f"{_piece_at(settings, second)} come within {distance:.1f} cm of each other, expected at "
                f"least {least_cm:.1f}: its width, and what the check leaves open"
            )
        return line
    # The other lane must keep to the smallest radius as well, and it lies inside left bends.
    radii_cm = (settings.min_radius_cm + 2.0 * middle_cm, settings.min_radius_cm)
    separation_cm = road_cm + 2.0 * _CLEARANCE_LANES * 0.5 * settings.lane_width_cm
    length_cm = LOOP_CM if settings.length_cm is None else settings.length_cm
    if settings.closed:
        return closed_centre_line(length_cm, radii_cm, separation_cm, middle_cm, rng)
    return open_centre_line(length_cm, radii_cm, separation_cm, middle_cm, rng, settings.corners)


def _piece_at(settings: TrackSettings, s_cm: float) -> str:
    """Name the piece at a place along the road."""
    ends_cm = np.cumsum([length_of([piece]) for piece in settings.pieces])
    number = min(int(np.searchsorted(ends_cm, s_cm)), len(ends_cm) - 1)
    piece = settings.pieces[number]
    return f"pieces.{number} ({piece.kind}, at {s_cm:.0f} cm)"


def _line(
    settings: TrackSettings,
    name: str,
    track: Track,
    kind_rng: np.random.Generator,
    interruption_rng: np.random.Generator,
    wear_rng: np.random.Generator,
) -> Iterator[Marking]:
    """Paint one line; a double one yields two."""
    offset_cm, marking = settings.lines[name]
    chance, colour_chance, phase = kind_rng.random(3)
    dashed = marking.kind == "dashed" or (marking.kind == "random" and chance < 0.5)
    colour = marking.colour
    if colour == "random":
        colour = "yellow" if colour_chance < 0.5 else "white"
    length_cm = track.length_cm
    painted_cm = np.array([[0.0, length_cm]])
    if dashed:
        start = float(phase) if marking.phase is None else marking.phase
        painted_cm = _dashes(track, offset_cm, marking, start)
    per_m = marking.interruptions_per_m
    per_m = settings.interruptions_per_m if per_m is None else per_m
    painted_cm = interrupt(painted_cm, length_cm, per_m, settings.max_interruption_cm, interruption_rng)
    for start_cm, end_cm in marking.interruptions:
        if end_cm > length_cm:
            raise ConfigError(
                f"{settings.origin}: key '{name}.interruptions': found one up to {end_cm:g} cm, but the road "
                f"is {length_cm:.1f} cm long"
            )
        painted_cm = cut(painted_cm, start_cm, end_cm)
    painted_cm = wear_off(painted_cm, length_cm, marking.wear, wear_rng.spawn(1)[0])
    if marking.kind == "none":
        return
    width_cm = settings.line_width_cm if marking.width_cm is None else marking.width_cm
    apart_cm = 0.5 * (width_cm + marking.double_gap_cm)
    for shift_cm in (apart_cm, -apart_cm) if marking.kind == "double" else (0.0,):
        yield Marking(offset_cm + shift_cm, width_cm, COLOURS[colour], painted_cm)


def _dashes(
    track: Track, offset_cm: float, marking: MarkingSettings, phase: float
) -> Float[np.ndarray, "k 2"]:
    """Dashes of even length along a line, which is shorter than the centre line inside bends."""
    s_cm = np.append(track.s_cm, [track.length_cm] if track.closed else [])
    per_cm = np.append(track.curvature_per_cm, track.curvature_per_cm[:1] if track.closed else [])
    along_cm = length_beside(s_cm, per_cm, offset_cm)
    dashes = paint_dashes(float(along_cm[-1]), track.closed, marking.dash_cm, marking.gap_cm, phase)
    return np.interp(dashes, along_cm, s_cm)


def _open_at_crossings(marking: Marking, track: Track) -> Marking:
    """Interrupt a line where it would lie on another section of the road."""
    reach_cm = track.half_width_cm + marking.width_cm
    on_cm = track.middle_cm
    line_cm = track.beside(np.arange(len(track.s_cm)), marking.offset_cm)
    road_cm = track.beside(np.arange(len(track.s_cm)), on_cm)
    painted_cm, lap_cm = marking.painted_cm, track.length_cm
    for k, near in enumerate(cKDTree(road_cm).query_ball_point(line_cm, reach_cm)):
        along_cm = np.abs(track.s_cm[near] - track.s_cm[k])
        if (np.minimum(along_cm, lap_cm - along_cm) > np.pi * reach_cm).any():
            painted_cm = cut(painted_cm, track.s_cm[k] - track.step_cm, track.s_cm[k] + track.step_cm)
    return replace(marking, painted_cm=painted_cm)


def _widths(track: Track, widening: float) -> Float[np.ndarray, "n"]:
    """Lane width at each sample over that of a straight: it grows with the curvature, over half a metre."""
    bend = np.abs(track.curvature_per_cm)
    n = max(1, round(0.5 * _WIDENS_OVER_CM / track.step_cm))
    bend = np.pad(bend, 2 * n, mode="wrap" if track.closed else "edge")
    for _ in range(2):  # twice, so that the lines have no kinks
        bend = np.convolve(bend, np.full(2 * n + 1, 1.0 / (2 * n + 1)), "valid")
    return 1.0 + widening * bend / max(float(bend.max()), 1e-9)


def _pieces_of_tape(marking: Marking, track: Track) -> Float[np.ndarray, "b 9"]:
    """Lay a line beside a lane that widens as short pieces of tape: rows of ``Track.boxes``."""
    rows = [np.empty((0, 9))]
    at_cm = np.append(track.s_cm, track.s_cm[-1] + track.step_cm)
    index = np.arange(len(at_cm)) % len(track.s_cm) if track.closed else np.arange(len(track.s_cm))
    at_cm = at_cm[: len(index)]
    line_cm = track.beside(index, marking.offset_cm * track.width_factors[index])
    for start_cm, end_cm in marking.painted_cm:
        places_cm = np.linspace(
            start_cm, end_cm, max(2, int(np.ceil((end_cm - start_cm) / _TAPE_PIECE_CM)) + 1)
        )
        points_cm = np.stack([np.interp(places_cm, at_cm, line_cm[:, k]) for k in range(2)], axis=1)
        along_cm = np.diff(points_cm, axis=0)
        length_cm = np.linalg.norm(along_cm, axis=1, keepdims=True)
        n = len(along_cm)
        rows.append(
            np.hstack(
                [
                    points_cm[:-1] + 0.5 * along_cm,
                    along_cm / length_cm,
                    0.5 * length_cm + 0.1 * marking.width_cm,  # they overlap: no floor shows in bends
                    np.full((n, 1), 0.5 * marking.width_cm),
                    np.broadcast_to(marking.colour_bgr, (n, 3)),
                ]
            )
        )
    return np.concatenate(rows)


def _without_cuts(marking: Marking, things: list[Painted], track: Track) -> Marking:
    """Interrupt a line where something takes its place."""
    painted_cm, lap_cm = marking.painted_cm, track.length_cm
    for thing in things:
        for offset_cm, start_cm, end_cm in thing.cuts:
            if abs(offset_cm - marking.offset_cm) > 0.25 * track.lane_width_cm:
                continue
            # Where a loop begins and ends, both ends of the line are cut.
            for shift_cm in (-lap_cm, 0.0, lap_cm) if track.closed else (0.0,):
                painted_cm = cut(painted_cm, start_cm + shift_cm, end_cm + shift_cm)
    return replace(marking, painted_cm=painted_cm)
