"""Stripes of a crossing are left out, lines beside and around it are not."""

from __future__ import annotations

import numpy as np
from lane_edges import arc_path, joined, paint, speckle

from datagen.lanes.fit import FitSettings, fit_lines
from datagen.lanes.path import Path, PathEdges
from datagen.lanes.profile import without_crossings
from datagen.lanes.trace import TraceSettings, trace_lane

HEIGHT_CM, LANE_CM, SIDE_CM = 15.0, 40.0, 100.0
PERIOD_CM, STRIPE_CM = 6.4, 3.2
ZEBRA_CM = (220.0, 260.0)


def _zebra(rng: np.random.Generator, path: Path, first_cm: float, count: int) -> PathEdges:
    on = (path.s_cm > ZEBRA_CM[0]) & (path.s_cm < ZEBRA_CM[1])
    middles = first_cm + PERIOD_CM * np.arange(count)
    return joined(*(paint(rng, path, np.full(len(on), d), on, tape_cm=STRIPE_CM) for d in middles))


def _dashes(path: Path) -> np.ndarray:
    """Dashes of 20 cm; the crossing interrupts them."""
    free = (path.s_cm < ZEBRA_CM[0] - 5.0) | (path.s_cm > ZEBRA_CM[1] + 5.0)
    return (np.mod(path.s_cm, 40.0) < 20.0) & free


def test_inner_stripes_go_and_lines_stay():
    rng = np.random.default_rng(0)
    path = arc_path(None)
    lines = joined(
        paint(rng, path, np.full(len(path.s_cm), 20.0), _dashes(path)),
        paint(rng, path, np.full(len(path.s_cm), -20.0), np.ones(len(path.s_cm), dtype=bool)),
    )
    clutter = speckle(rng, path, 300)
    zebra = _zebra(rng, path, -14.0, 9)
    kept = without_crossings(path, joined(lines, clutter, zebra), HEIGHT_CM, SIDE_CM)
    inner = (kept.s_cm > 225.0) & (kept.s_cm < 255.0) & (kept.d_cm > -10.0) & (kept.d_cm < 32.0)
    assert inner.sum() < 0.05 * len(zebra.s_cm)
    alone = without_crossings(path, joined(lines, clutter), HEIGHT_CM, SIDE_CM)
    assert len(alone.s_cm) > 0.99 * (len(lines.s_cm) + len(clutter.s_cm))
    right = np.abs(kept.d_cm + 20.0) < 2.0
    assert right.sum() > 0.99 * (np.abs(lines.d_cm + 20.0) < 2.0).sum()


def test_a_double_line_is_no_crossing():
    rng = np.random.default_rng(1)
    path = arc_path(200.0)
    on = np.ones(len(path.s_cm), dtype=bool)
    double = joined(*(paint(rng, path, np.full(len(on), d), on) for d in (18.0, 22.4)))
    kept = without_crossings(path, double, HEIGHT_CM, SIDE_CM)
    assert len(kept.s_cm) == len(double.s_cm)


def test_a_dashed_line_goes_straight_through_a_crossing():
    path = arc_path(None)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        edges = joined(
            paint(rng, path, np.full(len(path.s_cm), 20.0), _dashes(path)),
            paint(rng, path, np.full(len(path.s_cm), -20.0), np.ones(len(path.s_cm), dtype=bool)),
            # A stripe lies 1.8 cm beside the line's place.
            _zebra(rng, path, -10.2, 9),
        )
        clean = without_crossings(path, edges, HEIGHT_CM, SIDE_CM)
        lane = trace_lane(path, clean, HEIGHT_CM, LANE_CM, TraceSettings())
        left = fit_lines(path, clean, lane, HEIGHT_CM, FitSettings())[0]
        on = (path.s_cm > 180.0) & (path.s_cm < 300.0)
        assert np.abs(left.points(path.s_cm[on])[:, 1] - 20.0).max() < 0.5
