"""Messages are ROS 2's own, byte for byte, by another library's definitions and another library's CDR."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lanenet.viewers.ros_messages import definition, encode, message_names

RNG = np.random.default_rng(3)
OWN = [name for name in message_names() if not name.startswith("foxglove")]
INTEGERS = {"uint8": (0, 255), "int32": (-9999, 9999), "uint32": (0, 9999)}


def full(name: str) -> str:
    return name.replace("/", "/msg/")


@pytest.mark.parametrize("store", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
@pytest.mark.parametrize("name", OWN)
def test_definitions_are_those_of_ros(name: str, store: Stores) -> None:
    mine = get_types_from_msg(definition(name), full(name))
    theirs = get_typestore(store).fielddefs
    # All messages in it, too; constants are left out here.
    for message, (_, fields) in mine.items():
        assert fields == theirs[message][1]


def made_up(fields: Any, types: Any) -> dict[str, Any]:
    """Values for a message: odd lengths, so that alignment matters."""
    return {name: _value(kind, types) for name, kind in fields}


def _value(kind: Any, types: Any) -> Any:
    sort, about = kind
    if sort == Nodetype.BASE:
        name = about[0]
        if name == "string":
            return "x" * int(RNG.integers(0, 9)) + "\u00e9"
        if name == "bool":
            return bool(RNG.integers(2))
        if name in INTEGERS:
            return int(RNG.integers(*INTEGERS[name]))
        return float(np.float32(RNG.normal()))
    if sort == Nodetype.NAME:
        return made_up(types[about][1], types)
    (inner, length) = about
    count = length or int(RNG.integers(0, 4))
    values = [_value(inner, types) for _ in range(count)]
    return np.array(values) if inner[0] == Nodetype.BASE and inner[1][0] != "string" else values


def as_rosbags(value: Any, name: str, store: Any) -> Any:
    """The same value in the classes of rosbags."""
    fields = dict(store.fielddefs[name][1])
    made = {}
    for key, item in value.items():
        sort, about = fields[key]
        if sort == Nodetype.NAME:
            item = as_rosbags(item, about, store)
        elif sort in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            inner = about[0]
            if inner[0] == Nodetype.NAME:
                item = [as_rosbags(one, inner[1], store) for one in item]
            else:
                item = np.array(item, dtype=np.dtype(inner[1][0]))
        made[key] = item
    return store.types[name](**made)


@pytest.mark.parametrize("name", message_names())
def test_bytes_are_those_of_rosbags(name: str) -> None:
    store = get_typestore(Stores.EMPTY)
    types = get_types_from_msg(definition(name), full(name))
    store.register(types)
    for _ in range(20):
        value = made_up(types[full(name)][1], types)
        theirs = bytes(store.serialize_cdr(as_rosbags(value, full(name), store), full(name)))
        assert encode(name, value) == theirs


def test_what_is_left_out_is_zero_and_what_is_unknown_is_refused() -> None:
    header = encode("std_msgs/Header", {})
    assert header == b"\0\1\0\0" + bytes(8) + b"\1\0\0\0\0"
    with pytest.raises(KeyError, match="frame"):
        encode("std_msgs/Header", {"frame": "map"})


def test_arrays_of_points_are_sequences_of_points() -> None:
    points = RNG.normal(size=(3, 3))
    marker = {"ns": "odd", "points": points}
    spelt = {"ns": "odd", "points": [dict(zip("xyz", point.tolist(), strict=True)) for point in points]}
    assert encode("visualization_msgs/Marker", marker) == encode("visualization_msgs/Marker", spelt)
