from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.edges.canny import EdgeSettings, find_edges
from lanenet.perception.edges.markings_only import (
    COLOURS,
    ColourSettings,
    MarkingColour,
    colour_edges,
    measure_components,
)
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import PerceptionSettings, RangeSettings, RoadEdgeExtractor

COLOUR = EdgeSettings(method="colour")
CAMERA = Camera(
    "fisheye",
    320,
    240,
    np.array([[107.8, 0.0, 159.5], [0.0, 107.8, 119.5], [0.0, 0.0, 1.0]]),
    np.zeros(4),
    Mounting(20.0, 0.44),
    26.0,
)
WHITE, YELLOW, GRAY = (230, 230, 230), (40, 200, 210), (80, 80, 80)


def road(height: int = 120, width: int = 160) -> np.ndarray:
    return np.full((height, width, 3), GRAY, np.uint8)


def strip(frame: np.ndarray, u: int, colour: tuple[int, int, int], width: int = 6) -> np.ndarray:
    """A vertical strip whose edges lie half a pixel outside its first and last column."""
    frame[:, u : u + width] = colour
    return frame


def columns(edges: EdgePixels) -> tuple[np.ndarray, np.ndarray]:
    inner = (edges.uv_px[:, 1] > 5) & (edges.uv_px[:, 1] < 114)
    return edges.uv_px[inner, 0], edges.normals[inner, 0]


@pytest.mark.parametrize("colour", [WHITE, YELLOW])
def test_both_edges_of_a_strip_point_inwards(colour: tuple[int, int, int]) -> None:
    u, normal_u = columns(find_edges(strip(road(), 60, colour), COLOUR))
    left, right = u[normal_u > 0.9], u[normal_u < -0.9]
    assert len(left) + len(right) == len(u) and len(left) > 100 and len(right) > 100
    np.testing.assert_allclose(left, 59.5, atol=0.1)
    np.testing.assert_allclose(right, 65.5, atol=0.1)


def test_yellow_as_bright_as_the_road_is_found_by_its_colour() -> None:
    # Lab (L, a, b) of the road's own lightness, only yellower.
    lab = cv2.cvtColor(np.array([[GRAY]], np.uint8), cv2.COLOR_BGR2Lab)[0, 0] + np.array([0, 0, 40], np.uint8)
    same = tuple(int(c) for c in cv2.cvtColor(lab[None, None], cv2.COLOR_Lab2BGR)[0, 0])
    frame = strip(road(), 60, same)
    assert len(find_edges(frame, EdgeSettings()).uv_px) == 0
    u, normal_u = columns(find_edges(frame, COLOUR))
    assert len(u) > 150
    # Half the resolution: within a pixel and a half, on the right sides.
    assert np.abs(u[normal_u > 0] - 59.5).max() < 1.5
    assert np.abs(u[normal_u < 0] - 65.5).max() < 1.5
    blind = EdgeSettings(method="colour", colour=ColourSettings(yellow=False))
    assert len(find_edges(frame, blind).uv_px) == 0


def test_the_soft_round_image_of_a_lamp_falls_out_and_the_tape_stays() -> None:
    v, u = np.mgrid[0:120, 0:160]
    lamp = 150.0 * np.exp(-((u - 110.0) ** 2 + (v - 60.0) ** 2) / (2.0 * 5.0**2))
    frame = strip(road(), 40, WHITE)
    frame = np.clip(frame + lamp[..., None], 0, 255).astype(np.uint8)
    plain, colour = find_edges(frame, EdgeSettings(method="canny")), find_edges(frame, COLOUR)
    assert np.count_nonzero(plain.uv_px[:, 0] > 80) > 20
    assert np.count_nonzero(colour.uv_px[:, 0] > 80) == 0
    assert np.count_nonzero(colour.uv_px[:, 0] < 80) > 200


def test_dark_markings_are_an_option() -> None:
    frame = strip(np.full((120, 160, 3), 200, np.uint8), 60, (30, 30, 30))
    found = {
        markings: columns(
            find_edges(frame, EdgeSettings(method="colour", colour=ColourSettings(markings=markings)))
        )
        for markings in ("light", "dark", "both")
    }
    assert len(found["light"][0]) == 0
    for markings in ("dark", "both"):
        u, normal_u = found[markings]
        np.testing.assert_allclose(u[normal_u < 0], 59.5, atol=0.1)  # Towards the brighter side: outwards.
        np.testing.assert_allclose(u[normal_u > 0], 65.5, atol=0.1)
        assert len(u) > 200


def test_a_strip_too_thick_for_a_marking_is_dropped_by_its_centimetres() -> None:
    v, u = np.mgrid[0:240, 0:320].astype(np.float64)
    x = CAMERA.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1))[:, 0].reshape(u.shape)
    frame = road(240, 320)
    frame[np.abs(x - 12.0) < 1.5] = WHITE
    near = RangeSettings(max_cm_per_px=1.0)

    def points(thickest_cm: float) -> int:
        edges = EdgeSettings(method="colour", colour=ColourSettings(thickest_cm=thickest_cm))
        return len(
            RoadEdgeExtractor(CAMERA, PerceptionSettings(edges=edges, range=near)).extract(frame).points_cm
        )

    assert points(5.0) > 100
    assert points(1.0) == 0


def test_colour_edges_lie_on_the_tape_of_the_road() -> None:
    v, u = np.mgrid[0:240, 0:320].astype(np.float64)
    x = CAMERA.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1))[:, 0].reshape(u.shape)
    frame = road(240, 320)
    frame[np.abs(x - 12.0) < 1.5] = WHITE
    frame[np.abs(x + 12.0) < 1.5] = YELLOW
    settings_ = PerceptionSettings(edges=COLOUR, range=RangeSettings(far_cm=50.0, bottom_rows=3))
    found = RoadEdgeExtractor(CAMERA, settings_).extract(frame)
    distance = np.abs(np.abs(np.abs(found.points_cm[:, 0]) - 12.0) - 1.5)
    assert len(distance) > 200
    assert np.count_nonzero(found.points_cm[:, 0] < 0) > 80
    assert np.percentile(distance, 95) < 0.5


def test_a_mask_takes_the_car_out_of_the_road() -> None:
    frame = strip(road(240, 320), 155, WHITE, 10)
    car = np.zeros((240, 320), np.uint8)
    car[200:] = 255
    free = RoadEdgeExtractor(CAMERA, PerceptionSettings())
    masked = RoadEdgeExtractor(CAMERA, PerceptionSettings(), car)
    assert not masked.table.keep[200:].any()
    np.testing.assert_array_equal(masked.table.keep[:200], free.table.keep[:200])
    assert 0 < len(masked.extract(frame).points_cm) < len(free.extract(frame).points_cm)
    with pytest.raises(CalibrationError, match="mask of 160x120"):
        RoadEdgeExtractor(CAMERA, PerceptionSettings(), np.zeros((120, 160), np.uint8))
    with pytest.raises(CalibrationError, match="no pixel sees the road"):
        RoadEdgeExtractor(CAMERA, PerceptionSettings(), np.full((240, 320), 255, np.uint8))


@pytest.mark.parametrize("method", ["canny", "directional", "colour"])
@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_image_gives_finite_unit_normals_inside(method: str, data: st.DataObject) -> None:
    height, width = data.draw(st.integers(1, 20)), data.draw(st.integers(1, 20))
    shape = (height, width, 3) if data.draw(st.booleans()) else (height, width)
    frame = data.draw(arrays(np.uint8, shape, elements=st.sampled_from([0, 60, 255]), fill=st.just(60)))
    edges = find_edges(frame, EdgeSettings.model_validate({"method": method, "low": 5.0, "high": 10.0}))
    np.testing.assert_allclose(np.linalg.norm(edges.normals, axis=1), 1.0, atol=1e-9)
    assert np.all(edges.uv_px >= -0.75) and np.all(edges.uv_px <= [width - 0.25, height - 0.25])


def test_components_tell_a_strip_from_a_disk() -> None:
    mask = np.zeros((100, 100), np.uint8)
    cv2.circle(mask, (25, 25), 10, 255, -1)
    mask[50:54, 10:50] = 255
    mask[70:80, 60:70] = 255
    found = measure_components(mask, np.full(mask.shape, 0.5))
    disk, bar, square = 1, 2, 3
    assert found.area[bar] == 160 and found.rim[bar] == 84 and found.area[square] == 100
    assert found.elongation[square] == pytest.approx(4.0)
    assert found.elongation[disk] < 3.5 < 10.0 < found.elongation[bar]
    assert found.thickness_cm[bar] == pytest.approx(2.0 * 160 / 84 * 0.5)
    chosen = np.zeros(4, np.bool_)
    chosen[bar] = True
    assert np.count_nonzero(found.paint(chosen)) == 160
    np.testing.assert_allclose(found.mean(mask)[1:], 255.0)


def test_another_colour_is_an_entry(monkeypatch):
    # Blue tape on a floor of the same lightness: b falls towards blue.
    frame = np.full((60, 80, 3), (110, 128, 128), np.uint8)
    frame[10:50, 38:43] = (250, 110, 90)
    settings = ColourSettings(white_floor=255)
    assert len(colour_edges(frame, settings, 3).uv_px) == 0
    blue = MarkingColour(2, lambda settings: settings.yellow_floor, falls=True)
    monkeypatch.setitem(COLOURS, "blue", blue)
    u = colour_edges(frame, settings, 3).uv_px[:, 0]
    assert len(u) > 60 and np.median(np.abs(np.abs(u - 40.0) - 2.5)) < 0.5
