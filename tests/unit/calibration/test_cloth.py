from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cloth import CLICKED, NAMES, bends, real_corners, reference, side_lengths

from lanenet.calibration.ground import calibrate_ground, pixel_residuals
from lanenet.calibration.lens import pose_from_mounting

#: From pixels of the image to the frame car and back: the picture from above has y downwards, 1 px per cm.
FLIP = np.array([1.0, -1.0])


def figures(distance: np.ndarray) -> tuple[float, float, float]:
    return float(np.median(distance)), float(np.percentile(distance, 90)), float(distance.max())


@pytest.mark.parametrize(
    ("name", "median", "p90", "largest"),
    [
        ("front", 0.6, 1.3, 1.9),
        ("back", 1.2, 2.8, 4.0),
        ("left", 1.6, 3.3, 4.2),
        ("right", 1.4, 2.7, 3.2),
    ],
)
def test_the_references_own_mapping(
    shared_data: Path, name: str, median: float, p90: float, largest: float
) -> None:
    """Distances from the reference, px of 1 cm in the picture from above; see docs/calibration.md."""
    of = reference(shared_data / "fisheye_ground", name)
    lattice = of.lattice()
    pixels = of.pixels(lattice)
    assert np.isfinite(pixels).all()
    found = calibrate_ground(of.camera, lattice * FLIP, pixels)
    assert found.used.all()
    off = np.linalg.norm(found.camera.intersect_ground(pixels) * FLIP - lattice, axis=1)
    assert all(value < limit for value, limit in zip(figures(off), (median, p90, largest), strict=True))
    # The pose that was found is that of the camera that is returned.
    pose = pose_from_mounting(found.camera.mounting)
    again = pixel_residuals(of.camera, pose, lattice * FLIP, pixels)
    np.testing.assert_allclose(again, found.residuals_px, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_the_reference_is_four_clicks_on_whole_pixels(shared_data: Path, name: str) -> None:
    of = reference(shared_data / "fisheye_ground", name)
    left, right, top, bottom = CLICKED[name]
    clicks = of.flat(np.array([[left, top], [right, top], [left, bottom], [right, bottom]]))
    np.testing.assert_allclose(clicks, clicks.round(), atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_the_real_cloth_becomes_straight_and_square(shared_data: Path, name: str) -> None:
    """Corners found in the photo itself, against the cloth: 40 cm squares, 1 px of the picture is 1 cm."""
    folder = shared_data / "fisheye_ground"
    of = reference(folder, name)
    places, pixels = real_corners(folder, of)
    assert len(places) > 30
    found = calibrate_ground(of.camera, places * FLIP, pixels)
    above = found.camera.intersect_ground(pixels) * FLIP
    ours = figures(np.linalg.norm(above - places, axis=1))
    theirs = figures(np.linalg.norm(of.above(pixels) - places, axis=1))
    assert ours[0] < 1.25 and ours[1] < 3.6
    # Nearer to the real cloth than the reference is, by far.
    assert ours[0] < 0.6 * theirs[0] and ours[1] < 0.7 * theirs[1]
    assert np.median(bends(places, above)) < 0.6
    assert np.median(np.abs(side_lengths(places, above) - 40.0)) < 0.8
    assert 60.0 < found.camera.mounting.height_cm < 110.0
    assert found.sigma["height_cm"] < 0.5


@pytest.mark.parametrize("name", ["front", "back", "right"])
def test_half_of_the_corners_predict_the_others(shared_data: Path, name: str) -> None:
    folder = shared_data / "fisheye_ground"
    of = reference(folder, name)
    places, pixels = real_corners(folder, of)
    errors = []
    for seed in range(4):
        order = np.random.default_rng(seed).permutation(len(places))
        known, held = order[: len(order) // 2], order[len(order) // 2 :]
        camera = calibrate_ground(of.camera, places[known] * FLIP, pixels[known]).camera
        errors.append(np.linalg.norm(camera.intersect_ground(pixels[held]) * FLIP - places[held], axis=1))
    theirs = np.linalg.norm(of.above(pixels) - places, axis=1)
    assert np.median(np.concatenate(errors)) < 0.75 * np.median(theirs)
