"""The command line: what it asks of the functions behind it, and what it says when they fail."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from detections import read_detections
from typer.testing import CliRunner, Result

from datagen.prepare import MapRequest
from lanenet.cli import app as cli
from lanenet.cli.shared.options import lane_cm, length_cm
from lanenet.config import Settings
from lanenet.data.camera_file import write_camera
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.label_set import LabelMeta, LabelSet, write_labels
from lanenet.data.maps.folder import FORMAT
from lanenet.errors import TrackingLostError
from lanenet.evaluation.answers import RasterAnswers, RasterModel
from lanenet.geometry.birdseye import GENERAL_WINDOW, BirdseyeWindow
from lanenet.onboard.bench import example_camera, example_frames
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.perception.network.model_file import ModelMeta


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(cli.app, [str(word) for word in words], env={"COLUMNS": "200"})


def error_of(result: Result) -> str:
    """The one line that a failure says."""
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert result.exit_code == 1 and len(lines) == 1 and "Traceback" not in result.output, result.output
    return lines[0]


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, frame in enumerate(example_frames(example_camera(), 3, np.random.default_rng(1))):
        cv2.imwrite(str(folder / f"{i}.png"), frame)
    write_camera(tmp_path / "camera.yaml", example_camera(), "nominal values")
    return folder


def test_detect_writes_table_and_video_and_says_so(tmp_path: Path, photos: Path) -> None:
    out, video = tmp_path / "lanes.csv", tmp_path / "lanes.mp4"
    result = run(
        *("detect", photos, "--detector", "lane-filter", "--camera", tmp_path / "camera.yaml"),
        *("--lane-width", "40", "--out", out, "--video", video),
    )
    assert result.exit_code == 0, result.output
    assert np.isfinite(read_detections(out).points_cm).all()
    assert video.stat().st_size > 0
    for text in ("3 frames, 3 with all six points", f"wrote {out}", f"wrote {video}", "next, for the car: "):
        assert text in result.stdout


def test_of_one_photo_a_picture_is_suggested_that_is_not_the_photo(tmp_path: Path, photos: Path) -> None:
    for folder, name in ((tmp_path, "0.png"), (photos, "0_lanes.png")):
        result = run("detect", photos / "0.png", "--detector", "hough", "--out", folder / "0.csv")
        assert f"--video {folder / name}" in result.stdout, result.output


def test_detect_of_a_map_reads_its_drive(tmp_path: Path) -> None:
    """The pictures in its folder are no photos of a road."""
    frames = example_frames(example_camera(), 3, np.random.default_rng(1))
    with DriveWriter(tmp_path / "drive") as writer:
        for k, frame in enumerate(frames):
            writer.add(frame, 0.05 * k)
    a_map = tmp_path / "map"
    a_map.mkdir()
    write_camera(a_map / "camera.yaml", example_camera(), "nominal values")
    cv2.imwrite(str(a_map / "map.png"), frames[0])
    meta = {"format": FORMAT, "drive": str(tmp_path / "drive"), "lane_width_cm": 40.0, "mapped_lane_cm": 41.0}
    meta |= {"tape_cm": 2.0, "scale_from": "lane width", "laps": 2, "verdict": "good"}
    (a_map / "map.yaml").write_text(json.dumps(meta))
    words = ("detect", a_map, "--detector", "lane-filter", "--out", tmp_path / "l.csv")
    result = run(*words)
    assert result.exit_code == 0, result.output
    assert f"{a_map} is a map: its drive {tmp_path / 'drive'} is read" in result.stdout.replace("\n", "")
    assert "3 frames, 3 with all six points" in result.stdout
    inside = tmp_path / "drive" / "frames.csv"
    assert "is a file of" in error_of(run(*words[:-1], inside))
    (tmp_path / "drive").rename(tmp_path / "moved")
    assert f"is not there: type where it is now, with --camera {a_map}" in error_of(run(*words))
    (a_map / "map.yaml").rename(a_map / "refused.yaml")
    assert "its drive was refused" in error_of(run(*words))


def test_detect_says_what_is_missing(tmp_path: Path, photos: Path) -> None:
    camera = tmp_path / "camera.yaml"
    always = ("--out", tmp_path / "l.csv")
    lane_filter = ("--detector", "lane-filter", *always)
    assert "no such file" in error_of(run("detect", tmp_path / "none", *lane_filter))
    assert "--camera" in error_of(run("detect", photos, *lane_filter))
    assert "--lane-width" in error_of(run("detect", photos, *lane_filter, "--camera", camera))
    network = ("detect", photos, "--detector", "network", "--camera", camera, *always)
    assert "--model" in error_of(run(*network))
    assert "none.onnx" in error_of(run(*network, "--model", tmp_path / "none.onnx"))
    wrong = run("detect", photos, "--detector", "lane-filter", "--out", tmp_path / "l.txt")
    assert ".parquet or .csv" in error_of(wrong)
    assert not (tmp_path / "l.csv").exists()


def test_unknown_detector_is_a_usage_error(tmp_path: Path) -> None:
    result = run("detect", tmp_path, "--detector", "eagle", "--out", "l.csv")
    assert result.exit_code == 2 and "eagle" in result.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "detect d --detector eagle --out l.csv",
            "--detector: 'eagle' is not one of .*; see .* detect --help",
        ),
        ("map d --lane-width 0.4 --out m", "--lane-width: 0.4: expected .* type 40; see .* map --help"),
        ("map d", "missing option '--lane-width'; see .* map --help"),
        ("map d --lane-widht 40 --out m", "no such option: --lane-widht .*--lane-width.*"),
        ("map d e --lane-width 40 --out m", r"got unexpected extra argument.*\(e\).*"),
        ("calibrate eagle", "no such command 'eagle'; see .* calibrate --help"),
        ("eagle", "no such command 'eagle'; see .* --help"),
        ("--vesion", r"no such option: --vesion .*--version.*; see .* --help"),
    ],
)
def test_a_wrong_command_line_is_told_in_the_form_of_all_errors(words: str, said: str) -> None:
    result = run(*words.split())
    assert result.exit_code == 2 and result.stdout == ""
    assert re.fullmatch(f"error: {said}\n", result.stderr), result.stderr


@pytest.mark.parametrize(
    ("typed", "offered"),
    [("de", {"detect"}), ("detect --ma", {"--marking", "--mask"}), ("calibrate g", {"ground"})],
)
def test_the_tab_key_completes_verbs_and_options(typed: str, offered: set[str]) -> None:
    """As the shell asks, once ``lanenet --install-completion`` was run."""
    asked = {"COMP_WORDS": f"lanenet {typed}", "COMP_CWORD": str(len(typed.split()))}
    result = CliRunner().invoke(
        cli.app, [], prog_name="lanenet", env={"_LANENET_COMPLETE": "complete_bash", **asked}
    )
    assert set(result.stdout.split()) == offered


def test_a_group_without_a_verb_shows_its_help() -> None:
    result = run("calibrate")
    assert "chessboard" in result.output and "error" not in result.output


def test_bench_writes_json(tmp_path: Path) -> None:
    result = run("bench", "--rounds", "10", "--out", tmp_path / "bench.json")
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "bench.json").read_text())
    assert report["stages"]["edges"]["p99_ms"] > 0.0
    assert "lane filter" in result.stdout and "next: lanenet" in result.stdout


def test_doctor_fails_on_a_bad_camera_file(tmp_path: Path) -> None:
    assert run("doctor").exit_code == 0
    write_camera(tmp_path / "c.yaml", example_camera().with_mounting(height_cm=2.0), "in decimetres")
    result = run("doctor", "--camera", tmp_path / "c.yaml")
    assert "problem" in error_of(result)
    assert "centimetres" in result.stdout


def test_interrupt_is_one_line_and_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("lanenet.onboard.bench.time_stages", interrupted)
    result = run("bench")
    assert result.exit_code == 130
    assert "interrupted" in result.stderr and "Traceback" not in result.output


def test_faults_of_the_program_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fault(*_: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("lanenet.onboard.bench.time_stages", fault)
    assert isinstance(run("bench").exception, ZeroDivisionError)


def test_missing_extra_names_the_pip_command(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['torch'] = None; sys.argv = ['lanenet', 'export', sys.argv[1]]\n"
        "from lanenet.cli.app import main; main()"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, tmp_path], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: ") and "pip install 'lanenet[train]'" in done.stderr
    assert "Traceback" not in done.stderr


@dataclass(frozen=True)
class Report:
    lines: tuple[str, ...]
    grade: str = "good"

    @property
    def figures(self) -> dict[str, Any]:
        return {"verdict": {"grade": self.grade}}


class Asked:
    """Stands in for the workstation's modules and notes what is asked of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: dict[str, tuple[Any, ...]] = {}
        self.options: dict[str, dict[str, Any]] = {}
        self.order: list[str] = []
        self._patch = monkeypatch

    def module(self, name: str, **members: Any) -> None:
        module = ModuleType(name)
        for key, value in members.items():
            setattr(module, key, value)
        self._patch.setitem(sys.modules, name, module)

    def function(self, name: str, answer: Any = None) -> Any:
        def call(*args: Any, **options: Any) -> Any:
            self.calls[name] = args
            self.options[name] = options
            self.order.append(name)
            if isinstance(answer, Exception):
                raise answer
            return answer

        return call


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    return Asked(monkeypatch)


class FakeSettings(Settings):
    frames: int = 5


def test_map_hands_on_its_arguments(tmp_path: Path, asked: Asked) -> None:
    map_drive = asked.function("map", Report(("7 frames mapped",)))
    asked.module("datagen.pipeline", MapRequest=MapRequest, MapSettings=FakeSettings, map_drive=map_drive)
    config = tmp_path / "map.yaml"
    config.write_text("frames: 9\n")
    result = run(
        *("map", "tub", "--lane-width", "38.5", "--camera", "c.yaml", "--config", config, "--out", "m/one"),
        *("--camera-height", "17.5", "--tape-width", "1.9"),
    )
    assert result.exit_code == 0, result.output
    request = MapRequest(Path("tub"), 38.5, Path("c.yaml"), camera_height_cm=17.5, tape_width_cm=1.9)
    assert asked.calls["map"][:3] == (request, FakeSettings(frames=9), Path("m/one"))
    for text in ("7 frames mapped", "wrote m/one", "lanenet label m/one --out m/one.parquet"):
        assert text in result.stdout


@pytest.mark.parametrize(
    ("width", "instead"),
    [
        ("0.31", "0.31 m are 31 cm: type 31"),
        ("40,5", "type 40.5"),
        ("0,4m", "type 0.4m"),
        *((width, "as 40 or 40.5") for width in ("forty", "40 kg", "inf", "nan", "")),
        ("-40", "expected a length in cm"),
        ("5000", "2 to 1000"),
    ],
)
def test_a_lane_width_that_is_no_centimetres_is_a_usage_error(width: str, instead: str) -> None:
    result = run("map", "tub", "--lane-width", width, "--out", "map")
    assert result.exit_code == 2 and "--lane-width" in result.stderr
    assert instead in result.stderr and ("type" in result.stderr) == ("type" in instead)


@pytest.mark.parametrize("option", ["--wheelbase", "--camera-height"])
def test_a_length_of_the_car_in_metres_is_a_usage_error(option: str) -> None:
    result = run("map", "tub", "--lane-width", "40", "--out", "map", option, "0.17")
    assert result.exit_code == 2 and option in result.stderr and "0.17 m are 17 cm: type 17" in result.stderr


@pytest.mark.parametrize("width", ["40", "40cm", "40 CM", "400mm", "0.4 m"])
def test_a_length_may_have_its_unit(width: str) -> None:
    assert lane_cm(width) == length_cm(width) == pytest.approx(40.0)
    assert length_cm("2in") == pytest.approx(5.08)


def test_a_rejected_map_is_written_and_an_error(asked: Asked) -> None:
    map_drive = asked.function("map", Report(("verdict: reject",), "reject"))
    asked.module("datagen.pipeline", MapRequest=MapRequest, MapSettings=FakeSettings, map_drive=map_drive)
    result = run("map", "tub", "--lane-width", "40", "--out", "m")
    assert "the map was rejected" in error_of(result)
    assert "verdict: reject" in result.stdout and "wrote m/report.html" in result.stdout
    assert "next:" not in result.stdout
    # What finds lines all the same, to be copied: one needs no camera, the other takes that of this map.
    hints = [line for line in result.stderr.splitlines() if line.startswith("  to try ")]
    assert hints[0].endswith(": lanenet detect tub --detector hough --out m-hough.csv --video m-hough.mp4")
    assert "doubtful as the map" in hints[1] and (
        ": lanenet detect tub --model checkpoints/general --camera m --lane-width 40 --out m-network"
        in hints[1]
    )


def test_map_shows_three_lines_below_the_verdict_and_says_where_the_others_are(asked: Asked) -> None:
    lines = ("verdict: usable", *(f"line {k}" for k in range(11)))
    map_drive = asked.function("map", Report(lines, "usable"))
    asked.module("datagen.pipeline", MapRequest=MapRequest, MapSettings=FakeSettings, map_drive=map_drive)
    result = run("map", "tub", "--lane-width", "40", "--out", "m")
    assert "line 2" in result.stdout and "line 3" not in result.stdout
    assert "and 8 more in m/report.html" in result.stdout


def test_map_that_is_lost_says_so(asked: Asked) -> None:
    lost = asked.function("map", TrackingLostError("tub: lost at frame 12"))
    asked.module("datagen.pipeline", MapRequest=MapRequest, MapSettings=FakeSettings, map_drive=lost)
    assert error_of(run("map", "tub", "--lane-width", "40", "--out", "m")) == "error: tub: lost at frame 12"


def test_label_hands_on_its_arguments(asked: Asked) -> None:
    asked.module("datagen.pipeline", label_map=asked.function("label", Report(("7 frames mapped",))))
    # That of the shipped network, which shows wide lanes, too.
    wide = {"window": GENERAL_WINDOW}
    result = run("label", "m/one", "--out", "one.parquet")
    assert result.exit_code == 0, result.output
    assert asked.calls["label"][:2] == (Path("m/one"), Path("one.parquet"))
    assert asked.options["label"] == {"force": False, "colour_weight": 0.75, **wide}
    assert run("label", "m/one", "--out", "one.parquet", "--colour-weight", "0").exit_code == 0
    assert asked.options["label"]["colour_weight"] == 0.0
    assert run("label", "m/one", "--force", "--out", "one.parquet").exit_code == 0
    assert asked.options["label"] == {"force": True, "colour_weight": 0.75, **wide}
    assert ".parquet" in error_of(run("label", "m/one", "--out", "one.txt"))


def test_overrides_replace_settings_of_the_file(tmp_path: Path) -> None:
    from datagen.world.world import SimulationSettings

    config = tmp_path / "drive.yaml"
    config.write_text(f"seed: {SimulationSettings().seed + 1}\n")
    typo = run("simulate", config, "sed=3", "--out", tmp_path / "d")
    assert "did you mean 'seed'" in error_of(typo)
    assert "key=value" in error_of(run("simulate", config, "seed", "--out", tmp_path / "d"))


def test_simulate_writes_a_drive(tmp_path: Path) -> None:
    config = tmp_path / "drive.yaml"
    config.write_text("seed: 1\n")
    result = run("simulate", config, "frames=3", "--out", tmp_path / "d")
    assert result.exit_code == 0, result.output
    assert len((tmp_path / "d" / "frames.csv").read_text().splitlines()) == 4
    assert "next: lanenet map" in result.stdout


def tiny_labels(path: Path) -> LabelSet:
    """Straight lanes with both edges of their tapes, shifted from frame to frame."""
    y = np.arange(1.0, 60.0, 0.3)
    edges, points = [], []
    for shift in (-3.0, 0.0, 2.0, 5.0):
        # Bright markings: their two edges face each other.
        sides = {-21.0: 1.0, -19.0: -1.0, 19.0: 1.0, 21.0: -1.0}
        both = [np.stack([y * 0 + x + shift, y, y * 0 + to, y * 0], axis=1) for x, to in sides.items()]
        rows = np.concatenate(both)
        edges.append(np.hstack([rows, 0.0 * rows[:, :2]]).astype(np.float32))
        points.append(np.repeat([-20.0 + shift, 20.0 + shift], 3))
    n = len(points)
    line = np.array([[0.0, -20.0], [0.0, 60.0]], np.float32)
    labels = LabelSet(
        LabelMeta(BirdseyeWindow(), "c" * 16, 26.0, 40.0, "truth"),
        drive=["tiny"] * n,
        file=[""] * n,
        frame=np.arange(n),
        t_s=np.arange(n, dtype=np.float64),
        lap=np.zeros(n, np.int64),
        poses=np.zeros((n, 3)),
        points_cm=np.array(points),
        edges=edges,
        lines=[(line, line)] * n,
        quality=np.ones(n),
        divides=np.zeros((n, 2), dtype=bool),
    )
    write_labels(path, labels)
    return labels


def fake_checkpoint(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """A checkpoint whose model is a centimetre off; returns a list of the models that will be opened."""
    folder.mkdir()
    (folder / "model.onnx").write_bytes(b"")
    opened: list[Path] = []

    meta = ModelMeta(BirdseyeWindow(), ("c" * 16,), 26.0, 40.0, "", (math.nan,) * 6, "map")

    class OneOff(RasterModel):
        def __init__(self, path: Path) -> None:
            opened.append(path)
            self.meta = meta

        def check_edges(self, perception: PerceptionSettings) -> None:
            assert perception == PerceptionSettings()

        def answer(self, rasters: np.ndarray, lane_cm: np.ndarray | None = None) -> RasterAnswers:
            n = len(rasters)
            return RasterAnswers(np.zeros((n, 6)), np.full((n, 6), 2.0), np.full((n, 2), 0.9))

        def answer_labels(self, labels: LabelSet) -> RasterAnswers:
            n = len(labels)
            return RasterAnswers(labels.points_cm + 1.0, np.full((n, 6), 2.0), np.full((n, 2), 0.9))

    monkeypatch.setattr("lanenet.evaluation.answers.RasterModel", OneOff)
    monkeypatch.setattr("lanenet.perception.network.model_file.read_model_meta", lambda path: meta)
    return opened


def test_val_puts_the_lane_filter_beside_the_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny_labels(tmp_path / "l.parquet")
    opened = fake_checkpoint(tmp_path / "checkpoint", monkeypatch)
    result = run("val", tmp_path / "checkpoint", tmp_path / "l.parquet", "--out", tmp_path / "table")
    assert result.exit_code == 0, result.output
    assert opened == [tmp_path / "checkpoint" / "model.onnx"]
    report = json.loads((tmp_path / "table.json").read_text())
    assert report["format"] == "lanenet-evaluation/1" and report["reference"] == "truth"
    detectors = report["detectors"]
    assert detectors["network"]["groups"]["all"]["rmse_cm"] == pytest.approx(1.0)
    assert detectors["lane-filter"]["groups"]["all"]["rmse_cm"] < 0.2
    assert detectors["lane-filter"]["first_on_shared"]["rmse_cm"] == pytest.approx(1.0)
    assert "| network |" in (tmp_path / "table.md").read_text()
    assert (tmp_path / "table.png").stat().st_size > 1000
    # A label set holds no frames: nothing to draw, and nothing for the others to look at.
    assert not (tmp_path / "table-worst.jpg").exists()
    assert list(detectors) == ["network", "lane-filter"] and "hold no frames" in result.stderr
    # The files hold everything; the terminal a sentence and the network's own table.
    assert "it lies 1.00 cm from the truth (median;" in result.output and "lane-filter" not in result.stdout
    alone = run("val", tmp_path / "checkpoint", tmp_path / "l.parquet")
    assert alone.exit_code == 0 and "lane-filter" not in alone.output and "--all" in alone.stdout
    beside = run("val", tmp_path / "checkpoint", tmp_path / "l.parquet", "--all")
    assert beside.exit_code == 0 and beside.stdout.count("lane-filter") > 1


def test_val_owns_up_to_what_the_model_has_learned_from(tmp_path, monkeypatch):
    tiny_labels(tmp_path / "l.parquet")
    fake_checkpoint(tmp_path / "checkpoint", monkeypatch)
    for path, owned in (("l.parquet", True), ("other.parquet", False)):
        config = {"data": {"drives": [{"path": str(tmp_path / path)}]}}
        (tmp_path / "checkpoint" / "run.yaml").write_text(json.dumps(config))
        result = run("val", tmp_path / "checkpoint", tmp_path / "l.parquet")
        assert result.exit_code == 0 and ("which it has learned from" in result.output) == owned


def test_val_compares_models_and_changes_the_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    labels = tiny_labels(tmp_path / "l.parquet")
    opened = fake_checkpoint(tmp_path / "checkpoint", monkeypatch)
    (tmp_path / "alexnet").mkdir()
    (tmp_path / "alexnet" / "model.onnx").write_bytes(b"")
    along = np.array([[0.0, -20.0], [0.0, 60.0]])
    lines = [(along + [left, 0.0], along + [right, 0.0]) for left, right in labels.points_cm[:, [0, 3]]]
    training = replace(labels, meta=replace(labels.meta, source="map"), lines=lines)
    write_labels(tmp_path / "t.parquet", training)
    words = ["val", tmp_path / "checkpoint", tmp_path / "t.parquet", "--no-baselines", "--robust"]
    words += ["--also", tmp_path / "alexnet", "--trained-on", tmp_path / "t.parquet"]
    result = run(*words, "--out", tmp_path / "table")
    assert result.exit_code == 0, result.output
    assert {path.parent.name for path in opened} == {"checkpoint", "alexnet"}
    report = json.loads((tmp_path / "table.json").read_text())
    assert list(report["detectors"]) == ["network", "alexnet"]
    network = report["detectors"]["network"]
    assert network["doubt"]["coverage_68"] == 1.0 and network["presence"]["recall"] == 1.0
    # Every frame is a training frame.
    assert network["conditions"]["place"]["under 2 cm"]["count"] == 24
    robust = json.loads((tmp_path / "table-robust.json").read_text())
    assert {row["model"] for row in robust["rows"]} == {"network", "alexnet"}
    assert "| one line missing | alexnet |" in (tmp_path / "table-robust.md").read_text()
    assert (tmp_path / "table-breakdown.png").stat().st_size > 1000
    assert "How good checkpoint is" in (tmp_path / "table.html").read_text(encoding="utf-8")
    twice = run(*words, "--also", tmp_path / "alexnet" / "model.onnx")
    assert "the name 'alexnet' is taken" in error_of(twice)
    assert "expected a model (.onnx)" in error_of(run(*words, "--also", tmp_path / "l.parquet"))
    assert "expected a model before" in error_of(run("val", tmp_path / "l.parquet", "--robust"))


def test_val_runs_all_detectors_on_the_frames_of_a_drive(tmp_path: Path) -> None:
    config = tmp_path / "drive.yaml"
    config.write_text("seed: 4\n")
    assert run("simulate", config, "frames=8", "--out", tmp_path / "d").exit_code == 0
    result = run("val", tmp_path / "d", "--out", tmp_path / "t")
    assert result.exit_code == 0, result.output
    assert "against the truth" in result.stdout
    report = json.loads((tmp_path / "t.json").read_text())
    # Without a model there is no network.
    assert list(report["detectors"]) == ["lane-filter", "hough", "hough-value", "painter"]
    assert report["detectors"]["painter"]["groups"]["all"]["count"] > 0
    assert [(s["kind"], s["reference"], s["frames"]) for s in report["sources"]] == [
        ("simulated drive", "truth", 8)
    ]
    for ending in (".md", ".png", "-worst.jpg"):
        assert (tmp_path / f"t{ending}").stat().st_size > 500, ending
    one = run("val", tmp_path / "d", "--detectors", "painter")
    assert one.exit_code == 0 and "painter" in one.stdout and "hough" not in one.stdout


def test_val_says_what_does_not_go_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    labels, checkpoint = tmp_path / "l.parquet", tmp_path / "checkpoint"
    tiny_labels(labels)
    fake_checkpoint(checkpoint, monkeypatch)
    assert "expected a SOURCE" in error_of(run("val", checkpoint))
    assert "none: no such model or source" in error_of(run("val", tmp_path / "none", labels))
    misspelt = error_of(run("val", tmp_path / "chekpoint", labels))
    assert "chekpoint: no such model or source; did you mean" in misspelt and "checkpoint?" in misspelt
    assert "l.parquet is a label set" in error_of(run("val", labels, "--detectors", "hough"))
    assert "expected a model" in error_of(run("val", labels, "--detectors", "network"))
    assert "expected a model" in error_of(run("val", labels, "--no-baselines"))
    assert "found 'eagle'" in error_of(run("val", labels, "--detectors", "eagle"))
    both = run("val", checkpoint, labels, "--no-baselines", "--detectors", "network")
    assert "one of the two" in error_of(both)
    assert "not a drive" in error_of(run("val", tmp_path))
