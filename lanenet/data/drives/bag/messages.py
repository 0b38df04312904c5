"""Messages of ROS 2 and Foxglove: what an image or a command says.

Messages of ROS are CDR, those of Foxglove JSON. Only types of fixed standards are read, so that definitions
that a bag may hold of its own are not needed, and not trusted.
"""

from __future__ import annotations

import base64
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.data.drives.bag.storage import reading
from lanenet.data.drives.bag.topic import Topic
from lanenet.data.files import require
from lanenet.errors import DriveFormatError
from lanenet.reading import MAX_PIXELS, MEBIBYTE, decode_image

_NS_PER_S = 1_000_000_000
#: Of a message in JSON, [B], and its values. Chosen: an image of 4 megapixels without loss, and ten times the
#: fields of an image; a value takes twenty times its text in memory.
_MAX_JSON, _MAX_VALUES = 16 * MEBIBYTE, 100
#: Names of codecs whose frames cannot be decoded one by one.
_VIDEO_CODECS = frozenset(("h264", "h265", "hevc", "avc", "av1", "vp8", "vp9", "mpeg4", "theora", "ffmpeg"))
#: What to do about them.
VIDEO_REMEDY = (
    "a video stream has to become single images first: play the bag, have ros2 run image_transport republish "
    "write it out as 'compressed', and record that topic anew"
)

IMAGE_TYPES = (
    *("sensor_msgs/msg/Image", "foxglove.RawImage"),
    *("sensor_msgs/msg/CompressedImage", "foxglove.CompressedImage"),
)
#: The first of these that a bag holds gives the commands: a steering angle says more than a yaw rate.
COMMAND_TYPES = (
    *("ackermann_msgs/msg/AckermannDriveStamped", "ackermann_msgs/msg/AckermannDrive"),
    *("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"),
)
#: Not among the types that rosbags knows. Source: ackermann_msgs 2.0.2.
_ACKERMANN = {
    "ackermann_msgs/msg/AckermannDrive": "float32 steering_angle\nfloat32 steering_angle_velocity\n"
    "float32 speed\nfloat32 acceleration\nfloat32 jerk\n",
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\n"
    "ackermann_msgs/AckermannDrive drive\n",
}
#: Channels of an encoding, and OpenCV's code that makes it BGR. OpenCV names a Bayer pattern by the second
#: row and column.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    **dict.fromkeys(("bgr8", "8uc3"), (3, None)),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    **dict.fromkeys(("bgra8", "8uc4"), (4, cv2.COLOR_BGRA2BGR)),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    **dict.fromkeys(("mono8", "8uc1"), (1, cv2.COLOR_GRAY2BGR)),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2BGR),
    **dict.fromkeys(("yuv422", "uyvy"), (2, cv2.COLOR_YUV2BGR_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (2, cv2.COLOR_YUV2BGR_YUY2)),
}


class Decoder:
    """Decodes the messages of a topic."""

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self._store: Any = None

    def message(self, data: bytes) -> Any:
        """Return a message with its fields as attributes.

        Raises:
            DriveFormatError: If it cannot be decoded.
        """
        with reading(Path(self.topic.name)):
            if self.topic.encoding == "json":
                # Each value but the first follows one of these.
                values = sum(data.count(sign) for sign in (b",", b"[", b"{"))
                if len(data) > _MAX_JSON or values > _MAX_VALUES:
                    raise DriveFormatError(
                        f"{self.topic.name}: a message of {len(data) / MEBIBYTE:.1f} MB of JSON with about "
                        f"{values} values, expected at most {_MAX_JSON / MEBIBYTE:.0f} MB and {_MAX_VALUES}"
                    )
                return json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))
            if self._store is None:
                self._store = _typestore()
            return self._store.deserialize_cdr(data, self.topic.type)

    def stamp_ns(self, message: Any) -> int:
        """Return the time that a message gives itself, [ns]; 0 if it has none."""
        if (header := getattr(message, "header", None)) is not None:
            return int(header.stamp.sec) * _NS_PER_S + int(header.stamp.nanosec)
        stamp = getattr(message, "timestamp", None)
        return 0 if stamp is None else int(stamp.sec) * _NS_PER_S + int(stamp.nsec)

    def image(self, data: bytes, where: object) -> UInt8[np.ndarray, "h w 3"]:
        """Return the image in a message, BGR.

        Raises:
            DriveFormatError: If it is damaged, or its encoding is not known; names ``where``.
        """
        message = self.message(data)
        with reading(Path(str(where))):
            pixels = message.data
            pixels = base64.b64decode(pixels) if isinstance(pixels, str) else memoryview(pixels)
            if not self.topic.type.endswith("CompressedImage"):
                return _raw_image(message, pixels, where)
            return _packed_image(str(message.format).lower(), bytes(pixels), where)

    def command(self, data: bytes) -> tuple[int, float, float, float]:
        """Return stamp, [ns], speed, [cm/s], steering angle and yaw rate, [rad] and [rad/s], positive left.

        The signs are those of REP 103, which are this project's. What the type does not hold is NaN.
        """
        message = self.message(data)
        stamp_ns = self.stamp_ns(message)
        if self.topic.type.startswith("ackermann_msgs"):
            drive = getattr(message, "drive", message)
            return stamp_ns, 100.0 * float(drive.speed), float(drive.steering_angle), math.nan
        twist = getattr(message, "twist", message)
        return stamp_ns, 100.0 * float(twist.linear.x), math.nan, float(twist.angular.z)

    def is_picture(self, data: bytes) -> bool:
        """Tell whether an image message holds light, not a depth, which some cameras give as an image."""
        try:
            message = self.message(data)
            if self.topic.type.endswith("CompressedImage"):
                return not _is_depth(str(message.format).lower())
            return _eight_bits(message.encoding) in _ENCODINGS
        except (DriveFormatError, AttributeError):
            return False


def _typestore() -> Any:
    typesys = require("rosbags.typesys", "bags")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types: dict[str, Any] = {}
    for name, text in _ACKERMANN.items():
        types |= typesys.get_types_from_msg(text, name)
    store.register(types)
    return store


def _eight_bits(encoding: str) -> str:
    """Return the key of an encoding, or of the one with the upper halves of its 16 bits."""
    return re.sub("16$", "8", encoding.lower().strip())


def _is_depth(form: str) -> bool:
    """Tell whether the format of a compressed image is that of a depth."""
    return form.startswith(("16uc1", "32fc1")) or "compresseddepth" in form


def _packed_image(form: str, pixels: bytes, where: object) -> UInt8[np.ndarray, "h w 3"]:
    """Decode a compressed image.

    Args:
        form: Its format: image_transport writes ``ENCODING; CODEC compressed STORED``, others the codec.
        pixels: What was stored: BGR, or RGB taken for BGR, or the mosaic of a Bayer pattern as a gray image.
        where: Names it in errors.
    """
    named = sorted(_VIDEO_CODECS.intersection(re.split("[^a-z0-9]+", form)))
    # The start code of H.264 and H.265, for which publishers write any format.
    if named or pixels.startswith((b"\0\0\0\1", b"\0\0\1")):
        codec = repr(named[0]) if named else "H.264 or H.265"
        raise DriveFormatError(f"{where}: images in {codec}, expected JPEG or PNG; {VIDEO_REMEDY}")
    if _is_depth(form):
        raise DriveFormatError(f"{where}: depths in {form!r}, expected images of a camera")
    # As gray or BGR with 8 bits, whatever is stored: 16 bits with alpha take 8 bytes a pixel.
    image = decode_image(pixels, where, DriveFormatError, cv2.IMREAD_ANYCOLOR)
    if image.ndim == 2:
        encoding = _eight_bits(form.partition(";")[0])
        code = _ENCODINGS[encoding][1] if encoding in _ENCODINGS and "bayer" in encoding else None
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if code is None else code))
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR)) if "compressed rgb" in form else image


def _raw_image(message: Any, pixels: bytes | memoryview, where: object) -> UInt8[np.ndarray, "h w 3"]:
    height, width, step = int(message.height), int(message.width), int(message.step)
    encoding = _eight_bits(str(message.encoding))
    if encoding not in _ENCODINGS:
        raise DriveFormatError(
            f"{where}: images in {str(message.encoding)!r}, expected one of {', '.join(_ENCODINGS)}"
        )
    channels, code = _ENCODINGS[encoding]
    size = 2 if message.encoding.endswith("16") else 1
    least = width * channels * size
    if not (0 < height * width <= MAX_PIXELS and least <= step and len(pixels) == step * height):
        raise DriveFormatError(
            f"{where}: image of {width}x{height} px with {step} bytes a row and {len(pixels)} in all, "
            f"expected {least} a row or more, and {step * height} in all"
        )
    upper = 0 if getattr(message, "is_bigendian", 0) else size - 1
    rows = np.frombuffer(pixels, np.uint8).reshape(height, step)[:, upper:least:size]
    image = np.ascontiguousarray(rows).reshape(height, width, channels)
    return image if code is None else np.asarray(cv2.cvtColor(image, code))
