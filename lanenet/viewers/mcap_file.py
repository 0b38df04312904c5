"""MCAP files (https://mcap.dev) of ROS 2 messages, for Foxglove and for ROS 2.

The messages are those of ROS 2's own packages, in CDR with their definitions: Foxglove shows them as it shows
its own schemas, and ``ros2 bag play`` needs nothing installed. The two of Foxglove's own (``foxglove_msgs``)
say what ROS 2 has no message for: lines in the distorted image, and a fisheye lens by the name that Foxglove
gives it. Lengths are in metres, see :mod:`lanenet.viewers.ros_frames`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from lanenet.data.files import require
from lanenet.geometry.camera import Camera
from lanenet.perception.draw import TRUTH_BGR, Bgr
from lanenet.viewers.drawing import Artist, Drawing, DrawnLine, strips_of
from lanenet.viewers.ros_frames import BASE, CAMERA, MAP, base_from_car_m, camera_in_base_m, map_m, pose_m
from lanenet.viewers.ros_messages import definition, encode
from lanenet.viewers.seen import LANE_NAMES
from lanenet.viewers.viewer import ViewerKind

#: The map is repeated, so that who comes late to a replay gets it, too. Chosen.
_MAP_EVERY_S = 5.0
#: Who wrote a file, in its header.
_LIBRARY = "lanenet"
#: The times of ROS 2 have seconds of 32 bits; one year of them is left for the drive.
_LAST_S = 2.0**31 - 3.2e7
#: Marker.msg: types and actions.
_LINE_STRIP, _SPHERE_LIST, _ADD, _DELETE = 4, 7, 0, 2
#: PointsAnnotation.msg and PointField.msg.
_ANNOTATED_STRIP, _FLOAT32 = 3, 7
#: Drawn widths, [m] and [px]. Chosen: half a tape; a label's point stands out.
_LINE_M, _POINT_M, _LINE_PX = 0.015, 0.03, 1.5
_MAP_BGR, _PATH_BGR = (150, 160, 0), (255, 140, 90)
#: Names of lenses: those of ROS 2's ``sensor_msgs`` and those of Foxglove.
_ROS_LENS = {"fisheye": "equidistant", "pinhole": "plumb_bob"}
_FOXGLOVE_LENS = {"fisheye": "kannala_brandt", "pinhole": "plumb_bob"}
_UPRIGHT = {"orientation": {"w": 1.0}}


class McapFile:
    """Writes what is drawn as messages."""

    def __init__(self, path: str) -> None:
        """Open a file.

        Raises:
            MissingExtraError: If mcap is not installed.
            OSError: If the file cannot be written.
        """
        writer = require("mcap.writer", "viewers")
        self._file = Path(path).open("wb")  # noqa: SIM115 - closed by close()
        self._writer = writer.Writer(self._file)
        self._writer.start(profile="ros2", library=_LIBRARY)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._first_s: float | None = None
        self._map_due_s = -math.inf

    def begin(self, artist: Artist) -> None:
        """Remember the map, which is written with the first frame."""
        self._scene = artist.scene

    def add(self, drawing: Drawing) -> None:
        """Write the messages of a frame."""
        seen, camera = drawing.seen, drawing.camera
        self._now_s = self._time_s(seen.t_s, seen.frame)
        if self._now_s >= self._map_due_s:
            self._map_due_s = self._now_s + _MAP_EVERY_S
            self._write_map()
        transforms = []
        if seen.pose is not None:
            position, turn = pose_m(seen.pose)
            pose = {"position": _xyz(position), "orientation": _xyzw(turn)}
            self._write("/pose", "geometry_msgs/PoseStamped", {"header": self._header(MAP), "pose": pose})
            transforms.append(self._transform(MAP, BASE, position, turn))
        if camera is not None:
            transforms.append(self._transform(BASE, CAMERA, *camera_in_base_m(camera)))
            self._write("/tf", "tf2_msgs/TFMessage", {"transforms": transforms})
            self._write_camera(camera)
            self._write_lanes(drawing.lines, camera.wheelbase_cm)
            edges_m = base_from_car_m(drawing.edges_cm, camera.wheelbase_cm)
            self._write("/edges", "sensor_msgs/PointCloud2", self._cloud(BASE, edges_m))
        for topic, frame_id, jpeg in (
            ("/camera/image/compressed", CAMERA, drawing.jpeg),
            ("/birdseye/compressed", BASE, drawing.birdseye_jpeg),
        ):
            if jpeg is not None:
                image = {"header": self._header(frame_id), "format": "jpeg", "data": jpeg}
                self._write(topic, "sensor_msgs/CompressedImage", image)
        self._write_annotations(drawing.lines)
        for name, value in drawing.values.items():
            self._write(f"/{name}", "std_msgs/Float64", {"data": value})

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError: If it could not be written to its end.
        """
        with self._file:
            self._writer.finish()

    def _time_s(self, t_s: float, frame: int) -> float:
        """Return the time of a frame; photos, which have none, are one second apart."""
        t_s = t_s if np.isfinite(t_s) else float(frame)
        if self._first_s is None:
            # Clocks that ROS 2 has no times for count from the first frame.
            self._first_s = 0.0 if 0.0 <= t_s < _LAST_S else t_s
        return t_s - self._first_s

    def _write(self, topic: str, message: str, value: Mapping[str, Any]) -> None:
        if topic not in self._channels:
            package, _, name = message.partition("/")
            if message not in self._schemas:
                self._schemas[message] = self._writer.register_schema(
                    name=f"{package}/msg/{name}", encoding="ros2msg", data=definition(message).encode()
                )
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="cdr", schema_id=self._schemas[message]
            )
        now_ns = round(1e9 * self._now_s)
        count = self._counts[topic] = self._counts.get(topic, 0) + 1
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=now_ns,
            publish_time=now_ns,
            sequence=count,
            data=encode(message, value),
        )

    def _stamp(self) -> dict[str, int]:
        seconds, nanoseconds = divmod(round(1e9 * self._now_s), 10**9)
        return {"sec": seconds, "nanosec": nanoseconds}

    def _header(self, frame_id: str) -> dict[str, Any]:
        return {"stamp": self._stamp(), "frame_id": frame_id}

    def _transform(self, parent: str, child: str, position: np.ndarray, turn: np.ndarray) -> dict[str, Any]:
        moved = {"translation": _xyz(position), "rotation": _xyzw(turn)}
        return {"header": self._header(parent), "child_frame_id": child, "transform": moved}

    def _write_camera(self, camera: Camera) -> None:
        D = np.zeros(4 if camera.model == "fisheye" else 5)
        D[: len(camera.D)] = camera.D
        lens = {
            "width": camera.width,
            "height": camera.height,
            "d": D,
            "k": camera.K.ravel(),
            "r": np.eye(3).ravel(),
            "p": np.column_stack([camera.K, np.zeros(3)]).ravel(),
        }
        info = {"header": self._header(CAMERA), "distortion_model": _ROS_LENS[camera.model], **lens}
        self._write("/camera/camera_info", "sensor_msgs/CameraInfo", info)
        calibration = {
            "timestamp": self._stamp(),
            "frame_id": CAMERA,
            "distortion_model": _FOXGLOVE_LENS[camera.model],
            **lens,
        }
        self._write("/camera/calibration", "foxglove_msgs/CameraCalibration", calibration)

    def _write_lanes(self, lines: Sequence[DrawnLine], wheelbase_cm: float) -> None:
        for whose in LANE_NAMES:
            markers = []
            for line in (line for line in lines if line.name.startswith(whose)):
                known_m = base_from_car_m(line.known_cm, wheelbase_cm)
                strips = [base_from_car_m(strip, wheelbase_cm) for strip in strips_of(line.line_cm)]
                strip_m = max(strips, key=len, default=np.empty((0, 3)))
                colour = line.colour_bgr
                markers.append(self._marker(BASE, line.name, 0, strip_m, colour))
                markers.append(self._marker(BASE, line.name, 1, known_m, colour, _SPHERE_LIST))
            if markers:
                self._write(f"/lane/{whose}", "visualization_msgs/MarkerArray", {"markers": markers})

    def _write_annotations(self, lines: Sequence[DrawnLine]) -> None:
        """Write the lines in the image, whose origin is the corner of the first pixel there."""
        points = [
            {
                "timestamp": self._stamp(),
                "type": _ANNOTATED_STRIP,
                "points": strip + 0.5,
                "outline_color": _rgba(line.colour_bgr),
                "thickness": _LINE_PX,
            }
            for line in lines
            for strip in line.strips_px
        ]
        self._write("/camera/annotations", "foxglove_msgs/ImageAnnotations", {"points": points})

    def _write_map(self) -> None:
        scene = self._scene
        markers = [
            self._marker(MAP, name, number, map_m(strip), _MAP_BGR)
            for name, line in scene.lines_map_cm.items()
            for number, strip in enumerate(strips_of(line))
        ]
        if len(scene.path_map):
            markers.append(self._marker(MAP, "path", 0, map_m(scene.path_map[:, :2]), _PATH_BGR))
        if markers:
            self._write("/map/lines", "visualization_msgs/MarkerArray", {"markers": markers})
        if len(scene.edges_map_cm):
            cloud = self._cloud(MAP, map_m(scene.edges_map_cm))
            self._write("/map/edges", "sensor_msgs/PointCloud2", cloud)

    def _marker(
        self,
        frame_id: str,
        name: str,
        number: int,
        points_m: Float[np.ndarray, "n 3"],
        colour: Bgr,
        kind: int = _LINE_STRIP,
    ) -> dict[str, Any]:
        """A line or points; one that is empty takes an earlier one away."""
        size = {"x": _LINE_M} if kind == _LINE_STRIP else dict.fromkeys("xyz", _POINT_M)
        # A reference lies just above what is compared with it.
        lift = {"position": {"z": 0.002}} if colour == TRUTH_BGR else {}
        return {
            "header": self._header(frame_id),
            "ns": name,
            "id": number,
            "type": kind,
            "action": _ADD if len(points_m) else _DELETE,
            "pose": {**_UPRIGHT, **lift},
            "scale": size,
            "color": _rgba(colour),
            "points": points_m,
        }

    def _cloud(self, frame_id: str, points_m: Float[np.ndarray, "n 3"]) -> dict[str, Any]:
        return {
            "header": self._header(frame_id),
            "height": 1,
            "width": len(points_m),
            "fields": [
                {"name": axis, "offset": 4 * i, "datatype": _FLOAT32, "count": 1}
                for i, axis in enumerate("xyz")
            ],
            "point_step": 12,
            "row_step": 12 * len(points_m),
            "data": points_m.astype("<f4").tobytes(),
            "is_dense": True,
        }


def _xyz(values: Float[np.ndarray, "3"]) -> dict[str, float]:
    return dict(zip("xyz", values.tolist(), strict=True))


def _xyzw(values: Float[np.ndarray, "4"]) -> dict[str, float]:
    return dict(zip("xyzw", values.tolist(), strict=True))


def _rgba(bgr: Bgr) -> dict[str, float]:
    b, g, r = (value / 255.0 for value in bgr)
    return {"r": r, "g": g, "b": b, "a": 1.0}


def is_own(path: Path) -> bool:
    """Tell whether an MCAP file was written here; what cannot be read was not."""
    try:
        with path.open("rb") as file:
            # Magic bytes, then the header: its kind and length, profile and library (each with its length).
            start = file.read(8 + 9 + 4 + len("ros2") + 4 + len(_LIBRARY))
    except OSError:
        return False
    return start.startswith(b"\x89MCAP") and start.endswith(_LIBRARY.encode())


KIND = ViewerKind(
    "mcap",
    McapFile,
    check=lambda: require("mcap", "viewers"),
    ending=".mcap",
    help="Write what is seen as ROS 2 messages, for Foxglove and ROS 2.",
    to_look="open {file} in Foxglove",
)
