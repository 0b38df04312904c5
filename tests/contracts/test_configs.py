from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lanenet.cli import run_settings_schema
from lanenet.config import check_settings, load_settings, read_yaml
from lanenet.errors import ConfigError

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
ALL_FILES = sorted(CONFIGS.rglob("*.y*ml"))


def read_training_run(path: Path) -> Any:
    return load_settings(run_settings_schema(), path)


def read_simulation(path: Path) -> Any:
    from datagen.world.simulate import SimulationSettings

    return load_settings(SimulationSettings, path)


def read_track(path: Path) -> Any:
    from datagen.world.track import load_track

    return load_track(path)


def read_camera_file(path: Path) -> Any:
    from lanenet.data.camera_file import read_camera

    return read_camera(path)


def read_detector_settings(path: Path) -> Any:
    from lanenet.onboard.detectors import build_detector, lane_filter_settings

    # The detector's name comes first in the file's.
    if path.stem.startswith("lane_filter"):
        return lane_filter_settings(path, drive_lane_width_cm=40.0)
    return build_detector(path.stem.partition("_")[0], None, config=path)  # type: ignore[arg-type]


def read_donkeycar_pilot(path: Path) -> Any:
    from lanenet.onboard.donkey import LanePilot

    return LanePilot.from_file(path)


def read_car(path: Path) -> Any:
    from lanenet.onboard.drive_settings import load_drive_settings

    return load_drive_settings(path)


#: What reads the YAML files of each folder below configs/.
READERS = {
    ".": read_training_run,
    "car": read_car,
    "drives": read_simulation,
    "tracks": read_track,
    "cameras": read_camera_file,
    "detectors": read_detector_settings,
    "donkeycar": read_donkeycar_pilot,
}


def test_the_config_of_the_readme_ships() -> None:
    assert CONFIGS / "small.yaml" in ALL_FILES


@pytest.mark.parametrize("path", ALL_FILES, ids=lambda path: str(path.relative_to(CONFIGS)))
def test_every_shipped_config_loads(path: Path) -> None:
    kind = str(path.parent.relative_to(CONFIGS))
    assert kind in READERS, f"say in this test what reads the files of configs/{kind}"
    READERS[kind](path)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.y*ml")), ids=lambda path: path.name)
def test_a_training_run_is_named_after_its_file(path: Path) -> None:
    # checkpoints/<name>/ then tells which config made it, and two configs never share a folder.
    assert read_training_run(path).name == path.stem


def test_the_lane_filters_files_are_the_default_and_the_paper() -> None:
    from lanenet.perception.birdseye import PerceptionSettings
    from lanenet.perception.lane_filter import PAPER, LaneFilterSettings

    default = read_detector_settings(CONFIGS / "detectors" / "lane_filter.yaml")
    assert default == (LaneFilterSettings(lane_width_cm=40.0), PerceptionSettings())
    filter_, perception = read_detector_settings(CONFIGS / "detectors" / "lane_filter_paper.yaml")
    assert filter_ == LaneFilterSettings(lane_width_cm=40.0, **PAPER)
    assert perception.edges.method == "canny"


def test_a_misspelt_key_is_named() -> None:
    data = read_yaml(CONFIGS / "small.yaml")
    with pytest.raises(ConfigError, match="'lern', did you mean 'learn'"):
        check_settings(run_settings_schema(), {**data, "lern": {}}, "small.yaml")
