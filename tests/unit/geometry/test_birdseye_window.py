from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lanenet.geometry.birdseye import BirdseyeWindow

WINDOW = BirdseyeWindow()
#: Four columns and two rows of 10 cm: x from -20 to 20, y from 5 to 25.
SMALL = BirdseyeWindow(left_cm=-20.0, near_cm=5.0, cell_cm=10.0, rows=2, columns=4)

points_cm = hnp.arrays(
    np.float64, st.tuples(st.integers(0, 8), st.just(2)), elements=st.floats(-100.0, 100.0)
)


def test_default_window_is_centred_and_covers_the_label_rows() -> None:
    assert (WINDOW.left_cm, WINDOW.right_cm) == (-48.0, 48.0)
    assert (WINDOW.near_cm, WINDOW.far_cm) == (0.0, 72.0)


def test_cell_centres_by_hand() -> None:
    corners = np.array([[-15.0, 20.0], [15.0, 20.0], [-15.0, 10.0], [15.0, 10.0]])
    np.testing.assert_array_equal(SMALL.cells(corners), [[0, 0], [0, 3], [1, 0], [1, 3]])


@given(points_cm)
def test_cells_and_points_undo_each_other(points: np.ndarray) -> None:
    np.testing.assert_allclose(WINDOW.points(WINDOW.cells(points)), points, atol=1e-9)


def test_raster_looks_like_the_road_from_above() -> None:
    # Far left and near right.
    raster = SMALL.rasterise(np.array([[-12.0, 24.0], [19.0, 6.0]]))
    np.testing.assert_array_equal(raster, [[255, 0, 0, 0], [0, 0, 0, 255]])
    assert raster.dtype == np.uint8


def test_raster_borders_belong_to_one_cell_each() -> None:
    # The left and the far border are inside, the right and the near border are outside.
    inside = SMALL.rasterise(np.array([[-20.0, 25.0]]))
    assert inside[0, 0] == 255
    outside = np.array([[20.0, 20.0], [0.0, 5.0], [-20.0001, 20.0], [0.0, 25.0001]])
    assert not SMALL.rasterise(outside).any()


def test_raster_ignores_missing_points() -> None:
    points = np.array([[np.nan, 10.0], [0.0, np.nan], [np.inf, 10.0], [-np.inf, 10.0], [0.0, np.inf]])
    assert not SMALL.rasterise(points).any()
    assert not SMALL.rasterise(np.empty((0, 2))).any()


def test_raster_reuses_and_clears_the_buffer() -> None:
    buffer = np.full((2, 4), 7, np.uint8)
    raster = SMALL.rasterise(np.array([[-12.0, 24.0]]), out=buffer)
    assert raster is buffer
    np.testing.assert_array_equal(buffer, [[255, 0, 0, 0], [0, 0, 0, 0]])


@given(points_cm)
def test_each_point_marks_the_cell_that_cells_names(points: np.ndarray) -> None:
    raster = WINDOW.rasterise(points)
    # Points within a rounding error of a border may fall on either side.
    cells = WINDOW.cells(points)
    clear = np.all(np.abs(cells - np.floor(cells) - 0.5) > 1e-6, axis=1)
    nearest = np.rint(cells[clear]).astype(int)
    inside = np.all((nearest >= 0) & (nearest < [WINDOW.rows, WINDOW.columns]), axis=1)
    assert np.all(raster[tuple(nearest[inside].T)] == 255)
    assert np.count_nonzero(raster) <= len(points)
