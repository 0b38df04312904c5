from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera
from lanenet.onboard.bench import example_camera, example_frames
from lanenet.perception.camera_check import CameraCheck, Concern, view_of
from lanenet.perception.edges.road import RoadEdges

CAMERA = example_camera()
HEIGHT_CM = CAMERA.mounting.height_cm
ROWS_CM = np.concatenate([np.linspace(3.0, 55.0, 60), np.geomspace(60.0, 600.0, 60)])


def turned(camera: Camera, **degrees: float) -> Camera:
    angles = {f"{name}_rad": math.radians(by) for name, by in degrees.items()}
    angles = {name: by + getattr(camera.mounting, name) for name, by in angles.items()}
    return replace(camera, mounting=replace(camera.mounting, **angles))


def seen(true: Camera, bend: float = 0.0, flipped: bool = False, shift_px: float = 0.0) -> RoadEdges:
    """Lines 20 cm to either side, concentric, as the road of CAMERA shows them if ``true`` took the image."""
    points, normals = [], []
    for x in (-20.0, 20.0):
        # To the second order, the parallel of a circle of curvature 2 bend.
        curve = bend / (1.0 - 2.0 * bend * x)
        line = np.stack([x + curve * ROWS_CM**2, ROWS_CM], axis=1)
        step = 0.2 * np.stack([2.0 * curve * ROWS_CM, np.ones_like(ROWS_CM)], axis=1)
        near, far = (_moved(at, true, flipped, shift_px) for at in (line - step, line + step))
        along = far - near
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        points.append(0.5 * (near + far))
        normals.append(np.stack([along[:, 1], -along[:, 0]], axis=1))
    found = RoadEdges(np.concatenate(points), np.concatenate(normals))
    good = np.isfinite(found.points_cm).all(axis=1)
    return RoadEdges(found.points_cm[good], found.normals[good])


def _moved(line: np.ndarray, true: Camera, flipped: bool, shift_px: float) -> np.ndarray:
    pixels = true.project_ground(line)
    if flipped:
        pixels = np.array([CAMERA.width - 1.0, CAMERA.height - 1.0]) - pixels
    return CAMERA.intersect_ground(pixels + [shift_px, 0.0])


@pytest.mark.parametrize("bend", [-0.004, 0.0, 0.004])
@pytest.mark.parametrize("pitch", [-5.0, -3.0, 0.0, 3.0, 5.0])
def test_lines_that_converge_show_the_pitch(pitch: float, bend: float) -> None:
    found, _ = view_of(seen(turned(CAMERA, pitch_down=pitch), bend), HEIGHT_CM)
    assert math.degrees(found) == pytest.approx(pitch, abs=1.2)


@pytest.mark.parametrize("yaw", [-10.0, 0.0, 10.0])
def test_the_direction_shows_the_yaw(yaw: float) -> None:
    # A camera that looks to the left sees the lane run to the right.
    pitch, found = view_of(seen(turned(CAMERA, yaw=yaw)), HEIGHT_CM)
    assert math.degrees(found) == pytest.approx(-yaw, abs=1.0) and abs(math.degrees(pitch)) < 1.5


def test_a_camera_upside_down_is_far_off() -> None:
    pitch, _ = view_of(seen(CAMERA, flipped=True), HEIGHT_CM)
    assert abs(math.degrees(pitch)) > 10.0


def test_one_line_or_no_line_shows_nothing() -> None:
    edges = seen(CAMERA)
    left = edges.points_cm[:, 0] < 0.0
    for keep in (left, left & ~left):
        assert np.isnan(view_of(RoadEdges(edges.points_cm[keep], edges.normals[keep]), HEIGHT_CM)).all()


def drive(true: Camera, seconds: float = 6.0, shift_px: float = 0.0, flipped: bool = False) -> CameraCheck:
    """Bends to both sides, followed exactly by a car whose wheels turn 0.8 times as much as commanded."""
    check = CameraCheck(CAMERA)
    for i in range(round(4.0 * seconds)):
        bend = 0.003 * math.sin(0.5 * i)
        steering_rad = math.atan(-2.0 * bend * CAMERA.wheelbase_cm) / 0.8
        # The rear axle is tangent to the lane: what lies ahead of it runs askew by its distance.
        heading = turned(true, yaw=math.degrees(2.0 * bend * CAMERA.wheelbase_cm))
        check.add(*view_of(seen(heading, bend, flipped, shift_px), HEIGHT_CM), steering_rad)
    return check


def test_a_camera_as_calibrated_is_no_concern() -> None:
    assert drive(CAMERA).finding.concern is Concern.NONE


@pytest.mark.parametrize(
    ("check", "concern", "word"),
    [
        (lambda: drive(turned(CAMERA, pitch_down=5.0)), Concern.STOP, "down"),
        (lambda: drive(turned(CAMERA, pitch_down=-5.0)), Concern.SLOW, "up"),
        (lambda: drive(turned(CAMERA, yaw=10.0)), Concern.SLOW, "right"),
        (lambda: drive(turned(CAMERA, yaw=-10.0)), Concern.SLOW, "left"),
        (lambda: drive(CAMERA, shift_px=40.0), Concern.SLOW, "right"),
        (lambda: drive(CAMERA, shift_px=-40.0), Concern.SLOW, "left"),
        (lambda: drive(CAMERA, flipped=True), Concern.STOP, "upside down"),
    ],
)
def test_a_camera_that_has_moved_is_noticed(check, concern: Concern, word: str) -> None:
    finding = check().finding
    assert finding.concern >= concern and word in finding.text


def test_upside_down_shows_within_two_seconds() -> None:
    assert drive(CAMERA, seconds=2.0, flipped=True).finding.concern is Concern.STOP


def test_too_few_views_say_nothing() -> None:
    assert drive(turned(CAMERA, pitch_down=10.0), seconds=3.0).finding.concern is Concern.NONE


def test_frames_are_looked_at_four_times_a_second() -> None:
    check = CameraCheck(CAMERA)
    views: list[int] = []
    check.view = lambda frame: (views.append(1) or 0.0, 0.0)  # type: ignore[method-assign,func-returns-value]
    frame = example_frames(CAMERA, 1, np.random.default_rng(0))[0]
    for i in range(40):
        check.look(frame, i / 20.0)
    assert len(views) == 8


def test_a_frame_of_another_size_is_refused() -> None:
    with pytest.raises(CalibrationError, match="320x240"):
        CameraCheck(CAMERA).look(np.zeros((10, 10, 3), np.uint8), 0.0)
