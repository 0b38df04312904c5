"""Dashed and solid lines are distinguished by what single frames see of them."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.lanes.offset import unpainted_share

CELL_CM, REACH_CM = 1.5, 60.0


def _seen(painted: np.ndarray, s_cm: np.ndarray, frames: int, moved_cm: float = 0.0) -> np.ndarray:
    """Paint in the views of frames 3 cm apart, each 36 cm long, and the frames; some are moved along."""
    parts = []
    for k in range(frames):
        view = painted & (s_cm >= 3.0 * k) & (s_cm < 3.0 * k + 36.0)
        parts.append(np.column_stack([s_cm[view] + moved_cm * (k % 5), np.full(view.sum(), k)]))
    return np.concatenate(parts)


@pytest.mark.parametrize("moved_cm", [0.0, 2.0])
def test_the_unpainted_share_of_dashes_also_where_those_of_the_laps_do_not_lie_on_one_another(moved_cm):
    s = np.arange(0.0, 400.0, 0.5) + 0.1
    dashes = np.mod(s, 12.0) < 6.0
    seen = _seen(dashes, s, 100, moved_cm)
    share = unpainted_share(seen[:, 0], seen[:, 1].astype(np.int64), CELL_CM, REACH_CM)
    # Half is bare, less what lies beyond the outermost dash in view, and what a cell at either end swallows.
    assert 0.3 < share < 0.5
    if moved_cm:
        on_the_map = unpainted_share(seen[:, 0], np.zeros(len(seen), dtype=np.int64), CELL_CM, 1e9)
        assert on_the_map < 0.2


def test_a_solid_line_has_no_bare_places_and_a_crack_is_its_length():
    s = np.arange(0.0, 400.0, 0.5) + 0.1
    seen = _seen(np.ones(len(s), dtype=bool), s, 100)
    assert unpainted_share(seen[:, 0], seen[:, 1].astype(np.int64), CELL_CM, REACH_CM) == 0.0
    one = np.arange(0.0, 30.0, 0.5)
    cracked = one[(one < 12.0) | (one >= 18.0)]
    # Four of twenty cells.
    frame = np.zeros(len(cracked), dtype=np.int64)
    assert unpainted_share(cracked, frame, CELL_CM, REACH_CM) == pytest.approx(0.2)


def test_what_tells_nothing_is_left_out():
    none = np.empty(0)
    assert np.isnan(unpainted_share(none, none.astype(np.int64), CELL_CM, REACH_CM))
    # Three cells are too few, and a line on both sides of a lap's seam seems as long as the lap.
    few, seam = np.array([0.0, 2.0, 40.0]), np.array([0.0, 2.0, 4.0, 496.0, 498.0])
    for s in (few, seam):
        assert np.isnan(unpainted_share(s, np.zeros(len(s), dtype=np.int64), CELL_CM, REACH_CM))
