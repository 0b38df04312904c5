"""MCAP files, read back with rosbags, which did not write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from watched import CAMERA, PATH, POINTS_CM, POSE, SCENE, frames, image, rotation

from lanenet.geometry.frames import map_from_car
from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.viewers.recording import record
from lanenet.viewers.seen import Scene, Seen

LEFT_CM = np.column_stack([POINTS_CM[:3], ROWS_CM])


def read(path: Path) -> dict[str, list[tuple[float, Any]]]:
    """Messages by topic, each with its time, [s]."""
    found: dict[str, list[tuple[float, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, t_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((1e-9 * t_ns, message))
    return found


@pytest.fixture(scope="module")
def topics(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[float, Any]]]:
    path = tmp_path_factory.mktemp("mcap") / "drive.mcap"
    with record({"mcap": str(path)}, SCENE) as recording:
        for seen in frames():
            recording.add(seen)
    return read(path)


def xyz(points: Any) -> np.ndarray:
    return np.array([[p.x, p.y, p.z] for p in points]).reshape(-1, 3)


def place(pose: Any) -> tuple[np.ndarray, np.ndarray]:
    """Translation and rotation of a Pose or a Transform."""
    at = getattr(pose, "position", None) or pose.translation
    q = getattr(pose, "orientation", None) or pose.rotation
    return np.array([at.x, at.y, at.z]), rotation(np.array([q.x, q.y, q.z, q.w]))


def test_types_are_those_that_foxglove_and_ros_know(topics: dict[str, list[tuple[float, Any]]]) -> None:
    types = {topic: messages[0][1].__msgtype__ for topic, messages in topics.items()}
    assert types == {
        "/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
        "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
        "/camera/calibration": "foxglove_msgs/msg/CameraCalibration",
        "/camera/annotations": "foxglove_msgs/msg/ImageAnnotations",
        "/birdseye/compressed": "sensor_msgs/msg/CompressedImage",
        "/edges": "sensor_msgs/msg/PointCloud2",
        "/lane/detected": "visualization_msgs/msg/MarkerArray",
        "/map/lines": "visualization_msgs/msg/MarkerArray",
        "/map/edges": "sensor_msgs/msg/PointCloud2",
        "/pose": "geometry_msgs/msg/PoseStamped",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/steering_rad": "std_msgs/msg/Float64",
        "/confidence": "std_msgs/msg/Float64",
    }


def test_times_are_those_of_the_frames(topics: dict[str, list[tuple[float, Any]]]) -> None:
    for topic, expected in (("/confidence", (10.0, 10.05, 10.1)), ("/pose", (10.0, 10.05))):
        assert [t_s for t_s, _ in topics[topic]] == pytest.approx(expected)
    stamp = topics["/pose"][1][1].header.stamp
    assert stamp.sec + 1e-9 * stamp.nanosec == pytest.approx(10.05)
    # The steering of the last frame is unknown.
    assert [message.data for _, message in topics["/steering_rad"]] == [0.25, 0.25]
    assert [message.data for _, message in topics["/confidence"]] == [0.75, 0.75, 0.25]


def test_images_are_read_back(topics: dict[str, list[tuple[float, Any]]]) -> None:
    message = topics["/camera/image/compressed"][0][1]
    assert (message.format, message.header.frame_id) == ("jpeg", "camera_optical")
    again = cv2.imdecode(np.array(message.data), cv2.IMREAD_COLOR)
    assert np.abs(again.astype(int) - image()).mean() < 4.0
    # From above, the lines at 18 cm on either side run straight up.
    above = cv2.imdecode(np.array(topics["/birdseye/compressed"][0][1].data), cv2.IMREAD_GRAYSCALE)
    columns = np.flatnonzero(above[-120] > 150)
    x_cm = -48.0 + 0.375 * (columns + 0.5)
    assert x_cm[x_cm < 0].mean() == pytest.approx(-18.0, abs=0.5)
    assert x_cm[x_cm > 0].mean() == pytest.approx(18.0, abs=0.5)


def test_lane_points_are_metres_ahead_and_to_the_left(topics: dict[str, list[tuple[float, Any]]]) -> None:
    markers = {(m.ns, m.id): m for m in topics["/lane/detected"][0][1].markers}
    known = markers["detected/left", 1]
    assert (known.header.frame_id, known.action) == ("base_link", 0)
    # x: ahead of the rear axle, 17 cm behind the front axle; y: to the left.
    expected = [[0.17, 0.18, 0.0], [0.32, 0.20, 0.0], [0.47, 0.26, 0.0]]
    np.testing.assert_allclose(xyz(known.points), expected, atol=1e-12)
    line = xyz(markers["detected/left", 0].points)
    np.testing.assert_allclose(line[[0, 3, 6]], expected, atol=1e-12)


def test_a_line_that_is_gone_is_taken_away(topics: dict[str, list[tuple[float, Any]]]) -> None:
    markers = {(m.ns, m.id): m.action for m in topics["/lane/detected"][-1][1].markers}
    assert markers["detected/left", 0] == markers["detected/left", 1] == 0
    assert markers["detected/right", 0] == markers["detected/right", 1] == 2


def test_the_lane_comes_to_its_place_on_the_map(topics: dict[str, list[tuple[float, Any]]]) -> None:
    moved = {t.child_frame_id: t for t in topics["/tf"][0][1].transforms}
    assert moved["base_link"].header.frame_id == "map"
    known = next(m for m in topics["/lane/detected"][0][1].markers if (m.ns, m.id) == ("detected/left", 1))
    expected = 0.01 * map_from_car(LEFT_CM, POSE, CAMERA.wheelbase_cm)
    for pose in (moved["base_link"].transform, topics["/pose"][0][1].pose):
        position, turn = place(pose)
        np.testing.assert_allclose((xyz(known.points) @ turn.T + position)[:, :2], expected, atol=1e-9)


def test_the_lane_is_seen_where_opencv_projects_it(topics: dict[str, list[tuple[float, Any]]]) -> None:
    """From base_link by /tf into the optical frame, and by the numbers of CameraInfo into the image."""
    moved = {t.child_frame_id: t for t in topics["/tf"][0][1].transforms}
    position, turn = place(moved["camera_optical"].transform)
    known = next(m for m in topics["/lane/detected"][0][1].markers if (m.ns, m.id) == ("detected/left", 1))
    optical = (xyz(known.points) - position) @ turn
    info = topics["/camera/camera_info"][0][1]
    assert (info.distortion_model, info.width, info.height) == ("equidistant", 160, 120)
    K = np.array(info.k).reshape(3, 3)
    px, _ = cv2.fisheye.projectPoints(optical[:, None], np.zeros(3), np.zeros(3), K, np.array(info.d))
    np.testing.assert_allclose(px[:, 0], CAMERA.project_ground(LEFT_CM), atol=1e-6)
    assert topics["/camera/calibration"][0][1].distortion_model == "kannala_brandt"
    np.testing.assert_array_equal(topics["/camera/calibration"][0][1].k, info.k)
    # Foxglove counts from the corner of the first pixel.
    drawn = xyz_2d(topics["/camera/annotations"][0][1].points[0].points)
    distance = np.linalg.norm(drawn[:, None] - (px[:, 0] + 0.5), axis=2).min(axis=0)
    inside = (px[:, 0] > 0).all(axis=1) & (px[:, 0] < (160, 120)).all(axis=1)
    assert inside.any() and (distance[inside] < 1.5).all()


def xyz_2d(points: Any) -> np.ndarray:
    return np.array([[p.x, p.y] for p in points])


def test_edges_and_map_are_read_back(topics: dict[str, list[tuple[float, Any]]]) -> None:
    cloud = topics["/edges"][0][1]
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 3)
    assert len(points) == cloud.width > 50 and [f.name for f in cloud.fields] == ["x", "y", "z"]
    found = RoadEdgeExtractor(CAMERA, PerceptionSettings()).extract(image()).points_cm
    np.testing.assert_allclose(points[:, 0], 0.01 * (found[:, 1] + 17.0), atol=1e-6)
    np.testing.assert_allclose(points[:, 1], -0.01 * found[:, 0], atol=1e-6)
    markers = topics["/map/lines"][0][1].markers
    assert {m.header.frame_id for m in markers} == {"map"}
    parts = [xyz(m.points)[:, :2] for m in markers if m.ns == "0/left_0"]
    np.testing.assert_allclose(np.concatenate(parts), [[0, 0.2], [0.5, 0.2], [0.8, 0.2], [0.9, 0.25]])
    path = next(m for m in markers if m.ns == "path")
    np.testing.assert_allclose(xyz(path.points)[:, :2], 0.01 * PATH[:, :2])


def test_the_map_is_repeated_for_those_who_come_late(tmp_path: Path) -> None:
    path = tmp_path / "long.mcap"
    with record({"mcap": str(path)}, SCENE) as recording:
        for k in range(12):
            recording.add(Seen(k, float(k), None))
    assert [t_s for t_s, _ in read(path)["/map/lines"]] == [0.0, 5.0, 10.0]


@pytest.mark.parametrize(
    ("times_s", "expected"),
    [
        ((np.nan, np.nan, np.nan), (7.0, 8.0, 9.0)),  # photos: by their numbers
        ((1.7e9, 1.7e9 + 0.05, 1.7e9 + 0.1), (1.7e9, 1.7e9 + 0.05, 1.7e9 + 0.1)),
        ((-3.0, -2.0, -1.0), (0.0, 1.0, 2.0)),  # before 1970
        ((5e9, 5e9 + 1.0, 5e9 + 2.0), (0.0, 1.0, 2.0)),  # beyond 2038
    ],
)
def test_times_without_a_place_on_ros_clock(
    tmp_path: Path, times_s: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    path = tmp_path / "t.mcap"
    with record({"mcap": str(path)}, Scene("without a camera")) as recording:
        for seen in frames(times_s):
            recording.add(seen)
    found = read(path)
    assert [t_s for t_s, _ in found["/confidence"]] == pytest.approx(expected)
    assert "/tf" not in found and "/lane/detected" not in found and "/camera/image/compressed" in found
