"""A network without its first layer, which is added up for the filled cells of a raster alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from lanenet.perception.edges.raster import MIDDLE
from lanenet.perception.network import compiled
from lanenet.perception.network.first_layer import ANSWERS, Halves, cut_off, open_network
from lanenet.perception.network.model_file import INPUT_NAME, WIDTH_NAME, open_model

CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"
fused = pytest.mark.skipif(
    not compiled.is_fused(), reason="no compiled loops that multiply and add in one step"
)


def a_raster(shape: tuple[int, ...], share: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    filled = rng.random(shape[1:]) < share
    raster = np.where(filled, rng.integers(0, 256, shape), MIDDLE).astype(np.uint8)
    raster[0] = np.where(filled, 255, 0)
    return raster


@fused
@pytest.mark.parametrize("name", ["general", "small"])
def test_the_answers_are_those_of_the_whole_model(name):
    halves, meta = open_network(CHECKPOINTS / name)
    assert isinstance(halves, Halves)
    whole, _ = open_model(CHECKPOINTS / name, frames=1)
    shape = meta.planes, meta.window.rows, meta.window.columns
    for seed, share in enumerate((0.0, 0.001, 0.05, 0.3, 1.0)):
        feed = {INPUT_NAME: a_raster(shape, share, seed)[None]}
        for width_cm in (0.0, 40.0, None) if meta.takes_width else (None,):
            given = {} if width_cm is None else {WIDTH_NAME: np.array([width_cm], np.float32)}
            both = zip(halves.run(ANSWERS, feed | given), whole.run(ANSWERS, feed | given), strict=True)
            for ours, theirs in both:
                # Equal bytes on processors whose sums onnxruntime takes in the same order.
                np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-4)


def test_without_the_compiled_loops_the_whole_model_is_run(monkeypatch):
    monkeypatch.setattr(compiled, "_kernels", None)
    session, _ = open_network(CHECKPOINTS / "small")
    assert not isinstance(session, Halves)


@fused
def test_a_half_that_answers_otherwise_is_not_used(monkeypatch, caplog):
    monkeypatch.setattr(compiled, "first_layer", lambda layer, raster, out: out.fill(1.0))
    session, _ = open_network(CHECKPOINTS / "small")
    assert not isinstance(session, Halves)
    assert "first layer" in caplog.text


def a_model(**attributes: object) -> bytes:
    """A raster of 2 x 9 x 11, its decoding, and a convolution to 16 features."""
    wanted = {"strides": [2, 2], "pads": [1, 1, 1, 1], "kernel_shape": [3, 3]} | attributes
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(16, 2, 3, 3)).astype(np.float32)
    constants = {
        "scale": np.array([1.0 / 255.0, 1.0 / 127.0], np.float32),
        "zero": np.array([0, 128], np.uint8),
        "weights": weights,
        "bias": rng.normal(size=16).astype(np.float32),
    }
    nodes = [
        helper.make_node("DequantizeLinear", [INPUT_NAME, "scale", "zero"], ["cells"], axis=1),
        helper.make_node("Conv", ["cells", "weights", "bias"], ["features"], **wanted),
        *(helper.make_node("ReduceMean", ["features"], [name], axes=[1, 2, 3]) for name in ANSWERS),
    ]
    graph = helper.make_graph(
        nodes,
        "g",
        [helper.make_tensor_value_info(INPUT_NAME, TensorProto.UINT8, [1, 2, 9, 11])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 1, 1, 1]) for name in ANSWERS],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)]).SerializeToString()


def test_a_model_is_cut_behind_its_first_convolution():
    cut = cut_off(a_model(), (2, 9, 11))
    assert cut is not None
    assert cut.features == "features"
    assert cut.layer.size == 3 and cut.layer.stride == 2 and cut.layer.pad == 1
    assert cut.layer.new_features().shape == (1, 16, 5, 6)
    rest = onnx.load_from_string(cut.rest)
    onnx.checker.check_model(rest)
    assert [value.name for value in rest.graph.input] == ["features"]
    assert [node.op_type for node in rest.graph.node] == ["ReduceMean"] * 3
    assert not rest.graph.initializer


@fused
def test_sums_of_a_small_raster_are_those_of_the_definition():
    cut = cut_off(a_model(), (2, 9, 11))
    raster = a_raster((2, 9, 11), 0.4, 1)
    layer, out = cut.layer, cut.layer.new_features()
    compiled.first_layer(layer, raster, out[0])
    cells = np.take_along_axis(layer.values, raster.reshape(2, -1), axis=1).reshape(raster.shape)
    padded = np.pad(cells.astype(np.float64), ((0, 0), (1, 1), (1, 1)))
    for y, x in np.ndindex(5, 6):
        window = padded[:, 2 * y : 2 * y + 3, 2 * x : 2 * x + 3]
        expected = np.einsum("prc,prcf->f", window, layer.weights) + layer.bias
        np.testing.assert_allclose(out[0, :, y, x], expected, atol=1e-5)


@pytest.mark.parametrize(
    "attributes", [{"strides": [2, 1]}, {"pads": [1, 1, 0, 0]}, {"dilations": [2, 2]}, {"auto_pad": "VALID"}]
)
def test_other_convolutions_are_left_to_onnxruntime(attributes):
    if "auto_pad" in attributes:
        attributes = attributes | {"pads": [0, 0, 0, 0]}
    assert cut_off(a_model(**attributes), (2, 9, 11)) is None
    assert cut_off(a_model(), (3, 9, 11)) is None


@fused
def test_memory_beyond_a_raster_is_not_read():
    layer = cut_off(a_model(), (2, 9, 11)).layer
    raster, out = np.zeros((2, 9, 11), np.uint8), layer.new_features()[0]
    numbers = [raster, layer.nothing, layer.values, layer.weights, layer.bias, out, 2, 9, 11, 3, 2, 1]
    compiled._kernels.first_layer(*numbers)
    for at in (0, 1, 2, 3, 5):
        with pytest.raises(ValueError, match="differ in size"):
            compiled._kernels.first_layer(*numbers[:at], numbers[at][:1], *numbers[at + 1 :])
    for at, value in ((4, layer.bias[:5]), (6, 9), (7, 0), (8, 5000), (9, 9), (10, 0), (11, 3)):
        with pytest.raises(ValueError, match="not one that"):
            compiled._kernels.first_layer(*numbers[:at], value, *numbers[at + 1 :])
