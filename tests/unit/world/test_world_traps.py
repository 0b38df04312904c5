"""What is hard to map: roads that cross themselves, lanes that widen, recordings with gaps."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.world.car.camera import CameraSettings
from datagen.world.car.recording import BangBang, recorded_frames
from datagen.world.road.build import random_track
from datagen.world.road.track import is_painted, read_track, write_track
from datagen.world.road.track_picture import painted_bounds_cm
from datagen.world.road.track_settings import TrackSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.config import check_settings
from lanenet.data.drives import open_drive, read_truth
from lanenet.errors import ConfigError
from lanenet.geometry.lane import POINT_NAMES

LEG = {"straight": {"length_cm": 180}}
EIGHT = {
    "closed": True,
    "interruptions_per_m": 0,
    "left": {"kind": "solid"},
    "pieces": [
        LEG,
        {"arc": {"radius_cm": 90, "angle_deg": 270, "direction": "left"}},
        LEG,
        {"arc": {"radius_cm": 90, "angle_deg": 270, "direction": "right"}},
    ],
}
OVAL = {
    "closed": True,
    "interruptions_per_m": 0,
    "left": {"kind": "solid"},
    "pieces": [LEG, {"arc": {"radius_cm": 80, "angle_deg": 180, "direction": "left"}}] * 2,
}


def _track(data: dict):
    return random_track(check_settings(TrackSettings, data, "track"), np.random.default_rng(0))


def test_a_figure_of_eight_closes_and_is_open_where_it_crosses():
    track = _track(EIGHT | {"crosses": True})
    assert np.linalg.norm(track.xy_cm[-1] - track.xy_cm[0]) == pytest.approx(track.step_cm, abs=0.01)
    assert np.ptp(track.heading_rad) == pytest.approx(1.5 * np.pi, abs=0.01)
    # Straight ahead from the origin, the legs cross after half of their length.
    crossing = np.array([90.0, 0.0])
    half_cm = 0.5 * track.lane_width_cm
    for marking in track.markings:
        line = track.beside(np.arange(len(track.s_cm)), marking.offset_cm)
        off = np.abs(line - crossing)
        inside = (off < half_cm).all(axis=1)
        assert not is_painted(marking.painted_cm, track.s_cm[inside]).any()
        assert is_painted(marking.painted_cm, track.s_cm[off.max(axis=1) > 2.0 * half_cm]).all()


def test_a_road_that_crosses_itself_says_so():
    with pytest.raises(ConfigError):
        _track(EIGHT)
    with pytest.raises(ConfigError, match="crosses"):
        _track({"closed": True, "crosses": True})
    # Not even then beside itself.
    beside = [LEG, {"arc": {"radius_cm": 22, "angle_deg": 180, "direction": "left"}}] * 2
    with pytest.raises(ConfigError):
        _track(EIGHT | {"crosses": True, "pieces": beside})


def test_a_lane_widens_in_bends_and_its_lines_are_its_truth(tmp_path):
    track = _track(OVAL | {"widening": 0.3})
    widths = []
    for s_cm in (90.0, 180.0 + 0.5 * np.pi * 80.0):
        xy, heading = track.point(s_cm)
        pose = np.array([*xy, heading])
        left, right = track.lines_car(pose, 0.0)
        widths.append(np.interp(0.0, right[:, 1], right[:, 0]) - np.interp(0.0, left[:, 1], left[:, 0]))
        # Its tape lies along the lines of the truth.
        near = track.boxes[np.linalg.norm(track.boxes[:, :2] - xy, axis=1) < 35.0, :2]
        c, s = np.cos(heading), np.sin(heading)
        tape = (near - xy) @ np.array([[s, c], [-c, s]])  # right and ahead
        lines = np.concatenate([left, right])
        assert len(near) > 10
        assert np.linalg.norm(tape[:, None] - lines, axis=2).min(axis=1).max() < 0.7
    assert widths == pytest.approx([40.0, 52.0], abs=0.7)
    write_track(tmp_path / "track.json", track)
    again = read_track(tmp_path / "track.json")
    np.testing.assert_allclose(again.width_factors, track.width_factors, atol=1e-6)
    back = track.reversed()
    assert back.width_factors[round(90.0 / back.step_cm)] == pytest.approx(
        float(np.interp(back.length_cm - 90.0, track.s_cm, track.width_factors)), abs=1e-3
    )
    with pytest.raises(ConfigError, match="widening"):
        _track({"closed": True, "widening": 0.3, "lanes": 2})


BACK = [
    {"straight": {"length_cm": 200}},
    {"arc": {"radius_cm": 80, "angle_deg": 230, "direction": "left"}},
    {"straight": {"length_cm": 95}},
]
MAT = OVAL | {
    "lane_width_cm": 22,
    "right": {"kind": "dashed"},
    "left": {"kind": "solid", "colour": "yellow"},
    "extra_lines": [{"at_lanes": -1.5}, {"at_lanes": 1.5, "kind": "dashed"}, {"at_lanes": 2.5}],
}


def test_further_lines_lie_beside_the_driven_lane():
    track = _track(MAT)
    offsets = {round(marking.offset_cm, 6): len(marking.painted_cm) for marking in track.markings}
    assert sorted(offsets) == [-33.0, -11.0, 11.0, 33.0, 55.0]
    assert offsets[-33.0] == offsets[11.0] == offsets[55.0] == 1
    assert min(offsets[-11.0], offsets[33.0]) > 10
    assert [marking.offset_cm for marking in track.reversed().markings] == [
        pytest.approx(-marking.offset_cm) for marking in track.markings
    ]
    # The lane that is driven, and its truth, are those of the road without them.
    alone = _track({name: value for name, value in MAT.items() if name != "extra_lines"})
    pose = np.array([100.0, 0.0, 0.0])
    np.testing.assert_array_equal(track.truth(pose, 20.0), alone.truth(pose, 20.0))
    low, high = painted_bounds_cm(track, 0.0)
    assert (high - low)[1] == pytest.approx(160.0 + 2.0 * 55.0, abs=0.1)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"pieces": [], "length_cm": 900}, "extra_lines"),
        # Inside the bends of 80 cm radius.
        ({"extra_lines": [{"at_lanes": 3.6}]}, "radius_cm"),
        # It comes back to within 58 cm.
        ({"pieces": BACK, "closed": False}, "meets itself"),
    ],
)
def test_further_lines_need_room(changes, named):
    with pytest.raises(ConfigError, match=named):
        _track(MAT | changes)
    _track(MAT | changes | {"extra_lines": []})


def test_a_lens_beside_the_middle_has_the_same_focal_length():
    plain = CameraSettings(width=640, height=480).build(20.0)
    moved = CameraSettings(width=640, height=480, off_middle_px=(80.0, -30.0)).build(20.0)
    np.testing.assert_allclose(moved.K - plain.K, [[0.0, 0.0, 80.0], [0.0, 0.0, -30.0], [0.0, 0.0, 0.0]])
    ahead = np.array([[5.0, 40.0]])
    np.testing.assert_allclose(moved.project_ground(ahead) - plain.project_ground(ahead), [[80.0, -30.0]])


def test_pulses_and_pauses_are_as_in_public_tubs():
    pulses = recorded_frames("pulses", 20_000, np.random.default_rng(3))
    starts = np.flatnonzero(np.diff(pulses.astype(int)))
    runs, gaps = np.diff(starts)[::2], np.diff(starts)[1::2]
    if not pulses[starts[0] + 1]:
        runs, gaps = gaps, runs
    assert runs.min() >= 3
    assert runs.max() <= 25
    assert 6 <= np.median(runs) <= 8
    assert gaps.min() >= 3 and 0.7 < np.mean(gaps <= 5) < 0.8 and gaps.max() > 20
    pauses = recorded_frames("pauses", 3000, np.random.default_rng(3))
    edges = np.flatnonzero(np.diff(pauses.astype(int)))
    assert np.sum(np.diff(edges) > 150) >= 2  # twice the car is put elsewhere
    assert recorded_frames("none", 10, np.random.default_rng(3)).all()


def test_a_keyboard_steers_as_far_as_the_driver():
    bang, wanted = BangBang(), np.sin(np.arange(200) / 15.0) * 0.4 + 0.1
    given = np.array([bang.angle(angle) for angle in wanted])
    assert set(given) == {-1.0, 0.0, 1.0}
    assert np.abs(np.cumsum(given) - np.cumsum(wanted)).max() <= 0.5 + 1e-9


@pytest.mark.slow
def test_a_recording_with_gaps_is_the_whole_one_without_some_of_its_frames(tmp_path):
    whole = {
        "frames": 40,
        "recording": "donkeycar",
        "camera": {"width": 64, "height": 48},
        "track": {"preset": "paper"},
    }
    gaps = whole | {"gaps": "pulses", "angles": "bang"}
    drives = []
    for name, data in (("whole", whole), ("gaps", gaps)):
        path = simulate_drive(check_settings(SimulationSettings, data, name), tmp_path / name)
        drives.append((open_drive(path), read_truth(path)))
    (all_of_it, truth), (part, part_truth) = drives
    kept = np.flatnonzero(np.isin(np.round(all_of_it.t_s, 6), np.round(part.t_s, 6)))
    assert 5 < len(kept) == len(part) < 40
    assert np.diff(part.t_s).max() > 0.15
    for name in ("x_cm", "heading_rad", *POINT_NAMES):
        np.testing.assert_array_equal(part_truth[name], truth[name][kept])
    for row, of_all in enumerate(kept[:3]):
        np.testing.assert_array_equal(part.image(row), all_of_it.image(int(of_all)))
    with pytest.raises(ConfigError, match="angles"):
        bad = check_settings(SimulationSettings, {"angles": "bang", "frames": 5}, "bad")
        simulate_drive(bad, tmp_path / "bad")
