import csv
import sqlite3

import pytest
import torch
from synthetic_labels import make_label_set

from lanenet.data.label_set import write_labels
from lanenet.errors import ConfigError, LanenetError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn import sweep as sweep_module
from lanenet.learn.config import LearnSettings, LossSettings, NetworkSettings
from lanenet.learn.sweep import sweep, trials_csv, trials_table
from lanenet.learn.trunks.compact import SmallTrunk

torch.set_num_threads(1)

SETTINGS = LearnSettings(epochs=2, batch_size=16)
ROW = {
    "cell_cm": 0.75,
    "far_cm": 72.0,
    "half_width_cm": 48.0,
    "first_channels": 16,
    "layers": 4,
    "hidden": 64,
    "loss": "student",
    "evenness": 1.0,
    "learning_rate": 0.003,
    "parameters": 97310,
    "epochs": 8,
    "cpu_s": 41.2,
}


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    folder = tmp_path_factory.mktemp("labels")
    for name, seed in (("train", 0), ("val", 1)):
        write_labels(folder / f"{name}.parquet", make_label_set(40, seed))
    return [folder / "train.parquet"], [folder / "val.parquet"]


@pytest.fixture
def quick(monkeypatch):
    pytest.importorskip("optuna", reason="the extra 'sweep' is not installed")
    small = {"cell_cm": (3.0, 4.0), "first_channels": (4, 2), "layers": (2, 1), "hidden": (8, 4)}
    monkeypatch.setattr(sweep_module, "CHOICES", sweep_module.CHOICES | small)


def test_what_is_tried_first_is_the_small_network_as_it_is():
    first = {name: values[0] for name, values in sweep_module.CHOICES.items()}
    channels, hidden = SmallTrunk.default_channels, SmallTrunk.default_hidden
    assert [first["first_channels"] * k for k in range(1, first["layers"] + 1)] == list(channels)
    assert first["hidden"] == hidden
    assert (first["loss"], first["evenness"]) == ("bins", LossSettings().evenness)
    assert NetworkSettings(kind="small").bins > 0
    window = BirdseyeWindow()
    assert (first["cell_cm"], first["far_cm"], first["half_width_cm"]) == (
        window.cell_cm,
        window.far_cm,
        -window.left_cm,
    )


def read(folder):
    with (folder / "trials.csv").open() as file:
        return list(csv.DictReader(file))


def test_the_network_as_it_is_comes_first_and_a_later_call_goes_on(quick, paths, tmp_path):
    seen = []
    table = sweep(SETTINGS, *paths, tmp_path, 600.0, 2, lambda *done: seen.append(done))
    assert seen == [(1, 2), (2, 2)]
    rows = read(tmp_path)
    assert (rows[0]["cell_cm"], rows[0]["loss"], rows[0]["learning_rate"]) == ("3.0", "bins", "0.003")
    assert table == (tmp_path / "sweep.md").read_text() and "2 complete trials" in table
    sweep(SETTINGS, *paths, tmp_path, 600.0, 3, lambda *done: seen.append(done))
    assert seen[2:] == [(3, 3)]
    assert read(tmp_path)[:2] == rows and len(read(tmp_path)) == 3
    assert sqlite3.connect(tmp_path / "sweep.db").execute("select count(*) from trials").fetchone() == (3,)
    # Other data or settings are another search.
    sweep(SETTINGS.model_copy(update={"epochs": 1}), *paths, tmp_path, 600.0, 1)
    assert len(read(tmp_path)) == 1


def test_bins_and_the_weights_of_the_loss_are_kept_in_every_trial():
    optuna = pytest.importorskip("optuna", reason="the extra 'sweep' is not installed")
    first = {name: values[0] for name, values in sweep_module.CHOICES.items()}
    trial = optuna.trial.FixedTrial(first | {"learning_rate": SETTINGS.learning_rate})
    changes = {"network": NetworkSettings(bins=32), "loss": LossSettings(distance=0.7, presence=0.4)}
    _, chosen = sweep_module._draw(trial, SETTINGS.model_copy(update=changes))
    assert chosen.network.bins == 32 and chosen.loss == changes["loss"]


def test_a_network_that_is_told_the_width_is_told_it_in_every_trial():
    optuna = pytest.importorskip("optuna", reason="the extra 'sweep' is not installed")
    first = {name: values[0] for name, values in sweep_module.CHOICES.items()}
    trial = optuna.trial.FixedTrial(first | {"learning_rate": SETTINGS.learning_rate})
    for takes_width in (True, False):
        settings = SETTINGS.model_copy(update={"network": NetworkSettings(takes_width=takes_width)})
        _, chosen = sweep_module._draw(trial, settings)
        assert chosen.network.takes_width == takes_width
        # What is tried is all that is changed.
        assert chosen.network.channels == SmallTrunk.default_channels
        assert chosen.network.hidden == SmallTrunk.default_hidden
        assert chosen.model_copy(update={"network": settings.network}) == settings


def test_a_trial_that_time_cut_off_is_tried_again(quick, paths, tmp_path, monkeypatch):
    clock = iter([0.0, 0.0])
    with monkeypatch.context() as patch:
        patch.setattr(sweep_module.time, "monotonic", lambda: next(clock, 100.0))
        assert "0 complete trials" in sweep(SETTINGS, *paths, tmp_path, 60.0, 3)
    assert read(tmp_path) == []
    sweep(SETTINGS, *paths, tmp_path, 600.0, 1)
    assert [(row["trial"], row["learning_rate"]) for row in read(tmp_path)] == [("1", "0.003")]


def test_a_killed_trial_is_tried_again(quick, paths, tmp_path, monkeypatch):
    class KilledError(Exception):
        pass

    def die(*_):
        raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(sweep_module, "_try", die)
        with pytest.raises(KilledError):
            sweep(SETTINGS, *paths, tmp_path, 600.0, 1)
    sweep(SETTINGS, *paths, tmp_path, 600.0, 1)
    (row,) = read(tmp_path)
    assert (row["cell_cm"], row["state"], row["learning_rate"]) == ("3.0", "complete", "0.003")


def test_a_diverging_trial_is_given_up(quick, paths, tmp_path, monkeypatch):
    def diverge(*_):
        raise LanenetError("training diverged")

    monkeypatch.setattr(sweep_module.TrainingRun, "run_epoch", diverge)
    assert "1 stopped early" in sweep(SETTINGS, *paths, tmp_path, 600.0, 1)


def test_tables():
    rows = [
        {"trial": 0, "state": "complete", "val_rmse_cm": 0.9312, **ROW},
        {"trial": 1, "state": "complete", "val_rmse_cm": 0.8, **ROW, "loss": "laplace"},
        {"trial": 2, "state": "complete", "val_rmse_cm": 1.1, **ROW},
        {"trial": 3, "state": "pruned", "val_rmse_cm": None, **ROW, "epochs": 3},
    ]
    lines = trials_table(rows, ("loss", "cell_cm")).splitlines()
    assert lines[0].startswith("3 complete trials, 1 stopped early")
    assert lines[4].startswith("| 0.8 | 0.75 | 72 | 48 | 16 | 4 | 64 | laplace | 1 | 0.003 | 97310 | 8 |")
    assert (
        "| loss | student | 2 | 0.931 | 1.016 |" in lines
        and "| loss | laplace | 1 | 0.800 | 0.800 |" in lines
    )
    table = list(csv.DictReader(trials_csv(rows).splitlines()))
    assert [row["val_rmse_cm"] for row in table] == ["0.9312", "0.8", "1.1", ""]
    assert table[3]["state"] == "pruned" and table[1]["loss"] == "laplace"


def test_without_trials_there_is_a_table_without_rows():
    assert trials_table([], ("loss",)).startswith("0 complete trials, 0 stopped early")


def test_alexnet_is_refused_before_anything_is_read(tmp_path):
    settings = LearnSettings(network=NetworkSettings(kind="alexnet"))
    with pytest.raises(ConfigError, match="alexnet"):
        sweep(settings, [tmp_path / "none.parquet"], [tmp_path / "none.parquet"], tmp_path, 1.0, 1)
    assert not list(tmp_path.iterdir())
