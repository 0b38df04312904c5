"""Frames of a car that stands, frames that were recorded twice, and breaks, by small pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from picture_road import made_up_drive

from datagen.slam.stillness import (
    SMALL_HEIGHT,
    SMALL_WIDTH,
    following_frames,
    put_elsewhere,
    small_pictures,
    standing_frames,
)
from lanenet.data.recording import Commands, Drive


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


def test_small_pictures_are_means_over_patches():
    small = small_pictures(_drive(np.arange(5.0), noise=0.0))
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
    notes: list[str] = []
    kept = following_frames(drive, notes)
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
    notes: list[str] = []
    drive = _drive(np.arange(100) * 0.8)
    kept = following_frames(drive, notes)
    np.testing.assert_array_equal(kept.frames, drive.frames)
    assert notes == [] and not kept.breaks.any()


def test_a_break_in_the_pictures_is_told_with_its_frame():
    notes: list[str] = []
    breaks = np.zeros(160, dtype=bool)
    breaks[40] = True
    place = np.concatenate([np.arange(80) * 0.5, 300.0 + np.arange(80) * 0.5])
    kept = following_frames(_drive(place, breaks=breaks, frames=np.arange(160) + 1000), notes)
    # The recording's own break stays.
    assert np.flatnonzero(kept.breaks).tolist() == [40, 80]
    assert notes == ["1 breaks in the pictures, the first before frame 1080"]


def test_a_break_after_a_stop_is_not_left_out_with_it():
    place = np.concatenate([np.arange(80) * 0.8, np.full(30, 63.2), 300.0 + np.arange(80) * 0.8])
    kept = following_frames(_drive(place), [])
    assert kept.frames[kept.breaks].tolist() == [110]
    assert len(kept) < 165
