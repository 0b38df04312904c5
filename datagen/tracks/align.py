"""One map laid over another: guesses from the shape of their lines, each refined and measured.

A guess lays a stretch of one line along a stretch of another of the same length, in either direction, which
has a closed form (Procrustes). It is refined by the distances of all points of one map from the lines of the
other, with an error along the lines that costs nothing.

Source:
    Chen and Medioni 1992, "Object modelling by registration of multiple range images": points to lines.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree

from datagen.tracks.shape import STEP_CM, SampledLine, Similarity, TrackShape

#: Every so many samples of a line one counts for guesses. Chosen: 6 cm.
_EVERY = 3
#: A stretch turns by this much at least, [rad]: straight ones fit any other. Chosen: half of a sharp corner.
_LEAST_TURN_RAD = 0.8
#: Stretches of the shorter line, as shares of it; the longest first.
_SHARES = (1.0, 0.5)
#: What a stretch may miss in the mean, in lane widths, and guesses that are refined per pair of maps.
#: Chosen: maps of one track agree ten times better; refining takes 10 ms.
_ROUGH_LANES, _MOST_GUESSES = 0.5, 16
#: Guesses that move the track by less than this, in lane widths, are the same one.
_SAME_LANES = 0.4
#: Gates of the refinement, in lane widths, steps in each, and cosine between lines that may be one.
_GATES_LANES, _STEPS, _COSINE = (0.6, 0.3, 0.15, 0.1, 0.1), 4, 0.92
#: Lines of two maps are one up to this distance, in lane widths. Chosen: far from the middle of the lane.
_MET_LANES = 0.2
#: Sigma of the scale between two maps: two lane widths measured with a ruler, 1.2 % each, which the shape
#: overrules; and of a point across its line, in lane widths, of which one in so many lane widths counts.
_SCALE_SIGMA, _POINT_LANES, _ALIKE_LANES = 0.02, 0.02, 0.5
#: Share of the first map's points that must be near the second one's path to begin with. Chosen: a third of
#: a lap is not joined.
_LEAST_NEAR = 0.25
#: Points that are fitted, and share of those near the other map that must meet one of its lines. Chosen:
#: one every 5 cm, and half of what two maps of a track that was partly laid anew share.
_FITTED, _LEAST_MET = 250, 0.4


@dataclass(frozen=True, eq=False)
class Alignment:
    """One map laid over another.

    Attributes:
        move: Moves the first map onto the second.
        opposite: Whether their drives went in opposite directions.
        apart_cm: Distance of each of the first map's points (:attr:`TrackShape.points_cm`) from the lines of
            the second, signed across the line; NaN where there is none within a fifth of a lane, inf where
            the second map does not know: its car was never near, or it has a line there that it did not see.
        back_cm: The same for the second map's points.
        slack_cm: Sigma of where the worst known point lies on the second map, from the lines alone: large
            where they can slide along each other.
    """

    move: Similarity
    opposite: bool
    apart_cm: Float[np.ndarray, "m"]
    back_cm: Float[np.ndarray, "k"]
    slack_cm: float

    @property
    def shared(self) -> tuple[float, float]:
        """Share of each map's points near which the other car has been."""
        return tuple(float(np.mean(~np.isinf(off))) for off in (self.apart_cm, self.back_cm))  # type: ignore[return-value]

    def agreeing(self, within_cm: float) -> float:
        """Share of the points that both maps know at which both have a line; the worse way counts."""
        shares = []
        for off in (self.apart_cm, self.back_cm):
            near = off[~np.isinf(off)]
            shares.append(float(np.mean(np.abs(near) < within_cm)) if len(near) else 0.0)
        return min(shares)

    def shared_length_cm(self) -> float:
        """Length of the lines that both cars were near."""
        return STEP_CM * float(min(np.sum(~np.isinf(off)) for off in (self.apart_cm, self.back_cm)))

    @property
    def p95_cm(self) -> float:
        """Distance between the lines of both maps, 95th percentile where they agree at all."""
        off = np.abs(np.concatenate([self.apart_cm, self.back_cm]))
        off = off[np.isfinite(off)]
        return float(np.percentile(off, 95.0)) if len(off) else float("inf")


def alignments(first: TrackShape, second: TrackShape) -> list[Alignment]:
    """Lay the first map over the second in every way that their shapes propose; the best first."""
    found: list[Alignment] = []
    lane_cm = second.lane_cm
    for _, guess, opposite in guesses(first, second):
        if any(moved_cm(first, one.move, guess) < _SAME_LANES * lane_cm for one in found):
            continue
        one = refined(first, second, guess, opposite)
        if one is None:
            continue
        known = [i for i, k in enumerate(found) if moved_cm(first, k.move, one.move) < _SAME_LANES * lane_cm]
        if not known:
            found.append(one)
        elif quality(one, lane_cm) > quality(found[known[0]], lane_cm):
            found[known[0]] = one
    return sorted(found, key=lambda one: -quality(one, lane_cm))


def quality(one: Alignment, lane_cm: float) -> float:
    """How well an alignment explains both maps: the share that agrees of what both cars were near, and it."""
    return one.agreeing(0.1 * lane_cm) * min(one.shared)


def moved_cm(shape: TrackShape, one: Similarity, other: Similarity) -> float:
    """Mean distance between the places where two alignments have a track."""
    return float(np.hypot(*(one.points(shape.path_cm) - other.points(shape.path_cm)).T).mean())


def guesses(first: TrackShape, second: TrackShape) -> list[tuple[float, Similarity, bool]]:
    """Propose how to lay one map over another, from stretches of their lines.

    Returns:
        What each misses in the mean, [cm], the similarity, and whether the drives went in opposite
        directions; the best first.
    """
    found: list[tuple[float, Similarity, bool]] = []
    for a, b, opposite in product(first.lines, second.lines, (False, True)):
        # Lines on the other side of the lane are as far apart as the lane is wide; a few per cent of the lap.
        found += _of_lines(a, b, opposite, second.lane_cm)
    found.sort(key=lambda one: one[0])
    kept: list[tuple[float, Similarity, bool]] = []
    for one in found:
        if all(moved_cm(first, one[1], k[1]) > _SAME_LANES * second.lane_cm for k in kept):
            kept.append(one)
            if len(kept) == _MOST_GUESSES:
                break
    return kept


def _of_lines(
    a: SampledLine, b: SampledLine, opposite: bool, lane_cm: float
) -> list[tuple[float, Similarity, bool]]:
    """Lay stretches of one line along another."""
    za, zb = (line.xy_cm[:, 0] + 1j * line.xy_cm[:, 1] for line in (a, b))
    if opposite:
        zb = zb[::-1]
    if a.closed and b.closed:
        ratio = len(zb) / len(za)
        if abs(ratio - 1.0) > 0.1:
            return []
        count = max(len(za) // _EVERY, 8)
        za, zb = _resampled(za, count), _resampled(zb, count)
        return _sliding(za, np.concatenate([zb, zb[:-1]]), opposite, lane_cm)
    za, zb = za[::_EVERY], zb[::_EVERY]
    shorter = min(len(za), len(zb))
    found = []
    for share in _SHARES:
        window = int(share * shorter)
        if window < 8:
            continue
        around = np.concatenate([zb, zb[: window - 1]]) if b.closed else zb
        own = np.concatenate([za, za[: window - 1]]) if a.closed else za
        for start in range(0, len(own) - window + 1, max(window // 2, 1)):
            found += _sliding(own[start : start + window], around, opposite, lane_cm)
    return found


def _resampled(z: np.ndarray, count: int) -> np.ndarray:
    """Take so many points evenly of a closed line."""
    at = np.arange(count) * len(z) / count
    closed = np.append(z, z[0])
    grid = np.arange(len(closed))
    return np.asarray(np.interp(at, grid, closed.real) + 1j * np.interp(at, grid, closed.imag))


def _sliding(
    za: np.ndarray, zb: np.ndarray, opposite: bool, lane_cm: float
) -> list[tuple[float, Similarity, bool]]:
    """Lay one stretch along every place of another line; those that miss less than their neighbours stay."""
    step = np.diff(za)
    turned = np.abs(np.angle(step[1:] / np.where(step[:-1] == 0.0, 1.0, step[:-1])))
    if turned.sum() < _LEAST_TURN_RAD:
        return []
    own = za - za.mean()
    windows = sliding_window_view(zb, len(za))
    means = windows.mean(axis=1)
    centred = windows - means[:, None]
    cross = centred @ own.conj()
    energy = float(np.vdot(own, own).real)
    other = np.sum(np.abs(centred) ** 2, axis=1)
    missed = np.sqrt(np.maximum(energy + other - 2.0 * np.abs(cross), 0.0) / len(za))
    padded = np.concatenate([[np.inf], missed, [np.inf]])
    lowest = np.flatnonzero(
        (missed <= padded[:-2]) & (missed <= padded[2:]) & (missed < _ROUGH_LANES * lane_cm)
    )
    found = []
    for k in lowest.tolist():
        turn = float(np.angle(cross[k]))
        at = means[k] - np.exp(1j * turn) * za.mean()
        found.append((float(missed[k]), Similarity(float(at.real), float(at.imag), turn), opposite))
    return found


def refined(first: TrackShape, second: TrackShape, guess: Similarity, opposite: bool) -> Alignment | None:
    """Refine a guess and measure it; None where hardly anything meets."""
    move, lane_cm = guess, second.lane_cm
    every = max(len(first.points_cm) // _FITTED, 1)
    points, tangents = first.points_cm[::every], first.tangents[::every]
    near = float(np.mean(second.surveyed(guess.points(points))))
    if near < _LEAST_NEAR:
        return None
    least = _LEAST_MET * near
    centre = points.mean(axis=0)
    information = np.zeros((4, 4))
    for gate in _GATES_LANES:
        for _ in range(_STEPS):
            at, along = move.points(points), move.directions(tangents)
            off, normal, met = _off_lines(
                second.tree, second.points_cm, second.tangents, at, along, gate * lane_cm
            )
            if met.mean() < max(least, _LEAST_MET**2):
                return None
            offset = at[met] - move.points(centre[None])[0]
            n = normal[met]
            jacobian = np.column_stack(
                [n, n[:, 1] * offset[:, 0] - n[:, 0] * offset[:, 1], np.sum(n * offset, axis=1)]
            )
            sigma = _POINT_LANES * lane_cm
            # Neighbouring points err alike.
            weight = (
                every
                * STEP_CM
                / (_ALIKE_LANES * lane_cm)
                / sigma**2
                / (1.0 + (off[met] / (2.0 * sigma)) ** 2)
            )
            information = (jacobian * weight[:, None]).T @ jacobian
            prior = np.diag([0.0, 0.0, 0.0, 1.0 / _SCALE_SIGMA**2])
            pull = -(jacobian * weight[:, None]).T @ off[met] - prior @ [0, 0, 0, np.log(move.scale)]
            dx, dy, turn, grow = np.linalg.lstsq(information + prior, pull, rcond=1e-12)[0]
            move = _stepped(move, centre, float(dx), float(dy), float(turn), float(grow))
    apart_cm, _ = distances(second, move.points(first.points_cm), move.directions(first.tangents))
    back_cm, _ = distances(first.moved(move), second.points_cm, second.tangents)
    slack = _slack(information + prior, move.points(first.path_cm) - move.points(centre[None])[0])
    return Alignment(move, opposite, apart_cm, back_cm, slack)


def _stepped(
    move: Similarity, centre: Float[np.ndarray, "2"], dx: float, dy: float, turn: float, grow: float
) -> Similarity:
    """Shift, turn and grow about where the centre lies now."""
    at = move.points(centre[None])[0] + [dx, dy]
    turned = Similarity(0.0, 0.0, move.turn_rad + turn, move.scale * float(np.exp(grow)))
    x, y = at - turned.points(centre[None])[0]
    return Similarity(float(x), float(y), turned.turn_rad, turned.scale)


def _off_lines(
    tree: cKDTree,
    line_cm: Float[np.ndarray, "k 2"],
    tangents: Float[np.ndarray, "k 2"],
    at_cm: Float[np.ndarray, "m 2"],
    along: Float[np.ndarray, "m 2"],
    gate_cm: float,
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m 2"], Bool[np.ndarray, "m"]]:
    """Distance of points from the nearest line across it, the line's normal, and which points met one."""
    _, nearest = tree.query(at_cm)
    tangent = tangents[nearest]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    apart = at_cm - line_cm[nearest]
    off = np.sum(apart * normal, axis=1)
    # Beyond the end of a line, the nearest point lies behind.
    beside = np.abs(np.sum(apart * tangent, axis=1)) < max(2.0 * STEP_CM, 0.5 * gate_cm)
    same = np.abs(np.sum(tangent * along, axis=1)) > _COSINE
    return off, normal, (np.abs(off) < gate_cm) & beside & same


def distances(
    second: TrackShape, at_cm: Float[np.ndarray, "m 2"], along: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """Distance of points from the lines of a map, see :attr:`Alignment.apart_cm`, and the nearest points."""
    off, _, met = _off_lines(
        second.tree, second.points_cm, second.tangents, at_cm, along, _MET_LANES * second.lane_cm
    )
    missing = np.where(second.surveyed(at_cm) & ~second.unknown(at_cm), np.nan, np.inf)
    return np.where(met, off, missing), np.asarray(second.tree.query(at_cm)[1])


def _slack(information: Float[np.ndarray, "4 4"], offsets_cm: Float[np.ndarray, "p 2"]) -> float:
    """Largest sigma of a place that an alignment's information leaves, [cm]."""
    values, vectors = np.linalg.eigh(information)
    covariance = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    x, y = offsets_cm.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    by_x, by_y = np.stack([one, zero, -y, x], axis=1), np.stack([zero, one, x, y], axis=1)
    variance = sum(np.einsum("ni,ij,nj->n", by, covariance, by) for by in (by_x, by_y))
    return float(np.sqrt(np.max(variance)))
