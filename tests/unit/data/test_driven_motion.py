"""Motion from frame to frame, as it was commanded and by poses."""

from __future__ import annotations

import numpy as np
import pytest

from lanenet.data.drives import Commands
from lanenet.data.drives.motion import motion_of_commands, motion_of_poses

STARTS = np.array([True, False, False, False, True, False])
NAN = float("nan")


def test_a_command_moves_the_car_until_the_next_frame():
    speed, steering = np.array([20.0, 40.0, 0.0, -20.0, 20.0, 20.0]), np.full(6, np.arctan(0.5))
    t_s = np.array([0.0, 0.1, 0.2, 0.4, 5.0, 5.1])
    motion = motion_of_commands(Commands(speed_cm_s=speed, steering_rad=steering), t_s, STARTS, 25.0)
    assert motion is not None
    np.testing.assert_allclose(motion.travel_cm, [NAN, 2.0, 4.0, 0.0, NAN, 2.0])
    # Half the wheelbase to the left for each wheelbase of way.
    np.testing.assert_allclose(motion.turn_rad, motion.travel_cm * 0.5 / 25.0)
    part = motion.only(np.array([2, 3]))
    np.testing.assert_allclose(part.travel_cm, [4.0, 0.0])


@pytest.mark.parametrize("given", [{}, {"speed_cm_s": np.ones(6)}, {"steering_rad": np.zeros(6)}])
def test_without_speed_or_steering_it_is_unknown(given):
    assert motion_of_commands(Commands(**given), np.arange(6.0), STARTS, 25.0) is None


def test_poses_tell_the_way_its_sign_and_the_turn():
    heading = np.array([0.5 * np.pi, 0.5 * np.pi, 3.1, -3.1, 0.0, 0.0])
    xy = np.array([[0.0, 0.0], [0.0, 3.0], [0.0, 1.0], [-2.0, 1.0], [50.0, 0.0], [54.0, 0.0]])
    motion = motion_of_poses(np.column_stack([xy, heading]), STARTS, 25.0)
    np.testing.assert_allclose(motion.travel_cm, [NAN, 3.0, -2.0, 2.0, NAN, 4.0])
    np.testing.assert_allclose(motion.turn_rad[1:4], [0.0, 3.1 - 0.5 * np.pi, 2.0 * np.pi - 6.2])
