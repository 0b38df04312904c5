"""Wrong decisions about the lane are counted apart from errors."""

from __future__ import annotations

import numpy as np
import pytest

from lanenet.evaluation.decisions import decide
from lanenet.evaluation.errors import bootstrap_segments

LANE = np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0])
NAN = float("nan")


def decided(off_cm, sigma_cm=1.0, frames=(5, 5)):
    """What is decided where each frame's answer is off by this much."""
    known = np.tile(LANE, (len(off_cm), 1))
    answer = known + np.array(off_cm)[:, None]
    starts = np.cumsum(frames)[:-1]
    return decide(answer, known, np.full(known.shape, sigma_cm), starts, bootstrap_segments(frames)[0])


def test_runs_of_frames_in_another_lane_are_events_and_no_errors():
    found = decided([0.3, 40.0, 40.0, 0.3, 40.0, 40.0, 0.3, 0.3, NAN, 0.3])
    # A run ends with its source.
    assert (found.frames, found.wrong_lane.frames, found.wrong_lane.events) == (9, 4, 3)
    assert found.rmse_cm == pytest.approx(0.3) and found.p99_cm == pytest.approx(0.3)
    assert found.wrong_lane.interval is None


@pytest.mark.parametrize(("off_cm", "another"), [(19.9, 0), (20.1, 1), (-20.1, 1)])
def test_half_of_the_lanes_width_tells_another_lane(off_cm, another):
    assert decided([off_cm, 0.0], frames=(2,)).wrong_lane.frames == another


@pytest.mark.parametrize(
    ("off_cm", "sigma_cm", "frames"), [(3.9, 1.0, 0), (4.1, 1.0, 1), (4.1, 1.5, 0), (5.0, NAN, 0)]
)
def test_a_point_is_surely_wrong_beyond_its_sigmas_and_four_centimetres(off_cm, sigma_cm, frames):
    assert decided([off_cm, 0.0], sigma_cm, (2,)).surely_wrong.frames == frames


def test_without_answers_nothing_is_decided():
    found = decided([NAN, NAN], frames=(2,))
    assert found.frames == found.wrong_lane.frames == 0 and np.isnan(found.rmse_cm)
    assert found.as_dict()["wrong_lane"] == {"frames": 0, "events": 0, "interval": None}


def test_the_share_of_drives_like_these_has_an_interval():
    # One frame of five, in every other drive.
    off_cm = np.where(np.arange(100) % 10 == 9, 30.0, 0.0)
    low, high = decided(off_cm, frames=(5,) * 20).wrong_lane.interval
    assert 0.04 < low < 0.1 < high < 0.16
