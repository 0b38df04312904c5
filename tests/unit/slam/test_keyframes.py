"""Keyframes of a slow car, and the poses of the frames between them."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.slam.commands import CommandedMotion
from datagen.slam.keyframes import (
    choose_keyframes,
    commands_between,
    interleaved_rows,
    keyframe_pairs,
    poses_between,
    values_between,
)


def _arc(steps_cm: np.ndarray, radius_cm: float, slip_rad: float = 0.0) -> np.ndarray:
    """Poses on a circle, the axle off the heading by a slip."""
    angle = np.cumsum(steps_cm) / radius_cm
    heading = 0.3 + angle
    return np.column_stack(
        [radius_cm * np.sin(heading + slip_rad), -radius_cm * np.cos(heading + slip_rad), heading]
    )


@pytest.mark.parametrize("way", [0.08, 0.14, 0.5])
def test_a_car_that_drives_is_followed_by_every_frame(way):
    rng = np.random.default_rng(0)
    steps = way * rng.uniform(0.95, 1.05, 200)
    np.testing.assert_array_equal(choose_keyframes(steps, np.zeros(len(steps), np.int64)), np.arange(200))
    # Nor is a car slow that brakes for a moment, or sets out.
    steps[:20] = 0.01
    steps[100:130] = 0.03
    np.testing.assert_array_equal(choose_keyframes(steps, np.zeros(len(steps), np.int64)), np.arange(200))


@pytest.mark.parametrize("way", [0.01, 0.03, 0.05, 0.07])
@pytest.mark.parametrize("seed", range(3))
def test_keyframes_of_a_slow_car_are_as_far_apart_as_frames_of_a_drive(way, seed):
    steps = way * np.random.default_rng(seed).uniform(0.9, 1.1, 500)
    keys = choose_keyframes(steps, np.zeros(len(steps), np.int64))
    assert keys[0] == 0 and keys[-1] == 499
    apart = np.diff(np.cumsum(steps)[keys])
    # The last one comes when the drive ends.
    assert apart[:-1].min() > 0.15 - 0.6 * way and apart.max() < 0.15 + 0.6 * way


def test_only_the_slow_part_is_thinned():
    steps = np.concatenate([np.full(150, 0.12), np.full(200, 0.04), np.full(150, 0.12)])
    keys = choose_keyframes(steps, np.zeros(len(steps), np.int64))
    every = np.diff(keys) == 1
    assert every[:139].all() and every[-139:].all()
    slow = keys[(keys >= 165) & (keys < 335)]
    assert set(np.diff(slow)) <= {3, 4}


def test_rows_alongside_share_the_frames_out():
    keys = np.array([0, 1, 2, 5, 9, 12, 13])
    rows = interleaved_rows(keys, 14)
    assert [row.tolist() for row in rows] == [keys.tolist(), [3, 6, 10], [4, 7, 11], [8]]
    assert [row.tolist() for row in interleaved_rows(np.arange(5), 5)] == [[0, 1, 2, 3, 4]]


def test_pairs_of_keyframes_keep_to_their_parts():
    keys = np.array([0, 3, 6, 7, 8, 9, 13])
    one = [(0, 3), (3, 6), (6, 7), (7, 8), (8, 9), (9, 13), (0, 7), (3, 8), (6, 9), (7, 13)]
    assert keyframe_pairs(keys, (1, 3), np.zeros(14, np.int64)) == one
    # Frame 7 was recorded elsewhere than frame 6.
    assert keyframe_pairs(keys, (1, 3), np.repeat([0, 1], 7)) == [
        (0, 3),
        (3, 6),
        (7, 8),
        (8, 9),
        (9, 13),
        (7, 13),
    ]
    # From frame 7 to frame 9 every frame is a keyframe, and consecutive frames are compared anyway.
    keys, part = np.array([0, 3, 6, 7, 8, 9, 10, 13]), np.repeat([0, 1, 2], [7, 3, 4])
    assert keyframe_pairs(keys, (1, 2), part) == [(0, 3), (3, 6), (0, 6), (10, 13)]
    assert keyframe_pairs(np.arange(30), (1, 4), np.zeros(30, np.int64)) == []


def test_commands_between_keep_the_way_and_the_turn():
    rng = np.random.default_rng(0)
    commands = CommandedMotion.without_gaps(rng.uniform(0.5, 1.5, 90), True, rng.normal(size=90))
    keys = np.r_[0:20, 20:60:4, 60:90]
    thinned = commands_between(commands, keys)
    np.testing.assert_allclose(np.cumsum(thinned.distance_cm), np.cumsum(commands.distance_cm)[keys])
    assert thinned.turn is not None and commands.turn is not None
    np.testing.assert_array_equal(thinned.turn[:20], commands.turn[:20])
    assert thinned.turn[21] == pytest.approx(commands.turn[21:25].mean())
    assert commands_between(CommandedMotion.without_gaps(np.ones(90), False, None), keys).turn is None


@pytest.mark.parametrize("radius_cm", [60.0, -80.0, 1e12])
@pytest.mark.parametrize("seed", range(3))
def test_frames_between_lie_on_the_arc(radius_cm, seed):
    rng = np.random.default_rng(seed)
    steps_cm = rng.uniform(0.2, 1.5, 60)
    if abs(radius_cm) > 1e9:
        true = np.column_stack([np.cumsum(steps_cm), np.zeros(60), np.zeros(60)])
    else:
        # Also where the rear axle does not move along its heading.
        true = _arc(steps_cm, radius_cm, 0.02)
    keys = np.unique(np.r_[0, np.sort(rng.choice(60, 15, replace=False)), 59])
    # Steps in another unit do as well.
    found = poses_between(true[keys], keys, 0.07 * steps_cm)
    np.testing.assert_allclose(found, true, atol=1e-9)
    np.testing.assert_array_equal(found[keys], true[keys])


def test_values_between_go_straight():
    keys, steps = np.array([0, 2, 5]), np.array([9.0, 1.0, 3.0, 1.0, 1.0, 2.0])
    found = values_between(np.array([[0.0, 1.0], [4.0, 1.0], [0.0, 5.0]]), keys, steps)
    np.testing.assert_allclose(found[:, 0], [0.0, 1.0, 4.0, 3.0, 2.0, 0.0])
    np.testing.assert_allclose(found[:, 1], [1.0, 1.0, 1.0, 2.0, 3.0, 5.0])
