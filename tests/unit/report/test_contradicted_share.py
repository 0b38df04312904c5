"""Lines with which the pictures disagree count where the driver kept the frames."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.map_report import contradicted_share


def test_deleted_frames_say_nothing_of_the_map():
    contradicted = np.repeat([[True, True], [False, False]], [30, 70], axis=0)
    nothing, first = np.zeros(100, dtype=bool), np.arange(100) < 20
    assert contradicted_share(contradicted, nothing) == pytest.approx(0.3)
    # The car left the road for twenty frames.
    assert contradicted_share(contradicted, first) == pytest.approx(10 / 80)
    assert contradicted_share(contradicted, ~first) == 1.0
    assert contradicted_share(contradicted, ~nothing) == 0.0
    assert contradicted_share(None, nothing) == 0.0
    # One line of two is half of what a frame gives.
    contradicted[:, 1] = False
    assert contradicted_share(contradicted, nothing) == pytest.approx(0.15)
