"""What track files are refused for, and by which name."""

from __future__ import annotations

import math

import pytest

from datagen.world.car.car import CarSettings
from datagen.world.road.track_settings import load_track_settings
from datagen.world.world import SimulationSettings, build_world, draw_track
from lanenet.errors import ConfigError


def _file(folder, text, name="road.yaml"):
    path = folder / name
    path.write_text(text)
    return path


def _drawn(path, **more):
    return draw_track(SimulationSettings.model_validate({"track": {"file": path}, **more}))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("lane_width_cm: 10\nline_width_cm: 30\n", "key 'left': found a line 30 cm wide"),
        ("left: {width_cm: 60}\n", "key 'left': found a line 60 cm wide"),
        ("right: {kind: double, width_cm: 5, double_gap_cm: 40}\n", "key 'right': found a line 50 cm wide"),
    ],
)
def test_lines_that_leave_no_lane_are_named(tmp_path, text, found):
    path = _file(tmp_path, text + "closed: false\nlength_cm: 500\n")
    with pytest.raises(ConfigError, match=found) as error:
        _drawn(path)
    assert str(path) in str(error.value)


def test_a_file_that_is_its_own_base_is_named(tmp_path):
    first = _file(tmp_path, "file: second.yaml\n", "first.yaml")
    _file(tmp_path, "file: first.yaml\n", "second.yaml")
    with pytest.raises(ConfigError, match=r"first.yaml: key 'file': found a file that is its own base"):
        load_track_settings(first)


def test_a_base_is_looked_for_beside_the_file_that_names_it(tmp_path, monkeypatch):
    _file(tmp_path, "lane_width_cm: 33\n", "base.yaml")
    path = _file(tmp_path, "file: base.yaml\nline_width_cm: 3\n")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    settings = load_track_settings(path)
    assert (settings.lane_width_cm, settings.line_width_cm) == (33.0, 3.0)


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_a_bend_too_tight_for_the_car_is_named_in_either_direction(tmp_path, direction):
    pieces = (
        "pieces:\n- straight: {length_cm: 100}\n- arc: {radius_cm: 25, angle_deg: 90, direction: left}\n"
        "- straight: {length_cm: 400}\n"
    )
    with pytest.raises(ConfigError, match=r"radius 25\.0 cm in pieces\.1 \(arc, at 1[0-3]\d cm\)"):
        _drawn(_file(tmp_path, pieces), driver={"direction": direction})


@pytest.mark.parametrize("seed", range(5))
def test_a_donkeycar_can_turn_what_its_road_asks_for(seed):
    settings = SimulationSettings.model_validate(
        {"seed": seed, "frames": 10, "recording": "donkeycar", "track": {"preset": "duckietown"}}
    )
    world = build_world(settings)
    tightest = float(abs(world.track.curvature_per_cm).max())
    lock_rad = world.settings.donkey.full_steering_rad
    car = CarSettings()
    assert lock_rad >= min(1.1 * math.atan(car.wheelbase_cm * tightest), car.max_steering_rad)
