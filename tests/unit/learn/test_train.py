import csv
import json
import math
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from safetensors.torch import load_file
from synthetic_labels import make_label_set
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from lanenet.config import load_settings
from lanenet.data.label_set import read_labels, write_labels
from lanenet.errors import CheckpointError, ConfigError, LabelFormatError, LanenetError
from lanenet.evaluation.answers import RasterModel
from lanenet.evaluation.errors import point_errors
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn.checkpoint import EpochRecord, read_state, write_state
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.export import Int8Report, export_int8
from lanenet.learn.network import new_network
from lanenet.learn.train import TrainingRun, learning_rate_at, new_optimizer, set_learning_rate, train
from lanenet.perception.network.model_file import open_model, read_model_meta
from lanenet.samples.dataset import LaneSamples
from lanenet.samples.settings import AugmentSettings

torch.set_num_threads(1)

TINY = LearnSettings(
    epochs=3,
    batch_size=16,
    threads=1,
    network=NetworkSettings(channels=(4, 8), hidden=16),
)


class KilledError(Exception):
    pass


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    for name, n, seed in (("train", 70, 0), ("val", 40, 1), ("big", 400, 2)):
        write_labels(folder / f"{name}.parquet", make_label_set(n, seed))
    return folder


def run(data, out, settings=TINY, progress=None, name="train"):
    return train(settings, [data / f"{name}.parquet"], [data / "val.parquet"], out, progress)


def kill_at(last):
    def progress(epoch, *_):
        if epoch == last:
            raise KilledError

    return progress


@pytest.fixture(scope="module")
def finished(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "tiny"
    return run(data, out)


@pytest.mark.parametrize("bins", [pytest.param(0, marks=pytest.mark.slow), 24])
def test_learns_far_better_than_a_constant(data, tmp_path, bins):
    settings = LearnSettings(
        epochs=8,
        batch_size=16,
        threads=1,
        network=NetworkSettings(channels=(8, 16, 24), hidden=32, bins=bins),
        augment=AugmentSettings(clutter_points=3, clutter_segments=1),
        ema_decay=0.98,
    )
    result = run(data, tmp_path / "learned", settings, name="big")
    val = read_labels(data / "val.parquet")
    answers = {
        "network": RasterModel(result.model_path).answer_labels(val).points_cm,
        "constant": np.tile(val.points_cm.mean(axis=0), (len(val), 1)),
    }
    tables = {name: point_errors(answer, val.points_cm) for name, answer in answers.items()}
    assert tables["constant"].all.rmse_cm > 3.0
    assert tables["network"].all.rmse_cm < 0.35 * tables["constant"].all.rmse_cm
    assert tables["network"].all.rmse_cm == pytest.approx(result.val_rmse_cm, abs=1e-3)


def test_the_folder_holds_what_it_should(finished, data):
    names = {p.name for p in finished.folder.iterdir()}
    assert names >= {
        "weights.safetensors",
        "model.onnx",
        "config.yaml",
        "metrics.json",
        "curve.csv",
        "curve.png",
        "calibration_rasters.png",
        "check_rasters.png",
        "last.pt",
    }
    assert load_settings(LearnSettings, finished.folder / "config.yaml") == TINY
    metrics = json.loads((finished.folder / "metrics.json").read_text())
    assert metrics["val_rmse_cm"] == finished.val_rmse_cm
    assert metrics["val"]["reference"] == "map"
    assert len(metrics["sigma_factors"]) == 6 and metrics["val_presence"]["there"] == 80
    with (finished.folder / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["epoch"]) for row in rows] == [1, 2, 3]
    best = min(rows, key=lambda row: float(row["val_trimmed_cm"]))
    assert int(best["epoch"]) == finished.best_epoch == metrics["best_epoch"]
    assert float(best["val_rmse_cm"]) == pytest.approx(finished.val_rmse_cm, rel=1e-6)
    meta = read_model_meta(finished.model_path)
    assert meta.camera_hashes == ("cam0",) and meta.lane_width_cm == 40.0
    assert math.isfinite(sum(meta.rmse_cm)) and meta.training_hash == metrics["run_hash"]
    session = onnxruntime.InferenceSession(finished.model_path, providers=["CPUExecutionProvider"])
    assert session.get_inputs()[0].shape[1:] == [5, 24, 32]
    # Readable without trusting the file.
    torch.load(finished.folder / "last.pt", weights_only=True)


@pytest.mark.parametrize(("last", "every"), [(1, 1), pytest.param(2, 1, marks=pytest.mark.slow), (2, 5)])
def test_a_killed_run_ends_as_an_undisturbed_one(data, finished, tmp_path, last, every):
    settings = TINY.model_copy(update={"checkpoint_every": every, "tensorboard": True})
    with pytest.raises(KilledError):
        run(data, tmp_path / "a", settings, kill_at(last))
    assert not (tmp_path / "a" / "model.onnx").exists()
    seen = []
    result = run(data, tmp_path / "a", settings, lambda epoch, *_: seen.append(epoch))
    assert seen == ([1, 2, 3] if every > last else list(range(last + 1, 4)))
    a = load_file(result.folder / "weights.safetensors")
    b = load_file(finished.folder / "weights.safetensors")
    assert a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
    assert (result.best_epoch, result.val_rmse_cm) == (finished.best_epoch, finished.val_rmse_cm)
    # Each epoch stands once in the curve, also one that was computed again.
    events = EventAccumulator(str(tmp_path / "a" / "tensorboard")).Reload()
    assert [e.step for e in events.Scalars("val_rmse_cm")] == [1, 2, 3]
    assert min(e.value for e in events.Scalars("val_rmse_cm")) == pytest.approx(result.val_rmse_cm, rel=1e-5)


def test_a_run_of_all_that_a_network_can_have_is_gone_on_with_exactly(tmp_path):
    samples = LaneSamples([make_label_set(n, n) for n in (30, 18)], ["a.parquet", "b.parquet"])
    network = NetworkSettings(channels=(4, 8), hidden=8, takes_width=True, bins=8)
    settings = TINY.model_copy(update={"network": network, "balance": "drive"})
    whole, half = TrainingRun(settings, samples), TrainingRun(settings, samples)
    whole.run_epoch(samples), half.run_epoch(samples)
    write_state(tmp_path / "last.pt", half.state(), "hash")
    gone_on = TrainingRun(settings, samples, read_state(tmp_path / "last.pt", "hash"))
    whole.run_epoch(samples), gone_on.run_epoch(samples)
    for a, b in ((whole.network, gone_on.network), (whole.best_network(), gone_on.best_network())):
        assert all(torch.equal(value, b.state_dict()[name]) for name, value in a.state_dict().items())


def test_the_model_can_be_quantised(finished, tmp_path):
    path, report = export_int8(finished.folder, tmp_path / "model-int8.onnx")
    floats, meta = open_model(finished.model_path)
    small, small_meta = open_model(path)
    assert small_meta == meta and small_meta.training_hash
    assert {"QuantizeLinear", "DequantizeLinear"} <= {node.op_type for node in onnx.load(path).graph.node}
    labels = make_label_set(30, 9)
    rasters = np.stack([labels.raster(i) for i in range(30)])
    a, b = (session.run(["points_cm"], {"raster": rasters})[0] for session in (floats, small))
    assert 0.0 < np.sqrt(np.mean((a - b) ** 2)) < 0.5
    figures = json.loads(path.with_suffix(".json").read_text())
    assert 0.0 < figures["rms_difference_cm"] <= figures["largest_difference_cm"]
    assert figures["recommended"] == report.recommended
    assert figures["size_bytes"] == path.stat().st_size


def test_int8_is_recommended_only_where_it_is_faster_and_close():
    good = Int8Report(0.02, 0.1, 0.05, 0.06, 1000, 4000)
    assert good.recommended and good.lines[-1].endswith("use it")
    for worse in ({"rms_difference_cm": 0.06}, {"median_ms": 0.07}):
        other = replace(good, **worse)
        assert not other.recommended and other.lines[-1].endswith("keep model.onnx")


def test_a_finished_run_is_not_repeated(data, finished):
    def progress(*_):
        raise KilledError

    before = finished.model_path.stat().st_mtime_ns
    again = run(data, finished.folder, progress=progress)
    assert again == replace(finished, computed=False) and finished.computed
    assert finished.model_path.stat().st_mtime_ns == before


def test_another_run_in_the_same_folder_is_refused(data, finished, tmp_path):
    other = TINY.model_copy(update={"seed": 1})
    with pytest.raises(CheckpointError, match="pick another name, or delete"):
        run(data, finished.folder, other)
    with pytest.raises(CheckpointError, match="other settings or data"):
        run(data, finished.folder, name="val")
    with pytest.raises(KilledError):
        run(data, tmp_path / "half", progress=kill_at(1))
    with pytest.raises(CheckpointError, match="pick another name, or delete"):
        run(data, tmp_path / "half", other)
    (tmp_path / "half" / "last.pt").write_bytes(b"rubbish")
    with pytest.raises(CheckpointError, match="delete it to start over"):
        run(data, tmp_path / "half")


def test_label_sets_must_fit_together(data, tmp_path):
    wide = BirdseyeWindow(left_cm=-60.0, near_cm=0.0, cell_cm=3.0, rows=24, columns=40)
    write_labels(tmp_path / "other.parquet", make_label_set(5, 0, window=wide))
    with pytest.raises(LabelFormatError, match="window") as caught:
        train(TINY, [data / "train.parquet"], [tmp_path / "other.parquet"], tmp_path / "out")
    assert "train.parquet" in str(caught.value) and "other.parquet" in str(caught.value)
    with pytest.raises(LabelFormatError, match="no label set"):
        train(TINY, [data / "train.parquet"], [], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_divergence_is_an_error(data, tmp_path):
    with pytest.raises(LanenetError, match="learning_rate"):
        run(data, tmp_path / "wild", TINY.model_copy(update={"learning_rate": 1e30}))


def test_learning_rate_rises_and_falls():
    settings = LearnSettings(learning_rate=1.0, warmup=0.1)
    rates = [learning_rate_at(step, 100, settings) for step in range(100)]
    assert int(np.argmax(rates)) == 10 and rates[10] == 1.0
    assert (np.diff(rates[:11]) > 0).all() and (np.diff(rates[10:]) < 0).all()
    assert 0.0 < rates[0] < 0.2 and 0.0 < rates[-1] < 1e-3


def test_the_new_layer_of_alexnet_learns_faster_and_norms_do_not_decay():
    settings = LearnSettings(network=NetworkSettings(kind="alexnet"), head_rate=10.0, weight_decay=0.1)
    network = new_network(settings.network, 24, 32, 0)
    optimizer = new_optimizer(network, settings)
    set_learning_rate(optimizer, 1e-4)
    groups = {id(p): group for group in optimizer.param_groups for p in group["params"]}
    assert len(groups) == len(list(network.parameters()))
    assert groups[id(network.head.weight)]["lr"] == pytest.approx(1e-3)
    assert groups[id(network.trunk.features[0].weight)]["lr"] == pytest.approx(1e-4)
    assert groups[id(network.head.weight)]["weight_decay"] == 0.1
    assert groups[id(network.head.bias)]["weight_decay"] == 0.0
    small = new_network(NetworkSettings(), 24, 32, 0)
    set_learning_rate(compact := new_optimizer(small, LearnSettings()), 1e-4)
    assert {group["lr"] for group in compact.param_groups} == {1e-4}


def test_every_part_of_a_network_learns():
    samples = LaneSamples([make_label_set(48, 0)], ["train.parquet"])
    sizes = NetworkSettings(channels=(4, 8), hidden=8, takes_width=True, bins=8)
    run = TrainingRun(TINY.model_copy(update={"network": sizes}), samples)
    before = {name: value.clone() for name, value in run.network.named_parameters()}
    run.run_epoch(samples)
    still = [name for name, value in run.network.named_parameters() if torch.equal(value, before[name])]
    assert len(before) > 10 and not still


def test_patience_ends_a_run_that_gets_no_better():
    samples = LaneSamples([make_label_set(20, 0)], ["train.parquet"])

    def ended(errors_cm, patience, epochs=12):
        settings = TINY.model_copy(update={"epochs": epochs, "patience": patience})
        run = TrainingRun(settings, samples)
        run.history = [EpochRecord(i + 1, 1.0, 9.0, 1e-3, 1.0, error) for i, error in enumerate(errors_cm)]
        return run.ended

    # The second epoch was the best: two others have brought nothing.
    assert ended([3.0, 2.0, 2.5, 2.2], 2) and not ended([3.0, 2.0, 2.5], 2)
    assert not ended([3.0, 2.0, 2.5, 1.9], 2) and not ended([3.0, 2.0, 2.5, 2.2], 0)
    assert not ended([], 2) and ended([3.0, 2.0], 0, epochs=2)


def test_a_gpu_that_is_not_there_is_named(data, tmp_path):
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(ConfigError, match="device: cuda"):
        run(data, tmp_path / "gpu", TINY.model_copy(update={"device": "cuda"}))


def test_a_network_does_not_learn_from_the_truth(tmp_path):
    write_labels(tmp_path / "t.parquet", make_label_set(4, 0, source="truth"))
    with pytest.raises(LabelFormatError, match=r"t\.parquet.*truth"):
        train(LearnSettings(epochs=1), [tmp_path / "t.parquet"], [tmp_path / "t.parquet"], tmp_path / "run")
