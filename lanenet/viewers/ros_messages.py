"""ROS 2 messages: their definitions, and values encoded as CDR, as ROS 2 sends and stores them.

CDR of version 1, little-endian: each number lies at a multiple of its size, counted from the end of the
encapsulation header; texts end in a zero byte; sequences begin with their length.

Source:
    OMG Common Object Request Broker Architecture, part 2, section 9.3 (CDR transfer syntax); DDSI-RTPS 2.2,
    section 10 (encapsulation header). The definitions are those of ROS 2 Humble to Jazzy and of
    ``foxglove_msgs``, without comments and constants.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np

_DEFINITIONS = """
builtin_interfaces/Time: int32 sec, uint32 nanosec
builtin_interfaces/Duration: int32 sec, uint32 nanosec
std_msgs/Header: builtin_interfaces/Time stamp, string frame_id
std_msgs/ColorRGBA: float32 r, float32 g, float32 b, float32 a
std_msgs/Float64: float64 data
geometry_msgs/Point: float64 x, float64 y, float64 z
geometry_msgs/Vector3: float64 x, float64 y, float64 z
geometry_msgs/Quaternion: float64 x, float64 y, float64 z, float64 w
geometry_msgs/Pose: geometry_msgs/Point position, geometry_msgs/Quaternion orientation
geometry_msgs/PoseStamped: std_msgs/Header header, geometry_msgs/Pose pose
geometry_msgs/Transform: geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation
geometry_msgs/TransformStamped: std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform
tf2_msgs/TFMessage: geometry_msgs/TransformStamped[] transforms
sensor_msgs/CompressedImage: std_msgs/Header header, string format, uint8[] data
sensor_msgs/RegionOfInterest: uint32 x_offset, uint32 y_offset, uint32 height, uint32 width, bool do_rectify
sensor_msgs/CameraInfo: std_msgs/Header header, uint32 height, uint32 width, string distortion_model, float64[] d, float64[9] k, float64[9] r, float64[12] p, uint32 binning_x, uint32 binning_y, sensor_msgs/RegionOfInterest roi
sensor_msgs/PointField: string name, uint32 offset, uint8 datatype, uint32 count
sensor_msgs/PointCloud2: std_msgs/Header header, uint32 height, uint32 width, sensor_msgs/PointField[] fields, bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, bool is_dense
visualization_msgs/UVCoordinate: float32 u, float32 v
visualization_msgs/MeshFile: string filename, uint8[] data
visualization_msgs/Marker: std_msgs/Header header, string ns, int32 id, int32 type, int32 action, geometry_msgs/Pose pose, geometry_msgs/Vector3 scale, std_msgs/ColorRGBA color, builtin_interfaces/Duration lifetime, bool frame_locked, geometry_msgs/Point[] points, std_msgs/ColorRGBA[] colors, string texture_resource, sensor_msgs/CompressedImage texture, visualization_msgs/UVCoordinate[] uv_coordinates, string text, string mesh_resource, visualization_msgs/MeshFile mesh_file, bool mesh_use_embedded_materials
visualization_msgs/MarkerArray: visualization_msgs/Marker[] markers
foxglove_msgs/Point2: float64 x, float64 y
foxglove_msgs/Color: float64 r, float64 g, float64 b, float64 a
foxglove_msgs/CircleAnnotation: builtin_interfaces/Time timestamp, foxglove_msgs/Point2 position, float64 diameter, float64 thickness, foxglove_msgs/Color fill_color, foxglove_msgs/Color outline_color
foxglove_msgs/PointsAnnotation: builtin_interfaces/Time timestamp, uint8 type, foxglove_msgs/Point2[] points, foxglove_msgs/Color outline_color, foxglove_msgs/Color[] outline_colors, foxglove_msgs/Color fill_color, float64 thickness
foxglove_msgs/TextAnnotation: builtin_interfaces/Time timestamp, foxglove_msgs/Point2 position, string text, float64 font_size, foxglove_msgs/Color text_color, foxglove_msgs/Color background_color
foxglove_msgs/ImageAnnotations: foxglove_msgs/CircleAnnotation[] circles, foxglove_msgs/PointsAnnotation[] points, foxglove_msgs/TextAnnotation[] texts
foxglove_msgs/CameraCalibration: builtin_interfaces/Time timestamp, string frame_id, uint32 width, uint32 height, string distortion_model, float64[] d, float64[9] k, float64[9] r, float64[12] p
"""  # noqa: E501
#: ``struct`` codes of the plain types.
_CODES = {"bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}
_HEADER = b"\0\1\0\0"


class _Field(NamedTuple):
    """A field: its type, its name, and its length: None for one value, 0 for a sequence, else an array's."""

    kind: str
    name: str
    length: int | None


@cache
def _fields() -> dict[str, tuple[_Field, ...]]:
    messages = {}
    for line in _DEFINITIONS.strip().splitlines():
        name, _, fields = line.partition(": ")
        messages[name] = tuple(_field(text) for text in fields.split(", "))
    return messages


def _field(text: str) -> _Field:
    found = re.fullmatch(r"([\w/]+)(\[(\d*)\])? (\w+)", text)
    assert found is not None, text
    kind, many, length, name = found.groups()
    return _Field(kind, name, None if many is None else int(length or 0))


def message_names() -> list[str]:
    """Return the names of all messages, as ``std_msgs/Header``."""
    return list(_fields())


def definition(name: str) -> str:
    """Return a message's definition with those of all messages in it, as ``ros2msg`` schemas have them."""
    parts, waiting, done = [], [name], {name}
    while waiting:
        message = waiting.pop(0)
        fields = _fields()[message]
        text = "".join(
            f"{f.kind}{'' if f.length is None else f'[{f.length or str()}]'} {f.name}\n" for f in fields
        )
        parts.append(text if message == name else f"MSG: {message}\n{text}")
        inner = [f.kind for f in fields if f.kind in _fields() and f.kind not in done]
        # A message that is used twice is defined once.
        inner = list(dict.fromkeys(inner))
        done.update(inner)
        waiting += inner
    return f"{'=' * 80}\n".join(parts)


def encode(name: str, value: Mapping[str, Any]) -> bytes:
    """Encode a message.

    Args:
        name: As ``std_msgs/Header``.
        value: Fields by name; those that are left out are zero or empty. A sequence of messages that consist
            of float64 alone, such as points, may be an array with a row for each.

    Raises:
        KeyError: If there is no such message or field.
    """
    out = bytearray()
    _encode(out, name, value)
    return _HEADER + bytes(out)


def _encode(out: bytearray, name: str, value: Mapping[str, Any]) -> None:
    fields = _fields()[name]
    unknown = set(value) - {field.name for field in fields}
    if unknown:
        raise KeyError(f"{name} has no field {', '.join(sorted(unknown))}")
    for field in fields:
        _encode_field(out, field, value.get(field.name))


def _encode_field(out: bytearray, field: _Field, value: Any) -> None:
    if field.length is not None:
        _encode_many(out, field.kind, field.length, value)
    elif field.kind == "string":
        data = (value or "").encode() + b"\0"
        _pack(out, "I", len(data))
        out += data
    elif field.kind in _CODES:
        _pack(out, _CODES[field.kind], value or 0)
    else:
        _encode(out, field.kind, value or {})


def _encode_many(out: bytearray, kind: str, length: int, values: Any) -> None:
    if values is None:
        values = np.zeros(length)
    if length == 0:
        _pack(out, "I", len(values))
    if not len(values):
        return
    if isinstance(values, bytes):
        out += values
    elif kind in _CODES:
        assert length in (0, len(values)), kind
        _align(out, struct.calcsize(_CODES[kind]))
        out += np.asarray(values, dtype=f"<{_CODES[kind]}").tobytes()
    elif isinstance(values, np.ndarray):
        assert [f.kind for f in _fields()[kind]] == ["float64"] * values.shape[1], kind
        _align(out, 8)
        out += values.astype("<f8").tobytes()
    else:
        for one in values:
            _encode(out, kind, one)


def _align(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)


def _pack(out: bytearray, code: str, value: Any) -> None:
    _align(out, struct.calcsize(code))
    out += struct.pack(f"<{code}", value)
