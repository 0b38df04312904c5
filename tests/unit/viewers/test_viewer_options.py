"""The options of the viewers, through the verbs that have them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from commands import refused
from rosbags.highlevel import AnyReader
from typer.testing import CliRunner, Result
from watched import mapped_drive

from lanenet.cli.app import app
from lanenet.cli.map import view_map
from lanenet.cli.shared.viewing import Views
from lanenet.viewers.mcap_file import is_own
from lanenet.viewers.registry import VIEWERS


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def counts(path: Path) -> dict[str, int]:
    with AnyReader([path]) as reader:
        return {topic: info.msgcount for topic, info in reader.topics.items()}


def floats(path: Path, topic: str) -> list[float]:
    with AnyReader([path]) as reader:
        wanted = [c for c in reader.connections if c.topic == topic]
        assert wanted, topic
        return [reader.deserialize(raw, c.msgtype).data for c, _, raw in reader.messages(wanted)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("options")
    mapped_drive(folder)
    return folder


def test_every_verb_that_sees_frames_has_every_viewer() -> None:
    for verb in ("map", "detect", "drive", "val"):
        text = run(verb, "--help").stdout
        assert all(f"--{name}" in text for name in VIEWERS)


def test_detect_shows_a_drive_on_the_map_that_gave_its_camera(folder: Path, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "l.csv", "--mcap", tmp_path / "l.mcap", "--rerun", tmp_path / "l.rrd")
    words = ("detect", folder / "drive", "--detector", "lane-filter", "--lane-width", 36, "--marking", 3)
    words = (*words, "--frames", "0:9")
    result = run(*words, "--camera", folder / "map", *out)
    assert result.exit_code == 0, result.output
    assert f"wrote {tmp_path / 'l.rrd'}" in result.output and f"wrote {tmp_path / 'l.mcap'}" in result.output
    assert f"rerun {tmp_path / 'l.rrd'}" in result.output and "l.mcap in Foxglove" in result.output
    # It could be read as a drive, but nobody recorded it.
    assert is_own(tmp_path / "l.mcap") and not is_own(tmp_path / "l.rrd") and not is_own(tmp_path / "none")
    found = counts(tmp_path / "l.mcap")
    assert {found[t] for t in ("/pose", "/lane/detected", "/lane/reference", "/confidence", "/edges")} == {10}
    # With the camera alone there is no map.
    result = run(*words, "--camera", folder / "map" / "camera.yaml", *out)
    assert result.exit_code == 0, result.output
    found = counts(tmp_path / "l.mcap")
    assert "/pose" not in found and found["/lane/detected"] == 10


def test_a_map_is_shown_frame_by_frame(folder: Path, tmp_path: Path) -> None:
    view_map(Views({"mcap": str(tmp_path / "m.mcap")}), folder / "map")
    found = counts(tmp_path / "m.mcap")
    assert found["/pose"] == found["/lane/reference"] == found["/camera/image/compressed"] == 30
    assert "/lane/detected" not in found


def test_val_shows_answers_beside_the_map_with_their_error(folder: Path, tmp_path: Path) -> None:
    words = ("--detectors", "lane-filter", "--marking", 3)
    result = run("val", folder / "map", *words, "--mcap", tmp_path / "v.mcap")
    assert result.exit_code == 0, result.output
    found = counts(tmp_path / "v.mcap")
    assert found["/lane/detected"] == found["/lane/reference"] == found["/pose"] == found["/confidence"] == 30
    # The painted lane runs straight ahead.
    assert floats(tmp_path / "v.mcap", "/steering_rad") == pytest.approx([0.0] * 30, abs=0.02)


def test_drive_shows_what_it_saw_and_sent(folder: Path, tmp_path: Path) -> None:
    config = {
        "source": {"kind": "replay", "path": str(folder / "drive"), "pace": "fast"},
        "camera": str(folder / "map" / "camera.yaml"),
        "detector": {"kind": "lane-filter", "lane_width_cm": 36.0},
        "control": {"steering": {"look_ahead_cm": 20.0}},
        # On a busy machine a frame may be old before it is answered.
        "safety": {"countdown_s": 0.0, "max_age_s": 0.5},
    }
    (tmp_path / "car.yaml").write_text(yaml.safe_dump(config))
    result = run("drive", tmp_path / "car.yaml", "--dry-run", "--mcap", tmp_path / "d.mcap")
    assert result.exit_code == 0, result.output
    assert f"wrote {tmp_path / 'd.mcap'}" in result.output
    found = counts(tmp_path / "d.mcap")
    assert 0 < found["/lane/detected"] == found["/sent_steering_rad"] == found["/throttle"] <= 30


def test_a_mistake_is_found_before_the_work(folder: Path, tmp_path: Path) -> None:
    words = ("detect", folder / "drive", "--detector", "hough", "--out", tmp_path / "l.csv")
    assert "expected FILE.mcap" in refused(tmp_path, *words, "--mcap", tmp_path / "l.bag")
    (tmp_path / "folder.rrd").mkdir()
    assert "is a folder" in refused(tmp_path, *words, "--rerun", tmp_path / "folder.rrd")


def test_nothing_of_a_viewer_is_loaded_when_there_is_none(folder: Path) -> None:
    code = (
        "import sys; from lanenet.cli.app import app; from lanenet.onboard.drive import build_loop\n"
        "loaded = {name.partition('.')[0] for name in sys.modules}\n"
        "print(sorted(loaded & {'rerun', 'mcap', 'rosbags', 'pyarrow'}))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
