"""Runs of ``label-all`` in the test's own process, on a drive that is just long enough, and copies of it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from fleet_work import HereEngine

from datagen.fleet.checksums import with_checksums
from datagen.fleet.result import FleetResult
from datagen.fleet.run import label_all
from datagen.fleet.storage import Storage
from datagen.fleet.task import FleetDrive, FleetSettings
from datagen.quality.verdict import VerdictSettings
from datagen.settings import MapSettings

#: The least amounts are such that labels of the short drive are good.
SETTINGS = FleetSettings(
    map=MapSettings(find_bumper=False, verdict=VerdictSettings(min_frames=30, min_metres=1.0))
)
LANE_CM = 40.0


def drives_of(*paths: Path | str, names: tuple[str, ...] = ()) -> list[FleetDrive]:
    named = names or tuple(Path(path).name for path in paths)
    return [FleetDrive(name, str(path), "", LANE_CM) for name, path in zip(named, paths, strict=True)]


def run(
    out: Path | str, drives: list[FleetDrive], settings: FleetSettings = SETTINGS, **more: Any
) -> tuple[FleetResult, list[str]]:
    """Label drives in this process; returns the result and the names of the tasks."""
    storage, engine = Storage(str(out)), HereEngine()
    return label_all(with_checksums(drives, storage), settings, storage, engine, **more), engine.names


def copy_of(tiny: Path, path: Path) -> Path:
    """Copy a drive and make it another one."""
    shutil.copytree(tiny, path)
    (path / "note.txt").write_text(path.name)
    return path


def labels_in(out: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in out.glob("labels/*/labels.parquet")}
