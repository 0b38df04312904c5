"""The compact networks in compiled loops: the weights of an ONNX file without the price of a graph's steps.

onnxruntime spends more of a frame on the steps between its layers than on these small layers, and multiplies
every cell of the raster, of which nineteen of twenty hold nothing. So where the compiled loops are, the
weights of a compact network are taken out of its file and run by them, the first layer by the filled cells
alone. Any other model, and one that would answer otherwise, is left to onnxruntime.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from lanenet.geometry.lane import N_POINTS, SIDES
from lanenet.perception.edges.compiled import loops_of
from lanenet.perception.edges.raster import MIDDLE, STEPS
from lanenet.perception.network.compact.onnx_reading import Graph, read_graph
from lanenet.perception.network.model_file import (
    INPUT_NAME,
    SELF_TEST_TOLERANCE,
    WIDTH_NAME,
    ModelMeta,
    check_model,
    read_model,
)

if TYPE_CHECKING:
    from pathlib import Path

_kernels: Any = loops_of("lanenet.perception.network.compact")

log = logging.getLogger(__name__)

#: What a detector asks a network for.
ANSWERS = ("points_cm", "sigma_cm", "presence")
_ANSWERS_AT = dict(
    zip(ANSWERS, (slice(N_POINTS), slice(N_POINTS, 2 * N_POINTS), slice(2 * N_POINTS, None)), strict=True)
)
#: Sigma, in log width, of the Gaussians by which a network is told a lane's width: about the distance of two
#: neighbours among those of :mod:`lanenet.learn.network`, log(4/3).
WIDTH_SIGMA = 0.25
#: The predicted sigma stays within these, [cm], before it is calibrated. Chosen: from below the best labels'
#: error to half the window.
SIGMA_RANGE_CM = (0.05, 50.0)
#: The compiled loops have so many filters at a time; others are filled up with weights of 0.
_LANES = 16
#: Filled share of a raster, and lane widths, by which a network is compared with onnxruntime. Chosen.
_FILLED, _COMPARED_CM = 0.05, (0.0, 40.0)
#: Of an answer, what rounding may change. Chosen: some hundred times single precision.
_ROUNDING = 1e-5


@runtime_checkable
class Runs(Protocol):
    """What a detector needs of a session of onnxruntime."""

    def run(self, names: Sequence[str], feed: dict[str, np.ndarray]) -> Sequence[Any]:
        """Return outputs by their names, for inputs by theirs."""
        ...


def is_installed() -> bool:
    """Tell whether the compiled loops are installed."""
    return _kernels is not None


def is_here() -> bool:
    """Tell whether the compiled loops are installed, and this processor is one that they are for."""
    return is_installed() and bool(_kernels.is_fast())


def open_network(path: Path, threads: int = 1) -> tuple[Runs, ModelMeta]:
    """Open a model for one raster after the other; a compact network in the compiled loops where they are.

    Raises:
        ModelMismatchError: As :func:`lanenet.perception.network.model_file.open_model`.
    """
    data, where = read_model(path)
    session, meta = check_model(data, where, threads, frames=1)
    if not is_here():
        return session, meta
    weights = read_weights(data, meta)
    if weights is None:
        log.info("%s: not of the layers of a compact network: left to onnxruntime", where)
        return session, meta
    compact = CompactNetwork(weights)
    if not _agree(compact, session, meta):
        log.warning("%s: the compiled loops answer otherwise, or not: left to onnxruntime, slower", where)
        return session, meta
    return compact, meta


@dataclass(frozen=True, eq=False)
class Weights:
    """A compact network as the compiled loops take it, its channels filled up to whole blocks.

    Attributes:
        shape: Planes, rows and columns of the raster.
        window: Side of the first layer's filters, their stride, and how far the first one begins before the
            raster.
        nothing: The byte of each plane that stands for 0.
        values: What each byte stands for in each plane.
        filters: Of all layers, one after the other: by block of 16 filters, input, and filter.
        biases: Of all layers.
        channels: Of the convolutions; hidden units; outputs.
        log_widths: Logarithms of the lane widths by which a lane's width is told; none if it is not.
        width_biases: What each of them adds to ``biases``.
        tail: Middle and half of the range of log sigma, six factors on sigma, and the places between which a
            point's distribution is spread.
    """

    shape: tuple[int, int, int]
    window: tuple[int, int, int]
    nothing: UInt8[np.ndarray, "p"]
    values: Float32[np.ndarray, "p 256"]
    filters: Float32[np.ndarray, "w"]
    biases: Float32[np.ndarray, "b"]
    channels: Int32[np.ndarray, "l"]
    log_widths: Float32[np.ndarray, "k"]
    width_biases: Float32[np.ndarray, "k b"]
    tail: Float32[np.ndarray, "t"]


class CompactNetwork:
    """A compact network; its answers are those of onnxruntime but for the last digits."""

    def __init__(self, weights: Weights) -> None:
        """Take the weights."""
        self._shape = (1, *weights.shape)
        layers = weights.filters, weights.biases, weights.log_widths, weights.width_biases, weights.channels
        self._numbers = weights.nothing, weights.values, *layers, weights.tail, WIDTH_SIGMA
        self._sizes = *weights.shape, *weights.window

    def run(self, names: Sequence[str], feed: dict[str, np.ndarray]) -> Sequence[Any]:
        """Return some of ``ANSWERS`` for one raster, and the lane's width where the model takes it.

        Raises:
            ValueError: If the raster is not one of the model's.
        """
        raster = feed[INPUT_NAME]
        if raster.shape != self._shape or raster.dtype != np.uint8:
            raise ValueError(f"raster: expected uint8 {self._shape}, found {raster.dtype} {raster.shape}")
        width_cm = feed[WIDTH_NAME][0] if WIDTH_NAME in feed else 0.0
        found = np.empty((1, 2 * N_POINTS + len(SIDES)))
        _kernels.run(raster, width_cm, *self._numbers, found, *self._sizes)
        return [found[:, _ANSWERS_AT[name]] for name in names]


def _agree(compact: CompactNetwork, whole: Runs, meta: ModelMeta) -> bool:
    """Compare the two on a raster of which some cells hold anything; False if the loops lack a layer."""
    rng = np.random.default_rng(0)
    shape = meta.planes, meta.window.rows, meta.window.columns
    looks = rng.integers(MIDDLE - STEPS, MIDDLE + STEPS + 1, (1, *shape))
    raster = np.where(rng.random(shape[1:]) < _FILLED, looks, MIDDLE).astype(np.uint8)
    # Its own cells, so that none of the planes alone tells which are filled.
    raster[0, 0] = np.where(rng.random(shape[1:]) < _FILLED, 255, 0)
    feeds: list[dict[str, np.ndarray]] = [{INPUT_NAME: raster}]
    if meta.takes_width:
        feeds += [{INPUT_NAME: raster, WIDTH_NAME: np.array([w], np.float32)} for w in _COMPARED_CM]
    for feed in feeds:
        try:
            answers = compact.run(ANSWERS, feed)
        except (ValueError, OverflowError):
            return False
        for ours, theirs in zip(answers, whole.run(ANSWERS, feed), strict=True):
            # Written so that NaN fails as well.
            if not (np.abs(ours - theirs) <= SELF_TEST_TOLERANCE + _ROUNDING * np.abs(theirs)).all():
                return False
    return True


def read_weights(model: bytes, meta: ModelMeta) -> Weights | None:
    """Take the weights of a compact network out of its ONNX file.

    Args:
        model: The file, as :mod:`lanenet.learn` exports it.
        meta: What it says about itself.

    Returns:
        The weights; None if the graph has other layers than such a network. Whether they are put together as
        there only its answers tell.
    """
    try:
        return _weights(read_graph(model), meta)
    except (KeyError, IndexError, ValueError):
        # Other layers cannot be unpacked in this way.
        return None


def _weights(graph: Graph, meta: ModelMeta) -> Weights:
    (decode,) = graph.of_kind("DequantizeLinear")
    first, *others = graph.of_kind("Conv")
    connect = graph.of_kind("Gemm")
    (hidden, hidden_bias), (last, last_bias) = (graph.constants_of(n) for n in connect if len(n.inputs) == 3)
    size, stride, pad = (first.attributes[name][0] for name in ("kernel_shape", "strides", "pads"))
    rows, columns = ((n + 2 * pad - size) // stride + 1 for n in (meta.window.rows, meta.window.columns))
    kernels, biases = [], []
    for node in (first, *others):
        kernel, bias = graph.constants_of(node)
        kernels.append(kernel.transpose(2, 3, 1, 0))
        biases.append(bias)
        if node is not first:
            rows, columns = (rows + 1) // 2, (columns + 1) // 2
    kernels.append(hidden.reshape(len(hidden), -1, rows, columns).transpose(2, 3, 1, 0))
    kernels.append(last.T[None, None])
    biases = [_filled_up(bias) for bias in (*biases, hidden_bias, last_bias)]
    channels = [len(bias) for bias in biases]
    n_inputs = [meta.planes, *channels]
    scale, zero = (np.broadcast_to(x.reshape(-1), meta.planes) for x in graph.constants_of(decode))
    off = np.arange(256) - zero[:, None].astype(np.int64)
    log_widths = graph.constants["network.log_widths"] if meta.takes_width else np.zeros(0, np.float32)
    width_biases = np.zeros((len(log_widths), sum(channels)), np.float32)
    if meta.takes_width:
        # Neither the first layer nor the last one is told.
        told = [graph.constants_of(node)[0].T for node in connect if len(node.inputs) == 2]
        width_biases[:, channels[0] : -channels[-1]] = np.concatenate([*map(_filled_up, told)], axis=1)
    return Weights(
        (meta.planes, meta.window.rows, meta.window.columns),
        (size, stride, pad),
        zero.copy(),
        off.astype(np.float32) * scale[:, None],
        np.concatenate([_in_blocks(kernel, n) for kernel, n in zip(kernels, n_inputs, strict=False)]),
        np.concatenate(biases),
        np.array(channels, np.int32),
        log_widths.copy(),
        width_biases,
        _tail(graph.constants["network.bins_cm"], graph.constants["network.sigma_factor"]),
    )


def _filled_up(values: Float32[np.ndarray, "*k n"]) -> Float32[np.ndarray, "*k m"]:
    """Fill up the last axis with zeros to whole blocks."""
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, -values.shape[-1] % _LANES)])


def _in_blocks(kernel: Float32[np.ndarray, "r c i f"], n_inputs: int) -> Float32[np.ndarray, "n"]:
    """Return filters, with so many inputs each, in the order of the compiled loops."""
    more = n_inputs - kernel.shape[2]
    full = _filled_up(np.pad(kernel, [(0, 0), (0, 0), (0, more), (0, 0)]))
    return full.reshape(-1, full.shape[-1] // _LANES, _LANES).swapaxes(0, 1).ravel()


def _tail(
    bins_cm: Float32[np.ndarray, "c"], sigma_factor: Float32[np.ndarray, "6"]
) -> Float32[np.ndarray, "t"]:
    """Return what turns the last layer's outputs into answers, see ``Weights``."""
    low, high = (math.log(sigma_cm) for sigma_cm in SIGMA_RANGE_CM)
    middle_and_half = np.array([low + high, high - low], np.float32) / 2.0
    return np.concatenate([middle_and_half, sigma_factor, bins_cm], dtype=np.float32)
