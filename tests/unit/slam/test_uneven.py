"""Frames that come at uneven times: found by their images, and their steps measured."""

from __future__ import annotations

import numpy as np
import pytest
from picture_road import loop_drive
from pixel_road import fisheye

from datagen.slam.adjustment.adjust import BundleSettings, Observations, frame_priors
from datagen.slam.adjustment.state import BundleEstimate, BundleState
from datagen.slam.commands import commands_of
from datagen.slam.odometry.uneven import early_frames
from datagen.slam.settings import SlamSettings
from datagen.slam.view import SegmentView, view_segment, with_measured_periods

#: Fine frames of a lap, and how many of them are a typical step of 4 cm.
LAP_FRAMES, LAP_CM, STEP = 1000, 400.0, 10
#: Places where two images are missed and the next comes at once, as frames of the uneven drive; the images
#: change as much before as behind them.
EARLY = (35, 58)


@pytest.fixture(scope="module")
def fine():
    return loop_drive(fisheye(), 780, LAP_FRAMES, LAP_CM, 3)[0]


def _view(drive) -> SegmentView:
    rng, camera = np.random.default_rng(0), fisheye()
    return view_segment(drive, camera, commands_of(drive, camera.wheelbase_cm), SlamSettings(), rng)


def _steps() -> np.ndarray:
    steps = np.full(70, STEP)
    steps[0] = 0
    for k in EARLY:
        steps[k - 1], steps[k] = 2 * STEP + 6, 1
    return steps


def test_an_early_image_and_the_long_step_before_it_are_measured(fine):
    steps = _steps()
    drive = fine.subset(np.cumsum(steps))
    # Somebody wrote even times beside the images.
    drive.t_s[:] = 0.05 * np.arange(len(drive))
    assert np.flatnonzero(early_frames(drive)).tolist() == list(EARLY)
    before = _view(drive)
    view = with_measured_periods(before)
    uneven = view.commands.uneven
    assert uneven is not None
    for k in EARLY:
        assert uneven[k - 3 : k + 4].all()
        found = (view.typical.relative / before.typical.relative)[[k - 1, k]]
        # True are 2.6 and 0.1 typical steps. A single pair of images tells no more than that neither is even.
        assert found[0] > 1.4 and found[1] < 0.5
    others = ~np.isin(np.arange(len(steps)), [k - d for k in EARLY for d in (0, 1)])
    assert np.median(view.typical.relative[others]) == pytest.approx(1.0)
    np.testing.assert_allclose(view.images.periods[~uneven], 1.0)
    # What was recorded stays as it is.
    np.testing.assert_allclose(view.commands.periods, before.commands.periods)


def test_an_even_drive_stays_as_it_is(fine):
    drive = fine.subset(np.arange(0, 780, STEP))
    assert not early_frames(drive).any()
    view = _view(drive)
    assert with_measured_periods(view) is view


def test_an_early_image_without_a_miss_before_it_is_a_car_that_slows_down(fine):
    steps = np.full(70, STEP)
    steps[[0, *EARLY]] = 0, 1, 1
    drive = fine.subset(np.cumsum(steps))
    drive.t_s[:] = 0.05 * np.arange(len(drive))
    assert early_frames(drive).any()
    before = _view(drive)
    view = with_measured_periods(before)
    assert view.commands.uneven is not None and not view.commands.uneven.any()
    np.testing.assert_array_equal(view.typical.relative, before.typical.relative)


def test_nothing_is_assumed_of_the_steps_of_uneven_frames():
    poses = np.column_stack([np.arange(30) * 4.0, np.zeros(30), np.zeros(30)])
    poses[15:, 0] += 4.0
    state = BundleState.at(BundleEstimate.level(poses, fisheye()))
    uneven = np.zeros(30, dtype=bool)
    costs = []
    for frames in ([], [15]):
        uneven[frames] = True
        costs.append(frame_priors(state, BundleSettings(), Observations([], uneven=uneven))[0])
    # One step is twice as long as its neighbours, which costs dear where frames come evenly.
    step = 4.0 / fisheye().mounting.height_cm
    assert costs[0] == pytest.approx((step / BundleSettings().speed_change) ** 2, rel=0.01)
    assert costs[1] < 0.01 * costs[0]
