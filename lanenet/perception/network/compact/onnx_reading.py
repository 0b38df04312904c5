"""The nodes and constants of ONNX files, read without the package onnx, which the car does not have.

An ONNX file is a message of Protocol Buffers: fields with a number, one after the other, whose values are
whole numbers or bytes, which may be messages in turn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

# Numbers of the fields of ONNX files, see onnx.proto: of a model its graph, of that its nodes and constants.
_GRAPH, _NODE, _INITIALIZER = 7, 1, 5
_NODE_INPUT, _OP_TYPE, _ATTRIBUTE = 1, 4, 5
_ATTRIBUTE_NAME, _ATTRIBUTE_INTS = 1, 8
_DIMS, _DATA_TYPE, _TENSOR_NAME, _RAW_DATA = 1, 2, 8, 9
_NUMPY_TYPES: dict[int, np.dtype[Any]] = {1: np.dtype("<f4"), 2: np.dtype("u1")}
# Kinds of values: whole numbers, bytes after their length, and so many bytes.
_VARINT, _BYTES, _FIXED = 0, 2, {1: 8, 5: 4}


class Node(NamedTuple):
    """A node of a graph: its kind, the names of its inputs, and its attributes that are lists of integers."""

    kind: str
    inputs: list[str]
    attributes: dict[str, list[int]]


@dataclass(frozen=True)
class Graph:
    """The nodes of a graph, in order, and its constants of floats or bytes that are stored as raw data.

    The constants are views of the file.
    """

    nodes: list[Node]
    constants: dict[str, np.ndarray]

    def of_kind(self, kind: str) -> list[Node]:
        """Return the nodes of a kind."""
        return [node for node in self.nodes if node.kind == kind]

    def constants_of(self, node: Node) -> list[np.ndarray]:
        """Return a node's inputs but the first one.

        Raises:
            KeyError: If one of them is none of the constants.
        """
        return [self.constants[name] for name in node.inputs[1:]]


def read_graph(model: bytes) -> Graph:
    """Read the graph of an ONNX file.

    Raises:
        ValueError: If it is no such file.
    """
    nodes, constants = [], {}
    for graph in _values(model, _GRAPH):
        nodes += [_node(value) for value in _values(graph, _NODE)]
        for value in _values(graph, _INITIALIZER):
            if (tensor := _tensor(value)) is not None:
                constants[_text(value, _TENSOR_NAME)] = tensor
    return Graph(nodes, constants)


def _node(message: memoryview) -> Node:
    attributes = {
        _text(value, _ATTRIBUTE_NAME): _integers(value, _ATTRIBUTE_INTS)
        for value in _values(message, _ATTRIBUTE)
    }
    inputs = [bytes(value).decode() for value in _values(message, _NODE_INPUT)]
    return Node(_text(message, _OP_TYPE), inputs, attributes)


def _tensor(message: memoryview) -> np.ndarray | None:
    kinds, shape = _integers(message, _DATA_TYPE), _integers(message, _DIMS)
    data = [*_values(message, _RAW_DATA)]
    if len(kinds) != 1 or kinds[0] not in _NUMPY_TYPES or len(data) != 1:
        return None
    numbers: np.ndarray = np.frombuffer(data[0], _NUMPY_TYPES[kinds[0]])
    return numbers.reshape(shape) if len(numbers) == math.prod(shape) else None


def _values(message: bytes | memoryview, number: int) -> Iterator[Any]:
    """Return the values of the fields of a number."""
    return (value for n, value in _fields(message) if n == number)


def _fields(message: bytes | memoryview) -> Iterator[tuple[int, Any]]:
    """Return the number of each field, and its value: a whole number, or a view of its bytes."""
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


def _text(message: bytes | memoryview, number: int) -> str:
    """Return the text of a field; empty without one."""
    return b"".join(map(bytes, _values(message, number))).decode()


def _integers(message: bytes | memoryview, number: int) -> list[int]:
    """Return the whole numbers of a field that is repeated, one by one or packed."""
    found: list[int] = []
    for value in _values(message, number):
        if isinstance(value, int):
            found.append(value)
            continue
        at = 0
        while at < len(value):
            integer, at = _varint(value, at)
            found.append(integer)
    return found
