"""The data sheet of the shipped network is what its checkpoint recorded, and what its settings draw."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

#: Twice 700 drives are drawn.
pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
#: The commit that brought the weights, which only the repository knows.
ADDED = "0b26523b02ab"
KEPT = ("run.yaml", "metrics.json", "results.json", "MODEL_CARD.md", "camera.yaml")


def written(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "contrib" / "data_sheet.py"), str(folder), "--added", ADDED]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)


def test_the_sheet_of_the_general_network_can_be_written_again(tmp_path):
    shipped = ROOT / "checkpoints" / "general"
    for name in KEPT:
        (tmp_path / name).write_bytes((shipped / name).read_bytes())
    done = written(tmp_path)
    assert done.returncode == 0, done.stderr
    for name in ("DATA_SHEET.md", "data_sheet.json"):
        assert (tmp_path / name).read_text() == (shipped / name).read_text()
    sheet = json.loads((tmp_path / "data_sheet.json").read_text())
    # 62042 frames at 20 a second.
    assert sheet["parts"]["train"]["minutes"] == pytest.approx(62042 / 20 / 60)
    assert f"its weights came with commit {ADDED}" in sheet["notes"][0]
    # Five cameras take turns.
    assert [camera["drives"] for camera in sheet["simulated"]["cameras"]] == [280, 140, 140, 140]
    # Settings of other drives are noticed.
    run = (tmp_path / "run.yaml").read_text()
    (tmp_path / "run.yaml").write_text(run.replace("    seed: 24\n", "    seed: 25\n", 1))
    done = written(tmp_path)
    assert done.returncode != 0 and "camera.yaml is not the camera that run.yaml gives" in done.stderr
