import contextlib
import logging
import math
import shutil
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from synthetic_labels import WINDOW, make_label_set

from lanenet.config import dump_settings
from lanenet.data.label_set import write_labels
from lanenet.errors import CheckpointError, ModelMismatchError
from lanenet.evaluation.answers import RasterModel
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn import export
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.export import export_checkpoint, export_onnx, read_network, write_rasters, write_weights
from lanenet.learn.network import DeployedLaneNet, input_of_rasters, new_network
from lanenet.perception.network.model_file import (
    LOG_SHARE_NAME,
    OUTPUT_NAMES,
    ModelMeta,
    answers_of,
    open_model,
    read_model_meta,
    sealed,
)

torch.set_num_threads(1)

META = ModelMeta(WINDOW, ("cam0", "cam1"), 26.0, 40.0, "abc", (1.0, 0.5, 0.6, 1.1, 0.5, math.nan), "truth")
META = replace(META, planes=5)
LABELS = make_label_set(5, 3)
RASTERS = np.stack([LABELS.raster(i) for i in range(5)])


def make_network():
    network = new_network(NetworkSettings(bins=0), WINDOW.rows, WINDOW.columns, 1).eval()
    network.mean_cm.copy_(torch.tensor([-20.0, -19.0, -17.0, 20.0, 22.0, 25.0]))
    network.scale_cm.fill_(8.0)
    return network


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoint")
    (folder / "config.yaml").write_text(dump_settings(LearnSettings(network=NetworkSettings(bins=0))))
    write_weights(folder / "weights.safetensors", make_network(), META)
    write_rasters(folder / "check_rasters.png", RASTERS)
    export_checkpoint(folder)
    return folder


def test_one_file_that_old_runtimes_read(checkpoint):
    assert sorted(p.name for p in checkpoint.iterdir()) == [
        "check_rasters.png",
        "config.yaml",
        "model.onnx",
        "weights.safetensors",
    ]
    model = onnx.load(checkpoint / "model.onnx", load_external_data=False)
    assert model.ir_version <= 9
    assert [(o.domain, o.version <= 20) for o in model.opset_import] == [("", True)]
    assert not any(t.external_data for t in model.graph.initializer)
    # Bytes become numbers in one pass.
    assert [node.op_type for node in model.graph.node if "raster" in node.input] == ["DequantizeLinear"]
    assert not {"Cast", "Slice", "Concat"} & {node.op_type for node in model.graph.node}
    # Nothing of the machine that exported it.
    assert b"site-packages" not in (checkpoint / "model.onnx").read_bytes()


@pytest.mark.parametrize("n", [1, 5])
def test_onnx_agrees_with_torch_for_any_batch(checkpoint, n):
    session = onnxruntime.InferenceSession(checkpoint / "model.onnx", providers=["CPUExecutionProvider"])
    names = [o.name for o in session.get_outputs()]
    assert names == ["points_cm", "sigma_cm", "presence", "parabolas", "centre_cm", "steering_rad"]
    found = session.run(None, {"raster": RASTERS[:n]})
    with torch.inference_mode():
        expected = DeployedLaneNet(make_network()).eval()(torch.from_numpy(RASTERS[:n]))
    for f, e in zip(found, expected, strict=True):
        assert f.shape == tuple(e.shape)
        np.testing.assert_allclose(f, e.numpy(), atol=1e-3)


def test_a_network_with_bins_answers_with_the_probability_of_each_place(tmp_path):
    network = new_network(NetworkSettings(bins=16), WINDOW.rows, WINDOW.columns, 1).eval()
    network.spread_bins(WINDOW.left_cm, WINDOW.right_cm)
    export_onnx(network, META, RASTERS, tmp_path / "m.onnx")
    session, _ = open_model(tmp_path / "m.onnx")
    names = answers_of(session)
    assert names == (*OUTPUT_NAMES, LOG_SHARE_NAME)
    found = dict(zip(names, session.run(names, {"raster": RASTERS}), strict=True))
    share = np.exp(found[LOG_SHARE_NAME])
    assert share.shape == (len(RASTERS), 6, 16)
    np.testing.assert_allclose(share.sum(axis=2), 1.0, atol=1e-5)
    places_cm = np.linspace(WINDOW.left_cm, WINDOW.right_cm, 16)
    np.testing.assert_allclose(share @ places_cm, found["points_cm"], atol=1e-3)


def test_the_file_describes_itself(checkpoint):
    meta = read_model_meta(checkpoint / "model.onnx")
    assert meta.window == WINDOW and meta.camera_hashes == ("cam0", "cam1")
    np.testing.assert_equal(meta.rmse_cm, META.rmse_cm)
    assert (meta.wheelbase_cm, meta.lane_width_cm, meta.training_hash, meta.reference) == (
        26.0,
        40.0,
        "abc",
        "truth",
    )


def test_export_is_silent(tmp_path, capfd, caplog):
    export_onnx(make_network(), META, RASTERS, tmp_path / "m.onnx")
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""
    assert not [r for r in caplog.records if r.levelno >= logging.INFO]


def test_the_file_answers_as_the_network_and_not_for_empty_rasters(checkpoint):
    labels = make_label_set(3, 3)
    labels.edges[1] = labels.edges[1][:0]
    model = RasterModel(checkpoint / "model.onnx")
    found = model.answer_labels(labels).points_cm
    with torch.inference_mode():
        expected = make_network()(input_of_rasters(torch.from_numpy(RASTERS[:3]))).points_cm.numpy()
    np.testing.assert_allclose(found[[0, 2]], expected[[0, 2]], atol=1e-3)
    assert np.isnan(found[1]).all()
    # A label set of another window has the rasters of this one, too.
    other = replace(labels, meta=replace(labels.meta, window=BirdseyeWindow()))
    np.testing.assert_array_equal(model.answer_labels(other).points_cm, found)
    in_colour = replace(labels, meta=replace(labels.meta, perception=labels.meta.perception.with_colours()))
    with pytest.raises(ModelMismatchError, match=r"edges\.colour_weight 0\.75, not 0\.0"):
        model.answer_labels(in_colour)


def test_a_file_that_differs_never_appears(tmp_path, monkeypatch):
    monkeypatch.setattr(export, "_largest_difference", lambda *_: 0.5)
    with pytest.raises(CheckpointError, match=r"differs from PyTorch by 0\.5"):
        export_onnx(make_network(), META, RASTERS, tmp_path / "m.onnx")
    with pytest.raises(CheckpointError, match="no raster"):
        export_onnx(make_network(), META, RASTERS[:0], tmp_path / "m.onnx")
    assert list(tmp_path.iterdir()) == []


def test_faulty_checkpoints_are_refused(checkpoint, tmp_path):
    with pytest.raises(CheckpointError, match="no such folder"):
        export_checkpoint(tmp_path / "none")
    for i, (name, content, message) in enumerate(
        [
            ("config.yaml", None, "no such file"),
            ("config.yaml", "sed: 3", "unknown key 'sed'"),
            ("config.yaml", "network: {hidden: 8}", "weights do not fit"),
            ("weights.safetensors", None, "was the training finished"),
            ("weights.safetensors", "rubbish", "cannot be read as safetensors"),
            ("check_rasters.png", None, "no such file"),
            ("check_rasters.png", "rubbish", "not a readable image"),
            ("checkpoint.yaml", "format: lanenet-checkpoint/9", r"checkpoint\.yaml: .*lanenet-checkpoint/9"),
        ]
    ):
        folder = tmp_path / str(i)
        shutil.copytree(checkpoint, folder)
        (folder / "model.onnx").unlink()
        (folder / name).unlink(missing_ok=True)
        with contextlib.suppress(TypeError):
            (folder / name).write_text(content)
        with pytest.raises(CheckpointError, match=message):
            export_checkpoint(folder)
        assert not (folder / "model.onnx").exists()


def test_damaged_weights_are_refused(checkpoint, tmp_path):
    """They are numbers, and a network; what is exported would answer otherwise."""
    folder = tmp_path / "damaged"
    shutil.copytree(checkpoint, folder)
    path = folder / "weights.safetensors"
    for at in (-2, -100_000):
        data = bytearray(path.read_bytes())
        data[at] ^= 1
        path.write_bytes(data)
        with pytest.raises(CheckpointError, match=r"weights\.safetensors: was damaged"):
            read_network(folder)
        shutil.copy(checkpoint / path.name, path)
    # Of an earlier version.
    with safe_open(path, framework="pt") as file:
        properties = {k: v for k, v in file.metadata().items() if k != "sha256"}
    save_file(load_file(path), path, metadata=properties)
    read_network(folder)


def test_an_export_is_checked_on_labels_as_well(checkpoint, tmp_path):
    write_labels(tmp_path / "labels.parquet", LABELS)
    labels = [tmp_path / "labels.parquet"] * 60
    path, rasters, difference = export_checkpoint(checkpoint, tmp_path / "m.onnx", labels)
    assert path.is_file() and rasters == 5 + 60 * 5
    assert 0.0 <= difference <= 1e-3
    other = replace(LABELS, meta=replace(LABELS.meta, window=BirdseyeWindow(rows=48)))
    write_labels(tmp_path / "other.parquet", other)
    with pytest.raises(CheckpointError, match=r"other\.parquet: made for .*rows=48.*expected"):
        export_checkpoint(checkpoint, tmp_path / "n.onnx", [tmp_path / "other.parquet"])
    assert not (tmp_path / "n.onnx").exists()


def test_a_network_with_bins_is_exported(tmp_path):
    settings = NetworkSettings(channels=(4, 8), hidden=8, bins=16)
    network = new_network(settings, WINDOW.rows, WINDOW.columns, 1).eval()
    network.spread_bins(WINDOW.left_cm, WINDOW.right_cm)
    assert export_onnx(network, META, RASTERS, tmp_path / "m.onnx") < 1e-3


def test_an_output_that_is_no_number_is_a_difference(tmp_path):
    network = make_network()
    network.mean_cm[0] = math.nan
    with pytest.raises(CheckpointError, match="differs from PyTorch by nan"):
        export_onnx(network, META, RASTERS, tmp_path / "m.onnx")


def test_the_width_of_the_lane_may_be_told_to_all_or_to_each_or_left_out(tmp_path):
    # Of one plane: those who have all of them need not know.
    settings = NetworkSettings(channels=(4, 8), hidden=8, bins=0, planes=1, takes_width=True)
    network = new_network(settings, WINDOW.rows, WINDOW.columns, 1).eval()
    meta, rasters = replace(META, planes=1, takes_width=True), RASTERS[:, :1]
    assert export_onnx(network, meta, rasters, tmp_path / "m.onnx") < 1e-3
    assert read_model_meta(tmp_path / "m.onnx").takes_width
    session = onnxruntime.InferenceSession(tmp_path / "m.onnx", providers=["CPUExecutionProvider"])
    # Who knows of rasters only is not asked for more.
    assert [i.name for i in session.get_inputs()] == ["raster"]
    deployed = DeployedLaneNet(network).eval()
    for widths in (None, [30.0], [0.0], [30.0, 0.0, 60.0, 45.0, 25.0]):
        told = None if widths is None else np.array(widths, np.float32)
        feed = {"raster": rasters} | ({} if told is None else {"lane_width_cm": told})
        with torch.inference_mode():
            expected = deployed(torch.from_numpy(rasters), None if told is None else torch.from_numpy(told))
        np.testing.assert_allclose(session.run(["points_cm"], feed)[0], expected[0].numpy(), atol=1e-3)
    labels, model = make_label_set(3, 3), RasterModel(tmp_path / "m.onnx")
    width_cm = labels.meta.lane_width_cm
    with torch.inference_mode():
        expected = network(input_of_rasters(torch.from_numpy(rasters[:3])), torch.tensor([width_cm]))
    np.testing.assert_allclose(model.answer_labels(labels).points_cm, expected.points_cm.numpy(), atol=1e-3)
    found = model.answer(RASTERS[:3], np.full(3, width_cm)).points_cm
    np.testing.assert_allclose(found, expected.points_cm.numpy(), atol=1e-3)


def test_a_description_that_does_not_fit_the_width_is_refused(tmp_path):
    export_onnx(make_network(), META, RASTERS, tmp_path / "m.onnx")
    model = onnx.load(tmp_path / "m.onnx")
    onnx.helper.set_model_props(model, replace(META, takes_width=True).to_properties())
    (tmp_path / "m.onnx").write_bytes(sealed(model.SerializeToString()))
    with pytest.raises(ModelMismatchError, match=r"has no input lane_width_cm, .* takes_width: True"):
        read_model_meta(tmp_path / "m.onnx")
