"""Frames of a car that stands, frames that were recorded twice, and breaks, by small pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from picture_road import made_up_drive

from datagen.slam.odometry.stillness import (
    SMALL_HEIGHT,
    SMALL_WIDTH,
    following_frames,
    put_elsewhere,
    reversing_runs,
    small_images,
    standing_frames,
)
from lanenet.data.drives.recording import Commands, Drive
from lanenet.errors import TrackingLostError


def pictures(place_px, noise=0.3, seed=0):
    """A wide strip with blobs, seen from places along it, as small pictures."""
    rng = np.random.default_rng(seed)
    strip = np.kron(rng.uniform(40.0, 200.0, (6, 200)), np.ones((3, 3)))
    at = np.arange(24)
    rows = np.arange(18)[:, None]
    frames = []
    for place in place_px:
        whole, part = int(np.floor(place)), place - np.floor(place)
        left, right = strip[rows, whole + at], strip[rows, whole + 1 + at]
        frames.append((1.0 - part) * left + part * right)
    return (np.array(frames) + noise * rng.standard_normal((len(place_px), 18, 24))).astype(np.float32)


@pytest.mark.parametrize("step_px", [0.15, 0.5, 1.5])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_stop_is_found_and_a_crawl_is_not_one(step_px, seed):
    moving = np.arange(100) * step_px
    place = np.concatenate([moving, np.full(40, moving[-1]), moving[-1] + moving[1:]])
    standing = standing_frames(pictures(place, seed=seed))
    assert standing[102:138].all()
    # Where the car sets off or comes to rest, a few frames hardly differ.
    assert not standing[:96].any() and not standing[144:].any()


@pytest.mark.parametrize("share", [0.3, 0.6, 0.85])
@pytest.mark.parametrize("step_px", [0.15, 1.5])
@pytest.mark.parametrize("seed", range(4))
def test_stops_are_found_however_long_the_car_stands_in_all(share, step_px, seed):
    # Three stops within 150 frames of driving.
    still = np.zeros(round(150 / (1.0 - share)), dtype=bool)
    each = (len(still) - 150) // 3
    for k in range(3):
        still[40 + k * (each + 30) :][:each] = True
    place = np.cumsum(np.where(still, 0.0, step_px))
    # The light drifts all along.
    gain = 1.0 + np.cumsum(0.004 * np.random.default_rng(seed).standard_normal(len(still)))
    small = pictures(place, noise=0.3, seed=seed) * gain[:, None, None].astype(np.float32)
    found = standing_frames(small)
    assert found[still].mean() > 0.95
    # A few frames as the car sets off or comes to rest.
    assert found[~still].sum() <= 18


def test_a_picture_that_was_recorded_twice_is_left_out():
    small = pictures(np.arange(60) * 1.0)
    small[30] = small[29]
    assert np.flatnonzero(standing_frames(small)).tolist() == [30]


def test_a_lamp_that_flickers_is_no_motion():
    flicker = np.random.default_rng(1).uniform(-20.0, 20.0, 60).astype(np.float32)
    place = np.concatenate([np.arange(100) * 1.0, np.full(60, 99.0)])
    small = pictures(place)
    small[100:] += flicker[:, None, None]
    assert standing_frames(small)[102:158].all()


def test_a_car_that_is_put_elsewhere_makes_one_break():
    place = np.concatenate([np.arange(80) * 0.5, 300.0 + np.arange(80) * 0.5])
    assert np.flatnonzero(put_elsewhere(pictures(place))).tolist() == [80]


def test_a_quick_turn_is_no_break():
    place = np.concatenate([np.arange(60) * 0.5, 30.0 + np.arange(20) * 7.0, 170.0 + np.arange(60) * 0.5])
    assert not put_elsewhere(pictures(place)).any()


def test_few_frames_have_neither():
    for count in (1, 2, 5):
        small = pictures(np.arange(count) * 1.0)
        assert not standing_frames(small).any() and not put_elsewhere(small).any()


def _drive(place_px, noise=0.3, **changes) -> Drive:
    """The same pictures at full size, as a camera would give them."""
    full = [
        cv2.resize(small, (160, 120), interpolation=cv2.INTER_NEAREST) for small in pictures(place_px, noise)
    ]
    images = [cv2.cvtColor(np.clip(v, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR) for v in full]
    return made_up_drive(images, **changes)


def test_small_images_are_means_over_patches():
    small = small_images(_drive(np.arange(5.0), noise=0.0))
    assert small.shape == (5, SMALL_HEIGHT, SMALL_WIDTH)
    # To a gray level, but where a patch straddles two blobs.
    assert np.median(np.abs(small - pictures(np.arange(5.0), noise=0.0))) < 1.0


@pytest.mark.parametrize("step_px", [0.3, 0.5])
def test_repeated_frames_and_stops_are_left_out_and_nothing_breaks(step_px):
    moving = np.arange(80) * step_px
    place = np.concatenate([moving, np.full(30, moving[-1]), moving[-1] + moving[1:]])
    speed = np.arange(len(place)).astype(float)
    drive = _drive(place, commands=Commands(speed_cm_s=speed))
    twice = [30, 31, 150]
    for k in twice:
        drive.images.images[k] = drive.images.images[k - 1]
    kept, notes = following_frames(drive)
    left_out = np.setdiff1d(drive.frames, kept.frames)
    assert set(twice) <= set(left_out) and set(range(82, 106)) <= set(left_out)
    assert set(left_out) - set(twice) <= set(range(76, 116))
    assert not kept.breaks.any()
    assert notes == [f"{len(left_out)} frames show the same as the one before, and are left out"]
    # What remains keeps its number, its time, its command and its picture.
    np.testing.assert_allclose(kept.t_s, 0.05 * kept.frames)
    assert kept.commands.speed_cm_s is not None
    np.testing.assert_array_equal(kept.commands.speed_cm_s, kept.frames)
    for k in (0, 35, len(kept) - 1):
        np.testing.assert_array_equal(kept.image(k), drive.image(int(kept.frames[k])))


def test_a_drive_that_never_stops_is_kept_as_it_is():
    drive = _drive(np.arange(100) * 0.8)
    kept, notes = following_frames(drive)
    np.testing.assert_array_equal(kept.frames, drive.frames)
    assert notes == [] and not kept.breaks.any()


def test_a_break_in_the_pictures_is_told_with_its_frame():
    breaks = np.zeros(160, dtype=bool)
    breaks[40] = True
    place = np.concatenate([np.arange(80) * 0.5, 300.0 + np.arange(80) * 0.5])
    kept, notes = following_frames(_drive(place, breaks=breaks, frames=np.arange(160) + 1000))
    # The recording's own break stays.
    assert np.flatnonzero(kept.breaks).tolist() == [40, 80]
    assert notes == ["1 breaks in the images, the first before frame 1080"]


def test_a_break_after_a_stop_is_not_left_out_with_it():
    place = np.concatenate([np.arange(80) * 0.8, np.full(30, 63.2), 300.0 + np.arange(80) * 0.8])
    kept, _ = following_frames(_drive(place))
    assert kept.frames[kept.breaks].tolist() == [110]
    assert len(kept) < 165


@pytest.mark.parametrize("name", ["speed_cm_s", "throttle"])
def test_a_car_that_backs_up_makes_a_break_and_its_frames_are_left_out(name):
    place = np.concatenate(
        [np.arange(80) * 0.8, 63.2 - np.arange(1, 21) * 0.8, 47.2 + np.arange(1, 80) * 0.8]
    )
    told = np.full(len(place), 0.4)
    told[80:100] = -0.3
    told[[0, 50]] = np.nan
    numbers = np.arange(len(place)) + 1000
    kept, notes = following_frames(_drive(place, commands=Commands(**{name: told}), frames=numbers))
    assert np.setdiff1d(numbers, kept.frames).tolist() == list(range(1080, 1100))
    assert kept.frames[kept.breaks].tolist() == [1100]
    assert notes == ["the car was commanded to reverse in frames 1080-1099: left out"]


def test_a_stop_beside_backing_up_is_told_apart_and_keeps_the_break():
    back = 63.2 - np.arange(1, 21) * 0.8
    place = np.concatenate(
        [np.arange(80) * 0.8, back, np.full(30, back[-1]), back[-1] + np.arange(1, 80) * 0.8]
    )
    speed = np.full(len(place), 40.0)
    speed[80:100], speed[100:130] = -40.0, 0.0
    drive = _drive(place, commands=Commands(speed_cm_s=speed))
    kept, notes = following_frames(drive)
    assert kept.breaks.sum() == 1 and 100 <= kept.frames[kept.breaks][0] <= 130
    assert notes[0] == "the car was commanded to reverse in frames 80-99: left out"
    same = len(place) - len(kept) - 20
    assert 20 < same <= 30
    assert notes[1:] == [f"{same} frames show the same as the one before, and are left out"]


def test_what_may_not_be_reversing_is_not_taken_for_it():
    moving, told = np.zeros(60, dtype=bool), np.full(60, 0.5)
    told[20:30] = -0.5
    assert reversing_runs(Commands(throttle=told), moving) == [(20, 30)]
    assert reversing_runs(Commands(), moving) == []
    # A speed says it better.
    assert reversing_runs(Commands(throttle=told, speed_cm_s=np.full(60, 50.0)), moving) == []
    # A motor that turns the other way.
    assert reversing_runs(Commands(throttle=-told), moving) == []
    assert reversing_runs(Commands(speed_cm_s=-told), moving) == [(0, 20), (30, 60)]
    # Brakes, until the car stands.
    assert reversing_runs(Commands(throttle=told), np.arange(60) >= 24) == []
    short = np.where((np.arange(60) >= 20) & (np.arange(60) < 24), -0.5, 0.5)
    assert reversing_runs(Commands(throttle=short), moving) == []
    assert reversing_runs(Commands(throttle=np.where(told < 0.0, -0.04, 0.5)), moving) == []


def test_a_car_that_only_backs_up_is_an_error():
    drive = _drive(np.arange(60) * 0.8, commands=Commands(speed_cm_s=np.full(60, -40.0)))
    with pytest.raises(TrackingLostError, match="reverse in frames 0-59"):
        following_frames(drive)
