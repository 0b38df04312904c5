"""ROS 2 bags and MCAP files, written by the libraries of others with message definitions of their own."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from drives import frame_image
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

#: [ns]; frames come at 20 Hz, the commands of a frame 10 ms before it.
START_NS, STEP_NS, EARLIER_NS = 1_700_000_000_000_000_000, 50_000_000, 10_000_000

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(
    get_types_from_msg(
        "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\n"
        "float32 jerk",
        "ackermann_msgs/msg/AckermannDrive",
    )
    | get_types_from_msg(
        "std_msgs/Header header\nackermann_msgs/AckermannDrive drive",
        "ackermann_msgs/msg/AckermannDriveStamped",
    )
)
Messages = dict[str, list[tuple[int, Any]]]


def message(name: str, **values: Any) -> Any:
    return STORE.types[name](**values)


def header(t_ns: int) -> Any:
    stamp = message("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    return message("std_msgs/msg/Header", stamp=stamp, frame_id="camera")


def raw_image(pixels: np.ndarray, encoding: str, t_ns: int = 0, padding: int = 0) -> Any:
    height, width = pixels.shape[:2]
    rows = np.pad(pixels.reshape(height, -1), ((0, 0), (0, padding)))
    return message(
        "sensor_msgs/msg/Image",
        header=header(t_ns),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=rows.shape[1],
        data=rows.ravel(),
    )


def compressed(image: np.ndarray, t_ns: int = 0, form: str = "png") -> Any:
    data = cv2.imencode(".png", image)[1].ravel()
    return message("sensor_msgs/msg/CompressedImage", header=header(t_ns), format=form, data=data)


def ackermann(speed: float, steering_angle: float, t_ns: int = 0) -> Any:
    drive = message(
        "ackermann_msgs/msg/AckermannDrive",
        steering_angle=steering_angle,
        steering_angle_velocity=0.0,
        speed=speed,
        acceleration=0.0,
        jerk=0.0,
    )
    return message("ackermann_msgs/msg/AckermannDriveStamped", header=header(t_ns), drive=drive)


def twist(speed: float, yaw_rate: float) -> Any:
    def vector(x: float, z: float) -> Any:
        return message("geometry_msgs/msg/Vector3", x=x, y=0.0, z=z)

    return message("geometry_msgs/msg/Twist", linear=vector(speed, 0.0), angular=vector(0.0, yaw_rate))


def usual(n: int = 6) -> Messages:
    """Images at 20 Hz, and before each a command of its own."""
    times = [START_NS + k * STEP_NS for k in range(n)]
    return {
        "/camera/image_raw/compressed": [(t, compressed(frame_image(k), t)) for k, t in enumerate(times)],
        "/drive": [(t - EARLIER_NS, ackermann(0.5 + 0.1 * k, 0.02 * k)) for k, t in enumerate(times)],
    }


def write_bag(
    path: Path, topics: Messages, storage: str = "sqlite3", clock: Callable[[int], int] = lambda t_ns: t_ns
) -> Path:
    """Write messages in their order, with the times of a clock."""
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        queue = []
        for topic, messages in topics.items():
            name = messages[0][1].__msgtype__
            connection = writer.add_connection(topic, name, typestore=STORE)
            queue += [(t, connection, STORE.serialize_cdr(each, name)) for t, each in messages]
        for t, connection, data in sorted(queue, key=lambda each: each[0]):
            writer.write(connection, clock(t), data)
    return path


def write_foxglove(path: Path, n: int = 6) -> Path:
    """Images alone, as Foxglove's JSON."""
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/camera", "json", schema)
        for k in range(n):
            t_ns = START_NS + k * STEP_NS
            data = {
                "timestamp": {"sec": t_ns // 10**9, "nsec": t_ns % 10**9},
                "frame_id": "camera",
                "data": base64.b64encode(cv2.imencode(".png", frame_image(k))[1].tobytes()).decode(),
                "format": "png",
            }
            writer.add_message(channel, t_ns, json.dumps(data).encode(), t_ns)
        writer.finish()
    return path
