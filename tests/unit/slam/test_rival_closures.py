"""Closures by different ways around: what tells which one is likelier, and what it leaves open."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from pixel_road import fisheye

from datagen.slam.adjustment.adjust import CAMERA_NAMES, BundleResult
from datagen.slam.loops.revisits import Revisit, RevisitSettings
from datagen.slam.segment import _Closure, _DenseSegment, _go_around_alike, shared_misfits
from datagen.slam.view import RoadView

#: Frames of a lap, and the length of one, [cm]; three laps.
LAP, LAP_CM, LAPS = 40, 200.0, 3


def ring() -> np.ndarray:
    """Rear-axle poses on a circle, three laps."""
    angle = 2.0 * np.pi * np.arange(LAPS * LAP) / LAP
    radius_cm = LAP_CM / (2.0 * np.pi)
    return np.column_stack([radius_cm * np.sin(angle), -radius_cm * np.cos(angle), angle])


def bundle(loss: float, focal: float = 1.0, pairs: tuple[tuple[int, int], ...] = ()) -> BundleResult:
    """An adjustment of the ring whose frames agree that well, with a lens that is that much longer."""
    camera = fisheye()
    camera = replace(camera, K=camera.K @ np.diag([focal, focal, 1.0]))
    neighbours = [(k, k + 1) for k in range(LAPS * LAP - 1)] + list(pairs)
    n = len(neighbours)
    return BundleResult(
        poses=ring(),
        tilt=np.zeros((LAPS * LAP, 2)),
        camera=camera,
        sigma=dict.fromkeys(CAMERA_NAMES, 0.01),
        residual_px=np.zeros(0),
        pairs=np.array(neighbours),
        in_view=np.full(n, 10),
        loss=np.full(n, 10.0 * loss),
    )


def lap_later(lap: int, turns: int, first: int = 0) -> list[Revisit]:
    """Three revisits between frames that far apart."""
    return [Revisit(k, k + lap, np.zeros(3), 0.9, turns) for k in range(first, first + 3)]


class FakeMatcher:
    """Takes places for alike as it is told: by the match of any frame pair."""

    def __init__(self, match_of) -> None:
        self.match_of = match_of

    def matched(self, pairs, rng, poses=None) -> list[Revisit]:
        """All pairs, with their matches."""
        return [Revisit(a, b, np.zeros(3), self.match_of(a, b)) for a, b in pairs]


def segment(match_of=lambda a, b: 0.1) -> _DenseSegment:
    """A segment of the ring without images."""
    made = object.__new__(_DenseSegment)
    made.part = np.zeros(LAPS * LAP, dtype=np.int64)
    made.height, made.find_camera = 2.0, True
    made.view = SimpleNamespace(commands=SimpleNamespace(periods=np.ones(LAPS * LAP - 1)))
    made.solver = SimpleNamespace(rng=np.random.default_rng(0))
    made.revisit_settings = RevisitSettings()
    made.place_matcher = lambda opened: FakeMatcher(match_of)
    return made


@pytest.mark.parametrize(
    ("lap", "turns", "alike"),
    [
        (LAP, 1, True),
        (2 * LAP, 2, True),  # every second lap of the same ring
        (2 * LAP, 1, False),  # as long as two laps, and one turn
        (LAP - LAP // 4, 1, False),  # a corner less
        (LAP + 2, 1, True),
    ],
)
def test_laps_of_another_length_or_turn_are_another_way_around(lap, turns, alike):
    path_cm = LAP_CM / LAP * np.arange(LAPS * LAP)
    assert _go_around_alike(path_cm, lap_later(LAP, 1), lap_later(lap, turns)) == alike
    assert _go_around_alike(path_cm, lap_later(lap, turns), lap_later(LAP, 1)) == alike


def test_only_pairs_that_both_compare_tell_which_agrees_better():
    # The loops of one meet badly; its neighbours agree as well as those of the other.
    one, other = bundle(0.2), bundle(0.2, pairs=((0, 40), (1, 41)))
    loss = other.loss.copy()
    loss[-2:] = 100.0
    assert shared_misfits([one, replace(other, loss=loss)]) == pytest.approx([0.2, 0.2])
    # A pair is the same one whichever of its frames is moved.
    turned = replace(one, pairs=one.pairs[:, ::-1], loss=3.0 * one.loss)
    assert shared_misfits([one, turned]) == pytest.approx([0.2, 0.6])


def closure(loss: float, focal: float = 1.0, revisits: list[Revisit] | None = None) -> _Closure:
    """One that explains some revisits, three if left out."""
    return _Closure(revisits or lap_later(LAP, 1), bundle(loss, focal), Mock(spec=RoadView))


def test_a_rival_that_explains_the_images_as_well_widens_the_lens():
    opened = bundle(0.2)
    best, other = segment().likeliest_first([closure(0.22, 1.03), closure(0.2, 1.0)], opened)
    assert best.bundle.camera.K[0, 0] == pytest.approx(fisheye().K[0, 0])
    assert best.bundle.sigma["focal"] == pytest.approx(np.log(1.03))
    assert best.bundle.sigma["pitch"] == pytest.approx(0.01)
    assert other.bundle.camera.K[0, 0] == pytest.approx(1.03 * fisheye().K[0, 0])


def test_a_rival_that_explains_them_worse_leaves_the_lens_as_known_as_it_is():
    best, _ = segment().likeliest_first([closure(0.2), closure(0.6, 1.03)], bundle(0.2))
    assert best.bundle.sigma["focal"] == pytest.approx(0.01)


def test_a_lens_far_from_that_of_the_odometry_costs_less_heading_than_one_that_is_near():
    # Both miss half a radian in a lap; only a camera that was wrong before could have turned so far off.
    opened = bundle(0.2)
    bent = replace(opened, poses=opened.poses * np.array([1.0, 1.0, 1.0 + 0.5 / (2.0 * np.pi)]))
    near, far = closure(0.2), closure(0.2, 1.2)
    solver = segment()
    assert solver.missed(near, bent, 0.3) > 1.5
    assert solver.cost(far, 0.2, bent) < solver.cost(near, 0.2, bent) + np.log(15.0 * np.log(1.2) / 0.3)


@pytest.mark.parametrize(
    ("match_of", "decided", "alike"),
    [
        (lambda a, b: 0.1, True, False),  # beside the place all looks otherwise
        (lambda a, b: 0.9, False, True),  # a circle looks alike all along
    ],
)
def test_what_revisits_tell_is_what_places_beside_them_do_not(match_of, decided, alike):
    told = segment(match_of).with_told(closure(0.2, 1.0, lap_later(LAP, 1, 20)), bundle(0.2))
    assert (told.decided, told.alike) == (decided, alike)


def test_along_a_straight_the_turn_is_told_and_the_length_is_not():
    straight = replace(bundle(0.2), poses=ring() * np.array([1.0, 1.0, 0.01]))
    told = segment(lambda a, b: 0.9).with_told(closure(0.2, 1.0, lap_later(LAP, 1, 20)), straight)
    assert told.decided and told.alike


def test_revisits_that_no_closure_explains_are_tried_by_the_path_between_them():
    # What no closure explains lies two laps apart here, and once three quarters of a lap.
    found = closure(0.2, 1.0, lap_later(LAP, 1))
    left = lap_later(2 * LAP, 2, 10)
    stray = [Revisit(30, 30 + 3 * LAP // 4, np.zeros(3), 0.9, 1)]
    tried = list(segment().otherwise(ring(), found.revisits + left + stray, [found]))
    assert [[(r.earlier, r.later) for r in one] for one in tried] == [[(r.earlier, r.later) for r in left]]
