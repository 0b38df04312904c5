"""A network whose first layer looks only at the cells of a raster that hold something.

Nineteen cells of twenty hold nothing, and the first convolution, which has more to multiply than all others
together, multiplies them all the same. So where the compiled loops are, a model is opened without its first
layer, which they add up for the filled cells alone. Its sums are taken in onnxruntime's order: the bytes are
equal wherever that multiplies and adds in one step. Any other model is run as it is.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from lanenet.perception.edges.raster import MIDDLE, STEPS
from lanenet.perception.network import compiled
from lanenet.perception.network.model_file import (
    INPUT_NAME,
    SELF_TEST_TOLERANCE,
    WIDTH_NAME,
    ModelMeta,
    check_model,
    new_session,
    read_model,
)

if TYPE_CHECKING:
    from pathlib import Path

    import onnxruntime

log = logging.getLogger(__name__)

#: What a detector asks a network for.
ANSWERS = ("points_cm", "sigma_cm", "presence")
#: Filters at a time, and the largest side of a filter, of the compiled loops.
_LANES, _MOST = 16, 8
#: Share of filled cells in the raster by which a model's two halves are compared with the whole. Chosen.
_FILLED = 0.05

# Numbers of the fields in ONNX files, see onnx.proto.
_GRAPH, _NODE, _INITIALIZER, _INPUT, _OUTPUT = 7, 1, 5, 11, 12
_NODE_INPUT, _NODE_OUTPUT, _OP_TYPE, _ATTRIBUTE = 1, 2, 4, 5
_ATTRIBUTE_NAME, _ATTRIBUTE_INT, _ATTRIBUTE_TEXT, _ATTRIBUTE_INTS = 1, 3, 4, 8
_DIMS, _DATA_TYPE, _TENSOR_NAME, _RAW_DATA = 1, 2, 8, 9
_FLOAT, _NUMPY_TYPES = 1, {1: np.dtype("<f4"), 2: np.dtype("u1")}
# Kinds of values: whole numbers, bytes after their length, and so many bytes.
_VARINT, _BYTES, _FIXED = 0, 2, {1: 8, 5: 4}


@runtime_checkable
class Runs(Protocol):
    """What a detector needs of a session of onnxruntime."""

    def run(self, names: Sequence[str], feed: dict[str, np.ndarray]) -> Sequence[Any]:
        """Return outputs by their names, for inputs by theirs."""
        ...


def open_network(path: Path, threads: int = 1) -> tuple[Runs, ModelMeta]:
    """Open a model for one raster after the other, without its first layer where that can be done apart.

    Raises:
        ModelMismatchError: As :func:`lanenet.perception.network.model_file.open_model`.
    """
    data, where = read_model(path)
    session, meta = check_model(data, where, threads, frames=1)
    cut = cut_off(data, (meta.planes, meta.window.rows, meta.window.columns)) if compiled.is_fused() else None
    if cut is None:
        return session, meta
    halves = Halves(cut.layer, cut.features, new_session(cut.rest, where, threads, frames=1))
    if not _agree(halves, session, meta):
        log.warning("%s: its first layer alone gives another answer: the whole model is run, slower", where)
        return session, meta
    return halves, meta


@dataclass(frozen=True, eq=False)
class FirstLayer:
    """A convolution of a raster's bytes.

    Attributes:
        shape: Planes, rows and columns of the raster.
        nothing: The byte of each plane that stands for 0.
        values: What each byte stands for in each plane.
        weights: By plane, row and column of the filter, and filter.
        bias: Of each filter.
        stride: Distance of neighbouring windows, in cells.
        pad: By how much the first window begins before the first cell.
    """

    shape: tuple[int, int, int]
    nothing: UInt8[np.ndarray, "p"]
    values: Float32[np.ndarray, "p 256"]
    weights: Float32[np.ndarray, "p k k f"]
    bias: Float32[np.ndarray, "f"]
    stride: int
    pad: int

    @property
    def size(self) -> int:
        """Side of a filter."""
        return self.weights.shape[1]

    def new_features(self) -> Float32[np.ndarray, "1 f r c"]:
        """Return memory for the layer's output."""
        rows, columns = ((n + 2 * self.pad - self.size) // self.stride + 1 for n in self.shape[1:])
        return np.zeros((1, len(self.bias), rows, columns), np.float32)


class Halves:
    """A model in two parts; its answers are those of the whole."""

    def __init__(self, layer: FirstLayer, features: str, rest: onnxruntime.InferenceSession) -> None:
        """Take the first layer, the name of its output, and the rest, of which that is an input."""
        from onnxruntime import OrtValue

        self._layer, self._rest = layer, rest
        # Memory that onnxruntime reads and writes itself: it makes no arrays of its own in each frame.
        self._features, self._width_cm = layer.new_features(), np.zeros(1, np.float32)
        memory = {features: self._features, WIDTH_NAME: self._width_cm}
        given = {one.name: memory[one.name] for one in rest.get_inputs()}
        self._found = dict(zip(ANSWERS, rest.run(ANSWERS, given), strict=True))
        self._binding = rest.io_binding()
        for name, values in given.items():
            self._binding.bind_ortvalue_input(name, OrtValue.ortvalue_from_numpy(values))
        for name, values in self._found.items():
            self._binding.bind_ortvalue_output(name, OrtValue.ortvalue_from_numpy(values))

    def run(self, names: Sequence[str], feed: dict[str, np.ndarray]) -> Sequence[Any]:
        """Return some of ``ANSWERS`` for one raster, and the lane's width where the model takes it.

        The next run overwrites them.
        """
        compiled.first_layer(self._layer, feed[INPUT_NAME][0], self._features[0])
        self._width_cm[0] = feed[WIDTH_NAME][0] if WIDTH_NAME in feed else 0.0
        self._rest.run_with_iobinding(self._binding)
        return [self._found[name] for name in names]


def _agree(halves: Halves, whole: Runs, meta: ModelMeta) -> bool:
    """Compare the two on a raster in which some cells hold anything."""
    rng = np.random.default_rng(0)
    filled = rng.random((meta.window.rows, meta.window.columns)) < _FILLED
    looks = rng.integers(MIDDLE - STEPS, MIDDLE + STEPS + 1, (1, meta.planes, *filled.shape))
    raster = np.where(filled, looks, MIDDLE).astype(np.uint8)
    raster[0, 0] = np.where(filled, 255, 0)
    feed = {INPUT_NAME: raster}
    if meta.takes_width:
        feed[WIDTH_NAME] = np.array([meta.lane_width_cm], np.float32)
    both = zip(*(runs.run(ANSWERS, feed) for runs in (halves, whole)), strict=True)
    return all(bool((np.abs(ours - theirs) <= SELF_TEST_TOLERANCE).all()) for ours, theirs in both)


class Cut(NamedTuple):
    """A model in two parts.

    Attributes:
        layer: Its first layer.
        features: Name of the layer's output.
        rest: An ONNX file that has it as an input, in the place of the raster, and the lane's width as one that
            is not optional; its outputs are ``ANSWERS``.
    """

    layer: FirstLayer
    features: str
    rest: bytes


def cut_off(model: bytes, shape: tuple[int, int, int]) -> Cut | None:
    """Cut a model behind its first convolution.

    Args:
        model: An ONNX file, as :mod:`lanenet.learn` exports it.
        shape: Planes, rows and columns of its raster.

    Returns:
        Both parts; None if the model does not begin with a ``DequantizeLinear`` of the raster and a square
        convolution with a bias, or the compiled loops do not have such a layer.
    """
    graphs = [value for number, value in _fields(model) if number == _GRAPH]
    if len(graphs) != 1:
        return None
    # A graph has no field that is a whole number.
    graph = [(number, bytes(value)) for number, value in _fields(graphs[0])]
    nodes = [_Node.read(value) for number, value in graph if number == _NODE]
    decode = _only_user(nodes, INPUT_NAME, "DequantizeLinear", 3)
    convolve = None if decode is None else _only_user(nodes, decode.outputs[0], "Conv", 3)
    if decode is None or convolve is None:
        return None
    tensors = {
        name: value
        for number, value in graph
        if number == _INITIALIZER and (name := _text(value, _TENSOR_NAME))
    }
    wanted = (*decode.inputs[1:], *convolve.inputs[1:])
    scale, zero, weights, bias = (_tensor(tensors[name]) if name in tensors else None for name in wanted)
    if scale is None or zero is None or weights is None or bias is None:
        return None
    layer = _layer((scale, zero, weights, bias), decode.attributes, convolve.attributes, shape)
    if layer is None:
        return None
    features = convolve.outputs[0]
    rest = b"".join(
        _field(number, value)
        for number, value in graph
        if not (
            (number == _NODE and value in (decode.raw, convolve.raw))
            or (number == _INITIALIZER and _text(value, _TENSOR_NAME) in (*wanted, WIDTH_NAME))
            or (number == _INPUT and _text(value, 1) == INPUT_NAME)
            or (number == _OUTPUT and _text(value, 1) not in ANSWERS)
        )
    )
    rest += _field(_INPUT, _value_info(features, layer.new_features().shape))
    others = b"".join(_field(n, v) for n, v in _fields(model) if n != _GRAPH)
    return Cut(layer, features, others + _field(_GRAPH, rest))


def _layer(
    tensors: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    decoding: Mapping[str, list[Any]],
    convolving: Mapping[str, list[Any]],
    shape: tuple[int, int, int],
) -> FirstLayer | None:
    """Return a layer; None if it is not one of those that the compiled loops have."""
    scale, zero, weights, bias = tensors
    planes, (filters, size) = shape[0], (len(weights), weights.shape[-1])
    stride, pad = convolving.get("strides", [1])[0], convolving.get("pads", [0])[0]
    usual = (
        weights.shape == (filters, planes, size, size)
        and bias.shape == (filters,)
        and filters % _LANES == 0
        and pad < size <= _MOST
        and convolving.get("strides", [1, 1]) == [stride, stride]
        and convolving.get("pads", [0] * 4) == [pad] * 4
        and convolving.get("dilations", [1, 1]) == [1, 1]
        and convolving.get("group", [1]) == [1]
        and convolving.get("auto_pad", ["NOTSET"]) == ["NOTSET"]
        and scale.size == zero.size
        and scale.size in (1, planes)
        and decoding.get("axis", [1]) == [1]
    )
    if not usual:
        return None
    zeros = np.broadcast_to(zero.reshape(-1), planes)
    scales = np.broadcast_to(scale.reshape(-1), planes)
    off = np.arange(256) - zeros[:, None].astype(np.int64)
    return FirstLayer(
        shape,
        np.ascontiguousarray(zeros),
        off.astype(np.float32) * scales[:, None],
        np.ascontiguousarray(weights.transpose(1, 2, 3, 0)),
        bias,
        stride,
        pad,
    )


class _Node(NamedTuple):
    """A node of a graph; its attributes are lists of whole numbers, or of a text."""

    raw: bytes
    inputs: list[str]
    outputs: list[str]
    kind: str
    attributes: dict[str, list[Any]]

    @staticmethod
    def read(raw: bytes) -> _Node:
        names: dict[int, list[str]] = {_NODE_INPUT: [], _NODE_OUTPUT: [], _OP_TYPE: []}
        attributes: dict[str, list[Any]] = {}
        for number, value in _fields(raw):
            if number in names:
                names[number].append(bytes(value).decode())
            elif number == _ATTRIBUTE:
                text = _text(value, _ATTRIBUTE_TEXT)
                integers = *_integers(value, _ATTRIBUTE_INT), *_integers(value, _ATTRIBUTE_INTS)
                attributes[_text(value, _ATTRIBUTE_NAME)] = [text] if text else [*integers]
        return _Node(raw, names[_NODE_INPUT], names[_NODE_OUTPUT], "".join(names[_OP_TYPE]), attributes)


def _only_user(nodes: Sequence[_Node], name: str, kind: str, n_inputs: int) -> _Node | None:
    """Return the node of a kind that alone uses a value, as its first input."""
    users = [node for node in nodes if name in node.inputs]
    if len(users) != 1 or users[0].kind != kind or users[0].inputs[0] != name:
        return None
    return users[0] if len(users[0].inputs) == n_inputs else None


def _tensor(raw: bytes) -> np.ndarray | None:
    """Return a tensor of floats or bytes that is stored as raw data; None for another."""
    kinds, data = _integers(raw, _DATA_TYPE), [bytes(v) for n, v in _fields(raw) if n == _RAW_DATA]
    shape = _integers(raw, _DIMS)
    if len(kinds) != 1 or kinds[0] not in _NUMPY_TYPES or len(data) != 1:
        return None
    number = _NUMPY_TYPES[kinds[0]]
    if len(data[0]) != math.prod(shape) * number.itemsize:
        return None
    return np.frombuffer(data[0], number).reshape(shape)


def _value_info(name: str, shape: Sequence[int]) -> bytes:
    """Return the description of an input of floats."""
    dims = b"".join(_field(1, _field(1, n)) for n in shape)
    return _field(1, name.encode()) + _field(2, _field(1, _field(1, _FLOAT) + _field(2, dims)))


# Messages of Protocol Buffers: fields with a number, one after the other, whose values are whole numbers or bytes.


def _fields(message: bytes | memoryview) -> Iterator[tuple[int, Any]]:
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


def _field(number: int, value: int | bytes | memoryview) -> bytes:
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


def _text(message: bytes | memoryview, number: int) -> str:
    return b"".join(bytes(value) for n, value in _fields(message) if n == number).decode()


def _integers(message: bytes | memoryview, number: int) -> list[int]:
    """Return the whole numbers of a field that is repeated, one by one or packed."""
    found: list[int] = []
    for n, value in _fields(message):
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
