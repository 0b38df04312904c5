"""Joined lines followed through the edges, and the choice of the two that bound the lane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from lanenet.perception.image_lane import Polyline, sample_segment
from lanenet.perception.painter.curves import (
    Curve,
    CurveSettings,
    Plane,
    fit_curve,
    move_lines,
    slide_windows,
)
from lanenet.perception.painter.lines import (
    EdgeField,
    EvidenceSettings,
    LineEvidence,
    PainterLineSettings,
    SolidLine,
    are_apart,
    measure_evidence,
)

#: Widest inner pair as a share of the pair that holds a neighbouring lane as well. Chosen: between a half,
#: for lanes of equal width, and 1.
_INNER_WIDTH = 0.75


@dataclass(frozen=True)
class Marking:
    """A line of one side: where it lies and what supports it.

    Attributes:
        line: Where segments put it.
        curve: The parabola through the edges beside it, in the plane; None where it stays straight.
        line_px: The line in the image, near to far.
        points: The line in the plane, by rising y; empty where the plane does not hold it.
        evidence: Its support by the edges.
        known: It was answered in the frame before.
    """

    line: SolidLine
    curve: Curve | None
    line_px: Polyline
    points: Float[np.ndarray, "n 2"]
    evidence: LineEvidence = field(default_factory=LineEvidence)
    known: bool = False


Pair = tuple[Marking | None, Marking | None]


def straight_px(line: SolidLine, trapezoid_px: Float[np.ndarray, "4 2"]) -> Polyline:
    """Return the line from the region's bottom to its top, [px]."""
    near = (line.bottom_px, float(trapezoid_px[2, 1]))
    return sample_segment(near, (line.top_px, float(trapezoid_px[0, 1])))


def follow_lines(
    lines: Sequence[SolidLine],
    plane: Plane,
    trapezoid_px: Float[np.ndarray, "4 2"],
    edge_points: Float[np.ndarray, "n 2"],
    half_width: float,
    settings: CurveSettings | None,
) -> dict[SolidLine, tuple[Marking, Marking | None]]:
    """Return each straight line as a marking, with the curve that windows along it find, if any.

    Args:
        lines: Joined lines.
        plane: Where curves are followed.
        trapezoid_px: The region.
        edge_points: All edges in the plane.
        half_width: Half the width of a window in the plane.
        settings: Of the curves; None leaves the line straight.
    """
    lines_px = [straight_px(line, trapezoid_px) for line in lines]
    guesses = move_lines(plane.from_image, lines_px)
    straight = [
        Marking(line, None, line_px, guess[np.argsort(guess[:, 1], kind="stable")])
        for line, line_px, guess in zip(lines, lines_px, guesses, strict=True)
    ]
    if settings is None:
        return {marking.line: (marking, None) for marking in straight}
    found = [_find_curve(guess, edge_points, half_width, settings) for guess in guesses]
    paths = [curve.sample(float(guess[0, 1])) for curve, guess in zip(found, guesses, strict=True) if curve]
    paths_px = iter(move_lines(plane.to_image, paths))
    both: dict[SolidLine, tuple[Marking, Marking | None]] = {}
    for marking, curve in zip(straight, found, strict=True):
        curved = None
        if curve is not None and len(curve_px := next(paths_px)) >= 2:
            curved = Marking(marking.line, curve, curve_px, curve.sample())
        both[marking.line] = marking, curved
    return both


def _find_curve(
    guess: Float[np.ndarray, "m 2"],
    edge_points: Float[np.ndarray, "n 2"],
    half_width: float,
    settings: CurveSettings,
) -> Curve | None:
    """The parabola through the edges along a straight line of the plane, if there are enough of them."""
    if len(guess) < 2 or not np.all(np.diff(guess[:, 1]) > 0.0):
        return None
    seen = edge_points[:, 1].max() if len(edge_points) else guess[-1, 1]
    length = float(min(guess[-1, 1], seen) - guess[0, 1])
    if length <= 0.0:
        return None
    return fit_curve(slide_windows(edge_points, guess, half_width, settings), length, settings)


def weigh(
    straight: Marking, curved: Marking | None, edges: EdgeField, known: bool, settings: EvidenceSettings
) -> Marking:
    """Return the curve if about as many edges support it as the straight line, which else is returned.

    The curve is preferred since it is fitted to both borders of the marking and lies on its middle.
    """
    first, *second = (
        replace(m, evidence=measure_evidence(m.line_px, edges, settings), known=known)
        for m in (straight, curved)
        if m is not None
    )
    if second and second[0].evidence.score >= settings.curve_share * first.evidence.score:
        return second[0]
    return first


def choose_lane(
    lefts: Sequence[Marking],
    rights: Sequence[Marking],
    trapezoid_px: Float[np.ndarray, "4 2"],
    camera_height_cm: float | None,
    lines: PainterLineSettings,
    settings: EvidenceSettings,
) -> Pair:
    """Choose the lane that the car is in; without one, the best line that can be answered alone.

    A much narrower pair that scores about as much as the best one is the car's lane: the wider one includes
    the neighbouring lane.

    Args:
        lefts: Lines of the left side.
        rights: Lines of the right side.
        trapezoid_px: The region.
        camera_height_cm: Unit of the lane's width in the plane; None where the plane is no road.
        lines: Tolerances of straight lines.
        settings: Thresholds of the evidence.
    """
    pairs = [
        (left, right)
        for left in lefts
        for right in rights
        if are_apart(left.line, right.line, trapezoid_px, lines)
        and _is_lane(left, right, camera_height_cm, settings)
        and _is_convincing(left, right, settings)
    ]
    if pairs:
        whole = max(pairs, key=_score)
        inner = [
            pair
            for pair in pairs
            if _score(pair) >= settings.inner_share * _score(whole)
            and _width_px(pair) <= _INNER_WIDTH * _width_px(whole)
        ]
        return max(inner, key=_score) if inner else whole
    best: Pair = (None, None)
    best_score = 0.0
    for side, markings in enumerate((lefts, rights)):
        for marking in markings:
            evidence = marking.evidence
            alone = evidence.is_strong(settings) and evidence.support >= settings.alone_support
            # A line of the frame before needs less evidence.
            alone = alone or (marking.known and evidence.is_likely(settings))
            if alone and marking.evidence.score > best_score:
                best = (marking, None) if side == 0 else (None, marking)
                best_score = marking.evidence.score
    return best


def _width_px(pair: tuple[Marking, Marking]) -> float:
    return pair[1].line.bottom_px - pair[0].line.bottom_px


def _score(pair: tuple[Marking, Marking]) -> float:
    return pair[0].evidence.score + pair[1].evidence.score


def _is_convincing(left: Marking, right: Marking, settings: EvidenceSettings) -> bool:
    pair = (left, right)
    if not all(m.evidence.is_likely(settings, m.known) for m in pair):
        return False
    scored = all(m.known for m in pair) or _score(pair) >= settings.min_pair_score
    if not scored and any(m.evidence.contrast < settings.clear_contrast for m in pair):
        return False
    sure = any(m.known or m.evidence.is_strong(settings) for m in pair)
    return sure or all(
        m.evidence.extent >= settings.min_extent or m.evidence.contrast >= settings.clear_contrast
        for m in pair
    )


def can_bound_the_lane(
    markings: Sequence[Marking],
    plane: Plane,
    width_px: int,
    camera_height_cm: float,
    settings: EvidenceSettings,
) -> list[Marking]:
    """Drop lines that are further beside the car than the widest lane, at their nearest visible point.

    Args:
        markings: Lines of one side.
        plane: The road.
        width_px: Of the image.
        camera_height_cm: Unit of the lane's width.
        settings: The widest lane.
    """
    widest_cm = settings.max_width_heights * camera_height_cm
    visible = [m.line_px[(m.line_px[:, 0] >= 0.0) & (m.line_px[:, 0] <= width_px - 1.0)] for m in markings]
    kept = []
    for marking, seen in zip(markings, move_lines(plane.from_image, visible), strict=True):
        if len(seen) and abs(float(seen[np.argmin(seen[:, 1]), 0])) <= widest_cm:
            kept.append(marking)
    return kept


def _is_lane(
    left: Marking, right: Marking, camera_height_cm: float | None, settings: EvidenceSettings
) -> bool:
    """Whether the lane is about as wide at its far end as at its near end, and not too wide."""
    if len(left.points) < 2 or len(right.points) < 2:
        return False
    ends = (max(left.points[0, 1], right.points[0, 1]), min(left.points[-1, 1], right.points[-1, 1]))
    if ends[1] <= ends[0]:
        return False
    near, far = (
        float(np.interp(y, right.points[:, 1], right.points[:, 0]))
        - float(np.interp(y, left.points[:, 1], left.points[:, 0]))
        for y in ends
    )
    if near <= 0.0 or far <= 0.0 or max(near, far) > settings.max_width_ratio * min(near, far):
        return False
    return camera_height_cm is None or near <= settings.max_width_heights * camera_height_cm
