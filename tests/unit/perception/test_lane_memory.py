import numpy as np
import pytest

from lanenet.perception.estimate import LaneMemory

LANE = np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0])
SIGMA = np.full(6, 0.5)
BOTH, LEFT, RIGHT = np.array([0.99, 0.99]), np.array([0.9, 0.1]), np.array([0.1, 0.9])
LOST_RIGHT, LOST_LEFT = np.repeat([0.5, 6.0], 3), np.repeat([6.0, 0.5], 3)


def taught(widths_cm, **options):
    memory = LaneMemory(**options)
    for width in widths_cm:
        memory.learn(LANE * width / 40.0, BOTH)
    return memory


def test_the_width_is_that_of_sure_frames():
    assert taught([]).width_cm is None
    memory = taught([38.0, 40.0, 39.0] * 5 + [90.0] * 3)
    assert memory.width_cm == pytest.approx(39.0, rel=0.02)
    known_cm = memory.width_cm
    memory.learn(LANE * 2.0, np.array([0.99, 0.6]))
    memory.learn(-LANE, BOTH)
    assert memory.width_cm == known_cm
    memory.reset()
    assert memory.width_cm is None


@pytest.mark.parametrize("width_cm", [22.0, 40.0, 75.0])
def test_a_lane_with_both_lines_tells_its_width_within_a_second(width_cm):
    noise = np.random.default_rng(0).normal(0.0, 0.03, 20)
    memory = taught(width_cm * np.exp(noise))
    assert memory.width_cm == pytest.approx(width_cm, rel=0.05) and memory.width_sigma < 0.05


def test_two_widths_live_side_by_side_until_frames_decide():
    memory = taught([30.0, 60.0] * 10)
    assert memory.width_cm is None
    for _ in range(20):
        memory.learn(LANE * 1.5, BOTH)
    assert memory.width_cm == pytest.approx(60.0, rel=0.03)


def test_a_wrong_width_is_unlearned_and_lines_of_other_lanes_are_left_out():
    memory = taught([30.0] * 200)
    for width in [60.0, 60.0, 60.0, 90.0] * 100:
        memory.learn(LANE * width / 40.0, BOTH)
    assert memory.width_cm == pytest.approx(60.0, rel=0.03)


def test_a_width_in_doubt_is_kept_until_a_few_frames_say_otherwise():
    memory = taught([30.0] * 300)
    memory.doubt()
    assert memory.width_cm == pytest.approx(30.0, rel=0.05)
    for _ in range(20):
        memory.learn(LANE * 1.5, BOTH)
    assert memory.width_cm == pytest.approx(60.0, rel=0.03)


def test_before_any_frame_common_lanes_are_likelier():
    assert LaneMemory().width_cm is None
    assert LaneMemory().likely_cm == pytest.approx(40.0, rel=0.02)
    assert LaneMemory(120.0).likely_cm == LaneMemory(120.0).width_cm == 120.0


@pytest.mark.parametrize(("presence", "sigma", "seen"), [(LEFT, LOST_RIGHT, 0), (RIGHT, LOST_LEFT, 1)])
def test_either_line_is_rebuilt_from_the_other(presence, sigma, seen):
    guess = LANE.copy().reshape(2, 3)
    guess[1 - seen] += 7.0
    points, spread = taught([30.0] * 60).complete(guess.ravel(), sigma, presence)
    expected = LANE.copy().reshape(2, 3)
    expected[1 - seen] = expected[seen] + (30.0 if seen == 0 else -30.0)
    np.testing.assert_allclose(points, expected.ravel(), atol=0.1)
    # The seen line's doubt, and 2 % of the width.
    np.testing.assert_allclose(spread.reshape(2, 3)[1 - seen], np.hypot(0.5, 0.6), rtol=0.01)
    np.testing.assert_array_equal(spread.reshape(2, 3)[seen], 0.5)
    assert guess[1 - seen, 0] != points.reshape(2, 3)[1 - seen, 0]


def test_a_network_that_is_surer_keeps_its_answer():
    points, spread = taught([30.0] * 20).complete(LANE, SIGMA, LEFT)
    np.testing.assert_array_equal(points, LANE)
    np.testing.assert_array_equal(spread, SIGMA)


def test_without_a_width_or_any_line_nothing_is_rebuilt():
    for memory, presence in ((LaneMemory(), LEFT), (taught([30.0] * 20), np.array([0.2, 0.3]))):
        points, _ = memory.complete(LANE, LOST_RIGHT, presence)
        np.testing.assert_array_equal(points, LANE)


def test_a_given_width_goes_before_the_remembered_one_and_is_not_forgotten():
    memory = taught([40.0] * 20, given_cm=33.0)
    memory.reset()
    points, _ = memory.complete(LANE, LOST_RIGHT, LEFT)
    np.testing.assert_allclose(points[3:], 13.0, atol=1e-6)


def test_a_width_that_is_given_wrong_is_said():
    for given_cm in (30.0, 50.0):
        assert taught([40.0] * 20, given_cm=given_cm).contradiction == ""
        told = taught([40.0] * 60, given_cm=given_cm).contradiction
        assert f"{given_cm:g} cm" in told and "40 cm" in told
    assert taught([40.0] * 60, given_cm=37.0).contradiction == ""
    assert taught([40.0] * 60).contradiction == ""


def test_a_bend_tighter_than_the_lane_keeps_the_guess():
    # Radius 1 / (2 a) = 25 cm at most: no lane of 40 cm fits inside it.
    rows = np.array([0.0, 15.0, 30.0])
    bend = np.concatenate([-20.0 + 0.02 * rows**2, 20.0 + 0.02 * rows**2])
    points, spread = taught([40.0] * 20).complete(bend, LOST_RIGHT, LEFT)
    np.testing.assert_array_equal(points, bend)
    np.testing.assert_array_equal(spread, LOST_RIGHT)


def test_two_lines_that_are_seen_stay_as_they_are():
    # They may be a lane of another width than the one that was told: here it is wider, there narrower.
    for width in (30.0, 80.0):
        points, spread = LaneMemory(40.0).complete(LANE * width / 40.0, SIGMA, BOTH)
        np.testing.assert_array_equal(points, LANE * width / 40.0)
        np.testing.assert_array_equal(spread, SIGMA)


@pytest.mark.parametrize(("presence", "sigma"), [(LEFT, LOST_LEFT), (RIGHT, LOST_RIGHT)])
def test_a_line_that_is_not_seen_never_replaces_one_that_is(presence, sigma):
    # Of lines beside its window a network has learned nothing, and what it says of its doubt there is void.
    points, spread = LaneMemory(40.0).complete(LANE * 2.0, sigma, presence)
    np.testing.assert_array_equal(points, LANE * 2.0)
    np.testing.assert_array_equal(spread, sigma)
