"""A network whose first layer looks only at the cells of a raster that hold something.

Nineteen cells of twenty hold nothing, and the first convolution, which has more to multiply than all others
together, multiplies them all the same. So where the compiled loops are, a model is opened without its first
layer, which they add up for the filled cells alone. Its sums are taken in onnxruntime's order: the bytes are
equal wherever that multiplies and adds in one step. Any other model is run as it is.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from lanenet.errors import ModelMismatchError
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
from lanenet.perception.network.onnx_parts import (
    GRAPH,
    INITIALIZER,
    INPUT,
    NODE,
    OUTPUT,
    TENSOR_NAME,
    VALUE_NAME,
    Node,
    field_of,
    fields_of,
    float_input,
    only_user,
    tensor_of,
    text_of,
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
    halves = _halves(data, where, threads, meta)
    if halves is None:
        return session, meta
    if not _agree(halves, session, meta):
        log.warning("%s: without its first layer it answers otherwise: it is run as a whole, slower", where)
        return session, meta
    return halves, meta


def _halves(data: bytes, where: str, threads: int, meta: ModelMeta) -> Halves | None:
    """Return a model in two parts; None if it cannot be cut, or that would not make it faster."""
    if not compiled.is_fused():
        return None
    cut = cut_off(data, (meta.planes, meta.window.rows, meta.window.columns))
    if cut is None:
        return None
    try:
        return Halves(cut.layer, cut.features, new_session(cut.rest, where, threads, frames=1))
    except ModelMismatchError:
        return None


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
        rest: An ONNX file that has it as an input, in the place of the raster, and the lane's width as one
            that it always needs; its outputs are ``ANSWERS``.
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
    graphs = [value for number, value in fields_of(model) if number == GRAPH]
    if len(graphs) != 1:
        return None
    graph = [*fields_of(graphs[0])]
    nodes = [Node.read(value) for number, value in graph if number == NODE]
    decode = only_user(nodes, INPUT_NAME, "DequantizeLinear", 3)
    convolve = None if decode is None else only_user(nodes, decode.outputs[0], "Conv", 3)
    if decode is None or convolve is None:
        return None
    tensors = {
        name: value
        for number, value in graph
        if number == INITIALIZER and (name := text_of(value, TENSOR_NAME))
    }
    wanted = (*decode.inputs[1:], *convolve.inputs[1:])
    scale, zero, weights, bias = (tensor_of(tensors[name]) if name in tensors else None for name in wanted)
    if scale is None or zero is None or weights is None or bias is None:
        return None
    layer = _layer((scale, zero, weights, bias), decode.attributes, convolve.attributes, shape)
    if layer is None:
        return None
    features = convolve.outputs[0]
    rest = b"".join(
        field_of(number, value)
        for number, value in graph
        if not (
            (number == NODE and value in (decode.raw, convolve.raw))
            or (number == INITIALIZER and text_of(value, TENSOR_NAME) in (*wanted, WIDTH_NAME))
            or (number == INPUT and text_of(value, VALUE_NAME) == INPUT_NAME)
            or (number == OUTPUT and text_of(value, VALUE_NAME) not in ANSWERS)
        )
    )
    rest += field_of(INPUT, float_input(features, layer.new_features().shape))
    others = b"".join(field_of(n, v) for n, v in fields_of(model) if n != GRAPH)
    return Cut(layer, features, others + field_of(GRAPH, rest))


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
