"""A network that is cut behind its first layer answers as the whole one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lanenet.perception.network import compiled, onnx_bytes
from lanenet.perception.network.first_layer import ASKED, CutNetwork, FirstLayer, open_for_frames
from lanenet.perception.network.model_file import INPUT_NAME, WIDTH_NAME, open_model, read_model

CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"


def edge_raster(rng, shape, share):
    raster = np.full(shape, 128, np.uint8)
    raster[0] = 0
    edges = rng.random(shape[1:]) < share
    raster[:, edges] = rng.integers(0, 256, (shape[0], edges.sum()))
    raster[0, edges] = 255
    return raster


@pytest.mark.parametrize("name", ["general", "small"])
def test_a_cut_network_answers_as_the_whole_one(name):
    whole, meta = open_model(CHECKPOINTS / name, frames=1)
    cut, _ = open_for_frames(CHECKPOINTS / name)
    assert isinstance(cut, CutNetwork)
    rng = np.random.default_rng(0)
    for share in (0.0, 0.02, 0.08, 0.2):
        raster = edge_raster(rng, (meta.planes, meta.window.rows, meta.window.columns), share)
        feed = {INPUT_NAME: raster[None]}
        if meta.takes_width:
            feed[WIDTH_NAME] = np.array([rng.uniform(20.0, 60.0)], np.float32)
        for ours, theirs in zip(cut.run(ASKED, feed), whole.run(ASKED, feed), strict=True):
            # Sums in another order: the last bits of single precision, in cm.
            np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=2e-5)


@pytest.mark.skipif(not compiled.is_here(), reason="installed without a C++ compiler")
@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([1, 5]),
    st.sampled_from([8, 16, 24]),
    st.integers(1, 4),
    st.data(),
)
def test_the_layer_has_the_bytes_of_numpy_and_the_sums_of_a_convolution(seed, planes, channels, stride, data):
    rng = np.random.default_rng(seed)
    size = data.draw(st.integers(1, 8))
    rows, columns, pad = (data.draw(st.integers(low, high)) for low, high in ((8, 30), (8, 30), (0, 3)))
    weights = rng.normal(size=(size, size, planes, channels)).astype(np.float32)
    more = -size % stride
    filled = np.ascontiguousarray(np.pad(weights, ((0, more), (0, more), (0, 0), (0, 0))))
    zeros = np.where(np.arange(planes) == 0, 0, 128).astype(np.uint8)
    bias, scales = (rng.uniform(0.0, 1.0, n).astype(np.float32) for n in (channels, planes))
    layer = FirstLayer(filled, bias, scales, zeros, stride, pad, size)
    raster = edge_raster(rng, (planes, rows, columns), 0.2)
    found, expected = (np.full(layer.shape(rows, columns), np.nan, np.float32) for _ in range(2))
    layer.fill(raster, found)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled, "_kernels", None)
        layer.fill(raster, expected)
    assert found.tobytes() == expected.tobytes()
    decoded = (raster - zeros[:, None, None].astype(float)) * scales[:, None, None]
    padded = np.pad(decoded, ((0, 0), (pad, pad), (pad, pad)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (size, size), axis=(1, 2))
    sums = np.einsum("pyxij,ijpc->cyx", windows[:, ::stride, ::stride], weights) + bias[:, None, None]
    np.testing.assert_allclose(found, np.maximum(sums, 0.0), rtol=1e-4, atol=1e-2)


def test_parts_of_a_file_are_those_that_onnx_reads():
    data = read_model(CHECKPOINTS / "general")
    graph, expected = onnx_bytes.read_graph(data), onnx.load_from_string(data).graph
    assert [node.operator for node in graph.nodes] == [node.op_type for node in expected.node]
    assert [node.inputs for node in graph.nodes] == [tuple(node.input) for node in expected.node]
    assert [node.outputs for node in graph.nodes] == [tuple(node.output) for node in expected.node]
    for node, theirs in zip(graph.nodes, expected.node, strict=True):
        for attribute in theirs.attribute:
            if attribute.type == onnx.AttributeProto.INTS:
                assert node.attributes[attribute.name] == list(attribute.ints)
    for tensor in expected.initializer:
        if tensor.data_type in (onnx.TensorProto.FLOAT, onnx.TensorProto.UINT8):
            np.testing.assert_array_equal(graph.tensor(tensor.name), onnx.numpy_helper.to_array(tensor))
    with pytest.raises(KeyError):
        graph.tensor("nothing")


def test_a_cut_model_is_sound_and_computes_no_more_than_is_asked():
    data = read_model(CHECKPOINTS / "general")
    rest = onnx.load_from_string(
        onnx_bytes.cut(data, onnx_bytes.read_graph(data), INPUT_NAME, "relu", (1, 16, 24, 32), ASKED)
    )
    onnx.checker.check_model(rest)
    assert [value.name for value in rest.graph.output] == list(ASKED)
    assert {value.name for value in rest.graph.input} == {"relu", WIDTH_NAME}
    assert not {"DequantizeLinear", "Atan"} & {node.op_type for node in rest.graph.node}


def test_memory_beyond_the_arguments_is_not_read():
    if not compiled.is_here():
        pytest.skip("installed without a C++ compiler")
    raster, out = np.zeros((1, 8, 8), np.uint8), np.zeros((8, 2, 2), np.float32)
    weights, bias, scales, zeros = (
        np.zeros((4, 4, 1, 8), np.float32),
        np.zeros(8, np.float32),
        np.ones(1, np.float32),
        np.zeros(1, np.uint8),
    )
    good = [raster, weights, bias, scales, zeros, out, 8, 8, 2, 2, 1, 8, 4, 4, 0]
    compiled._kernels.first_layer(*good)
    for at, wrong in (
        (0, raster[:, :7]),
        (1, weights[:3]),
        (2, bias[:7]),
        (5, out[:7]),
        (12, 3),
        (13, 0),
        (14, -1),
    ):
        with pytest.raises(ValueError, match=r"fit|above 0"):
            compiled._kernels.first_layer(*good[:at], wrong, *good[at + 1 :])
