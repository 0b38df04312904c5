"""Whether edges moved from one image to the next, on floors that show next to nothing."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from picture_road import made_up_drive

from datagen.slam.odometry.edge_motion import edges_moved
from datagen.slam.odometry.stillness import following_frames, small_images, standing_frames
from lanenet.data.drives import open_drive

SIZE = (240, 320)


def sheet(shift_px=0.0, noise=0.0, brightness=200.0, seed=0):
    """A pale sheet with one line of tape and a few stains, moved to the right."""
    rng = np.random.default_rng(7)
    image = np.full(SIZE, brightness, np.float32)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
    image -= 70.0 * np.clip(6.0 - np.abs(u - 60.0 - shift_px - 0.4 * v), 0.0, 3.0) / 3.0
    for at_u, at_v in rng.uniform([120, 60], [300, 230], (12, 2)):
        image -= 12.0 * np.exp(-((u - at_u - shift_px) ** 2 + (v - at_v) ** 2) / 8.0)
    image += noise * np.random.default_rng(seed).standard_normal(SIZE)
    return cv2.cvtColor(np.clip(image, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)


@pytest.mark.parametrize("noise", [0.0, 2.0])
@pytest.mark.parametrize("shift_px", [2.0, 4.0, 8.0])
def test_a_line_that_moves_is_seen(shift_px, noise):
    assert edges_moved(sheet(0.0, noise, seed=1), sheet(shift_px, noise, seed=2))


@pytest.mark.parametrize("noise", [0.0, 2.0, 6.0])
@pytest.mark.parametrize("brightness", [200.0, 180.0])
def test_neither_noise_nor_light_is_motion(noise, brightness):
    assert not edges_moved(sheet(0.0, noise, seed=1), sheet(0.0, noise, brightness, seed=2))


@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_a_blank_image_shows_no_motion(noise):
    rng = np.random.default_rng(3)
    blank = [
        np.clip(128.0 + noise * rng.standard_normal((120, 160)), 0, 255).astype(np.uint8) for _ in range(2)
    ]
    assert not edges_moved(*blank)


def test_the_car_that_rolls_over_a_bare_sheet_does_not_stand():
    rng = np.random.default_rng(5)
    texture = cv2.GaussianBlur(rng.uniform(0, 255, SIZE).astype(np.float32), (0, 0), 8.0)
    texture = cv2.normalize(texture, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)
    # A road full of marks, then a sheet that shows one line, which hardly moves between frames.
    images = [cv2.cvtColor(np.roll(texture, 12 * k, axis=1), cv2.COLOR_GRAY2BGR) for k in range(60)]
    images += [sheet(2.0 * k) for k in range(20)]
    images += [sheet(38.0, noise=1.0, seed=k) for k in range(20)]
    drive = made_up_drive(images)
    # The mean change alone takes the line for a stop.
    assert standing_frames(small_images(drive))[62:79].all()
    kept, _ = following_frames(drive)
    assert set(range(80)) <= set(kept.frames.tolist())
    assert not set(range(82, 100)) & set(kept.frames.tolist())


@pytest.mark.slow
def test_bare_sheets_of_a_real_drive_are_driven_over_and_its_stop_is_left_out(shared_data):
    """``blue_tape``: with each lap the car rolls over a bare sheet (frames 340 to 362), and it stops once."""
    kept, _ = following_frames(open_drive(shared_data / "blue_tape"))
    frames = set(kept.frames.tolist())
    assert len(frames & set(range(340, 363))) == 23
    assert not frames & set(range(972, 997))
