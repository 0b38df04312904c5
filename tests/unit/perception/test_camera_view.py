"""What a camera shows of the ground."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lanenet.geometry.lane import ROWS_CM
from lanenet.onboard.bench import example_camera
from lanenet.perception.network.tracking.camera_view import CameraView

CAMERA = example_camera()
VIEW = CameraView(CAMERA)


@pytest.mark.parametrize("x_cm", [-40.0, -10.0, 0.0, 25.0])
@pytest.mark.parametrize("row", range(len(ROWS_CM)))
def test_a_place_is_hidden_as_far_as_the_image_begins_ahead_of_it(x_cm, row):
    hidden_cm = VIEW.hidden_cm(row, x_cm)
    ahead = np.arange(ROWS_CM[row], ROWS_CM[row] + 60.0, 0.5)
    shown = CAMERA.shows_ground(np.stack([np.full_like(ahead, x_cm), ahead], axis=1))
    assert shown.any()
    assert abs(hidden_cm - (ahead[shown.argmax()] - ROWS_CM[row])) <= 2.5


def test_the_view_opens_ahead():
    assert VIEW.hidden_cm(0, 0.0) > 0.0 and VIEW.hidden_cm(2, 0.0) == 0.0
    assert VIEW.hidden_cm(0, 1e4) == VIEW.hidden_cm(0, 120.0)
    assert VIEW.hidden_cm(0, math.nan) == 0.0


def test_a_line_is_in_sight_where_most_of_it_is():
    assert VIEW.shows_line(np.array([-20.0, -20.0, -20.0]))
    assert not VIEW.shows_line(np.array([-1e3, -1e3, -1e3]))
