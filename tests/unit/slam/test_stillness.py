import numpy as np
import pytest

from datagen.slam.stillness import put_elsewhere, standing_frames


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
