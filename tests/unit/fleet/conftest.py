"""A drive that is just long enough, its map and labels, and a mapping that copies them."""

from __future__ import annotations

import errno
import json
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
from fleet_runs import SETTINGS, drives_of

from datagen.fleet import work
from datagen.fleet.checksums import with_checksums
from datagen.fleet.local_engine import LocalEngine
from datagen.fleet.run import label_all
from datagen.fleet.storage import Storage
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.errors import LanenetError, TrackingLostError


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated drive that is just long enough."""
    camera = {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0}
    track = {"left": {}, "right": {}, "interruptions_per_m": 0.0}
    settings = {"seed": 1, "frames": 70, "camera": camera, "track": track}
    folder = tmp_path_factory.mktemp("drives") / "tiny"
    return simulate_drive(SimulationSettings.model_validate(settings), folder)


@pytest.fixture(scope="session")
def labelled(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The storage of the tiny drive, labelled by a process of its own."""
    out = tmp_path_factory.mktemp("labelled") / "out"
    storage = Storage(str(out))
    result = label_all(with_checksums(drives_of(tiny), storage), SETTINGS, storage, LocalEngine(1))
    assert [drive.verdict for drive in result.drives] == ["good"]
    return out


@pytest.fixture
def mapping(monkeypatch: pytest.MonkeyPatch, labelled: Path) -> list[str]:
    """Instead of mapping, copy the tiny drive's map, or fail as the drive's name says; notes the names."""
    (ready,) = (labelled / "maps").iterdir()
    mapped: list[str] = []

    def copy(request: Any, settings: Any, out: Path, **_: Any) -> Any:
        name = request.drive_path.name
        mapped.append(name)
        if "lost" in name:
            raise TrackingLostError(f"{request.drive_path}: the car stands still")
        if "bug" in name:
            raise ZeroDivisionError("by zero")
        if "memory" in name:
            raise MemoryError
        if "full" in name:
            raise LanenetError(f"{out}: cannot be written") from OSError(errno.ENOSPC, "No space left")
        shutil.copytree(ready, out, dirs_exist_ok=True)
        verdict = {"reasons": ["as good as it looks"]}
        if "reject" in name:
            report = json.loads((out / "report.json").read_text())
            report["verdict"] |= {"grade": "reject", "sentence": "the lines are not where they seem"}
            (out / "report.json").write_text(json.dumps(report))
        return type("Report", (), {"figures": {"verdict": verdict}})()

    monkeypatch.setattr(work, "map_drive", copy)
    return mapped
