"""Tracks that are known again by their maps, and those that must not be."""

from __future__ import annotations

import numpy as np
import pytest
from track_shapes import LANE_CM, bean, oval, track

from datagen.tracks.align import refined
from datagen.tracks.recognise import recognise
from datagen.tracks.shape import Similarity

ELSEWHERE = Similarity(310.0, -45.0, 2.1, 1.015)


def wavy(xy: np.ndarray) -> np.ndarray:
    """Bend a map by up to 1.5 cm."""
    return xy + 1.5 * np.stack([np.sin(xy[:, 1] / 70.0), np.cos(xy[:, 0] / 90.0)], axis=1)


def marks_on(centre_cm: np.ndarray) -> np.ndarray:
    """Marks near the middle of the lane, at random."""
    rng = np.random.default_rng(3)
    return centre_cm[rng.integers(len(centre_cm), size=60)] + rng.normal(0.0, 4.0, (60, 2))


@pytest.mark.parametrize(
    ("start", "laps", "opposite"),
    [(0.0, 1.0, False), (0.37, 1.0, False), (0.7, 1.0, True), (0.2, 0.6, False), (0.55, 0.6, True)],
)
def test_a_track_is_known_again_from_any_start_in_both_directions_and_from_part_of_a_lap(
    start, laps, opposite
):
    centre, marks = bean(), marks_on(bean())
    other = track(centre, start, laps, opposite, marks, bend=wavy)
    found = recognise(other.moved(ELSEWHERE), track(centre, marks_cm=marks))
    assert found.answer == "same", found.sentence
    assert found.alignment.opposite is opposite
    # Back where it came from: the bend of the map is left, and what it does beyond the part that was driven.
    at = found.alignment.move.points(ELSEWHERE.points(other.points_cm))
    assert np.abs(at - other.points_cm).max() < 5.0
    assert found.alignment.move.scale == pytest.approx(1.0 / ELSEWHERE.scale, abs=0.012)


@pytest.mark.parametrize("phase", [1.4, 2.2, 5.0])
def test_other_tracks_of_the_same_length_and_width_are_not_joined(phase):
    found = recognise(track(bean(phase), bend=wavy).moved(ELSEWHERE), track(bean()))
    assert found.answer == "different"
    assert "lines" in found.sentence


def test_a_part_of_a_lap_needs_more_than_its_lines():
    found = recognise(track(bean(), 0.2, 0.6), track(bean()))
    assert found.answer == "undetermined"
    assert "confirm" in found.sentence


def test_the_mirror_image_of_a_track_is_another_track():
    assert recognise(track(bean() * [1.0, -1.0]), track(bean())).answer == "different"


def test_an_oval_fits_itself_turned_and_is_refused_unless_marks_tell():
    plain = recognise(track(oval(), 0.1).moved(ELSEWHERE), track(oval()))
    assert plain.answer == "ambiguous"
    assert "2 ways" in plain.sentence
    rng = np.random.default_rng(3)
    marks = marks_on(oval())
    marked = track(oval(), 0.1, marks_cm=marks).moved(ELSEWHERE)
    told = recognise(marked, track(oval(), 0.6, marks_cm=marks + rng.normal(0.0, 0.5, (60, 2))))
    assert told.answer == "same"
    assert np.abs(told.alignment.move.points(ELSEWHERE.points(marks)) - marks).max() < 2.0
    # Marks that are elsewhere on the other map speak for neither way.
    strange = recognise(marked, track(oval(), 0.6, marks_cm=marks * [1.0, -1.0]))
    assert strange.answer == "ambiguous"


def test_a_circle_may_lie_anyhow_on_itself_and_is_refused():
    assert recognise(track(oval(150.0, 150.0), 0.3), track(oval(150.0, 150.0))).answer in (
        "ambiguous",
        "undetermined",
    )


def test_a_piece_of_tape_that_was_moved_does_not_make_another_track():
    def relaid(xy: np.ndarray) -> np.ndarray:
        moved = xy.copy()
        near = np.hypot(*(xy - [197.0, 60.0]).T) < 40.0
        moved[near] += [7.0, 0.0]
        return moved

    found = recognise(track(bean(), bend=relaid), track(bean()))
    assert found.answer == "same"
    apart = found.alignment.apart_cm
    assert np.sum(~(np.abs(apart) < 0.1 * LANE_CM)) > 10


def test_two_halves_that_share_little_are_not_joined():
    first, second = track(bean(), 0.0, 0.5), track(bean(), 0.4, 0.5)
    assert recognise(first, second).answer != "same"


def test_slack_says_how_far_lines_may_slide_along_each_other():
    x = np.linspace(0.0, 900.0, 2000)
    straight = track(np.stack([x, np.zeros_like(x)], axis=1), 0.01, 0.98)
    one = refined(straight, straight, Similarity(), opposite=False)
    assert one is not None
    assert one.slack_cm > 5.0
    bent = track(bean())
    turning = refined(bent, bent, Similarity(), opposite=False)
    assert turning is not None
    assert turning.slack_cm < 1.0


def test_a_similarity_and_its_inverse_are_the_identity():
    xy = np.array([[1.0, 2.0], [-30.0, 4.0]])
    assert np.allclose(ELSEWHERE.inverse.points(ELSEWHERE.points(xy)), xy)
    poses = ELSEWHERE.poses(np.array([[1.0, 2.0, 7.0]]))
    assert poses[0, 2] == pytest.approx(9.1)
