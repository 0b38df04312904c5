"""Training on more label sets than fit into the memory that they are given."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic_labels import make_label_set

from lanenet.data import label_set
from lanenet.data.label_set import read_labels, read_places, write_labels
from lanenet.learn.checkpoint import choose_stream, hash_run, read_state
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.train import TrainingRun, train
from lanenet.reading import MEBIBYTE
from lanenet.samples.shards import StreamedSamples

torch.set_num_threads(1)

#: The training sets unpack to some 3 MB.
SETTINGS = LearnSettings(
    epochs=2, batch_size=16, memory_mb=1, balance="drive", network=NetworkSettings(channels=(4, 8), hidden=16)
)


class KilledError(Exception):
    pass


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(label_set, "GROUP_ROWS", 8)
        for name, n, seed in (("a", 70, 0), ("b", 40, 1), ("c", 50, 2), ("val", 40, 3)):
            labels, rng = make_label_set(n, seed), np.random.default_rng(seed)
            # As real edges, which no encoding makes smaller.
            edges = [edge + 1e-3 * rng.standard_normal(edge.shape) for edge in labels.edges]
            write_labels(folder / f"{name}.parquet", replace(labels, edges=edges))
    return [folder / f"{name}.parquet" for name in "abc"], [folder / "val.parquet"]


def test_training_from_shards_is_gone_on_with_exactly(data, tmp_path):
    shards = choose_stream(SETTINGS, *data)
    assert shards is not None
    samples, val = (StreamedSamples(part, MEBIBYTE) for part in shards)
    whole = TrainingRun(SETTINGS, samples)
    while not whole.ended:
        whole.run_epoch(val)

    def kill(epoch, *_):
        raise KilledError

    with pytest.raises(KilledError):
        train(SETTINGS, *data, tmp_path / "killed", kill)
    result = train(SETTINGS, *data, tmp_path / "killed")
    again = read_state(tmp_path / "killed" / "last.pt", hash_run(SETTINGS, *data))
    assert all(torch.equal(value, again.network[name]) for name, value in whole.network.state_dict().items())
    metrics = json.loads((result.folder / "metrics.json").read_text())
    assert (metrics["train_frames"], metrics["val_frames"]) == (160, 40)
    assert result.val_rmse_cm == pytest.approx(whole.history[result.best_epoch - 1].val_rmse_cm)


def test_the_memory_decides_a_run_only_where_it_is_too_small(data):
    large = SETTINGS.model_copy(update={"memory_mb": 500})
    larger = SETTINGS.model_copy(update={"memory_mb": 600})
    assert choose_stream(large, *data) is None
    assert hash_run(large, *data) == hash_run(larger, *data) != hash_run(SETTINGS, *data)
    assert hash_run(SETTINGS, *data) != hash_run(SETTINGS, data[0][:2], data[1])
    # How often the sets are shown decides the run; that all are shown alike is no news.
    even, uneven = [2.0] * len(data[0]), [0.3, *([1.0] * (len(data[0]) - 1))]
    assert hash_run(SETTINGS, *data) == hash_run(SETTINGS, *data, even) != hash_run(SETTINGS, *data, uneven)


def test_places_are_a_label_set_without_what_it_shows(data):
    whole, places = read_labels(data[0][0]), read_places(data[0][0])
    assert places.meta == whole.meta and places.drive == whole.drive and len(places) == len(whole)
    assert (places.poses == whole.poses).all() and not any(len(edges) for edges in places.edges)
