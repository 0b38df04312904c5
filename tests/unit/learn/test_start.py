from pathlib import Path

import numpy as np
import pytest
import torch
from synthetic_labels import WINDOW, make_label_set

from lanenet.data.label_set import write_labels
from lanenet.errors import CheckpointError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn.checkpoint import check_start, hash_run, load_start_weights, publish
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.export import read_network
from lanenet.learn.network import new_network
from lanenet.learn.train import train
from lanenet.perception.edges.road import PerceptionSettings, RangeSettings

SEEN = PerceptionSettings()
TINY = LearnSettings(epochs=3, batch_size=16, threads=1, network=NetworkSettings(channels=(4, 8), hidden=16))


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    write_labels(folder / "train.parquet", make_label_set(300, 0))
    write_labels(folder / "val.parquet", make_label_set(60, 1))
    return [folder / "train.parquet"], [folder / "val.parquet"]


@pytest.fixture(scope="module")
def checkpoint(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("start")
    result = train(TINY.model_copy(update={"epochs": 12}), *data, folder / "run")
    publish(result.folder, folder / "start", "start", {})
    return folder / "start"


def test_the_weights_are_those_of_the_checkpoint(checkpoint):
    network = new_network(TINY.network, WINDOW.rows, WINDOW.columns, 7)
    load_start_weights(network, checkpoint, WINDOW, SEEN)
    expected = read_network(checkpoint)[0].state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in network.state_dict().items())


def test_fine_tuning_begins_where_the_checkpoint_ended(data, checkpoint, tmp_path):
    # A rate of nearly nothing keeps the weights; a network that starts anew is far off after one epoch.
    one = TINY.model_copy(update={"epochs": 1, "learning_rate": 1e-9, "ema_decay": 0.0})
    tuned = train(one.model_copy(update={"start_from": checkpoint}), *data, tmp_path / "tuned")
    anew = train(one, *data, tmp_path / "anew")
    publish(tuned.folder, tmp_path / "p", "p", {})
    after = read_network(tmp_path / "p")[0].state_dict()
    for name, value in read_network(checkpoint)[0].named_parameters():
        # Where presence begins (the last two) is set anew after each training.
        told = slice(-2) if name == "head.2.bias" else slice(None)
        np.testing.assert_allclose(after[name][told].numpy(), value[told].detach().numpy(), atol=1e-5)
    assert tuned.val_rmse_cm < 0.8 * anew.val_rmse_cm


def test_other_weights_are_another_run(data, checkpoint, tmp_path):
    settings = TINY.model_copy(update={"start_from": checkpoint})
    first = hash_run(settings, *data)
    assert first != hash_run(TINY, *data) and first == hash_run(settings, *data)
    kept = (checkpoint / "weights.safetensors").read_bytes()
    try:
        (checkpoint / "weights.safetensors").write_bytes(kept + b" ")
        assert hash_run(settings, *data) != first
    finally:
        (checkpoint / "weights.safetensors").write_bytes(kept)
    with pytest.raises(CheckpointError, match=r"start_from .*gone: no weights.safetensors"):
        hash_run(TINY.model_copy(update={"start_from": Path(tmp_path / "gone")}), *data)


def test_what_does_not_fit_is_refused(checkpoint):
    network = new_network(TINY.network, WINDOW.rows, WINDOW.columns, 0)
    with pytest.raises(CheckpointError, match=r"data\.window"):
        load_start_weights(network, checkpoint, BirdseyeWindow(cell_cm=1.0), SEEN)
    other = new_network(NetworkSettings(channels=(4, 12), hidden=16), WINDOW.rows, WINDOW.columns, 0)
    with pytest.raises(CheckpointError, match=r"found weights .*shape .*learn.network"):
        load_start_weights(other, checkpoint, WINDOW, SEEN)
    # The rows that a car has to leave out are its own affair, how edges are found is not.
    hidden = SEEN.model_copy(update={"range": RangeSettings(bottom_rows=9)})
    load_start_weights(network, checkpoint, WINDOW, hidden)
    with pytest.raises(CheckpointError, match=r"data\.colour_weight"):
        load_start_weights(network, checkpoint, WINDOW, SEEN.with_colours())
    # The same before there are any data; one drive of several is enough.
    settings = TINY.model_copy(update={"start_from": checkpoint})
    check_start(settings, WINDOW, [SEEN, hidden])
    with pytest.raises(CheckpointError, match=r"data\.colour_weight"):
        check_start(settings, WINDOW, [SEEN, SEEN.with_colours()])
    check_start(TINY, BirdseyeWindow(cell_cm=1.0), [SEEN.with_colours()])
