"""Whole drives: truth, commands, determinism, files."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_roads import drive_frames, frames_of

from datagen.world.car.camera import CameraSettings
from datagen.world.car.car import CarSettings, advance
from datagen.world.render.appearance import Appearance
from datagen.world.road.track import read_track
from datagen.world.road.track_settings import TrackSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings, build_world
from lanenet.config import check_settings, load_settings
from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import read_truth
from lanenet.errors import ConfigError
from lanenet.geometry.lane import POINT_NAMES, rows_of_polyline

SMALL = CameraSettings(width=80, height=60)


def _settings(**changes: object) -> SimulationSettings:
    return SimulationSettings(**{"frames": 12, "camera": SMALL, **changes})


def _stack(frames: list, name: str) -> np.ndarray:
    return np.array([getattr(frame, name) for frame in frames])


def test_same_settings_same_frames_and_another_seed_another_drive():
    a, b = list(drive_frames(_settings(seed=3))), list(drive_frames(_settings(seed=3)))
    for name in ("image_bgr", "pose", "points_cm", "steering_rad", "t_s"):
        np.testing.assert_array_equal(_stack(a, name), _stack(b, name))
    c = list(drive_frames(_settings(seed=4)))
    assert not np.allclose(_stack(a, "pose"), _stack(c, "pose"))


def test_resolved_settings_give_the_same_drive():
    settings = _settings(seed=5)
    resolved = build_world(settings).settings
    assert not resolved.random_look and resolved.track.length_cm is not None
    again = check_settings(SimulationSettings, resolved.model_dump(mode="json"), "resolved")
    for a, b in zip(drive_frames(settings), drive_frames(again), strict=True):
        np.testing.assert_array_equal(a.image_bgr, b.image_bgr)
        np.testing.assert_array_equal(a.points_cm, b.points_cm)


def test_the_look_does_not_change_the_truth():
    plain = list(drive_frames(_settings(seed=2, random_look=False)))
    rich = list(drive_frames(_settings(seed=2)))
    loud = list(drive_frames(_settings(seed=2, look=Appearance(noise_level=9.0, clutter_per_m=6.0))))
    for other in (rich, loud):
        np.testing.assert_array_equal(_stack(plain, "points_cm"), _stack(other, "points_cm"))
        np.testing.assert_array_equal(_stack(plain, "pose"), _stack(other, "pose"))
        assert (_stack(plain, "image_bgr") != _stack(other, "image_bgr")).mean() > 0.3


def test_the_car_does_not_change_the_road_or_the_wandering():
    a = build_world(_settings(seed=2))
    b = build_world(_settings(seed=2, car=CarSettings(speed_noise=0.0, steering_gain=0.8, speed_gain=0.94)))
    n = min(len(a.track.xy_cm), len(b.track.xy_cm))
    np.testing.assert_array_equal(a.track.xy_cm[:n], b.track.xy_cm[:n])
    assert a.driver.script.offset_cm(100.0) == b.driver.script.offset_cm(100.0)


def test_truth_follows_from_pose_and_track():
    world = build_world(_settings(seed=6))
    for frame in frames_of(world):
        left, right = world.track.lines_car(frame.pose, 26.0)
        expected = np.concatenate([rows_of_polyline(left), rows_of_polyline(right)])
        np.testing.assert_allclose(frame.points_cm, expected, atol=1e-9)
        width = frame.points_cm[3] - frame.points_cm[0]
        assert 39.0 < width < 50.0


def test_recorded_commands_are_not_the_motion():
    frames = list(drive_frames(_settings(seed=1, frames=120, random_look=False)))
    poses = _stack(frames, "pose")
    assert (_stack(frames, "speed_cm_s") == 60.0).all()
    # Dead reckoning with the recorded commands drifts away; the true car went another way.
    pose = poses[0]
    for frame in frames[:-1]:
        pose = advance(pose, frame.speed_cm_s / 20.0, frame.steering_rad, 26.0)
    assert np.linalg.norm(pose[:2] - poses[-1, :2]) > 10.0
    way = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
    assert np.mean(way) / 3.0 == pytest.approx(0.94, abs=0.06)
    assert np.std(way) > 0.01


def test_the_driver_stays_in_the_lane_and_wanders():
    offsets = []
    for seed, closed in ((0, False), (2, True)):
        world = build_world(
            _settings(seed=seed, frames=420, camera=CameraSettings(width=16, height=16), random_look=False,
                      track=TrackSettings(closed=closed))
        )  # fmt: skip
        frames = list(frames_of(world))
        offsets.append([world.track.nearest(f.pose[:2])[1] for f in frames])
        points = _stack(frames, "points_cm")
        # In the tightest bends the inner line turns away before it is 30 cm ahead; never both lines do.
        assert np.isfinite(points).mean() > 0.98
        assert np.isfinite(points[:, [0, 3]]).all()
        assert (np.isfinite(points[:, :3]).all(axis=1) | np.isfinite(points[:, 3:]).all(axis=1)).all()
        assert (points[:, 0] < 0.0).all() and (points[:, 3] > 0.0).all()
    assert np.max(np.abs(offsets)) < 15.0
    assert np.std(offsets) > 1.0


def test_a_loop_is_driven_more_than_once():
    world = build_world(
        _settings(seed=0, frames=450, camera=CameraSettings(width=16, height=16), random_look=False,
                  track=TrackSettings(closed=True, length_cm=700.0))
    )  # fmt: skip
    frames = list(frames_of(world))
    turned = frames[-1].pose[2] - frames[0].pose[2]
    assert abs(turned) > 2.0 * np.pi  # unwrapped
    assert world.driver.s_cm > 1.5 * 700.0
    assert np.isfinite(_stack(frames, "points_cm")[:, [0, 3]]).all()


def test_drive_on_disk(tmp_path):
    settings = _settings(seed=8, look=Appearance(jpeg_quality=70))
    calls: list[tuple[int, int]] = []
    out = simulate_drive(settings, tmp_path / "drive", lambda done, total: calls.append((done, total)))
    assert calls == [(k, 12) for k in range(1, 13)]
    frames, world = list(drive_frames(settings)), build_world(settings)
    drive = open_drive(out)
    assert len(drive) == 12
    assert drive.camera is not None and drive.camera.hash == world.camera.hash
    assert drive.lane_width_cm == 40.0
    assert drive.commands.speed_cm_s is not None and drive.commands.yaw_rate_rad_s is None
    np.testing.assert_allclose(drive.commands.steering_rad, _stack(frames, "steering_rad"), rtol=1e-8)
    np.testing.assert_allclose(drive.t_s, _stack(frames, "t_s"))
    for i, frame in enumerate(frames):  # one compression, the same in memory and on disk
        np.testing.assert_array_equal(drive.image(i), frame.image_bgr)
    truth = read_truth(out)
    assert truth is not None
    np.testing.assert_allclose(truth["x_cm"], _stack(frames, "pose")[:, 0], rtol=1e-8, atol=1e-8)
    columns = np.stack([truth[name] for name in POINT_NAMES], axis=1)
    np.testing.assert_allclose(columns, _stack(frames, "points_cm"), rtol=1e-8)
    np.testing.assert_array_equal(read_track(out / "track.json").xy_cm, world.track.xy_cm)
    header = (out / "frames.csv").read_text().splitlines()[0]
    assert header == "frame,file,t_s,speed_cm_s,steering_rad"


def test_same_settings_same_bytes(tmp_path):
    first = simulate_drive(_settings(seed=9), tmp_path / "a")
    resolved = load_settings(SimulationSettings, first / "simulation.yaml")
    second = simulate_drive(resolved, tmp_path / "b")
    names = sorted(p.relative_to(first) for p in first.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(second) for p in second.rglob("*") if p.is_file())
    assert len(names) == 12 + 6
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


def test_an_interrupted_drive_leaves_nothing(tmp_path):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_drive(_settings(), tmp_path / "drive", stop)
    assert list(tmp_path.iterdir()) == []


def test_contradictions_are_refused():
    with pytest.raises(ConfigError, match="too short for 12 frames"):
        build_world(_settings(track=TrackSettings(length_cm=150.0)))
    with pytest.raises(ConfigError, match="shortest_wander_cm 500"):
        check_settings(SimulationSettings, {"driver": {"shortest_wander_cm": 500.0}}, "x.yaml")
    with pytest.raises(ConfigError, match="did you mean 'frames'"):
        check_settings(SimulationSettings, {"frame": 3}, "x.yaml")
