"""How far a line is continued from what a frame shows of it, with numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.perception.image_lane import rows_of_points

UNKNOWN = float("nan")


def seen(near_cm: float, far_cm: float) -> np.ndarray:
    """Points every cm of the line x = 5 + 0.1 y: 5, 6.5 and 8 at the label rows."""
    y = np.arange(near_cm, far_cm + 0.5)
    return np.stack([5.0 + 0.1 * y, y], axis=1)


@pytest.mark.parametrize(
    ("near_cm", "far_cm", "rows"),
    [
        # Seen from below the first row to beyond the last.
        (-5.0, 40.0, [5.0, 6.5, 8.0]),
        # 30 cm back to the first row, over 50 cm seen.
        (30.0, 80.0, [5.0, 6.5, 8.0]),
        # 31 cm is too far, 16 is not.
        (31.0, 80.0, [UNKNOWN, 6.5, 8.0]),
        # 20 cm are seen: 20 back are allowed, but not 21.
        (20.0, 40.0, [5.0, 6.5, 8.0]),
        (21.0, 41.0, [UNKNOWN, 6.5, 8.0]),
        # 10 cm are seen, from 35 cm on: only the 5 cm to the last row.
        (35.0, 45.0, [UNKNOWN, UNKNOWN, 8.0]),
        # From 60 cm on, the last row lies 30 cm back; from 61 cm on, nothing is known.
        (60.0, 120.0, [UNKNOWN, UNKNOWN, 8.0]),
        (61.0, 120.0, [UNKNOWN, UNKNOWN, UNKNOWN]),
        # Nothing is known beyond the farthest point.
        (-5.0, 20.0, [5.0, 6.5, UNKNOWN]),
    ],
)
def test_a_line_is_continued_towards_the_car_only(near_cm: float, far_cm: float, rows: list[float]) -> None:
    np.testing.assert_allclose(rows_of_points(seen(near_cm, far_cm)), rows, equal_nan=True)


def test_the_nearest_20_cm_give_the_direction() -> None:
    # Straight ahead from 10 to 30 cm, then to the side: x at y = 0 is that of the straight piece.
    points = np.array([[4.0, 10.0], [4.0, 20.0], [4.0, 30.0], [14.0, 40.0], [24.0, 50.0]])
    np.testing.assert_allclose(rows_of_points(points), [4.0, 4.0, 4.0])


@given(st.floats(-20.0, 80.0), st.floats(2.0, 100.0))
def test_what_is_answered_lies_within_reach(near_cm: float, length_cm: float) -> None:
    y = np.linspace(near_cm, near_cm + length_cm, 30)
    known = np.isfinite(rows_of_points(np.stack([0.0 * y, y], axis=1)))
    rows = np.array([0.0, 15.0, 30.0])
    reach = min(30.0, float(y[-1] - y[0]))
    assert (known == ((rows >= y[0] - reach) & (rows <= y[-1]))).all()
