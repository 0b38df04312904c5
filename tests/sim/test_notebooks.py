"""The notebooks run from top to bottom: their code cells in order, with the paths and sizes of the test."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
import yaml

from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings

REPO = Path(__file__).resolve().parents[2]
NOTEBOOKS = REPO / "docs" / "notebooks"


@pytest.fixture(autouse=True)
def no_windows() -> Iterator[None]:
    before = matplotlib.get_backend()
    plt.switch_backend("agg")
    yield
    plt.close("all")
    plt.switch_backend(before)


def run_notebook(name: str, **parameters: Any) -> dict[str, Any]:
    """Run a notebook and return its names; the parameters take the place of its own."""
    cells = json.loads((NOTEBOOKS / name).read_text(encoding="utf-8"))["cells"]
    names: dict[str, Any] = {"__name__": "notebook"}
    for number, cell in enumerate(cells):
        if cell["cell_type"] != "code":
            continue
        assert not cell["outputs"], f"{name}: is kept without outputs"
        exec(compile("".join(cell["source"]), f"{name}, cell {number}", "exec"), names)
        if "parameters" in cell["metadata"].get("tags", ()):
            assert parameters.keys() <= names.keys()
            names |= parameters
    return names


def test_what_the_network_sees(capsys: pytest.CaptureFixture[str]) -> None:
    # With the paths of the notebook itself.
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(NOTEBOOKS)
        names = run_notebook("what_the_network_sees.ipynb")
    assert len(plt.get_fignums()) == 4
    whole, covered, untold = names["answers"].values()
    assert whole.presence.min() > 0.9 and covered.presence[1] < 0.5 < covered.presence[0]
    # As the text says.
    assert covered.sigma_cm[3:].max() < 2.0 * whole.sigma_cm[3:].max()
    guessed = untold.mask[3:]
    assert (untold.sigma_cm[3:] > 2.0 * covered.sigma_cm[3:])[guessed].all() and not guessed.all()
    # Rows above the road do not count, the road does.
    assert names["moved_cm"][0] < 0.1 < 1.0 < np.nanmax(names["moved_cm"])
    assert "left  x =" in capsys.readouterr().out


@pytest.mark.slow
def test_own_tub_to_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # Fewer frames give no map, and these no good labels.
    settings = SimulationSettings(frames=60, seed=3)
    simulate_drive(settings, tmp_path / "tub")
    monkeypatch.chdir(tmp_path)
    split = "split: time, gap_frames: 2"
    names = run_notebook(
        "own_tub_to_model.ipynb", project=REPO, tub="tub", work=Path("car"), split=split, epochs=1
    )
    assert names["found"].figures["verdict"]["grade"] == "usable"
    assert names["checkpoint"] == Path("car/my_car")
    run = yaml.safe_load((tmp_path / "car" / "my_car" / "run.yaml").read_text())
    assert run["learn"]["epochs"] == 1 and run["data"]["drives"][0]["path"] == "car/map"
    # The finished map is used.
    assert not list((tmp_path / "car" / "drives").rglob("map.yaml"))
    points_cm = np.array([answer.points_cm for answer in names["answers"].values()])
    assert np.isfinite(points_cm).mean() > 0.9
    assert np.nanmedian(points_cm[:, 4] - points_cm[:, 1]) == pytest.approx(40.0, abs=3.0)
    assert "verdict: usable: the drive is short" in capsys.readouterr().out
