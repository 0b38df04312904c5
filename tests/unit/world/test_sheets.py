"""Sheets for the eye, and what was mended after looking at them."""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from datagen.world import sheets
from datagen.world.render.appearance import Appearance
from datagen.world.render.scene import place_objects
from datagen.world.road.build import random_track
from datagen.world.road.furniture import COLOURS, Furniture, Junction
from datagen.world.road.track_settings import TrackSettings, preset, preset_names
from datagen.world.sheets import EFFECT_SHEETS, Effect, draw_sheet, encode_sheet, sheet_names
from lanenet.cli.app import app
from lanenet.errors import ConfigError


@pytest.fixture
def small_sheets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sheets, "_ROAD_COLUMNS", 1)
    monkeypatch.setattr(sheets, "_ROAD_ROWS", 1)
    monkeypatch.setitem(
        EFFECT_SHEETS, "sensor", (("paper",), (Effect("ideal"), Effect("noise", {"noise_level": 9.0})))
    )


def test_there_are_twelve_sheets_and_every_preset_has_one() -> None:
    assert len(sheet_names()) == 12 and set(preset_names()) <= set(sheet_names())
    with pytest.raises(ConfigError, match="no sheet 'moon', expected one of bfmc"):
        draw_sheet("moon")


def test_a_preset_is_shown_with_its_true_lines_beside_its_edges(small_sheets: None) -> None:
    sheet = draw_sheet("paper")
    assert sheet.shape == (240 + 18, 640, 3)
    frame, above = sheet[18:, :320].astype(int), sheet[18:, 320:].astype(int)
    for picture in (frame, above):
        # Left cyan, right red; nothing else of a paper road under a grey look is as colourful.
        left = (picture[..., 0] - picture[..., 2] > 120).sum()
        right = (picture[..., 2] - picture[..., 0] > 120).sum()
        assert left > 40 and right > 40
    assert (above == 0).all(axis=2).sum() > 200 and (above == 255).all(axis=2).mean() > 0.7
    np.testing.assert_array_equal(draw_sheet("paper"), sheet)


def test_effects_stand_beside_the_same_place_without_them(small_sheets: None) -> None:
    sheet = draw_sheet("sensor")
    assert sheet.shape == (258, 644, 3)
    ideal, noisy = sheet[18:, :320].astype(float), sheet[18:, 324:].astype(float)
    # Where neither end of the scale is near, the noise is as large as it was set.
    inner = (ideal > 50) & (ideal < 200)
    assert (noisy - ideal)[inner].std() == pytest.approx(9.0, rel=0.1)
    assert abs((noisy - ideal)[inner].mean()) < 0.3


def test_a_sheet_shrinks_until_it_fits() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (300, 400, 3)).astype(np.uint8)
    whole = cv2.imdecode(np.frombuffer(encode_sheet(noise), np.uint8), cv2.IMREAD_COLOR)
    assert whole.shape == noise.shape
    data = encode_sheet(noise, 12_000)
    assert 4_000 < len(data) <= 12_000
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape[0] < 300


def test_the_verb_writes_what_is_asked_for(small_sheets: None, tmp_path) -> None:
    words = ["sheets", "paper", "sensor", "--out", str(tmp_path / "s"), "--max-kb", "20"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    written = sorted(path.name for path in (tmp_path / "s").iterdir())
    assert written == ["paper.jpg", "sensor.jpg"]
    assert all(path.stat().st_size <= 20_000 for path in (tmp_path / "s").iterdir())
    bad = CliRunner().invoke(app, ["sheets", "paper", "moon", "--out", str(tmp_path / "t")])
    assert bad.exit_code == 1 and "no sheet 'moon'" in bad.stderr and not (tmp_path / "t").exists()


@pytest.mark.parametrize("seed", range(3))
def test_no_two_things_stand_in_each_other(seed: int) -> None:
    track = random_track(TrackSettings(closed=True, length_cm=1200.0), np.random.default_rng(seed))
    look = Appearance(objects_per_m=6.0)
    solids = place_objects(track, look, *np.random.default_rng(seed).spawn(2)).solids
    assert len(solids) > 40

    def outline(row: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...], float]:
        angle = float(np.rad2deg(np.arctan2(row[3], row[2])))
        return tuple(row[:2]), tuple(2.0 * row[4:6]), angle

    compared = 0
    for one, other in combinations(solids, 2):
        # Parts of one thing lie within 30 cm of each other.
        if np.hypot(*(one[:2] - other[:2])) < 30.0:
            continue
        compared += 1
        met, _ = cv2.rotatedRectangleIntersection(outline(one), outline(other))
        assert met == cv2.INTERSECT_NONE
    assert compared > 500


def test_a_thing_without_room_leaves_the_others_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    track = random_track(TrackSettings(closed=True, length_cm=1200.0), np.random.default_rng(0))

    def rows() -> set[bytes]:
        rngs = np.random.default_rng(0).spawn(2)
        return {row.tobytes() for row in place_objects(track, Appearance(objects_per_m=6.0), *rngs).solids}

    apart = rows()
    monkeypatch.setattr("datagen.world.render.scene._overlap", lambda one, other: False)
    assert apart < rows()


@pytest.mark.parametrize("seed", range(4))
def test_random_crossings_stay_between_the_lines_of_a_bend(seed: int) -> None:
    rates = {"zebra_per_m": 1.0}
    settings = TrackSettings(closed=True, length_cm=1500.0, random_furniture=rates, lanes=2)
    track = random_track(settings, np.random.default_rng(seed))
    assert len(track.boxes) > 5
    for x, y, c, s, half_cm, *_ in track.boxes:
        for end in (-half_cm, half_cm):
            _, offset_cm = track.nearest(np.array([x + end * c, y + end * s]))
            # Half a bar, and what straight bars leave the bend by.
            assert abs(offset_cm - track.middle_cm) < track.half_width_cm + 2.5


def test_bars_and_dashes_of_a_side_road_have_colours_of_their_own() -> None:
    junction = Junction(at_cm=300, width_cm=60, stop_colour="red", middle_colour="yellow", length_cm=150)
    plain = Junction(at_cm=300, width_cm=60, length_cm=150)
    boxes = {}
    for name, item in (("own", junction), ("plain", plain)):
        settings = TrackSettings(
            lanes=2,
            pieces=[{"straight": {"length_cm": 600}}],
            furniture=[Furniture(junction=item).model_dump()],
        )
        boxes[name] = random_track(settings, np.random.default_rng(0)).boxes
    np.testing.assert_array_equal(boxes["own"][:, :6], boxes["plain"][:, :6])
    colours = {tuple(row) for row in boxes["own"][:, 6:]}
    assert colours == {COLOURS["white"], COLOURS["red"], COLOURS["yellow"]}
    assert {tuple(row) for row in boxes["plain"][:, 6:]} == {COLOURS["white"]}


def test_duckietown_stops_at_red_bars() -> None:
    tracks = [random_track(preset("duckietown"), np.random.default_rng(seed)) for seed in range(6)]
    painted = np.concatenate([track.boxes[:, 6:] for track in tracks])
    assert (painted == COLOURS["red"]).all(axis=1).any() and (painted == COLOURS["yellow"]).all(axis=1).any()
