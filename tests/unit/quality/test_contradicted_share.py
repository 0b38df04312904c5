"""Contradicted lines count where the driver kept the frames."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.quality.figures import contradicted_share


def test_deleted_frames_say_nothing_of_the_map():
    contradicted, known = (
        np.repeat([[True, True], [False, False]], [30, 70], axis=0),
        np.ones((100, 2), dtype=bool),
    )
    nothing, first = np.zeros(100, dtype=bool), np.arange(100) < 20
    assert contradicted_share(contradicted, known, nothing) == pytest.approx(0.3)
    # The car left the road for twenty frames.
    assert contradicted_share(contradicted, known, first) == pytest.approx(10 / 80)
    assert contradicted_share(contradicted, known, ~first) == 1.0
    assert contradicted_share(contradicted, known, ~nothing) == 0.0
    # One line of two is half of what a frame gives.
    contradicted[:, 1] = False
    assert contradicted_share(contradicted, known, nothing) == pytest.approx(0.15)


def test_a_line_that_a_frame_does_not_have_is_neither_right_nor_wrong():
    nothing = np.zeros(100, dtype=bool)
    contradicted = np.repeat([[True, True], [False, False]], [30, 70], axis=0)
    # The right line is known in the first twenty frames and in the last thirty.
    known = np.ones((100, 2), dtype=bool)
    known[20:70, 1] = False
    assert contradicted_share(contradicted, known, nothing) == pytest.approx((30 + 20) / 150)
    contradicted[:, 0] = False
    assert contradicted_share(contradicted, known, nothing) == pytest.approx(20 / 150)
    assert contradicted_share(contradicted, known, np.arange(100) < 20) == 0.0
    assert contradicted_share(contradicted, np.zeros((100, 2), dtype=bool), nothing) == 0.0
