"""What ``lanenet train`` makes of drives, maps and label sets of one's own."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import yaml
from drives import record, write_drive, write_tub
from small_map import small_map
from synthetic_labels import make_label_set
from typer.testing import CliRunner

from datagen.datasets.jobs import RecordedJob
from datagen.datasets.settings import DataSettings, RecordedSettings
from datagen.made import Output
from datagen.pipeline import MapRequest, map_key
from datagen.settings import MapSettings
from lanenet.cli.app import app
from lanenet.cli.shared import console
from lanenet.cli.shared.own_drive import (
    Measured,
    check_name,
    check_paths,
    epochs_of,
    learned_from,
    own_config,
    parts_of,
    sources_in,
)
from lanenet.cli.shared.stages import Stages, stopped_in
from lanenet.cli.train import _Run, expected_s, gain_line, run_settings_schema
from lanenet.config import apply_overrides, check_settings
from lanenet.data.drives import open_drive
from lanenet.data.label_set import write_labels
from lanenet.data.maps.folder import write_map
from lanenet.errors import ConfigError, DriveFormatError, LanenetError
from lanenet.evaluation.comparison import SharedErrors
from lanenet.evaluation.errors import error_stats

GENERAL = Path(__file__).resolve().parents[3] / "checkpoints" / "general"

NO_CONFIG = Path("none.yaml")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is the working folder."""
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def config_of(*paths: Path, overrides: tuple[str, ...] = (), **measured: Any) -> dict[str, Any]:
    return own_config("mine", paths, Measured(**measured), overrides, Path("runs"))


def mapped(folder: Path) -> Path:
    write_map(folder, small_map(), {"frame": np.arange(2)}, {}, "given")
    return folder


def settings_of(config: dict[str, Any]) -> Any:
    return check_settings(run_settings_schema(), config, "test")


def test_a_tub_and_what_was_measured_become_a_config_that_starts_from_general(here: Path) -> None:
    tub = write_tub(here / "tub", [record(k) for k in range(5)])
    config = config_of(Path("tub"), lane_width_cm=40.0, tape_width_cm=2.0, frames=(1, 3))
    (drive,) = config["data"]["drives"]
    assert drive == {
        "path": str(tub),
        **{"lane_width_cm": 40.0, "tape_width_cm": 2.0, "frames": [1, 3]},
        **{"split": "auto", "gap_cm": 100.0},
    }
    settings = settings_of(config)
    assert settings.learn.start_from == GENERAL and settings.learn.network.planes == 5
    assert settings.data.window.rows == 96
    # From any folder.
    assert yaml.safe_load(yaml.safe_dump(config)) == config
    changed = config_of(Path("tub"), lane_width_cm=40.0, overrides=("learn.epochs=3", "data.colour_weight=0"))
    assert settings_of(changed).learn.epochs == 3 and settings_of(changed).data.colour_weight == 0.0
    with pytest.raises(ConfigError, match="tub: expected --lane-width"):
        config_of(Path("tub"))


def test_a_setting_of_one_drive_is_replaced_by_its_number(here: Path) -> None:
    plain = {"drives": [{"path": "a"}, {"path": "b", "split": "auto"}]}
    assert apply_overrides(plain, ["drives.1.split=lap"])["drives"] == [
        {"path": "a"},
        {"path": "b", "split": "lap"},
    ]
    assert plain["drives"][1]["split"] == "auto"
    for key in ("drives.2.split", "drives.first.split", "drives.2"):
        with pytest.raises(ConfigError, match=f"override '{key}=lap': .* is no entry of a list of 2"):
            apply_overrides(plain, [f"{key}=lap"])


def test_few_frames_are_shown_more_often() -> None:
    # 600 of 1000 frames are learned from, 32 at a step.
    assert epochs_of(1000) * 600 / 32 == pytest.approx(1600, rel=0.02)
    assert epochs_of(100) == 100 and epochs_of(100_000) == 20


def test_a_folder_stands_for_the_drives_and_maps_in_it(here: Path) -> None:
    for name in ("lap_10", "lap_2"):
        write_drive(here / "data" / name, 2)
    mapped(here / "data" / "map")
    write_labels(here / "data" / "labels.parquet", make_label_set(2, 0))
    # In the order in which people count.
    assert sources_in(Path("data")) == [Path("data/lap_2"), Path("data/lap_10"), Path("data/map")]
    assert sources_in(Path("data/labels.parquet")) == [Path("data/labels.parquet")]
    with pytest.raises(DriveFormatError, match="no such drive, map, label set or config"):
        sources_in(Path("dat"))
    (here / "mycar").mkdir()
    shutil.move(here / "data", here / "mycar" / "data")
    with pytest.raises(
        DriveFormatError, match="there are drives in it: type mycar/data/lap_2, mycar/data/lap_10"
    ):
        sources_in(Path("mycar"))
    with pytest.raises(DriveFormatError, match="the folder above it: type mycar/data/lap_10"):
        sources_in(Path("mycar/data/lap_10/images"))


def test_maps_and_label_sets_know_their_lane(here: Path) -> None:
    mapped(here / "map")
    write_labels(here / "labels.parquet", make_label_set(300, 0))
    drives = config_of(Path("map"), Path("labels.parquet"))["data"]["drives"]
    assert [(drive["path"], drive["lane_width_cm"]) for drive in drives] == [
        (str(here / "map"), 36.0),
        (str(here / "labels.parquet"), 40.0),
    ]
    with pytest.raises(ConfigError, match="--lane-width: is for a drive to be mapped, but map is finished"):
        config_of(Path("map"), lane_width_cm=40.0)
    # Beside a drive it is that drive's.
    write_drive(here / "drive", 2)
    drives = config_of(Path("map"), Path("drive"), lane_width_cm=50.0)["data"]["drives"]
    assert [drive["lane_width_cm"] for drive in drives] == [36.0, 50.0]


def test_a_map_that_another_command_made_is_used(here: Path) -> None:
    drive = write_drive(here / "drive", 2)
    marker = Output(
        mapped(here / "runs" / "lap") / "map.yaml", map_key(MapRequest(drive, 40.0), MapSettings())
    )
    marker.mark()
    assert config_of(drive, lane_width_cm=40.0)["data"]["drives"][0]["path"] == str(here / "runs" / "lap")
    # Not one of other settings, or of a drive that has changed.
    assert config_of(drive, lane_width_cm=41.0)["data"]["drives"][0]["path"] == str(drive)
    (drive / "drive.yaml").touch()
    assert config_of(drive, lane_width_cm=40.0)["data"]["drives"][0]["path"] == str(here / "runs" / "lap")
    image = next((drive / "images").iterdir())
    image.write_bytes(image.read_bytes() + b"x")
    assert config_of(drive, lane_width_cm=40.0)["data"]["drives"][0]["path"] == str(drive)


def test_a_network_of_another_drive_is_kept(here: Path) -> None:
    def trained(*drives: Path) -> Path:
        folder = here / "checkpoints" / "mine"
        folder.mkdir(parents=True, exist_ok=True)
        run = {"data": {"drives": [{"path": str(drive)} for drive in drives]}}
        (folder / "run.yaml").write_text(json.dumps(run))
        return folder

    one, other = write_drive(here / "one", 2), write_drive(here / "other", 2)
    check_name(here / "checkpoints" / "mine", NO_CONFIG, [one])
    checkpoint = trained(other)
    assert learned_from(checkpoint / "run.yaml") == {other}
    with pytest.raises(LanenetError, match=f"the name is taken by a network of {other}.*--force"):
        check_name(checkpoint, NO_CONFIG, [one])
    check_name(checkpoint, NO_CONFIG, [one, other])
    # A map stands for its drive, and simulated drives for each other.
    folder = mapped(here / "map")
    plain = yaml.safe_load((folder / "map.yaml").read_text())
    (folder / "map.yaml").write_text(yaml.safe_dump({**plain, "drive": str(other)}))
    check_name(checkpoint, NO_CONFIG, [folder])
    with pytest.raises(LanenetError, match="taken by a network of"):
        check_name(checkpoint, NO_CONFIG, [])
    check_name(trained(), NO_CONFIG, [])
    with pytest.raises(LanenetError, match="taken by a network of simulated drives"):
        check_name(checkpoint, NO_CONFIG, [one])


def test_a_config_from_another_folder_says_where_its_paths_are(here: Path, tmp_path: Path) -> None:
    project = tmp_path / "pro ject"
    (project / "configs").mkdir(parents=True)
    (project / "drive").mkdir()
    config = project / "configs" / "mine.yaml"
    with pytest.raises(
        ConfigError, match=r"drive is not in .*here: type cd '.*/pro ject' && lanenet train configs/mine.yaml"
    ):
        check_paths(config, [None, Path("drive")])
    # The folder that has most of them.
    (tmp_path / "network").mkdir()
    (project / "network").mkdir()
    (tmp_path / "camera.yaml").touch()
    paths = [Path("camera.yaml"), Path("drive"), Path("network"), Path("nowhere")]
    with pytest.raises(ConfigError, match=r"type cd '.*/pro ject' && "):
        check_paths(config, paths[1:])
    shutil.rmtree(project / "network")
    with pytest.raises(ConfigError, match=r"type cd \S*test_a_config\S* && lanenet train 'pro ject/configs"):
        check_paths(config, [paths[0], paths[2], paths[1]])
    # What is nowhere has its own error, and so has a full path.
    check_paths(config, [Path("nowhere"), tmp_path / "nowhere"])
    (here / "drive").mkdir()
    check_paths(config, [Path("drive")])


def test_words_are_sources_or_settings(here: Path) -> None:
    (here / "a=b").mkdir()
    assert parts_of(["tub", "a=b", "learn.epochs=3"]) == ([Path("tub"), Path("a=b")], ["learn.epochs=3"])


def test_a_drive_that_is_too_short_is_named_before_others_are_mapped(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_drive(here / "long", 60)
    write_drive(here / "short", 3)

    def mapped(*_: object, **__: object) -> None:
        raise AssertionError("the first one is mapped")

    monkeypatch.setattr("datagen.datasets.jobs.map_drive", mapped)
    words = ["train", "long", "short", "--lane-width", "40", "--name", "a"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 1 and "short: found 3 frames of a car that drives" in result.stderr


def test_a_lane_unlike_those_that_the_network_knows_is_warned_of_at_once(here: Path) -> None:
    """As lanenet detect does; not after the minutes that mapping takes."""
    write_drive(here / "short", 3)
    words = ["train", "short", "--name", "a", "--lane-width"]
    for width, warned in (("100", True), ("40", False)):
        result = CliRunner().invoke(app, [*words, width, "--force"])
        assert result.exit_code == 1 and "short: found 3 frames" in result.stderr
        assert ("lane width 100 cm: " in result.stderr) == warned
    assert "was trained on lanes of" in CliRunner().invoke(app, [*words, "100", "--force"]).stderr


def test_the_lane_width_of_a_finished_map_is_corrected_by_map(here: Path) -> None:
    folder = mapped(here / "map")
    with pytest.raises(
        ConfigError, match=r"is finished; to map it anew: lanenet map .* --lane-width 41 --out"
    ):
        config_of(folder, lane_width_cm=41.0)
    with pytest.raises(ConfigError, match=r"is finished$"):
        config_of(folder, wheelbase_cm=26.0)


def test_photos_are_no_drive_and_that_is_said(here: Path) -> None:
    (here / "photos").mkdir()
    for name in ("a.jpg", "b.PNG", "notes.txt"):
        (here / "photos" / name).write_bytes(b"")
    with pytest.raises(DriveFormatError, match=r"it holds 2 images without a frames\.csv"):
        open_drive(here / "photos")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["drive", "--lane-width", "40"], "as in --name drive"),
        (["learn.epochs=3", "--name", "a"], "expected a drive, a map, a label set or a config"),
        (["mine.yaml", "--name", "a"], "--name: is for drives, but mine.yaml is a config"),
        (["mine.yaml", "--frames", "1:3"], "--frames: is for drives, but mine.yaml is a config"),
        (["drive", "--lane-width", "40", "--name", "a", "learn.epochz=3"], "unknown key 'learn.epochz'"),
        (["drive", "--lane-width", "40", "--name", "../a"], "key 'name': expected letters"),
        (["none", "--lane-width", "40", "--name", "a"], "none: no such drive"),
        (["drive", "--lane-width", "40", "--name", "a", "learn.start_from=b"], "b: no such folder"),
    ],
)
def test_what_cannot_be_trained_is_one_line(here: Path, words: list[str], said: str) -> None:
    write_drive(here / "drive", 2)
    (here / "mine.yaml").write_text("name: mine\n")
    result = CliRunner().invoke(app, ["train", *words])
    assert result.exit_code == 1 and said in result.stderr and len(result.stderr.splitlines()) == 1
    assert sorted(path.name for path in here.iterdir()) == ["drive", "mine.yaml"]


def test_stages_say_what_is_left_at_the_speed_so_far(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    now_s = [0.0]
    monkeypatch.setattr("lanenet.cli.shared.stages.time.monotonic", lambda: now_s[0])
    log = tmp_path / "train.log"
    with console.log_file(log):
        stages = Stages({"map": 60.0, "train": 30.0})
        with stages.begin("map"):
            now_s[0] = 120.0
        assert stopped_in(log) == "map"
        with stages.begin("train"):
            now_s[0] = 180.0
        assert stopped_in(log) == "train"
        stages.finish()
    assert capsys.readouterr().out.splitlines() == [
        "[1/2] map: about 1 min 30 s left in all",
        "  map took 2 min 00 s",
        "[2/2] train: about 1 min 00 s left in all",
        "  train took 1 min 00 s",
        "all stages are done: 3 min 00 s",
    ]
    assert stopped_in(log) is None and stopped_in(tmp_path / "other.log") is None
    with pytest.raises(LanenetError), console.log_file(log), Stages({"map": 0.0}).begin("map"):
        raise LanenetError("no lane")
    assert stopped_in(log) == "map"
    assert log.read_text().splitlines()[-2][20:] == "[1/1] map"
    assert log.read_text().splitlines()[-1].endswith(" error: no lane")


def test_a_finished_map_takes_no_time(here: Path) -> None:
    from datagen.datasets.build import recorded_jobs

    write_drive(here / "drive", 40)
    stages = {}
    for path, options in ((Path("drive"), {"lane_width_cm": 40.0}), (mapped(here / "map"), {})):
        settings = settings_of(config_of(path, **options))
        stages[path.name] = expected_s(settings, recorded_jobs(settings.data, here / "work"))
    assert list(stages["map"]) == ["map", "label", "train", "test", "export", "video"]
    assert stages["map"]["map"] == 0.0 < stages["drive"]["map"]
    simulated = settings_of({"name": "a", "data": {"synthetic": {"train": 1, "validation": 1}}})
    assert not any(expected_s(simulated, []).values()) and "map" not in expected_s(simulated, [])


def test_labels_of_a_rejected_map_are_warned_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for verdict in ("usable", "reject"):
        labels = make_label_set(4, 0)
        path = tmp_path / f"{verdict}.parquet"
        write_labels(path, replace(labels, meta=replace(labels.meta, verdict=verdict)))
        job = RecordedJob(RecordedSettings(path=path, lane_width_cm=40.0), DataSettings(), tmp_path)
        _Run._map(cast(_Run, None), job)
        said = capsys.readouterr().err.count(f"{path}: the map of these labels was rejected")
        assert said == (verdict == "reject")


def test_the_config_of_another_drives_run_is_not_written_over(tmp_path: Path) -> None:
    one, other, config = tmp_path / "one", tmp_path / "other", tmp_path / "mine.yaml"
    config.write_text(f"data:\n  drives:\n  - path: {one}\n")
    check_name(tmp_path / "none", config, [one])
    with pytest.raises(LanenetError, match=r"taken by a network of .*one; .*--force"):
        check_name(tmp_path / "none", config, [other])


@pytest.mark.parametrize(
    ("after_cm", "said"),
    [
        ([0.1, 0.1, 0.4], "the training has made it better"),
        ([0.3, 0.3, 2.0], "the training has not made it better"),
        ([0.1, 0.1, 2.0], "neither is better in both"),
        # What is printed decides: a median of 0.20 cm is none that is worse than 0.20 cm.
        ([0.204, 0.204, 0.5], "the training has made it better"),
        ([0.196, 0.196, 2.0], "the training has not made it better"),
    ],
)
def test_train_says_whether_it_was_worth_it(after_cm, said):
    known = np.ones((1, 3), dtype=bool)
    errors_cm = np.array([[[0.2, 0.2, 1.0]], [after_cm]])
    before, after = (error_stats(error_cm, known, known) for error_cm in errors_cm)
    line = gain_line("general", SharedErrors(own=before, first=after))
    assert line.endswith(said)
    assert "general, which it started from, has a median error of 0.20 cm (RMSE 0.60)" in line
