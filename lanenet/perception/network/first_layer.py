"""The first layer of a network, where the raster has edges: nine of ten cells are empty, and add nothing.

onnxruntime would decode every cell and weigh all of them. So the model is cut behind its first convolution:
what lies before is summed up here, edge by edge, and onnxruntime begins there. The sums are taken in another
order than its own, which changes answers in the last bits of single precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int, UInt8

from lanenet.perception.network import compiled, onnx_bytes
from lanenet.perception.network.model_file import (
    INPUT_NAME,
    ModelMeta,
    model_options,
    open_model,
    read_model,
)
from lanenet.perception.network.onnx_bytes import Graph, Node
from lanenet.reading import MEBIBYTE

#: What a detector asks a network for.
ASKED = ("points_cm", "sigma_cm", "presence")
#: Larger models are left whole: their first layer is a small part of their work.
_LARGEST = 16 * MEBIBYTE


@runtime_checkable
class Network(Protocol):
    """What answers a raster: an onnxruntime session, or one behind a :class:`FirstLayer`."""

    def run(self, names: Sequence[str], feed: dict[str, np.ndarray]) -> Sequence[Any]:
        """Return the named outputs for the named inputs."""
        ...


@dataclass(frozen=True, eq=False)
class FirstLayer:
    """A convolution over decoded planes, and the rectifier behind it.

    Attributes:
        weights: Of each place of its filter and each plane, by channel; filled up with 0 to a multiple of the
            stride, so that every cell adds to as many places.
        bias: By channel.
        scales: What a step of each plane is worth.
        zeros: What each plane has for nothing.
        stride: Cells from one place of the result to the next.
        pad: Cells that count as empty beyond the raster's border.
        size: Of the filter as it was, along each side.
    """

    weights: Float32[np.ndarray, "k k p c"]
    bias: Float32[np.ndarray, "c"]
    scales: Float32[np.ndarray, "p"]
    zeros: UInt8[np.ndarray, "p"]
    stride: int
    pad: int
    size: int

    def shape(self, rows: int, columns: int) -> tuple[int, int, int]:
        """Return the channels, rows and columns of the result for a raster of this size."""
        down, across = ((n + 2 * self.pad - self.size) // self.stride + 1 for n in (rows, columns))
        return len(self.bias), down, across

    def fill(self, raster: UInt8[np.ndarray, "p r q"], out: Float32[np.ndarray, "c y x"]) -> None:
        """Write the layer's answer to a raster into ``out``."""
        if compiled.is_here():
            layer = self.weights, self.bias, self.scales, self.zeros
            compiled.fill_first_layer(raster, layer, self.stride, self.pad, out)
            return
        sums = np.tile(self.bias, (out.shape[1] * out.shape[2], 1))
        row, column = np.nonzero((raster != self.zeros[:, None, None]).any(axis=0))
        steps = (raster[:, row, column].astype(np.int32) - self.zeros[:, None]).astype(np.float32)
        values = steps * self.scales[:, None]
        # Each cell adds to all places that it is in the filter of; cell by cell, as the compiled loops do.
        place, at, cell = self._meets(row, column, out.shape[1:])
        taps = self.weights.reshape(-1, *self.weights.shape[2:])[at]
        added = values[0, cell, None] * taps[:, 0]
        for plane in range(1, len(values)):
            added += values[plane, cell, None] * taps[:, plane]
        np.add.at(sums, place, added)
        out[:] = np.maximum(sums, np.float32(0.0)).T.reshape(out.shape)

    def _meets(
        self, row: Int[np.ndarray, "n"], column: Int[np.ndarray, "n"], size: tuple[int, int]
    ) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"], Int[np.ndarray, "m"]]:
        """Return the places of the result that cells add to, where in the filter, and which cell."""
        n_filter = len(self.weights)
        back = np.arange(n_filter // self.stride - 1, -1, -1)

        def along(cells: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            to = (cells + self.pad)[:, None] // self.stride - back
            tap = (cells + self.pad)[:, None] - self.stride * to
            return to, tap, (to >= 0) & (to < n)

        down, tap_down, in_down = along(row, size[0])
        across, tap_across, in_across = along(column, size[1])
        there = in_down[:, :, None] & in_across[:, None, :]
        cell = np.nonzero(there)[0]
        place = (down[:, :, None] * size[1] + across[:, None, :])[there]
        return place, (tap_down[:, :, None] * n_filter + tap_across[:, None, :])[there], cell


class CutNetwork:
    """A first layer, and the rest of the model in onnxruntime."""

    def __init__(self, layer: FirstLayer, name: str, shape: tuple[int, int, int], session: Network) -> None:
        """Take a session whose input of this name is the answer of the layer, of this shape."""
        self._layer, self._name, self._session = layer, name, session
        self._answer = np.zeros((1, *shape), np.float32)

    def run(self, names: Sequence[str], feed: dict[str, np.ndarray]) -> Sequence[Any]:
        """Return the named outputs, among :data:`ASKED`, for one raster and what else goes in."""
        others = {name: value for name, value in feed.items() if name != INPUT_NAME}
        self._layer.fill(feed[INPUT_NAME][0], self._answer[0])
        return self._session.run(names, others | {self._name: self._answer})


def open_for_frames(path: Path, threads: int = 1) -> tuple[Network, ModelMeta]:
    """Open a model for one raster after the other, cut behind its first layer if it begins as ours do.

    Args:
        path: ONNX file or checkpoint folder.
        threads: Threads of the computation.

    Raises:
        ModelMismatchError: As :func:`lanenet.perception.network.model_file.open_model`.
    """
    session, meta = open_model(path, threads, frames=1)
    model = read_model(path)
    if len(model) > _LARGEST:
        return session, meta
    graph = onnx_bytes.read_graph(model)
    found = _find_first_layer(graph)
    if found is None:
        return session, meta
    import onnxruntime

    layer, end = found
    shape = layer.shape(meta.window.rows, meta.window.columns)
    rest = onnx_bytes.cut(model, graph, INPUT_NAME, end, (1, *shape), ASKED)
    options = model_options(threads, frames=1)
    cut = onnxruntime.InferenceSession(rest, options, providers=["CPUExecutionProvider"])
    return CutNetwork(layer, end, shape, cut), meta


def _find_first_layer(graph: Graph) -> tuple[FirstLayer, str] | None:
    """Return the layer with which a graph begins and the name of its answer; None if it is none of ours."""
    chain: list[Node] = []
    name = INPUT_NAME
    for operator in ("DequantizeLinear", "Conv", "Relu"):
        users = [node for node in graph.nodes if name in node.inputs]
        if len(users) != 1 or users[0].operator != operator or users[0].inputs[0] != name:
            return None
        chain += users
        name = users[0].outputs[0]
    decode, convolution, _ = chain
    try:
        scales, zeros = (graph.tensor(name) for name in decode.inputs[1:])
        weights, bias = (graph.tensor(name) for name in convolution.inputs[1:])
    except (KeyError, ValueError):
        return None
    numbers = convolution.attributes
    size = weights.shape[-1] if weights.ndim == 4 else 0
    stride, pad = numbers.get("strides", [0])[0], numbers.get("pads", [0])[0]
    plain = {"strides": [stride] * 2, "pads": [pad] * 4, "dilations": [1, 1], "kernel_shape": [size] * 2}
    sound = (
        weights.shape[1:] == (len(zeros), size, size)
        and len(bias) % 8 == 0
        and zeros.dtype == np.uint8
        and scales.shape == zeros.shape
        and all(each.dtype == np.float32 for each in (scales, weights, bias))
        and all(numbers.get(key, value) == value for key, value in plain.items())
        and numbers.get("group", [1]) == [1]
        and decode.attributes.get("axis", [1]) == [1]
        and stride > 0
    )
    if not sound:
        return None
    more = -size % stride
    by_place = np.pad(weights.transpose(2, 3, 1, 0), ((0, more), (0, more), (0, 0), (0, 0)))
    return FirstLayer(np.ascontiguousarray(by_place), bias, scales, zeros, stride, pad, size), name
