"""Chains of pieces of tape, where pieces lie over each other."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.lanes.chains import chains_of
from datagen.lanes.tape import Piece

HEIGHT_CM = 18.0


def _piece(begin: tuple[float, float], length_cm: float, angle_deg: float) -> Piece:
    angle = np.deg2rad(angle_deg)
    start = np.array(begin)
    return Piece(start, start + length_cm * np.array([np.cos(angle), np.sin(angle)]), 2.4)


@pytest.mark.parametrize("angle_deg", [60.0, 85.0])
def test_a_piece_that_two_others_cross_at_one_place_has_one_corner_there(angle_deg):
    # Longest first: the walk begins at the piece that is crossed, and leaves it at the same place both ways.
    crossed = _piece((0.0, 0.0), 12.0, 0.0)
    onwards, back = _piece((6.0, 0.0), 11.0, angle_deg), _piece((6.0, 0.0), 11.0, 180.0 - angle_deg).turned()
    chains = chains_of(
        [crossed, onwards, back], lambda piece: True, lambda a, b, width: np.ones(3, bool), HEIGHT_CM
    )
    assert any(len(chain.markings_cm) == 2 for chain in chains)
    assert all(np.diff(chain.lengths_cm).min() > 1.0 for chain in chains)
