"""Revisits that bear each other out where the open loop has lost its heading at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.slam.loops.consistency import (
    consistent_revisits,
    count_places,
    with_supported,
    without_contradicted,
)
from datagen.slam.loops.revisits import Revisit, RevisitSettings
from lanenet.geometry.poses import compose, relative_pose

HEIGHT_CM, LAP = 15.0, 90
SETTINGS = RevisitSettings()


def _circuit(laps: int) -> np.ndarray:
    """Poses on a circle of 4 m, to the left, 4.4 cm apart."""
    angle = 2.0 * np.pi * np.arange(laps * LAP) / LAP
    return np.column_stack([64.0 * np.sin(angle), 64.0 * (1.0 - np.cos(angle)), angle])


def _with_a_slip(true: np.ndarray, frame: int, lost_rad: float) -> np.ndarray:
    """Open-loop poses of a car whose turn was lost in one frame."""
    before, after = true[:frame], true[frame:]
    turn = np.array([np.cos(lost_rad), -np.sin(lost_rad), np.sin(lost_rad), np.cos(lost_rad)]).reshape(2, 2)
    xy = (after[:, :2] - after[0, :2]) @ turn.T + after[0, :2]
    return np.concatenate([before, np.column_stack([xy, after[:, 2] + lost_rad])])


def _revisits(true: np.ndarray, every: int) -> list[Revisit]:
    """Each place a lap later, as seen by a perfect match."""
    return [
        Revisit(k, k + LAP, relative_pose(true[k], true[k + LAP]), 0.8)
        for k in range(0, len(true) - LAP, every)
    ]


@pytest.fixture(scope="module")
def slipped() -> tuple[np.ndarray, list[Revisit], list[Revisit]]:
    """Poses, all revisits, and those that a drift explains: the slip lies between the others' visits."""
    true = _circuit(3)
    poses = _with_a_slip(true, 2 * LAP + 20, -1.2)
    matched = _revisits(true, 6)
    explained = [replace(r, turns=1) for r in matched if r.later < 2 * LAP + 20]
    return poses, matched, explained


def test_revisits_after_a_slip_bear_each_other_out(slipped):
    poses, matched, explained = slipped
    # No drift in proportion to the way explains the heading that is lost at once.
    assert all(len(group) < len(matched) for group, _ in consistent_revisits(poses, matched, SETTINGS))
    kept = with_supported(poses, explained, matched, HEIGHT_CM, SETTINGS)
    assert [(r.earlier, r.later) for r in kept] == [(r.earlier, r.later) for r in matched]
    assert {r.turns for r in kept} == {1}


def test_a_wrong_revisit_has_no_witness(slipped):
    poses, matched, explained = slipped
    rng = np.random.default_rng(0)
    after = [r for r in matched if r.later >= 2 * LAP + 20]
    for _ in range(5):
        wrong = [replace(r, relative=r.relative + rng.normal(size=3) * [40.0, 40.0, 0.6]) for r in after]
        assert with_supported(poses, explained, explained + wrong, HEIGHT_CM, SETTINGS) == explained


def test_one_place_alone_is_no_witness_of_itself(slipped):
    poses, matched, explained = slipped
    # Frames beside each other that all show the same place, elsewhere on the road.
    one = next(r for r in matched if r.later > 2 * LAP + 40)
    beside = [
        Revisit(k, one.later + k - one.earlier, one.relative, 0.8)
        for k in range(one.earlier, one.earlier + 8)
    ]
    assert with_supported(poses, explained, explained + beside, HEIGHT_CM, SETTINGS) == explained


def test_moving_the_world_changes_nothing(slipped):
    poses, matched, explained = slipped
    c, s = np.cos(0.7), np.sin(0.7)
    moved = np.column_stack([poses[:, :2] @ np.array([[c, s], [-s, c]]) + [50.0, -20.0], poses[:, 2] + 0.7])
    kept = with_supported(moved, explained, matched, HEIGHT_CM, SETTINGS)
    assert len(kept) == len(with_supported(poses, explained, matched, HEIGHT_CM, SETTINGS))


def test_neighbouring_frames_are_one_place():
    assert count_places(np.array([100.0, 96.0, 104.0, 130.0]), 15.0) == 1
    assert count_places(np.array([100.0, 96.0, 104.0, 145.0, 400.0]), 15.0) == 3
    assert count_places(np.empty(0), 15.0) == 0


def _along(pose: np.ndarray, ahead_cm: float) -> np.ndarray:
    """The pose further ahead on the circle: what is seen where one dash is taken for the next."""
    angle = ahead_cm / 64.0
    return compose(pose, np.array([64.0 * np.sin(angle), 64.0 * (1.0 - np.cos(angle)), angle]))


@pytest.mark.parametrize("dash_cm", [9.0, -32.0])
def test_a_revisit_that_takes_one_dash_for_the_next_is_contradicted(dash_cm):
    true = _circuit(3)
    # The open loop misses way and heading alike on every lap, by more than a dash.
    angle = 1.05 * true[:, 2]
    bent = 64.0 * 1.04 / 1.05
    drifted = np.column_stack([bent * np.sin(angle), bent * (1.0 - np.cos(angle)), angle])
    revisits = _revisits(true, 6)
    wrong = {5, 12, 13}
    for k in wrong:
        revisits[k] = replace(revisits[k], relative=_along(revisits[k].relative, dash_cm))
    for poses in (true, drifted):
        kept = without_contradicted(poses, revisits, HEIGHT_CM)
        assert kept == [r for k, r in enumerate(revisits) if k not in wrong]


def test_nobody_is_contradicted_without_a_neighbour():
    true = _circuit(3)
    lonely = _revisits(true, 6)[::10]
    lonely[1] = replace(lonely[1], relative=_along(lonely[1].relative, 9.0))
    assert without_contradicted(true, lonely, 2.0) == lonely
    assert without_contradicted(true, [], HEIGHT_CM) == []


def test_one_against_two_goes_and_the_two_stay():
    true = _circuit(2)
    three = _revisits(true, 6)[:3]
    three[1] = replace(three[1], relative=_along(three[1].relative, 9.0))
    assert without_contradicted(true, three, HEIGHT_CM) == [three[0], three[2]]
