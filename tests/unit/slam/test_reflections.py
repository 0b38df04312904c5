"""Edges of lamps mirrored in the floor go, edges of the road stay."""

from __future__ import annotations

import numpy as np
import pytest
import tape_road as tape_road_module
from pixel_road import fisheye, pixels
from tape_road import HEIGHT_CM, STEP_CM, tape_road

from datagen.slam.odometry.stillness import without_reflections
from lanenet.perception.edges.canny import EdgePixels
from lanenet.perception.edges.road import RangeSettings, RoadTable

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
