"""The package in Python: a model in three lines, and commands as functions."""

from __future__ import annotations

import ast
import inspect
import logging
import re
import shutil
from pathlib import Path
from typing import Any, assert_type

import cv2
import numpy as np
import pytest
from drives import write_drive  # type: ignore[import-not-found]
from typer.testing import CliRunner

import lanenet
from datagen.pipeline import MapRequest, MapSettings
from lanenet.cli import train as train_command
from lanenet.cli.app import app
from lanenet.data.camera_file import read_camera
from lanenet.errors import CalibrationError, ConfigError, LanenetError, ModelMismatchError
from lanenet.perception.estimate import DetectorInputs, LaneEstimate
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.registry import build_detector

CHECKPOINTS = Path(__file__).resolve().parents[2] / "checkpoints"
SMALL, GENERAL = CHECKPOINTS / "small", CHECKPOINTS / "general"


def example(checkpoint: Path) -> Any:
    image = cv2.imread(str(checkpoint / "example.jpg"))
    assert image is not None
    return image


def test_three_lines_give_the_lane_that_the_commands_see() -> None:
    image = example(GENERAL)
    model = lanenet.load(str(GENERAL), camera=str(GENERAL / "camera.yaml"), lane_width_cm=40)
    lanes = model(image)
    # What type checkers know: mypy looks at this file, too.
    assert_type(model, NetworkDetector)
    assert_type(lanes, LaneEstimate)
    camera = read_camera(GENERAL / "camera.yaml")
    detector = build_detector("network", DetectorInputs(camera=camera, model=GENERAL, lane_width_cm=40.0))
    same = detector.detect(image)
    assert np.isfinite(lanes.points_cm).all()
    np.testing.assert_array_equal(lanes.points_cm, same.points_cm)
    assert (lanes.steering_rad, lanes.confidence) == (same.steering_rad, same.confidence)
    # As users of other libraries turn RGB around, without a copy.
    model.reset()
    np.testing.assert_array_equal(model(image[..., ::-1].copy()[..., ::-1]).points_cm, lanes.points_cm)


@pytest.mark.parametrize("of", ["file", "camera", "map", "none", "onnx"])
def test_a_camera_may_be_given_in_many_ways(
    of: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = SMALL / "camera.yaml"
    shutil.copy(path, tmp_path)
    (tmp_path / "map.yaml").write_text("verdict: good\n")
    given: Any = {"file": path, "camera": read_camera(path), "map": tmp_path}.get(of)
    with caplog.at_level(logging.WARNING):
        model = lanenet.load(SMALL / "model.onnx" if of == "onnx" else SMALL, camera=given)
    assert np.isfinite(model(example(SMALL)).points_cm).all()
    # The camera beside this model is the only one that it was trained with.
    assert not model.problems and not caplog.records


def test_a_network_for_many_cameras_has_to_be_told_which() -> None:
    with pytest.raises(CalibrationError, match=r"general: .*several cameras.*expected camera=\.\.\. with"):
        lanenet.load(GENERAL, lane_width_cm=40)


def test_what_cannot_be_loaded_says_why(tmp_path: Path) -> None:
    shutil.copy(SMALL / "model.onnx", tmp_path)
    with pytest.raises(CalibrationError, match=r"expected a camera \(camera=\.\.\.\)"):
        lanenet.load(tmp_path)
    with pytest.raises(ConfigError, match=r"0\.4 m are 40 cm"):
        lanenet.load(SMALL, lane_width_cm=0.4)
    with pytest.raises(ModelMismatchError, match="any_camera"):
        lanenet.load(SMALL, camera=GENERAL / "camera.yaml")
    lanenet.load(SMALL, camera=GENERAL / "camera.yaml", any_camera=True)
    with pytest.raises(ModelMismatchError, match="no such file"):
        lanenet.load(tmp_path / "none")


def test_map_hands_on_what_it_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[tuple[Any, ...]] = []
    monkeypatch.setattr("datagen.pipeline.map_drive", lambda *args: asked.append(args))
    file = tmp_path / "map.yaml"
    file.write_text("seed: 7\n")
    settings = MapSettings(seed=7)
    for config in (file, str(file), {"seed": 7}, settings):
        lanenet.map("tub", "m", lane_width_cm=38.5, camera="c.yaml", config=config, tape_width_cm=1.9)
        request = MapRequest(Path("tub"), 38.5, Path("c.yaml"), tape_width_cm=1.9)
        assert asked.pop()[:3] == (request, settings, Path("m"))
    lanenet.map("tub", "m", lane_width_cm=38.5)
    assert asked.pop()[:2] == (MapRequest(Path("tub"), 38.5), MapSettings())
    lanenet.map("tub", "m", lane_width_cm=38.5, frames=(7, 9))
    assert asked.pop()[0] == MapRequest(Path("tub"), 38.5, frames=(7, 9))
    (tmp_path / "map.yaml").write_text("drive: other\n")
    with pytest.raises(LanenetError, match="the map of another drive, other"):
        lanenet.map("tub", tmp_path, lane_width_cm=38.5)
    assert not asked
    lanenet.map("tub", tmp_path, lane_width_cm=38.5, force=True)
    lanenet.map("other", tmp_path, lane_width_cm=38.5)
    assert len(asked) == 2
    asked.clear()
    with pytest.raises(ConfigError, match="unknown key 'sed'"):
        lanenet.map("tub", "m", lane_width_cm=38.5, config={"sed": 7})
    with pytest.raises(ConfigError, match=r"0\.38 m are 38 cm"):
        lanenet.map("tub", "m", lane_width_cm=0.38)
    assert not asked


def test_map_refuses_what_is_no_drive(tmp_path: Path) -> None:
    with pytest.raises(LanenetError, match="nothing"):
        lanenet.map(tmp_path / "nothing", tmp_path / "map", lane_width_cm=40)
    assert not (tmp_path / "map").exists()


def test_train_takes_a_config_as_a_file_or_as_values(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[Any] = []

    def train_run(settings: Any, marking: float | None, force: bool) -> Path:
        asked.append((settings, marking, force))
        return Path(settings.checkpoints_dir / settings.name)

    monkeypatch.setattr(train_command, "train_run", train_run)
    file = tmp_path / "run.yaml"
    file.write_text("name: mine\ndata: {synthetic: {train: 1, validation: 1}}\n")
    values = {"name": "mine", "data": {"synthetic": {"train": 1, "validation": 1}}}
    for config in (file, values):
        assert lanenet.train(config, "learn.epochs=5", marking_cm=2.0) == Path("checkpoints/mine")
    assert asked[0] == asked[1] and asked[0][0].learn.epochs == 5 and asked[0][1] == 2.0
    assert lanenet.train(asked[0][0], "name=yours", force=True) == Path("checkpoints/yours")
    assert [force for *_, force in asked] == [False, False, True]
    with pytest.raises(ConfigError, match="unknown key 'nmae'"):
        lanenet.train({"nmae": "mine"})


def test_train_takes_a_drive_as_the_command_does(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[Any] = []

    def train_run(settings: Any, *_: object) -> Path:
        asked.append(settings)
        return Path("c")

    monkeypatch.setattr(train_command, "train_run", train_run)
    monkeypatch.chdir(tmp_path)
    drive = write_drive(tmp_path / "tub", 90)
    assert lanenet.train("tub", "learn.epochs=5", lane_width_cm=50, name="x", wheelbase_cm=17) == Path("c")
    (known,) = asked[0].data.drives
    assert (known.path, known.lane_width_cm, known.wheelbase_cm) == (drive.resolve(), 50.0, 17.0)
    assert asked[0].name == "x" and asked[0].learn.epochs == 5
    # Written down as the command writes it.
    words = ["train", "tub", "learn.epochs=5", "--lane-width", "50", "--name", "x", "--wheelbase", "17"]
    written = Path("runs/x/x.yaml").read_text()
    assert CliRunner().invoke(app, words).exit_code == 0
    assert asked[1] == asked[0] and Path("runs/x/x.yaml").read_text() == written
    write_drive(tmp_path / "tub2", 90)
    both: Any
    for both in (["tub", Path("tub2")], {"tub", "tub2"}, iter(["tub", "tub2"])):
        lanenet.train(both, lane_width_cm=50, name="both")
        assert [each.path.name for each in asked[-1].data.drives] == ["tub", "tub2"]
    with pytest.raises(ConfigError, match=r"expected a name .*lanenet\.train\('tub', name='tub'\)"):
        lanenet.train("tub", lane_width_cm=50)
    with pytest.raises(ConfigError, match=r"0\.5 m are 50 cm"):
        lanenet.train("tub", lane_width_cm=0.5, name="x")
    wrong: tuple[dict[str, Any], ...] = ({"name": "y"}, {"lane_width_cm": 40})
    for given in wrong:
        with pytest.raises(ConfigError, match=f"{next(iter(given))}=.*a config has a key"):
            lanenet.train("runs/x/x.yaml", **given)


def test_what_is_no_argument_is_refused_with_what_was_expected(tmp_path: Path) -> None:
    # As users have them, without the checks of types in these tests.
    map_drive, train, detect = (inspect.unwrap(f) for f in (lanenet.map, lanenet.train, lanenet.detect))
    camera: Any = read_camera(SMALL / "camera.yaml")
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"camera": camera}, r"camera=\.\.\.: expected the path .*write_camera"),
        ({"frames": "0:2"}, r"frames='0:2': expected the first and the last"),
        ({"frames": (9, 7)}, "expected the first and the last"),
        ({"wheelbase_cm": -3}, "wheelbase_cm=-3: expected"),
        ({"camera_height_cm": 0.2}, "camera_height_cm=0.2: .*0.2 m are 20 cm"),
    )
    for given, words in wrong:
        with pytest.raises(ConfigError, match=words):
            map_drive("tub", tmp_path / "m", lane_width_cm=40, **given)
        with pytest.raises(ConfigError, match=words):
            train("tub", name="x", lane_width_cm=40, **given)
        if "wheelbase_cm" not in given and "camera_height_cm" not in given:
            with pytest.raises(ConfigError, match=words):
                detect("tub", tmp_path / "l.csv", detector="hough", **given)
    nothing: Any
    for nothing in ((), None):
        with pytest.raises(ConfigError, match="expected drives"):
            train(nothing, name="x")
    override: Any = {"learn.epochs": 5}
    with pytest.raises(ConfigError, match=r"expected a setting .*learn\.epochs=5"):
        train("tub", override, name="x")


def test_detect_writes_what_the_command_writes(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    shutil.copy(GENERAL / "example.jpg", tmp_path / "photos")
    options: dict[str, Any] = {"model": GENERAL, "camera": GENERAL / "camera.yaml", "lane_width_cm": 40}
    report = lanenet.detect(tmp_path / "photos", tmp_path / "own.csv", **options)
    assert (report.frames, report.complete, report.out) == (1, 1, tmp_path / "own.csv")
    words = [f"--{name.removesuffix('_cm').replace('_', '-')}={value}" for name, value in options.items()]
    result = CliRunner().invoke(
        app, ["detect", str(tmp_path / "photos"), f"--out={tmp_path / 'c.csv'}", *words]
    )
    assert result.exit_code == 0, result.output
    assert (tmp_path / "own.csv").read_bytes() == (tmp_path / "c.csv").read_bytes()
    with pytest.raises(LanenetError, match="no detector was named"):
        lanenet.detect(tmp_path / "photos", tmp_path / "own.csv")
    with pytest.raises(LanenetError, match="ends in"):
        lanenet.detect(tmp_path / "photos", tmp_path / "own.csv", video=tmp_path / "v.txt", **options)


def test_the_page_calls_what_exists() -> None:
    blocks = re.findall(
        r"```python\n(.*?)```", (CHECKPOINTS.parent / "docs/python.md").read_text(), re.DOTALL
    )
    calls = [node for block in blocks for node in ast.walk(ast.parse(block)) if isinstance(node, ast.Call)]
    called = [(node.func.attr, node) for node in calls if isinstance(node.func, ast.Attribute)]
    assert {name for name, _ in called} == set(lanenet.__all__)
    for name, call in called:
        keywords = {word.arg: word.value for word in call.keywords if word.arg is not None}
        inspect.signature(getattr(lanenet, name)).bind(*call.args, **keywords)


def test_the_names_are_seen() -> None:
    assert {"load", "map", "label", "train", "detect"} <= set(dir(lanenet))
    for name in lanenet.__all__:
        assert "Raises:" in (getattr(lanenet, name).__doc__ or "")
