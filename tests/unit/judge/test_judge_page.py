"""The report page of a contest: who it is about, what the sentence says, and the hardest roads first."""

from __future__ import annotations

import re
from pathlib import Path

from datagen.judge.contest import judge
from datagen.judge.page import contest_page, contest_sentence, subject, write_page
from datagen.judge.run import TRUTH, Entrant, RunResult
from datagen.judge.settings import JudgeSettings
from datagen.world.car.camera import CameraSettings
from datagen.world.road.track_settings import TrackSettings
from datagen.world.world import SimulationSettings
from lanenet.cli.research.judge import NamedDetector

# A short open road: a run is a few dozen frames.
SETTINGS = JudgeSettings(
    tracks=("open",),
    count=5,
    laps=1,
    simulation=SimulationSettings(
        camera=CameraSettings(width=48, height=36), track=TrackSettings(length_cm=320.0), rate_hz=10.0
    ),
)


def _result(entrant: str, number: int, **changes: object) -> RunResult:
    plain = RunResult(entrant, "open", number, 1, True, "completed", 1.0, 0, 0, 1.0, 2.0, 0.5, 0.0, 10, 9.0)
    return RunResult(**{**plain.__dict__, **changes})


def test_the_sentence_is_about_the_first_that_has_to_see():
    clean = [_result(name, k) for k in range(2) for name in (TRUTH, "network")]
    assert subject(clean) == "network" and subject(clean[:1]) == TRUTH
    assert contest_sentence(clean) == (
        "network stays in its lane on 2 of 2 roads (the scripted driver on 2); it is never further than "
        "2.0 cm from the middle"
    )
    assert "scripted" not in contest_sentence(clean[:1])
    lost = _result("network", 2, departures=3, worst_offset_cm=41.0, completed=False, ended="stuck")
    said = contest_sentence([*clean, _result(TRUTH, 2), lost])
    assert "on 2 of 3 roads (the scripted driver on 3); it goes over a line 3 times, most on open_02" in said
    assert said.endswith("up to 41.0 cm from the middle of the lane; 1 run not completed")


def test_runs_that_left_the_lane_are_listed_the_worst_first():
    runs = [_result("a", k, departures=k, worst_offset_cm=5.0 + k) for k in range(4)]
    page = contest_page(SETTINGS, runs, [])
    assert re.findall(r"<td class=text>(open_\d\d)</td>", page) == ["open_03", "open_02", "open_01"]
    assert "<td class=text>a</td><td>1/4</td><td>6</td><td>0</td><td>8.0</td>" in page
    assert "None." in contest_page(SETTINGS, runs[:1], [])


def test_the_page_shows_the_hardest_roads_with_their_runs(tmp_path: Path):
    entrants = [Entrant(TRUTH), Entrant("painter", NamedDetector("painter"), "p")]
    results = judge(SETTINGS, entrants, tmp_path)
    page = write_page(tmp_path, SETTINGS, entrants, results).read_text(encoding="utf-8")
    captions = re.findall(r"<figcaption>(open_\d\d)\. truth: .*; painter: .*</figcaption>", page)
    own = [result for result in results if result.entrant == "painter"]
    hardest = max(own, key=lambda r: (not r.completed, r.departures, r.worst_offset_cm))
    assert len(captions) == len(set(captions)) == 4 and captions[0] == hardest.road
    assert page.count("data:image/jpeg") == 4 and 'class="key"' in page
