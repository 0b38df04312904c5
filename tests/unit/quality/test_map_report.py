"""A small drive from frames to the report: verdict, figures, page, and labels of a rejected map."""

from __future__ import annotations

import html
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import yaml

from datagen.labels.label_map import label_map, refuse_rejected
from datagen.pipeline import MapRequest, map_drive
from datagen.quality.verdict import VerdictSettings
from datagen.settings import MapSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.label_set import read_label_index
from lanenet.data.maps.folder import read_map
from lanenet.errors import TrackingLostError

FRAMES = 80
#: Of a set that is small enough for a test.
LEAST = {"min_frames": 60, "min_metres": 2.0}
SETTINGS = MapSettings(find_bumper=False, verdict=VerdictSettings.model_validate(LEAST))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = {
        "seed": 1,
        "frames": FRAMES,
        "camera": {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0},
        "track": {"left": {}, "right": {}, "interruptions_per_m": 0.0},
    }
    return simulate_drive(SimulationSettings.model_validate(settings), tmp_path_factory.mktemp("d") / "drive")


@pytest.fixture(scope="module")
def mapped(drive: Path) -> tuple[Path, tuple[str, ...]]:
    out = drive.parent / "map"
    return out, map_drive(MapRequest(drive, 40.0), SETTINGS, out).lines


def test_a_clean_drive_is_good_and_says_so_first(mapped):
    folder, lines = mapped
    assert lines[0].startswith("verdict: good: ")
    meta = read_map(folder).meta
    # The road does not close, which its labels need not.
    assert (meta.verdict, meta.state) == ("good", "open")


def test_without_pictures_the_map_is_the_same(drive, mapped, tmp_path):
    folder, lines = mapped
    bare = tmp_path / "bare"
    assert map_drive(MapRequest(drive, 40.0), SETTINGS, bare, pictures=False).lines == lines
    drawn = {"map.png", "frames.png", "report.html"}
    assert {p.name for p in folder.iterdir()} - {p.name for p in bare.iterdir()} == drawn
    for name in ("poses.csv", "lanes.json", "report.json"):
        assert (bare / name).read_bytes() == (folder / name).read_bytes()
    rejected = read_map(bare)
    rejected = replace(rejected, meta=rejected.meta.model_copy(update={"verdict": "reject"}))
    # Nobody is sent to a page that is not there.
    with pytest.raises(TrackingLostError, match=r"rejected.*see .*report\.json"):
        refuse_rejected(bare, rejected)
    with pytest.raises(TrackingLostError, match=r"rejected.*see .*report\.html"):
        refuse_rejected(folder, rejected)


def test_figures_for_machines(mapped):
    folder, _ = mapped
    report = json.loads((folder / "report.json").read_text())
    assert report["format"].startswith("lanenet-map-report/")
    held = report["held_out"]
    assert held["frames"] == FRAMES // 10 == read_map(folder).held_out.sum()
    assert 0.0 < held["robust_sd_px_at_160"] < 0.5
    assert held["coverage"] > 0.9 and held["coverage_by_chance"] < 0.2
    assert (report["verdict"]["grade"], report["verdict"]["state"]) == ("good", "open")
    labels, checks = report["labels"], {one["name"]: one for one in report["verdict"]["checks"]}
    assert labels["labelled"] + sum(labels["not_labelled"].values()) == labels["frames"]
    assert checks["min_frames"]["value"] == labels["labelled"]
    errors = read_map(folder).errors
    assert (np.isfinite(errors.off_3).mean(axis=0) > 0.5).all()
    assert labels["off_3"] == pytest.approx(errors.off_3[~errors.withheld].mean(), abs=1e-3)


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.pictures: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            self.pictures.append(dict(attrs)["src"] or "")
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_stands_alone(mapped):
    text = (mapped[0] / "report.html").read_text(encoding="utf-8")
    page = _Page()
    page.feed(text)
    assert not page.open
    assert len(page.pictures) >= 4 and all(src.startswith("data:image/") for src in page.pictures)
    assert not re.search(r"https?://|<script|<link", text)
    for words in (
        "good",
        "Worst frames with labels",
        "Checks of the verdict",
        "min_bend_m",
        "focal length",
        "viewport",
    ):
        assert words in text


def test_held_out_frames_have_no_say_in_the_lines(drive, mapped, tmp_path):
    """With other frames held out the lines move a little; the poses do not move at all."""
    settings = SETTINGS.model_copy(update={"held_out_every": 0})
    map_drive(MapRequest(drive, 40.0), settings, tmp_path / "none", pictures=False)
    first, second = (read_map(folder) for folder in (tmp_path / "none", mapped[0]))
    np.testing.assert_array_equal(first.poses, second.poses)
    s = np.linspace(20.0, 150.0, 30)
    off = np.abs(first.lines[0][0].points(s) - second.lines[0][0].points(s))
    assert 0.0 < np.nanmax(off) < 1.0
    assert first.meta.verdict == "usable" and not first.held_out.any()


def test_a_rejected_map_shows_three_findings_and_what_works_without_it(drive, tmp_path):
    """The rest is folded; a remedy that sends to the strip of frames finds a heading of that name."""
    strict = VerdictSettings(min_frames=500, min_metres=50.0, min_bend_m=50.0, max_off=1e-6)
    out = tmp_path / "maps" / "one"
    report = map_drive(MapRequest(drive, 40.0), SETTINGS.model_copy(update={"verdict": strict}), out)
    verdict = report.figures["verdict"]
    assert verdict["grade"] == "reject"
    page = html.unescape((out / "report.html").read_text(encoding="utf-8"))
    first, *_ = re.findall(r"<ul>(.*?)</ul>", page, re.DOTALL)
    assert first.count("<li>") == 3
    folded = re.search(r"<details><summary>(\d+) more</summary><ul>(.*?)</ul></details>", page, re.DOTALL)
    assert folded is not None
    assert int(folded[1]) == folded[2].count("<li>") == len(verdict["reasons"]) + len(verdict["remarks"]) - 3
    assert "<h2>Strip of frames</h2>" in page
    text = re.sub("<[^>]+>", "", page)
    with pytest.raises(TrackingLostError) as refused:
        label_map(out, tmp_path / "l.parquet")
    for words in (
        f"lanenet detect {drive} --detector hough --out {out}-hough.csv --video {out}-hough.mp4",
        f"lanenet detect {drive} --model checkpoints/general --camera {out} --lane-width 40 --out {out}-net",
    ):
        assert words in text and any(words in line for line in refused.value.hints)


def test_a_rejected_map_is_not_labelled_unless_forced(mapped, tmp_path):
    folder, _ = mapped
    meta = (folder / "map.yaml").read_text()
    try:
        (folder / "map.yaml").write_text(yaml.safe_dump(yaml.safe_load(meta) | {"verdict": "reject"}))
        with pytest.raises(TrackingLostError, match="rejected: ") as refused:
            label_map(folder, tmp_path / "l.parquet")
        assert "to label it all the same: lanenet label --force" in refused.value.hints[0]
        assert not list(tmp_path.iterdir())
        label_map(folder, tmp_path / "l.parquet", force=True)
        assert read_label_index(tmp_path / "l.parquet").meta.verdict == "reject"
    finally:
        (folder / "map.yaml").write_text(meta)


@pytest.mark.slow
def test_a_killed_map_leaves_no_half_of_it_and_runs_again(drive, mapped, tmp_path):
    """Killed early, at random moments, and while the folder is being filled; then as if undisturbed."""
    out = tmp_path / "maps" / "one"
    config = tmp_path / "map.yaml"
    config.write_text(yaml.safe_dump({"find_bumper": False, "verdict": LEAST}))
    command = [sys.executable, "-m", "lanenet", "map", str(drive), "--lane-width", "40"]
    command += ["--config", str(config), "--out", str(out)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}

    def kill_when(ready, delay_s=0.0):
        process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
        deadline = time.monotonic() + 180.0
        while process.poll() is None and not ready():
            assert time.monotonic() < deadline
            time.sleep(0.002)
        time.sleep(delay_s)
        assert process.poll() is None, process.communicate()
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL

    for delay_s in (2.0, *np.random.default_rng(0).uniform(0.1, 4.0, 3)):
        begin = time.monotonic()
        kill_when(lambda end_s=begin + delay_s: time.monotonic() > end_s)
        assert not out.exists()
    kill_when(lambda: any(out.parent.glob(".one.*.tmp")))
    assert not out.exists()
    kill_when(lambda: any(out.parent.glob(".one.*.tmp/poses.csv")))
    assert not out.exists()
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "verdict: good" in done.stdout
    before = (out / "poses.csv").read_bytes()
    for name in ("poses.csv", "lanes.json", "report.json"):
        assert (out / name).read_bytes() == (mapped[0] / name).read_bytes(), name
    # What was killed leaves nothing that the next run does not clear away.
    assert [path.name for path in out.parent.iterdir()] == ["one"]
    kill_when(lambda: any(out.parent.glob(".one.*.tmp")))
    assert (out / "poses.csv").read_bytes() == before and read_map(out).meta.verdict == "good"
