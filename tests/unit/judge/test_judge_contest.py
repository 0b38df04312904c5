"""Whole contests: any number of processes, resuming, tables and pictures; the verb."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from datagen.judge.contest import contest_jobs, judge, read_run, read_trajectory, run_job
from datagen.judge.report import COLOURS_BGR, draw_top_view, summarise, tables, write_report
from datagen.judge.run import TRUE_POINTS, TRUTH, Entrant, RunResult, Trajectory, drive_run
from datagen.judge.settings import JudgeSettings
from datagen.world.car.camera import CameraSettings
from datagen.world.road.build import random_track
from datagen.world.road.track_settings import TrackSettings
from datagen.world.world import SimulationSettings, draw_track
from lanenet.cli.app import app
from lanenet.cli.research.judge import NamedDetector, named_entrant
from lanenet.errors import ConfigError, LanenetError

# Short open roads: a run is a few dozen frames.
COMMON = SimulationSettings(
    camera=CameraSettings(width=48, height=36), track=TrackSettings(length_cm=320.0), rate_hz=10.0
)
SETTINGS = JudgeSettings(tracks=("open",), count=2, laps=1, simulation=COMMON)
ENTRANTS = [Entrant(TRUTH), Entrant("painter", NamedDetector("painter"), "p")]


TRAJECTORY = Trajectory(*(np.zeros(2), np.zeros((2, 2))), *np.zeros((3, 2)), *np.zeros((3, 2), bool))


def _files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_two_processes_give_the_same_files(tmp_path: Path) -> None:
    one = judge(SETTINGS, ENTRANTS, tmp_path / "one", workers=1)
    calls: list[tuple[int, int]] = []
    two = judge(SETTINGS, ENTRANTS, tmp_path / "two", 2, lambda *done: calls.append(done))
    assert one == two
    assert [(r.number, r.entrant) for r in one] == [
        (0, "truth"),
        (0, "painter"),
        (1, "truth"),
        (1, "painter"),
    ]
    assert calls == [(k, 4) for k in range(5)]
    assert _files(tmp_path / "one") == _files(tmp_path / "two")
    assert len(_files(tmp_path / "one")) == 8


def test_finished_runs_are_kept_and_others_driven_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driven: list[tuple[str, int]] = []

    def counted(settings, road, entrant):
        driven.append((entrant.name, road.number))
        return _result(entrant.name, road.number), TRAJECTORY

    monkeypatch.setattr("datagen.judge.contest.drive_run", counted)
    entrants = [Entrant(TRUTH), Entrant(TRUE_POINTS)]
    first = judge(SETTINGS, entrants, tmp_path)
    assert len(driven) == 4
    assert judge(SETTINGS, entrants, tmp_path) == first and len(driven) == 4
    # More roads leave those that were driven.
    judge(SETTINGS.model_copy(update={"count": 3}), entrants, tmp_path)
    assert driven[4:] == [("truth", 2), ("true-points", 2)]
    (tmp_path / "runs" / "open_01_truth.json").write_text("{")
    (tmp_path / "runs" / "open_00_true-points.csv").unlink()
    assert judge(SETTINGS, entrants, tmp_path) == first
    assert driven[6:] == [("true-points", 0), ("truth", 1)]
    judge(SETTINGS.model_copy(update={"speed_cm_s": 50.0}), entrants, tmp_path)
    assert len(driven) == 12
    judge(SETTINGS.model_copy(update={"speed_cm_s": 50.0}), [Entrant(TRUTH, None, "changed")], tmp_path)
    assert len(driven) == 14


def test_an_interrupted_contest_leaves_its_finished_runs(tmp_path: Path) -> None:
    def stop(done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        judge(SETTINGS, [Entrant(TRUTH)], tmp_path, progress=stop)
    assert sorted(_files(tmp_path)) == ["runs/open_00_truth.csv", "runs/open_00_truth.json"]


def test_a_run_comes_back_from_disk_as_it_was(tmp_path: Path) -> None:
    job = contest_jobs(SETTINGS, [Entrant(TRUTH)], tmp_path)[1]
    result = run_job(job)
    assert read_run(job.path, job.key) == result
    assert read_run(job.path, "another") is None
    _, trajectory = drive_run(SETTINGS, job.road, job.entrant)
    again = read_trajectory(job.path)
    for name in ("t_s", "xy_cm", "s_cm", "offset_cm", "steering_rad", "answered", "over", "put_back"):
        np.testing.assert_allclose(getattr(again, name), getattr(trajectory, name), rtol=1e-8, atol=1e-12)


def test_entrants_need_names_and_eyes_or_the_truth(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="each may be named once"):
        contest_jobs(SETTINGS, [Entrant(TRUTH), Entrant(TRUTH)], tmp_path)
    with pytest.raises(ConfigError, match="'nobody': without a detector"):
        contest_jobs(SETTINGS, [Entrant("nobody")], tmp_path)


def _result(entrant: str, number: int, **changes: object) -> RunResult:
    plain = RunResult(entrant, "open", number, 1, True, "completed", 2.0, 0, 0, 1.0, 2.0, 0.5, 0.0, 10, 9.0)
    return RunResult(**{**plain.__dict__, **changes})


def test_the_table_shows_mean_and_worst(tmp_path: Path) -> None:
    results = [
        _result("a", 0),
        _result("b", 0),
        _result("a", 1, departures=3, mean_offset_cm=2.0, completed=False, ended="stuck", unanswered=0.5),
    ]
    rows = summarise(results)
    assert [row["entrant"] for row in rows] == ["a", "b"]
    assert (rows[0]["runs"], rows[0]["completed"], rows[0]["clean"]) == (2, 1, 1)
    assert (rows[0]["departures_mean"], rows[0]["departures_worst"]) == (1.5, 3.0)
    headers, first, _ = tables(results)["open"]
    shown = dict(zip(headers, first, strict=True))
    assert shown["completed"] == "1/2" and shown["departures"] == "1.5/3.0"
    assert shown["offset, cm"] == "1.50/2.00" and shown["no answer, %"] == "25.0/50.0"
    paths = write_report(tmp_path, SETTINGS, results)
    assert [path.name for path in paths] == ["results.json", "results.md", "runs.csv"]
    data = json.loads(paths[0].read_text())
    assert data["summary"][0]["mean_offset_cm_mean"] == 1.5 and len(data["runs"]) == 3
    assert "| a | 1/2 | 1/2 | 1.5/3.0 |" in paths[1].read_text()
    assert len(paths[2].read_text().splitlines()) == 4


def test_the_table_says_who_came_back_where_cars_start_across() -> None:
    straight = tables([_result("a", 0)])["open"][0]
    across = [
        _result("a", 0, across_deg=30.0, back_after_s=0.5),
        _result("a", 1, across_deg=-30.0, back=False, back_after_s=5.0),
    ]
    headers, row = tables(across)["open"]
    assert set(headers) - set(straight) == {"back in lane", "back after, s"}
    shown = dict(zip(headers, row, strict=True))
    assert shown["back in lane"] == "1/2" and shown["back after, s"] == "2.8/5.0"
    assert summarise(across)[0]["back"] == 1


def test_several_networks_take_part_by_their_models() -> None:
    models = Path(__file__).parents[3] / "checkpoints"
    entrants = [
        named_entrant(f"network={models / name}", None, "--detectors", True) for name in ("small", "general")
    ]
    assert [entrant.name for entrant in entrants] == ["network-small", "network-general"]
    assert entrants[0].identity != entrants[1].identity
    with pytest.raises(LanenetError, match="nowhere"):
        named_entrant("network=nowhere", None, "--detectors", True)


def test_the_top_view_shows_who_drove_where(tmp_path: Path) -> None:
    job = contest_jobs(SETTINGS, [Entrant(TRUTH)], tmp_path)[0]
    result, trajectory = drive_run(SETTINGS, job.road, job.entrant)
    away = type(trajectory)(
        **{**trajectory.__dict__, "xy_cm": trajectory.xy_cm + 25.0, "put_back": trajectory.t_s == 2.0}
    )
    track = draw_track(job.road.simulation)
    plain = draw_top_view(track, [], "road")
    picture = draw_top_view(track, [(result, trajectory), (result, away)], "road")
    legend = picture.shape[0] - plain.shape[0]
    assert legend > 0 and picture.shape[1] == plain.shape[1]
    for index in (0, 1):
        colour = np.array(COLOURS_BGR[index], np.uint8)
        assert np.sum((picture[legend + 60 :] == colour).all(axis=2)) > 1000
    assert 900 < max(plain.shape[:2]) < 1400


def test_the_top_view_shows_what_is_painted_beside_the_lines() -> None:
    # A road of 400 cm along +x with two bays on its right, 30 cm deep, and a red bar.
    settings = TrackSettings.model_validate(
        {
            "pieces": [{"straight": {"length_cm": 400}}],
            "furniture": [
                {"parking": {"at_cm": 200, "bays": 2, "bay_cm": 60}},
                {"stop_line": {"at_cm": 320, "colour": "red"}},
            ],
        }
    )
    track = random_track(settings, np.random.default_rng(0))
    picture = draw_top_view(track, [], "road")
    # The picture goes on for 50 cm beyond the lines, which lie 20 cm beside the centre line.
    scale = 1100 / (400.0 + 2 * 70.0)
    top_px = 26 + 12

    def at(x_cm: float, y_cm: float) -> list[int]:
        column, row = round((x_cm + 70.0) * scale), round(top_px + (70.0 - y_cm) * scale)
        return picture[row, column].tolist()

    assert at(320.0, 5.0) == [45, 40, 190] and at(300.0, 5.0) == [120, 120, 120]
    # Separators and back edges white, the bay between them paved, the ground beyond it not.
    for x_cm, y_cm in ((140.0, -35.0), (200.0, -35.0), (170.0, -50.0)):
        assert at(x_cm, y_cm) == [235, 235, 235]
    assert at(170.0, -35.0) == [120, 120, 120]
    assert at(170.0, -62.0) == at(60.0, -35.0) == [225, 228, 225]


def test_the_verb_judges_writes_and_draws(tmp_path: Path) -> None:
    config = tmp_path / "judge.yaml"
    config.write_text("simulation: {camera: {width: 48, height: 36}, rate_hz: 10, track: {length_cm: 320}}\n")
    command = ["judge", "--detectors", "truth,painter", "--tracks", "open", "--count", "1", "--workers", "1"]
    out = tmp_path / "out"
    result = CliRunner().invoke(app, [*command, "--config", str(config), "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "painter" in result.stdout and "furthest" in result.stdout
    # What to try next is this contest by another law, not another contest.
    suggested = shlex.split(result.stdout.replace("\n", " ").split("next: lanenet ")[1])
    assert suggested == [*command[:-2], "--law", "own", "--config", str(config), "--out", "DIR"]
    data = json.loads((out / "results.json").read_text())
    assert data["format"] == "lanenet-judge/1"
    assert data["settings"]["tracks"] == ["open"] and data["settings"]["simulation"]["camera"]["width"] == 48
    assert [run["entrant"] for run in data["runs"]] == ["truth", "painter"]
    picture = cv2.imread(str(out / "pictures" / "open_00.png"))
    assert picture is not None and picture.shape[1] >= 700


def test_everybody_drives_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def refuse(settings: JudgeSettings, entrants: list[Entrant], *_: object) -> None:
        asked.append([entrant.name for entrant in entrants])
        raise LanenetError("no time to drive")

    monkeypatch.setattr("datagen.judge.contest.judge", refuse)
    monkeypatch.chdir(tmp_path)
    # Without the network where there is none, and it says so.
    result = CliRunner().invoke(app, ["judge"])
    assert asked == [["truth", "lane-filter", "hough", "hough-value", "painter"]]
    assert "checkpoints/small is not there" in result.stderr
    # A model that is asked for has to be there; the one that ships drives with the others.
    assert "mine.onnx: no such file" in CliRunner().invoke(app, ["judge", "--model", "mine.onnx"]).stderr
    (tmp_path / "checkpoints").symlink_to(Path(__file__).parents[3] / "checkpoints")
    CliRunner().invoke(app, ["judge"])
    assert asked[1:] == [["truth", "network", "lane-filter", "hough", "hough-value", "painter"]]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--detectors", "truth,lens"], "'lens': expected truth, true-points, network"),
        (["--detectors", "network", "--model", "nowhere.onnx"], "no such file"),
        (["--detectors", "truth=x.yaml"], "expected truth"),
        (["--detectors", "truth", "--law", "magic"], "pilot.law"),
        (
            ["--detectors", "truth", "--tracks", "random,moon"],
            "tracks: found 'moon', expected random, open, varied (drawn roads), a preset (bfmc, carolo_cup, ",
        ),
        (["--detectors", "truth", "--tracks", "donkytape"], "(.yaml), did you mean 'donkey_tape'?"),
        (["--detectors", "truth,truth"], "each may be named once"),
    ],
)
def test_the_verb_refuses_what_it_does_not_know(tmp_path: Path, words: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["judge", *words, "--out", str(tmp_path / "out")])
    assert result.exit_code == 1
    assert message in " ".join(result.stderr.split())
    assert not (tmp_path / "out").exists()


def test_a_detector_at_the_wheel_records_a_drive(tmp_path: Path) -> None:
    config = tmp_path / "drive.yaml"
    config.write_text("seed: 1\nframes: 4\ncamera: {width: 48, height: 36}\n")
    command = ["simulate", str(config), "--detector", "painter", "--out", str(tmp_path / "d")]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    assert len((tmp_path / "d" / "frames.csv").read_text().splitlines()) == 5
    unknown = CliRunner().invoke(app, [*command[:3], "nobody", *command[4:]])
    assert unknown.exit_code == 1 and "'nobody'" in unknown.stderr
