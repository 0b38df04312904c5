"""A compact network in compiled loops gives the answers of onnxruntime."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn.config import NetworkSettings
from lanenet.learn.export import export_onnx
from lanenet.learn.network import LaneNet
from lanenet.onboard.bench import example_camera
from lanenet.perception.edges.raster import MIDDLE, PLANES
from lanenet.perception.network.compact import network as compact
from lanenet.perception.network.compact.network import ANSWERS, CompactNetwork, open_network, read_weights
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.network.model_file import INPUT_NAME, WIDTH_NAME, ModelMeta, open_model, read_model

CHECKPOINTS = Path(__file__).parents[3] / "checkpoints"
compiled = pytest.mark.skipif(not compact.is_here(), reason="no compiled loops for this processor")


def a_raster(shape: tuple[int, ...], share: float, seed: int) -> np.ndarray:
    """A raster of which a share of the cells is filled, most of them in one half, each plane by itself."""
    rng = np.random.default_rng(seed)
    likely = np.broadcast_to(np.linspace(2.0 * share, 0.0, shape[2]), shape)
    filled = rng.random(shape) < likely
    raster = np.where(filled, rng.integers(0, 256, shape), MIDDLE).astype(np.uint8)
    raster[0] = np.where(filled[0], 255, 0)
    return raster


def assert_answers_of_the_whole(path: Path) -> None:
    found, meta = open_network(path)
    assert isinstance(found, CompactNetwork)
    whole, _ = open_model(path, frames=1)
    shape = meta.planes, meta.window.rows, meta.window.columns
    for seed, share in enumerate((0.0, 0.001, 0.05, 0.3, 1.0)):
        feed = {INPUT_NAME: a_raster(shape, share, seed)[None]}
        for width_cm in (0.0, 40.0, 110.0, None) if meta.takes_width else (None,):
            given = {} if width_cm is None else {WIDTH_NAME: np.array([width_cm], np.float32)}
            both = zip(found.run(ANSWERS, feed | given), whole.run(ANSWERS, feed | given), strict=True)
            for ours, theirs in both:
                np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


@compiled
@pytest.mark.parametrize("name", ["general", "small"])
def test_shipped_networks_answer_as_in_onnxruntime(name):
    assert_answers_of_the_whole(CHECKPOINTS / name)


@compiled
@pytest.mark.parametrize(
    ("rows", "columns", "settings"),
    [
        (37, 50, {"kind": "nano", "takes_width": True}),
        (64, 33, {"kind": "base", "bins": 17}),
        (20, 21, {"kind": "small", "channels": (8, 40), "hidden": 9, "planes": 1}),
        (41, 64, {"kind": "nano", "channels": (16,), "takes_width": True}),
        (1100, 9, {"kind": "nano"}),
    ],
)
def test_networks_of_any_size_answer_as_in_onnxruntime(rows, columns, settings, tmp_path):
    torch.manual_seed(0)
    network = LaneNet(NetworkSettings(**settings), rows, columns).eval()
    network.spread_bins(-30.0, 30.0)
    for layer in network.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            torch.nn.init.normal_(layer.weight, 1.0, 0.3)
            torch.nn.init.normal_(layer.bias, 0.0, 0.3)
    network.sigma_factor.copy_(torch.linspace(0.5, 2.0, 6))
    planes = settings.get("planes", len(PLANES))
    window = BirdseyeWindow(-30.0, 0.0, 1.0, rows, columns)
    told = {"planes": planes, "takes_width": settings.get("takes_width", False)}
    meta = ModelMeta(window, ("any",), 26.0, 40.0, "", (math.nan,) * 6, "map", **told)
    rasters = np.stack([a_raster((planes, rows, columns), share, 7) for share in (0.0, 0.1)])
    export_onnx(network, meta, rasters, tmp_path / "model.onnx")
    assert_answers_of_the_whole(tmp_path / "model.onnx")


@compiled
def test_an_answer_stays_as_it_is_when_the_next_one_comes():
    detector = NetworkDetector(CHECKPOINTS / "general", example_camera(), any_camera=True)
    first, second = (a_raster((5, 96, 128), 0.05, seed) for seed in (1, 2))
    kept = detector.detect_raster(first)
    before = replace(kept, **{name: getattr(kept, name).copy() for name in ("points_cm", "presence")})
    assert not np.array_equal(detector.detect_raster(second).points_cm, before.points_cm)
    np.testing.assert_array_equal(kept.points_cm, before.points_cm)
    np.testing.assert_array_equal(kept.presence, before.presence)


@compiled
def test_another_raster_is_refused():
    network, _ = open_network(CHECKPOINTS / "small")
    raster = np.zeros((1, 5, 96, 128), np.uint8)
    for wrong in (raster[0], raster.transpose(0, 1, 3, 2), raster.astype(np.int8), raster.repeat(2, axis=0)):
        with pytest.raises(ValueError, match="raster: expected uint8"):
            network.run(ANSWERS, {INPUT_NAME: wrong})


def test_without_the_compiled_loops_onnxruntime_is_used(monkeypatch):
    monkeypatch.setattr(compact, "_kernels", None)
    session, _ = open_network(CHECKPOINTS / "small")
    assert not isinstance(session, CompactNetwork)


@compiled
@pytest.mark.parametrize(
    "changed", [{"window": (17, 4, 3)}, {"window": (7, 4, 2)}, {"tail": np.ones(72, np.float32)}]
)
def test_a_network_that_answers_otherwise_is_left_to_onnxruntime(changed, monkeypatch, caplog):
    def read_other_weights(model: bytes, meta: ModelMeta):
        return replace(read_weights(model, meta), **changed)

    monkeypatch.setattr(compact, "read_weights", read_other_weights)
    session, _ = open_network(CHECKPOINTS / "small")
    assert not isinstance(session, CompactNetwork)
    assert "left to onnxruntime" in caplog.text


def test_other_layers_are_not_read():
    data, _ = read_model(CHECKPOINTS / "small")
    meta = open_model(CHECKPOINTS / "small")[1]
    assert read_weights(data, meta) is not None
    for old, new in (
        (b"\x04Gemm", b"\x04Gemx"),
        (b"\x04Conv", b"\x04Conx"),
        (b"network.bins_cm", b"network.bins_xx"),
    ):
        assert old in data
        assert read_weights(data.replace(old, new), meta) is None
    assert read_weights(b"", meta) is None


@compiled
def test_memory_beyond_the_arrays_is_not_read():
    data, _ = read_model(CHECKPOINTS / "small")
    weights = read_weights(data, open_model(CHECKPOINTS / "small")[1])
    raster = np.zeros(weights.shape, np.uint8)
    network = CompactNetwork(weights)
    numbers = [raster, 0.0, *network._numbers, np.zeros(14), *network._sizes]
    compact._kernels.run(*numbers)
    arrays = [i for i, each in enumerate(numbers) if isinstance(each, np.ndarray)]
    assert len(arrays) == 10
    for i in arrays:
        flat = numbers[i].ravel()
        for other in (flat[:-16], flat[:-3], np.concatenate([flat, np.ones(16, flat.dtype)])):
            if other.shape == flat.shape:
                continue
            with pytest.raises(ValueError, match=r"differ in size|not one that"):
                compact._kernels.run(*numbers[:i], other.copy(), *numbers[i + 1 :])
    for i, wrong in ((8, np.array([16, 17, 64, 400], np.int32)), *((i, 5000) for i in range(12, 18))):
        with pytest.raises(ValueError, match="not one that"):
            compact._kernels.run(*numbers[:i], wrong, *numbers[i + 1 :])
