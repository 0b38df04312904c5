from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from lanenet.errors import CalibrationError, DriveFormatError
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.canny import EdgeSettings, find_edges, sample_pixels, to_gray
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import (
    COLOUR_WEIGHT,
    PerceptionSettings,
    RangeSettings,
    RoadEdgeExtractor,
    RoadTable,
)

DIRECTIONAL = EdgeSettings()
CANNY = EdgeSettings(method="canny")
CAMERA = Camera(
    model="fisheye",
    width=320,
    height=240,
    K=np.array([[107.8, 0.0, 159.5], [0.0, 107.8, 119.5], [0.0, 0.0, 1.0]]),
    D=np.zeros(4),
    mounting=Mounting(height_cm=20.0, pitch_down_rad=0.44, ahead_of_front_axle_cm=-2.0),
    wheelbase_cm=26.0,
)
#: Near road only, without the last rows, where the picture mirrored at its border bends the gradient.
FINE = RangeSettings(max_cm_per_px=1.0, bottom_rows=3)
#: A tape along y, its middle 10 cm to the right.
TAPE_LEFT_CM, TAPE_RIGHT_CM = 8.0, 12.0


def blurred_step(
    angle_rad: float, offset_px: float, sigma_px: float = 1.0, dark: float = 40.0, bright: float = 200.0
) -> tuple[np.ndarray, np.ndarray, float]:
    """A straight step, bright on the side of its unit normal; returns image, normal and normal . edge."""
    v, u = np.mgrid[0:60, 0:80].astype(np.float64)
    normal = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    level = float(normal @ [39.5, 29.5]) + offset_px
    distance = u * normal[0] + v * normal[1] - level
    share = 0.5 * (1.0 + np.vectorize(math.erf)(distance / (sigma_px * math.sqrt(2.0))))
    gray = np.rint(dark + (bright - dark) * share).astype(np.uint8)
    return np.repeat(gray[:, :, None], 3, axis=2), normal, level


@pytest.fixture(scope="module")
def tape_frame() -> np.ndarray:
    """The tape as the camera sees it, each pixel the mean of 5 x 5 rays."""
    share = np.zeros((CAMERA.height, CAMERA.width))
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
    for dv in (np.arange(5) + 0.5) / 5 - 0.5:
        for du in (np.arange(5) + 0.5) / 5 - 0.5:
            x = CAMERA.intersect_ground(np.stack([(u + du).ravel(), (v + dv).ravel()], axis=1))[:, 0]
            share += ((x > TAPE_LEFT_CM) & (x < TAPE_RIGHT_CM)).reshape(share.shape)
    gray = np.rint(50.0 + 180.0 * share / 25.0).astype(np.uint8)
    return np.repeat(gray[:, :, None], 3, axis=2)


def extractor(edges: EdgeSettings, road: RangeSettings) -> RoadEdgeExtractor:
    return RoadEdgeExtractor(CAMERA, PerceptionSettings(edges=edges, range=road))


def away_from_the_border(edges: EdgePixels) -> np.ndarray:
    """Select the edge points whose neighbourhood is inside the 80 x 60 image of ``blurred_step``."""
    u, v = edges.uv_px.T
    return (u > 4) & (u < 75) & (v > 4) & (v < 55)


@pytest.mark.parametrize("offset_px", [-0.4, -0.2, 0.0, 0.1, 0.3, 0.5])
@pytest.mark.parametrize("degrees", [0.0, 90.0, 180.0, 270.0, 10.0, 20.0, 70.0, 110.0, 200.0, 340.0])
def test_subpixel_position_of_a_blurred_step(degrees: float, offset_px: float) -> None:
    frame, normal, level = blurred_step(math.radians(degrees), offset_px)
    edges = find_edges(frame, DIRECTIONAL)
    inner = away_from_the_border(edges)
    assert np.count_nonzero(inner) >= 45
    error_px = edges.uv_px[inner] @ normal - level
    assert abs(error_px.mean()) < 0.05
    assert np.abs(error_px).max() < 0.1


@pytest.mark.parametrize("degrees", [30.0, 40.0, 45.0, 60.0, 135.0, 215.0])
def test_subpixel_position_of_a_diagonal_step(degrees: float) -> None:
    worst_px = 0.0
    for offset_px in (-0.4, -0.2, 0.0, 0.1, 0.3, 0.5):
        frame, normal, level = blurred_step(math.radians(degrees), offset_px)
        edges = find_edges(frame, DIRECTIONAL)
        error_px = edges.uv_px[away_from_the_border(edges)] @ normal - level
        worst_px = max(worst_px, float(np.abs(error_px).max()))
    assert worst_px < 0.1


def test_canny_answers_whole_pixels_with_the_same_directions() -> None:
    frame, _, _ = blurred_step(math.radians(20.0), 0.3)
    plain, moved = find_edges(frame, CANNY), find_edges(frame, DIRECTIONAL)
    np.testing.assert_array_equal(plain.uv_px, np.rint(plain.uv_px))
    np.testing.assert_array_equal(plain.normals, moved.normals)
    shift = moved.uv_px - plain.uv_px
    assert np.linalg.norm(shift, axis=1).max() <= 0.5 * math.sqrt(2.0) + 1e-9
    assert np.abs(shift).max() > 0.05
    # Only along the normal.
    cross = shift[:, 0] * plain.normals[:, 1] - shift[:, 1] * plain.normals[:, 0]
    np.testing.assert_allclose(cross, 0.0, atol=1e-12)


@pytest.mark.parametrize("settings", [CANNY, DIRECTIONAL])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0, 135.0, 180.0, 250.0, 315.0])
def test_normals_point_to_the_brighter_side(settings: EdgeSettings, degrees: float) -> None:
    frame, normal, _ = blurred_step(math.radians(degrees), 0.2)
    edges = find_edges(frame, settings)
    inner = away_from_the_border(edges)
    assert inner.any()
    np.testing.assert_allclose(np.linalg.norm(edges.normals, axis=1), 1.0, atol=1e-12)
    # Within two degrees of the true direction.
    assert (edges.normals[inner] @ normal).min() > math.cos(math.radians(2.0))


@pytest.mark.parametrize(
    ("tape_bgr", "yellow", "red"),
    [
        ((235, 235, 235), 0.0, 0.0),
        ((25, 25, 25), 0.0, 0.0),
        ((40, 190, 230), 1.0, 0.35),
        # As bright as the road: it is found by its colour alone.
        ((40, 105, 110), 1.0, 0.25),
        # Brighter than the road in red, darker in blue.
        ((45, 40, 190), 0.5, 1.0),
        # Towards the road, which is yellower than the tape.
        ((165, 90, 30), 1.0, 0.75),
    ],
)
def test_hues_are_what_the_gradient_gains_in_yellow_and_in_red(
    tape_bgr: tuple[int, int, int], yellow: float, red: float
) -> None:
    share, _, _ = blurred_step(0.3, 0.0, dark=0.0, bright=255.0)
    frame = np.rint(100.0 + share / 255.0 * (np.array(tape_bgr) - 100.0)).astype(np.uint8)
    edges = find_edges(frame, EdgeSettings(colour_weight=COLOUR_WEIGHT))
    inner = away_from_the_border(edges)
    assert edges.hues is not None and np.count_nonzero(inner) >= 45
    np.testing.assert_allclose(np.median(edges.hues[inner], axis=0), [yellow, red], atol=0.1)


def test_gray_images_have_no_hues() -> None:
    frame, _, _ = blurred_step(0.3, 0.0)
    weighted = EdgeSettings(colour_weight=COLOUR_WEIGHT)
    assert find_edges(frame[:, :, 0].copy(), weighted).hues is None
    assert find_edges(frame, DIRECTIONAL).hues is None
    in_colour = find_edges(frame, weighted)
    assert in_colour.hues is not None and not in_colour.hues.any()
    without = extractor(DIRECTIONAL, RangeSettings()).extract(np.zeros((240, 320, 3), np.uint8))
    assert without.hues is None and without.rows().shape == (0, 6)


@pytest.mark.parametrize("settings", [CANNY, DIRECTIONAL])
@pytest.mark.parametrize("level", [0, 255])
def test_a_flat_frame_has_no_edges(settings: EdgeSettings, level: int) -> None:
    frame = np.full((240, 320, 3), level, np.uint8)
    edges = find_edges(frame, settings)
    assert edges.uv_px.shape == edges.normals.shape == (0, 2)
    road = extractor(settings, RangeSettings()).extract(frame)
    assert road.points_cm.shape == road.normals.shape == (0, 2)


def test_a_step_below_the_threshold_is_no_edge() -> None:
    faint, _, _ = blurred_step(0.0, 0.0, dark=100.0, bright=110.0)
    assert len(find_edges(faint, EdgeSettings(low=100.0, high=200.0)).uv_px) == 0
    assert len(find_edges(faint, EdgeSettings(low=5.0, high=10.0)).uv_px) > 0


def test_the_lower_threshold_is_not_above_the_upper_one() -> None:
    with pytest.raises(ValueError, match="expected low at most high, found 90 above 80"):
        EdgeSettings(low=90.0)


def test_a_bright_tape_raises_the_threshold_for_soft_edges() -> None:
    # A soft edge at u = 20 that passes the fixed thresholds, and a strong one at u = 60.
    soft, _, _ = blurred_step(0.0, -19.5, dark=40.0, bright=85.0)
    strong, _, _ = blurred_step(0.0, 20.5, dark=0.0, bright=160.0)
    both = soft + strong

    def has_soft(frame: np.ndarray, settings: EdgeSettings) -> bool:
        return bool(np.any(np.abs(find_edges(frame, settings).uv_px[:, 0] - 20.0) < 2.0))

    assert has_soft(soft, DIRECTIONAL)
    assert has_soft(both, CANNY)
    assert not has_soft(both, DIRECTIONAL)
    assert has_soft(both, EdgeSettings(contrast_share=0.0))


def test_a_dim_frame_lowers_the_threshold_but_noise_is_no_edge() -> None:
    # A step of 45 gray levels, as soft as if out of focus.
    step, _, _ = blurred_step(0.0, 0.0, dark=60.0, bright=105.0)
    soft = cv2.GaussianBlur(step, (0, 0), 1.5)
    assert len(find_edges(soft, EdgeSettings(contrast_share=0.0)).uv_px) == 0
    assert len(find_edges(soft, DIRECTIONAL).uv_px) > 0.8 * soft.shape[0]
    for sigma in (2.0, 4.0, 6.0, 8.0):
        noise = np.random.default_rng(0).normal(70.0, sigma, (240, 320))
        assert len(find_edges(np.rint(noise).astype(np.uint8), DIRECTIONAL).uv_px) < 10


def test_keep_drops_pixels_and_changes_no_other() -> None:
    frame, _, _ = blurred_step(math.radians(20.0), 0.3)
    keep = np.zeros(frame.shape[:2], np.uint8)
    keep[30:] = 255
    everything, kept = find_edges(frame, CANNY), find_edges(frame, CANNY, keep)
    below = everything.uv_px[:, 1] >= 30
    assert 0 < np.count_nonzero(below) < len(below)
    np.testing.assert_array_equal(kept.uv_px, everything.uv_px[below])


def test_gray_and_colour_frames_of_the_same_picture_agree() -> None:
    frame, _, _ = blurred_step(math.radians(20.0), 0.3)
    np.testing.assert_array_equal(to_gray(frame), frame[:, :, 0])
    np.testing.assert_array_equal(find_edges(frame[:, :, 0], CANNY).uv_px, find_edges(frame, CANNY).uv_px)


@pytest.mark.parametrize("shape", [(240, 320, 4), (240, 320, 2), (0, 0, 3), (2, 240, 320, 3)])
def test_what_is_not_an_image_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(DriveFormatError, match="frame: expected"):
        to_gray(np.zeros(shape, np.uint8))


def test_the_table_is_exact_at_pixel_centres() -> None:
    table = RoadTable(CAMERA, RangeSettings())
    v, u = np.nonzero(table.keep)
    assert len(u) > 10_000
    pixels = np.stack([u, v], axis=1).astype(np.float64)
    expected = CAMERA.intersect_ground(pixels)
    lifted = table.lift(EdgePixels(pixels, np.tile([1.0, 0.0], (len(u), 1))))
    np.testing.assert_array_equal(lifted.points_cm, expected)
    np.testing.assert_array_equal(table.points_cm[v, u], expected)


def test_the_table_is_linear_between_pixel_centres() -> None:
    table = RoadTable(CAMERA, RangeSettings(max_cm_per_px=1.0))
    rng = np.random.default_rng(1)
    v, u = np.nonzero(table.keep)
    chosen = rng.choice(len(u), 2000, replace=False)
    pixels = np.stack([u, v], axis=1)[chosen] + rng.uniform(-0.49, 0.49, (2000, 2))
    lifted = table.lift(EdgePixels(pixels, np.tile([1.0, 0.0], (2000, 1))))
    error_cm = np.linalg.norm(lifted.points_cm - CAMERA.intersect_ground(pixels), axis=1)
    # Where a pixel spans at most 1 cm of road, the bend of the table within half a pixel is small.
    assert error_cm.max() < 0.02
    assert np.median(error_cm) < 0.002


def test_range_limits_what_is_kept() -> None:
    settings = RangeSettings(far_cm=50.0, side_cm=40.0, max_cm_per_px=2.0, top_row=110, bottom_rows=20)
    table = RoadTable(CAMERA, settings)
    kept = table.keep > 0
    assert kept.any()
    assert set(np.unique(table.keep)) == {0, 255}
    assert not kept[:110].any()
    assert not kept[-20:].any()
    assert table.points_cm[kept][:, 1].max() <= 50.0
    assert np.abs(table.points_cm[kept][:, 0]).max() <= 40.0
    for axis in (0, 1):
        per_px = np.linalg.norm(np.gradient(table.points_cm, axis=axis), axis=-1)
        assert per_px[:, 1:-1][kept[:, 1:-1]].max() <= 2.0
    # Each limit is the active one somewhere.
    assert table.points_cm[kept][:, 1].max() > 48.0
    assert np.abs(table.points_cm[kept][:, 0]).max() > 38.0


def test_edges_of_a_tape_lie_on_the_road_where_the_tape_is(tape_frame: np.ndarray) -> None:
    edges = extractor(DIRECTIONAL, FINE).extract(tape_frame)
    x, y = edges.points_cm.T
    near = y < 40.0
    left = near & (np.abs(x - TAPE_LEFT_CM) < 1.0)
    right = near & (np.abs(x - TAPE_RIGHT_CM) < 1.0)
    assert np.count_nonzero(left) > 30
    assert np.count_nonzero(right) > 30
    assert np.all(left | right | ~near)  # Nothing else.
    assert abs(np.median(x[left]) - TAPE_LEFT_CM) < 0.1
    assert abs(np.median(x[right]) - TAPE_RIGHT_CM) < 0.1
    # The fitted middle of the two edges is the middle of the tape, better than either edge.
    assert abs(0.5 * (np.median(x[left]) + np.median(x[right])) - 10.0) < 0.05


@pytest.mark.parametrize("settings", [CANNY, DIRECTIONAL])
def test_normals_on_the_road_point_into_the_bright_tape(
    settings: EdgeSettings, tape_frame: np.ndarray
) -> None:
    edges = extractor(settings, FINE).extract(tape_frame)
    x, y = edges.points_cm.T
    near = y < 40.0
    np.testing.assert_allclose(np.linalg.norm(edges.normals, axis=1), 1.0, atol=1e-6)
    # From the left edge to the right, from the right edge to the left, within ten degrees.
    into = np.where(x < 10.0, 1.0, -1.0) * edges.normals[:, 0]
    assert into[near].min() > math.cos(math.radians(10.0))


def test_a_dark_stripe_on_a_bright_floor_turns_the_normals(tape_frame: np.ndarray) -> None:
    # Without the blur, which rounds halves upwards: blurred negatives are not quite negatives.
    find = extractor(EdgeSettings(blur_px=0), FINE).extract
    bright, dark = find(tape_frame), find(255 - tape_frame)
    assert len(bright.points_cm) > 100
    np.testing.assert_allclose(dark.points_cm, bright.points_cm, atol=1e-9)
    np.testing.assert_allclose(dark.normals, -bright.normals, atol=1e-9)


@pytest.mark.parametrize("shape", [(120, 160, 3), (320, 240, 3), (240, 321, 3)])
def test_a_frame_of_the_wrong_size_is_refused(shape: tuple[int, int, int]) -> None:
    with pytest.raises(CalibrationError, match=rf"{shape[1]}x{shape[0]} px.*320x240"):
        extractor(DIRECTIONAL, RangeSettings()).extract(np.zeros(shape, np.uint8))


def test_a_camera_that_looks_up_is_refused() -> None:
    narrow = Camera(
        "pinhole", 320, 240, np.diag([900.0, 900.0, 1.0]) + 0.0, np.zeros(5), CAMERA.mounting, 26.0
    )
    with pytest.raises(CalibrationError, match="no pixel sees the road"):
        RoadTable(narrow.with_mounting(pitch_down_rad=-1.0), RangeSettings())


def test_a_range_that_leaves_no_rows_is_refused() -> None:
    with pytest.raises(CalibrationError, match="240 rows"):
        RoadTable(CAMERA, RangeSettings(top_row=200, bottom_rows=40))


def test_the_sample_of_a_mask_is_found_alike_by_the_caller_and_by_the_search(tape_frame: np.ndarray) -> None:
    keep = np.zeros((240, 320), np.uint8)
    keep[120:, 40:] = 255
    sample = sample_pixels(keep)
    assert {(int(i) // 320 % 3, int(i) % 320 % 3) for i in sample} == {(0, 0)}
    assert len(sample) == 40 * 93 and keep.ravel()[sample].all()
    given, own = (
        find_edges(tape_frame, DIRECTIONAL, keep, None, sample),
        find_edges(tape_frame, DIRECTIONAL, keep),
    )
    np.testing.assert_array_equal(given.uv_px, own.uv_px)
    assert len(given.uv_px) > 100
    assert len(find_edges(tape_frame, DIRECTIONAL, np.zeros_like(keep)).uv_px) == 0
