"""One drift per length explains the revisits: what it counts as whole turns, and what it does not believe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.slam.loops.consistency import consistent_revisits, of_one_length
from datagen.slam.loops.revisits import Revisit, RevisitSettings
from lanenet.geometry.poses import path_lengths

LAP = 80
STEP_CM = 5.0
LAP_CM = LAP * STEP_CM
BOUNDS = RevisitSettings()


def _laps(turns: float, laps: int, drift_rad: float = 0.0) -> np.ndarray:
    """Open-loop poses of a road that turns so often to the left in a lap, with drift per lap.

    A figure of eight turns to one side as much as to the other.
    """
    s = np.arange(laps * LAP + 1) / LAP
    swing = 2.0 * np.pi * np.sin(2.0 * np.pi * s) if turns == 0 else 0.4 * np.sin(4.0 * np.pi * s)
    heading = (2.0 * np.pi * turns + drift_rad) * s + swing
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = STEP_CM * np.column_stack([np.cos(middle), np.sin(middle)])
    return np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), heading])


def _visits(later_by: int, frames: range, rng: np.random.Generator | None = None) -> list[Revisit]:
    """Places seen again so many frames later, at a slightly other heading if there is noise."""
    angle = np.zeros(len(frames)) if rng is None else rng.normal(0.0, 0.05, len(frames))
    return [
        Revisit(k, k + later_by, np.array([0.0, 0.0, a]), 0.8) for k, a in zip(frames, angle, strict=True)
    ]


@pytest.mark.parametrize("turns", [1, -1, 0, 2])
@pytest.mark.parametrize("drift", [0.0, 0.5, -0.9])
@pytest.mark.parametrize("seed", range(2))
def test_a_lap_is_as_many_turns_as_the_road_makes(turns, drift, seed):
    """A circle turns once, a figure of eight not at all, a road that crosses itself twice."""
    visits = _visits(LAP, range(0, 70, 5), np.random.default_rng(seed))
    found = consistent_revisits(_laps(turns, 2, drift), visits, BOUNDS)
    revisits, rate = found[0]
    assert len(found) == 1
    assert [r.turns for r in revisits] == [turns] * len(visits)
    assert [replace(r, turns=0) for r in revisits] == visits
    # Exactly alike drifts are told apart no better than revisits scatter.
    assert rate * LAP_CM == pytest.approx(drift, abs=0.15)


@pytest.mark.parametrize("turns", [1, 0])
@pytest.mark.parametrize("drift", [2.5, -2.5])
def test_much_drift_leaves_two_counts_of_turns_to_choose_from(turns, drift):
    found = consistent_revisits(_laps(turns, 2, drift), _visits(LAP, range(0, 70, 5)), BOUNDS)
    rivals = {revisits[0].turns: rate * LAP_CM for revisits, rate in found}
    other = turns + int(np.sign(drift))
    assert set(rivals) == {turns, other}
    assert rivals[turns] == pytest.approx(drift, abs=0.15)
    assert rivals[other] == pytest.approx(drift - np.sign(drift) * 2.0 * np.pi, abs=0.15)
    for revisits, _ in found:
        assert len({r.turns for r in revisits}) == 1 and len(revisits) == 14


def test_drift_beyond_the_bound_is_not_tried():
    tight = BOUNDS.model_copy(update={"max_drift_rad": 1.0})
    poses, visits = _laps(1, 2, 2.5), _visits(LAP, range(0, 70, 5))
    assert len(consistent_revisits(poses, visits, BOUNDS)) == 2
    assert consistent_revisits(poses, visits, tight) == []


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("drift", [0.4, -1.1])
def test_visits_that_skip_laps_count_their_turns(seed, drift):
    rng = np.random.default_rng(seed)
    visits = [v for laps in (1, 2, 3) for v in _visits(laps * LAP, range(0, (4 - laps) * LAP, 9), rng)]
    found = consistent_revisits(_laps(1, 4, drift), visits, BOUNDS)
    revisits, rate = found[0]
    assert len(revisits) == len(visits)
    assert [r.turns for r in revisits] == [(r.later - r.earlier) // LAP for r in revisits]
    assert rate * LAP_CM == pytest.approx(drift, abs=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_false_revisits_are_outvoted(seed):
    """Twelve right ones at places with any heading, and as many that only look alike."""
    rng = np.random.default_rng(seed)
    poses = _laps(1, 3, 0.6)
    right = _visits(LAP, range(0, 2 * LAP, 14), rng)
    path = path_lengths(poses)
    false = []
    while len(false) < len(right):
        earlier, later = np.sort(rng.integers(0, len(poses), 2))
        if path[later] - path[earlier] > BOUNDS.min_gap_heights * 15.0:
            false.append(
                Revisit(int(earlier), int(later), np.array([0.0, 0.0, rng.uniform(-0.45, 0.45)]), 0.8)
            )
    mixed = right + false
    order = rng.permutation(len(mixed))
    revisits, rate = consistent_revisits(poses, [mixed[k] for k in order], BOUNDS)[0]
    kept = {(r.earlier, r.later) for r in revisits}
    assert kept >= {(r.earlier, r.later) for r in right}
    # By chance, most of a circle: the loops' robust weights see to the rest.
    assert len(kept) - len(right) <= 2 * len(false) // 3
    assert all(r.turns == 1 for r in revisits if r.later - r.earlier == LAP)
    assert rate * path[LAP] == pytest.approx(0.6, abs=0.2)


def test_a_car_that_comes_back_at_an_angle_has_not_drifted():
    poses = _laps(1, 2, 0.0)
    poses[LAP:, 2] += 0.3
    visits = [replace(v, relative=np.array([0.0, 0.0, 0.3])) for v in _visits(LAP, range(0, 70, 5))]
    _, rate = consistent_revisits(poses, visits, BOUNDS)[0]
    assert rate * LAP_CM == pytest.approx(0.0, abs=0.1)


def test_fewer_than_three_are_not_believed():
    poses = _laps(1, 2)
    assert consistent_revisits(poses, _visits(LAP, range(0, 10, 5)), BOUNDS) == []
    assert consistent_revisits(poses, [], BOUNDS) == []
    # Three that contradict each other: no drift per length explains more than one or two.
    wrong = [
        replace(v, relative=np.array([0.0, 0.0, a]))
        for v, a in zip(_visits(LAP, range(3)), (0.0, 2.0, 4.0), strict=True)
    ]
    assert consistent_revisits(poses, wrong, BOUNDS) == []


@pytest.mark.parametrize("drift", [0.7, 2.5])
def test_a_mirrored_drive_turns_the_other_way(drift):
    visits = _visits(LAP, range(0, 70, 5), np.random.default_rng(1))
    flipped = [replace(v, relative=v.relative * [1.0, -1.0, -1.0]) for v in visits]
    poses = _laps(1, 2, drift)
    here = consistent_revisits(poses, visits, BOUNDS)
    there = consistent_revisits(poses * [1.0, -1.0, -1.0], flipped, BOUNDS)
    rivals = sorted((rate, r[0].turns) for r, rate in here)
    mirrored = sorted((-rate, -r[0].turns) for r, rate in there)
    assert np.array(mirrored) == pytest.approx(np.array(rivals), abs=1e-9)


def test_a_good_open_loop_is_tried_though_more_false_revisits_agree_on_a_large_drift():
    poses = _laps(1, 2)
    true = _visits(LAP, range(0, 70, 10))
    # Bends that look alike, half a lap apart and heading the same way as far as the pictures tell.
    false = [Revisit(k, k + LAP // 2, np.zeros(3), 0.9) for k in range(40, 80, 4)]
    found = consistent_revisits(poses, true + false, BOUNDS)
    pairs = {(r.earlier, r.later) for r in true}
    rates = [rate for revisits, rate in found if {(r.earlier, r.later) for r in revisits} == pairs]
    assert len(rates) == 1 and abs(rates[0]) * LAP_CM < 0.15
    assert {r.turns for revisits, rate in found if rate == rates[0] for r in revisits} == {1}


def test_revisits_of_corners_that_look_alike_are_grouped_by_the_path_between_them():
    """Each group has one lap length, within a drift of the path; single ones are in none."""
    right = _visits(LAP, range(0, 60, 4))
    half, three_quarters = _visits(LAP // 2, range(0, 60, 6)), _visits(3 * LAP // 4, range(0, 60, 10))
    drifting = [replace(r, later=r.later + k % 3) for k, r in enumerate(right)]
    others = _visits(LAP // 4, range(0, 20, 10))
    groups = of_one_length(_laps(1, 2), [*others, *three_quarters, *drifting, *half], BOUNDS)
    assert groups == [drifting, half, three_quarters]
    assert of_one_length(_laps(1, 2), [], BOUNDS) == []
