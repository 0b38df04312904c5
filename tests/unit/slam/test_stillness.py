"""Frames of a car that stands, frames that were recorded twice, breaks, and edges of mirrored lamps.

Edges of lamps mirrored in the floor go, edges of the road stay.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import tape_road as tape_road_module
from picture_road import made_up_drive
from pixel_road import fisheye, pixels
from tape_road import HEIGHT_CM, STEP_CM, tape_road

from datagen.slam.odometry.stillness import (
    SMALL_HEIGHT,
    SMALL_WIDTH,
    following_frames,
    put_elsewhere,
    reversing_runs,
    small_images,
    standing_frames,
    without_reflections,
)
from lanenet.data.drives.recording import Commands, Drive
from lanenet.errors import TrackingLostError
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RangeSettings, RoadTable


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


@pytest.mark.parametrize("contrast", [1.0, 0.5])
def test_a_bare_picture_is_no_break(contrast):
    place = np.concatenate([np.arange(80) * 0.5, 300.0 + np.arange(80) * 0.5])
    small = pictures(place)
    # What is seen before the jump is fainter than in most frames of the drive.
    small[60:80] = 120.0 + contrast * (small[60:80] - 120.0)
    assert put_elsewhere(small).any() == (contrast == 1.0)


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


CAMERA = fisheye()
TABLE = RoadTable(CAMERA, RangeSettings(far_cm=75.0, side_cm=60.0))


def lamp(heading_rad, ahead_cm=25.0, bearing_rad=0.1, radius_cm=4.0):
    """Rim of a glare that keeps its distance from the camera and turns away as the car turns."""
    m = CAMERA.mounting
    at = bearing_rad + heading_rad
    centre = np.array([m.right_of_centre_cm, m.ahead_of_front_axle_cm])
    centre = centre + ahead_cm * np.array([np.sin(at), np.cos(at)])
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    out = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    uv = CAMERA.project_ground(centre + radius_cm * out)
    inwards = CAMERA.project_ground(centre + (radius_cm - 0.5) * out) - uv
    seen = (uv >= 0.0).all(axis=1) & (uv[:, 0] <= CAMERA.width - 1) & (uv[:, 1] <= CAMERA.height - 1)
    return EdgePixels(uv[seen], (inwards / np.linalg.norm(inwards, axis=1, keepdims=True))[seen])


def joined(a, b):
    return EdgePixels(np.concatenate([a.uv_px, b.uv_px]), np.concatenate([a.normals, b.normals]))


@pytest.mark.parametrize("curvature_per_cm", [0.0, 0.012])
def test_the_rim_of_a_mirrored_lamp_goes_and_tapes_stay(curvature_per_cm):
    road = tape_road(40, curvature_per_cm, 0.0)
    tapes = pixels(road, CAMERA)
    # The first heading at which the lamp is ahead is the middle of the drive.
    lamps = [lamp(pose[2] - road.poses[20, 2]) for pose in road.poses]
    kept = without_reflections([joined(a, b) for a, b in zip(tapes, lamps, strict=True)], CAMERA, TABLE)
    left_of_lamps, left_of_tapes, total = 0, 0, 0
    for k in range(12, 28):
        key = {tuple(p) for p in np.round(kept[k].uv_px, 6)}
        left_of_lamps += sum(tuple(p) in key for p in np.round(lamps[k].uv_px, 6))
        left_of_tapes += sum(tuple(p) in key for p in np.round(tapes[k].uv_px, 6))
        total += len(tapes[k].uv_px)
    assert left_of_lamps < 0.2 * sum(len(lamps[k].uv_px) for k in range(12, 28))
    assert left_of_tapes > 0.9 * total


def test_without_a_lamp_hardly_anything_is_dropped():
    tapes = pixels(tape_road(60), CAMERA)
    kept = without_reflections(tapes, CAMERA, TABLE)
    assert sum(len(e.uv_px) for e in kept) > 0.97 * sum(len(e.uv_px) for e in tapes)


@pytest.mark.parametrize("dash_cm", [4.5, 9.0, 14.0])
@pytest.mark.parametrize("curvature_per_cm", [0.0, 0.01])
def test_dashes_that_pass_beside_the_car_stay(monkeypatch, dash_cm, curvature_per_cm):
    """Their sides face the camera, one follows on the other in one place, and their ends tell the way."""
    monkeypatch.setattr(tape_road_module, "LINES", ((18.0, dash_cm, 2.0 * dash_cm, 0.0),))
    dashes = pixels(tape_road(60, curvature_per_cm, 0.0), CAMERA)
    kept = without_reflections(dashes, CAMERA, TABLE)
    assert sum(len(e.uv_px) for e in kept) > 0.95 * sum(len(e.uv_px) for e in dashes)


def test_a_glare_for_a_few_frames_could_be_anything():
    tapes = pixels(tape_road(30), CAMERA)
    edges = [joined(e, lamp(0.0)) if 10 <= k < 15 else e for k, e in enumerate(tapes)]
    kept = without_reflections(edges, CAMERA, TABLE)
    assert all(len(kept[k].uv_px) > 0.8 * len(edges[k].uv_px) for k in range(10, 15))


def test_frames_without_edges_are_fine():
    nothing = EdgePixels(np.empty((0, 2)), np.empty((0, 2)))
    assert all(len(e.uv_px) == 0 for e in without_reflections([nothing] * 3, CAMERA, TABLE))
    assert without_reflections([], CAMERA, TABLE) == []


def test_the_road_of_this_test_is_wide_enough_to_tell():
    # Over the frames that an edge has to stand still, the road moves by far more than a ring is wide.
    assert 8 * STEP_CM > 1.0 * HEIGHT_CM
