"""The few parts of an ONNX file that a model is cut by, read without the package that cars do not have.

ONNX files are messages of Protocol Buffers: fields with a number, a type and a value, in any order. The
numbers are those of ``onnx.proto``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

#: Types of fields: a number, or bytes of a given length; and of numbers that none of these parts has.
_VARINT, _LENGTH, _FIXED = 0, 2, {1: 8, 5: 4}
_GRAPH: Final = 7
_NODE, _TENSOR, _INPUT, _OUTPUT = 1, 5, 11, 12
_DTYPES: dict[int, np.dtype[Any]] = {1: np.dtype("<f4"), 2: np.dtype("u1")}


@dataclass(frozen=True)
class Node:
    """One operation of a graph.

    Attributes:
        inputs: Names of its inputs.
        outputs: Names of its outputs.
        operator: What it does.
        attributes: Those that are whole numbers.
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    operator: str
    attributes: dict[str, list[int]]


@dataclass(frozen=True)
class Graph:
    """The operations of a model in their order, and its constants."""

    nodes: tuple[Node, ...]
    tensors: dict[str, bytes]

    def tensor(self, name: str) -> np.ndarray:
        """Return a constant.

        Raises:
            KeyError: If there is none of that name.
            ValueError: If it is of another type than float32 and uint8, or is not held as bytes.
        """
        dims: list[int] = []
        kind, raw = 0, b""
        for number, value, _ in _fields(self.tensors[name]):
            if number == 1:
                dims += _whole(value)
            elif number == 2 and isinstance(value, int):
                kind = value
            elif number == 9 and isinstance(value, bytes):
                raw = value
        if kind not in _DTYPES or not raw:
            raise ValueError(f"{name}: a constant of another kind")
        return np.frombuffer(raw, _DTYPES[kind]).reshape(dims)


def read_graph(model: bytes) -> Graph:
    """Return the graph of a model file that onnxruntime accepts."""
    (graph,) = (value for number, value, _ in _fields(model) if number == _GRAPH and isinstance(value, bytes))
    parts = [(number, value) for number, value, _ in _fields(graph) if isinstance(value, bytes)]
    nodes = tuple(_node(value) for number, value in parts if number == _NODE)
    return Graph(nodes, {_name(value, 8): value for number, value in parts if number == _TENSOR})


def cut(
    model: bytes, graph: Graph, begin: str, end: str, shape: Sequence[int], asked: Collection[str]
) -> bytes:
    """Return a model that begins behind some operations, and computes only what is asked.

    Args:
        model: The model file.
        graph: What :func:`read_graph` returned for it.
        begin: The input that it no longer has.
        end: Name of the value with which it begins instead, float32.
        shape: Of that value.
        asked: The outputs that it keeps.
    """
    wanted, kept = set(asked), set[int]()
    for i, node in reversed(list(enumerate(graph.nodes))):
        if wanted & set(node.outputs) and end not in node.outputs:
            kept.add(i)
            wanted |= set(node.inputs)
    whole = bytearray()
    for number, value, raw in _fields(model):
        if number != _GRAPH or not isinstance(value, bytes):
            whole += raw
            continue
        inner, i = bytearray(), 0
        for part, content, field in _fields(value):
            assert isinstance(content, bytes | int)
            if part == _NODE:
                inner += field if i in kept else b""
                i += 1
            elif part == _TENSOR and isinstance(content, bytes):
                inner += field if _name(content, 8) in wanted else b""
            elif part == _OUTPUT and isinstance(content, bytes):
                inner += field if _name(content, 1) in asked else b""
            elif part != _INPUT or not isinstance(content, bytes) or _name(content, 1) != begin:
                inner += field
        inner += _message(_INPUT, _float_input(end, shape))
        whole += _message(_GRAPH, bytes(inner))
    return bytes(whole)


def _float_input(name: str, shape: Sequence[int]) -> bytes:
    sizes = b"".join(_message(1, b"\x08" + _varint(size)) for size in shape)
    tensor = b"\x08\x01" + _message(2, sizes)
    return _message(1, name.encode()) + _message(2, _message(1, tensor))


def _node(data: bytes) -> Node:
    inputs, outputs, operator, attributes = [], [], "", {}
    for number, value, _ in _fields(data):
        if not isinstance(value, bytes):
            continue
        if number == 1:
            inputs.append(value.decode())
        elif number == 2:
            outputs.append(value.decode())
        elif number == 4:
            operator = value.decode()
        elif number == 5:
            numbers = [_whole(each) for key, each, _ in _fields(value) if key in (3, 8)]
            attributes[_name(value, 1)] = [number for each in numbers for number in each]
    return Node(tuple(inputs), tuple(outputs), operator, attributes)


def _name(data: bytes, field: int) -> str:
    """Return the name of a part, which is its field of that number."""
    names = [value for number, value, _ in _fields(data) if number == field and isinstance(value, bytes)]
    return names[0].decode() if names else ""


def _whole(value: bytes | int) -> list[int]:
    """Return whole numbers, of which several may be packed into one field."""
    if isinstance(value, int):
        return [value]
    numbers, at = [], 0
    while at < len(value):
        number, at = _read_varint(value, at)
        numbers.append(number)
    return numbers


def _fields(data: bytes) -> Iterator[tuple[int, bytes | int, bytes]]:
    """Return number, value and all bytes of each field of a message."""
    at = 0
    while at < len(data):
        begin = at
        key, at = _read_varint(data, at)
        number, kind = key >> 3, key & 7
        value: bytes | int
        if kind == _VARINT:
            value, at = _read_varint(data, at)
        else:
            if kind == _LENGTH:
                length, at = _read_varint(data, at)
            else:
                length = _FIXED[kind]
            value, at = data[at : at + length], at + length
        yield number, value, data[begin:at]


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number in groups of seven bits, the lowest first, and where it ends."""
    number = shift = 0
    while True:
        byte = data[at]
        number |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return number, at


def _varint(number: int) -> bytes:
    groups = bytearray()
    while number >= 0x80:
        groups.append(number & 0x7F | 0x80)
        number >>= 7
    groups.append(number)
    return bytes(groups)


def _message(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | _LENGTH) + _varint(len(data)) + data
