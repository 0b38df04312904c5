"""ONNX files read and written piece by piece, as far as a model is cut in two.

The car has no library for that. An ONNX file is a message of Protocol Buffers: fields with a number, one
after the other, whose values are whole numbers or bytes, which may be messages in turn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

#: Numbers of the fields of ONNX files, see onnx.proto: of a model its graph; of a graph its nodes, constants,
#: inputs and outputs.
GRAPH, NODE, INITIALIZER, INPUT, OUTPUT = 7, 1, 5, 11, 12
_NODE_INPUT, _NODE_OUTPUT, _OP_TYPE, _ATTRIBUTE = 1, 2, 4, 5
_ATTRIBUTE_NAME, _ATTRIBUTE_INT, _ATTRIBUTE_TEXT, _ATTRIBUTE_INTS = 1, 3, 4, 8
#: Of a constant its name, and of an input or output.
TENSOR_NAME, VALUE_NAME = 8, 1
_DIMS, _DATA_TYPE, _RAW_DATA = 1, 2, 9
_FLOAT = 1
_NUMPY_TYPES: dict[int, np.dtype[Any]] = {_FLOAT: np.dtype("<f4"), 2: np.dtype("u1")}
# Kinds of values: whole numbers, bytes after their length, and so many bytes.
_VARINT, _BYTES, _FIXED = 0, 2, {1: 8, 5: 4}


class Node(NamedTuple):
    """A node of a graph; its attributes are lists of whole numbers, or of a text."""

    raw: memoryview
    inputs: list[str]
    outputs: list[str]
    kind: str
    attributes: dict[str, list[Any]]

    @staticmethod
    def read(raw: memoryview) -> Node:
        """Read the message of a node."""
        names: dict[int, list[str]] = {_NODE_INPUT: [], _NODE_OUTPUT: [], _OP_TYPE: []}
        attributes: dict[str, list[Any]] = {}
        for number, value in fields_of(raw):
            if number in names:
                names[number].append(bytes(value).decode())
            elif number == _ATTRIBUTE:
                text = text_of(value, _ATTRIBUTE_TEXT)
                integers = *integers_of(value, _ATTRIBUTE_INT), *integers_of(value, _ATTRIBUTE_INTS)
                attributes[text_of(value, _ATTRIBUTE_NAME)] = [text] if text else [*integers]
        return Node(raw, names[_NODE_INPUT], names[_NODE_OUTPUT], "".join(names[_OP_TYPE]), attributes)


def only_user(nodes: Sequence[Node], name: str, kind: str, n_inputs: int) -> Node | None:
    """Return the node of a kind that alone uses a value, as its first input."""
    users = [node for node in nodes if name in node.inputs]
    if len(users) != 1 or users[0].kind != kind or users[0].inputs[0] != name:
        return None
    return users[0] if len(users[0].inputs) == n_inputs else None


def tensor_of(raw: memoryview) -> np.ndarray | None:
    """Return a tensor of floats or bytes that is stored as raw data; None for another."""
    kinds, data = integers_of(raw, _DATA_TYPE), [bytes(v) for n, v in fields_of(raw) if n == _RAW_DATA]
    shape = integers_of(raw, _DIMS)
    if len(kinds) != 1 or kinds[0] not in _NUMPY_TYPES or len(data) != 1:
        return None
    numbers: np.ndarray = np.frombuffer(data[0], _NUMPY_TYPES[kinds[0]])
    return numbers.reshape(shape) if len(numbers) == math.prod(shape) else None


def float_input(name: str, shape: Sequence[int]) -> bytes:
    """Return the description of an input of floats."""
    dims = b"".join(field_of(1, field_of(1, n)) for n in shape)
    return field_of(1, name.encode()) + field_of(2, field_of(1, field_of(1, _FLOAT) + field_of(2, dims)))


def fields_of(message: bytes | memoryview) -> Iterator[tuple[int, Any]]:
    """Return the number of each field, and its value: a whole number, or a view of its bytes.

    Raises:
        ValueError: If it is no such message.
    """
    view, at = memoryview(message), 0
    while at < len(view):
        key, at = _varint(view, at)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            value, at = _varint(view, at)
            yield number, value
            continue
        if kind == _BYTES:
            length, at = _varint(view, at)
        elif kind in _FIXED:
            length = _FIXED[kind]
        else:
            raise ValueError(f"field {number}: of unknown kind {kind}")
        yield number, view[at : at + length]
        at += length


def _varint(view: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = view[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def field_of(number: int, value: int | bytes | memoryview) -> bytes:
    """Write a field."""
    if isinstance(value, int):
        return _as_varint(number << 3 | _VARINT) + _as_varint(value)
    return _as_varint(number << 3 | _BYTES) + _as_varint(len(value)) + bytes(value)


def _as_varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def text_of(message: bytes | memoryview, number: int) -> str:
    """Return the text of a field; empty without one."""
    return b"".join(bytes(value) for n, value in fields_of(message) if n == number).decode()


def integers_of(message: bytes | memoryview, number: int) -> list[int]:
    """Return the whole numbers of a field that is repeated, one by one or packed."""
    found: list[int] = []
    for n, value in fields_of(message):
        if n != number:
            continue
        if isinstance(value, int):
            found.append(value)
            continue
        at = 0
        while at < len(value):
            integer, at = _varint(value, at)
            found.append(integer)
    return found
