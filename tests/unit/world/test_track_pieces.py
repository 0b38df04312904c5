"""Roads that are written down: pieces, settings, files, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_roads import load_track

from datagen.world.road.build import check_drivable, random_track
from datagen.world.road.pieces import Piece, lay_out, length_of
from datagen.world.road.track_settings import TrackSettings, preset, preset_names
from datagen.world.world import SimulationSettings, build_world
from lanenet.config import check_settings, dump_settings
from lanenet.errors import ConfigError

STRAIGHT = {"straight": {"length_cm": 200}}
HALF = {"arc": {"radius_cm": 80, "angle_deg": 180, "direction": "left"}}
OVAL = {"closed": True, "pieces": [STRAIGHT, HALF, STRAIGHT, HALF]}


def _arc(radius_cm: float, angle_deg: float, direction: str = "left") -> dict:
    return {"arc": {"radius_cm": radius_cm, "angle_deg": angle_deg, "direction": direction}}


def _pieces(*data: dict) -> list[Piece]:
    return [Piece.model_validate(d) for d in data]


def _write(tmp_path: Path, data: dict) -> Path:
    path = tmp_path / "road.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def test_an_oval_is_two_straights_and_two_half_circles(tmp_path):
    track = load_track(_write(tmp_path, OVAL))
    assert track.length_cm == pytest.approx(400.0 + 2.0 * np.pi * 80.0)
    straight = track.s_cm < 200.0
    np.testing.assert_allclose(track.xy_cm[straight, 1], 0.0, atol=1e-9)
    bend = (track.s_cm >= 200.0) & (track.s_cm < 200.0 + np.pi * 80.0)
    radius = np.linalg.norm(track.xy_cm[bend] - [200.0, 80.0], axis=1)
    np.testing.assert_allclose(radius, 80.0, atol=1e-6)
    np.testing.assert_allclose(track.curvature_per_cm[bend], 1.0 / 80.0, atol=1e-12)
    back = (track.s_cm > 205.0 + np.pi * 80.0) & (track.s_cm < 395.0 + np.pi * 80.0)
    np.testing.assert_allclose(track.xy_cm[back, 1], 160.0, atol=1e-6)


def _kink(angle_deg: float, direction: str = "left") -> dict:
    return {"kink": {"angle_deg": angle_deg, "direction": direction}}


def test_a_kink_turns_all_lines_at_once(tmp_path):
    straight = {"straight": {"length_cm": 100.4}}
    track = load_track(_write(tmp_path, {"pieces": [straight, _kink(90), straight]}))
    assert np.count_nonzero(track.kinks_rad) == 1
    assert track.kinks_rad.sum() == pytest.approx(0.5 * np.pi)
    assert np.abs(track.curvature_per_cm).max() < 1e-6
    for offset_cm in (20.0, -20.0):
        corner = np.array([100.4 - offset_cm, offset_cm])
        line = track.line_beside(0.0, 200.0, offset_cm)
        # Along +x to the corner, then along +y, without the ends that cross on the inside.
        off = np.minimum(np.abs(line[:, 1] - corner[1]), np.abs(line[:, 0] - corner[0]))
        assert off.max() < 2e-3 and np.linalg.norm(line - corner, axis=1).min() < 2e-3
        assert (np.diff(line[:, 0]) > -2e-3).all() and (np.diff(line[:, 1]) > -2e-3).all()
        # The renderer asks each place for its offset.
        found = [track.nearest(point)[1] for point in line]
        np.testing.assert_allclose(found, offset_cm, atol=2e-3)


def test_a_loop_of_kinks_closes_and_the_driver_keeps_to_its_lane():
    sides = [{"straight": {"length_cm": length}} for length in (150, 170, 130)]
    pieces = [part for side in 2 * sides for part in (side, _kink(60))]
    road = {"closed": True, "lane_width_cm": 60, "pieces": pieces}
    world = build_world(
        check_settings(SimulationSettings, {"frames": 2, "track": road, "driver": {"wander_cm": 0}}, "x")
    )
    assert np.rad2deg(world.track.kinks_rad.sum()) == pytest.approx(360.0, abs=0.1)
    wheelbase_cm, offsets = world.settings.car.wheelbase_cm, []
    for frame in range(300):
        front = world.car.pose[:2] + wheelbase_cm * np.array(
            [np.cos(world.car.pose[2]), np.sin(world.car.pose[2])]
        )
        offsets.append(world.track.nearest(front)[1])
        world.car.step(*world.driver.command(world.car.pose, frame / 20.0), 0.05)
    assert np.abs(offsets).max() < 0.3 * 60.0


def test_a_road_of_two_lanes_has_no_kinks():
    with pytest.raises(ConfigError, match="lanes"):
        random_track(
            check_settings(TrackSettings, {"lanes": 2, "pieces": [STRAIGHT, _kink(30), STRAIGHT]}, "x"),
            np.random.default_rng(0),
        )


def test_a_clothoid_turns_by_half_of_what_its_arc_would():
    line = lay_out(
        _pieces({"clothoid": {"length_cm": 100, "to_radius_cm": 80, "direction": "right"}}), False, "x"
    )
    assert line.heading_rad[-1] == pytest.approx(-0.5 * 100.0 / 80.0, abs=1e-12)
    np.testing.assert_allclose(line.curvature_per_cm, -np.arange(101) / 100.0 / 80.0, atol=1e-12)
    # Fresnel integral of the heading -s^2 / 16000, by a fine sum.
    s = (np.arange(100_000) + 0.5) / 1000.0
    turn = -(s**2) / 16000.0
    expected = [100.0 * np.cos(turn).mean(), 100.0 * np.sin(turn).mean()]
    np.testing.assert_allclose(line.xy_cm[-1], expected, atol=1e-6)


def test_an_s_bend_comes_out_parallel():
    line = lay_out(_pieces({"s_bend": {"radius_cm": 90, "angle_deg": 40, "direction": "right"}}), False, "x")
    assert line.heading_rad[-1] == pytest.approx(0.0, abs=1e-12)
    assert line.xy_cm[-1, 1] == pytest.approx(-2.0 * 90.0 * (1.0 - np.cos(np.deg2rad(40.0))), abs=1e-6)


@settings(max_examples=25, deadline=None)
@given(
    gap=st.floats(-2.0, 2.0),
    turn=st.floats(-0.6, 0.6),
    radius=st.floats(70.0, 150.0),
    length=st.floats(50.0, 300.0),
)
def test_a_small_gap_is_spread_over_the_loop(gap, turn, radius, length):
    pieces = _pieces(
        {"straight": {"length_cm": length}},
        _arc(radius, 180.0),
        {"straight": {"length_cm": length + gap}},
        _arc(radius, 180.0 + turn),
    )
    line = lay_out(pieces, True, "x")
    ends = np.concatenate([line.xy_cm, line.xy_cm[:1]])
    steps = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    np.testing.assert_allclose(steps, line.step_cm, atol=1e-3)
    assert len(line.xy_cm) * line.step_cm == pytest.approx(length_of(pieces))
    # The last step leads back into the first heading.
    last = line.heading_rad[-1] + line.step_cm * line.curvature_per_cm[-1]
    assert np.cos(last - line.heading_rad[0]) > np.cos(0.02)
    assert np.max(np.abs(line.curvature_per_cm)) < 1.0 / radius + 6e-4


def test_a_gap_is_named_in_cm_and_degrees(tmp_path):
    with pytest.raises(ConfigError, match=r"road.yaml: pieces: .* by 30.0 cm .* and \+0.0 degrees"):
        load_track(
            _write(tmp_path, {**OVAL, "pieces": [STRAIGHT, HALF, {"straight": {"length_cm": 230}}, HALF]})
        )
    with pytest.raises(ConfigError, match=r"-20.0 degrees"):
        load_track(_write(tmp_path, {**OVAL, "pieces": [STRAIGHT, HALF, STRAIGHT, _arc(80, 160)]}))


BAD = [
    ({"lane_width_cm": 0}, r"key 'lane_width_cm': .*greater than 0, found 0"),
    ({"line_width_cm": 0}, r"key 'line_width_cm'"),
    ({"lane_wdth_cm": 40}, r"unknown key 'lane_wdth_cm', did you mean 'lane_width_cm'"),
    ({"right": {"kind": "dashed", "dash_cm": 0}}, r"key 'right.dash_cm': .*greater than 0"),
    ({"right": {"colour": "green"}}, r"key 'right.colour'"),
    ({"right": {"interruptions": [[50, 20]]}}, r"key 'right': .*from < to"),
    ({"right": {"interruptions": [[50, 2000]]}}, r"key 'right.interruptions': found one up to 2000 cm"),
    ({"pieces": [STRAIGHT, _arc(-3, 9)]}, r"'pieces.1.arc.radius_cm'"),
    ({"pieces": [STRAIGHT, {"ark": {}}]}, r"unknown key 'pieces.1.ark', did you mean 'arc'"),
    ({"pieces": [STRAIGHT, {**STRAIGHT, **HALF}]}, r"'pieces.1': .*found straight and arc"),
    ({"pieces": [STRAIGHT, {}]}, r"'pieces.1': .*found none"),
    ({"pieces": [{"clothoid": {"length_cm": 50, "direction": "left"}}]},
     r"'pieces.0.clothoid': .*found neither"),
    ({"pieces": [STRAIGHT, _arc(20, 90)]}, r"'pieces.1.arc.radius_cm': found 20, expected more than 22"),
    ({"lanes": 2, "pieces": [STRAIGHT, _arc(60, 90)]},
     r"'pieces.1.arc.radius_cm': found 60, expected more than 62"),
    ({"pieces": [STRAIGHT, _arc(50, 350)]},
     r"meets itself: pieces.0 \(straight, at \d+ cm\) and pieces.1 \(arc, at"),
    ({"pieces": [STRAIGHT], "length_cm": 300}, r"'length_cm': found 300, but the pieces are 200.000 cm"),
    ({"pieces": [STRAIGHT], "furniture": [{"zebra": {"at_cm": 195}}]},
     r"'furniture.0.zebra.at_cm': found 195"),
    ({"pieces": [STRAIGHT, HALF], "furniture": [{"stop_line": {"at_cm": 9}}, {"junction": {"at_cm": 300}}]},
     r"'furniture.1.junction.at_cm': found a road that turns by"),
    ({**OVAL, "furniture": [{"stop_line": {"at_cm": 5000}}]}, r"'furniture.0.stop_line.at_cm': found 5000"),
    ({**OVAL, "furniture": [{"junction": {"at_cm": 100, "sides": "left", "length_cm": 200}}]},
     r"'furniture.0.junction.at_cm': it lies on .* of the road, at"),
    ({"furniture": [{"tree": {}}]}, r"unknown key 'furniture.0.tree'"),
    ({"lanes": 2, "left": {}}, r"a road of 2 lane\(s\) has the lines middle, right, far"),
    ({"far": {}}, r"key 'far': a road of 1 lane"),
    ({"lanes": 3}, r"key 'lanes'"),
]  # fmt: skip


@pytest.mark.parametrize(("data", "message"), BAD, ids=[m[:40] for _, m in BAD])
def test_bad_files_are_refused_with_the_place(tmp_path, data, message):
    path = _write(tmp_path, data)
    with pytest.raises(ConfigError, match=message) as caught:
        load_track(path)
    assert str(path) in str(caught.value)


def test_a_figure_of_eight_is_refused():
    cross = [STRAIGHT, _arc(80, 270), {"straight": {"length_cm": 300}}, _arc(80, 270, "right")]
    with pytest.raises(ConfigError, match="meets itself"):
        random_track(TrackSettings(pieces=cross), np.random.default_rng(0))


def test_bends_that_the_car_cannot_turn_are_refused(tmp_path):
    track = load_track(_write(tmp_path, OVAL))
    check_drivable(track, 79.9)
    with pytest.raises(ConfigError, match=r"bend of radius 80.0 cm at \d+ cm, expected at least 100.0"):
        check_drivable(track, 100.0)


def test_a_resolved_road_is_the_same_road(tmp_path):
    data = {
        **OVAL,
        "lanes": 2,
        "middle": {"kind": "double", "colour": "yellow", "wear": 0.2},
        "pieces": [STRAIGHT, _arc(120, 180), STRAIGHT, _arc(120, 180)],
        "furniture": [{"zebra": {"at_cm": 100}}, {"parking": {"at_cm": 100, "side": "right"}}],
        "random_furniture": {"arrow_per_m": 0.5},
    }
    path = _write(tmp_path, data)
    first = SimulationSettings(track={"file": path, "lane_width_cm": 30})
    assert first.track.lane_width_cm == 30.0 and first.track.file is None
    again = check_settings(SimulationSettings, yaml.safe_load(dump_settings(first)), "resolved")
    a, b = (random_track(s.track, np.random.default_rng(4)) for s in (first, again))
    np.testing.assert_array_equal(a.xy_cm, b.xy_cm)
    np.testing.assert_array_equal(a.boxes, b.boxes)
    for m, n in zip(a.markings, b.markings, strict=True):
        assert (m.offset_cm, m.width_cm, m.colour_bgr) == (n.offset_cm, n.width_cm, n.colour_bgr)
        np.testing.assert_array_equal(m.painted_cm, n.painted_cm)


def test_a_drive_knows_how_long_the_pieces_are():
    road = TrackSettings(pieces=[STRAIGHT])
    assert road.length_cm == 200.0
    with pytest.raises(ConfigError, match="length_cm 200 is too short"):
        build_world(SimulationSettings(track=road, camera={"width": 16, "height": 16}, frames=100))


def test_errors_of_a_file_inside_a_config_name_both(tmp_path):
    path = _write(tmp_path, {"pieces": [{"straight": {"length": 3}}]})
    with pytest.raises(
        ConfigError, match=r"sim.yaml: key 'track': .*road.yaml: .*'pieces.0.straight.length'"
    ):
        check_settings(SimulationSettings, {"track": {"file": str(path)}}, "sim.yaml")


def test_presets_and_what_changes_them():
    assert set(preset_names()) == {
        "bfmc",
        "carolo_cup",
        "donkey_tape",
        "duckietown",
        "garage",
        "mat",
        "paper",
    }
    carolo = preset("carolo_cup")
    assert 35.0 <= carolo.lane_width_cm <= 45.0 and carolo.line_width_cm == 2.0
    assert carolo.middle is not None and (carolo.middle.dash_cm, carolo.middle.gap_cm) == (20.0, 20.0)
    bfmc = preset("bfmc")
    assert bfmc.lane_width_cm - bfmc.line_width_cm == 35.0 and bfmc.line_width_cm == 2.0
    duck = preset("duckietown")
    assert (duck.lane_width_cm, duck.line_width_cm) == (23.0, 5.0)
    assert duck.middle is not None
    assert (duck.middle.colour, duck.middle.width_cm, duck.middle.dash_cm) == ("yellow", 2.5, 5.0)
    changed = check_settings(TrackSettings, {"preset": "duckietown", "middle": {"gap_cm": 3}}, "x")
    assert changed.middle is not None and (changed.middle.gap_cm, changed.middle.dash_cm) == (3.0, 5.0)
    with pytest.raises(ConfigError, match="no preset 'bfnc', did you mean 'bfmc'"):
        preset("bfnc")
    with pytest.raises(ConfigError, match="expected one of them"):
        check_settings(TrackSettings, {"preset": "bfmc", "file": "x.yaml"}, "x")


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_gives_roads_that_the_car_can_drive(name):
    for seed in range(3):
        track = random_track(preset(name), np.random.default_rng(seed))
        check_drivable(track, 26.0 / np.tan(0.45))
        check_drivable(track.reversed(), 26.0 / np.tan(0.45))
