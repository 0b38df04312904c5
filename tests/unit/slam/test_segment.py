"""A segment from pictures to closed poses: tracked, closed, adjusted, its laps counted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from picture_road import loop_drive, made_up_drive
from pixel_road import camera_numbers, fisheye

from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleSettings
from datagen.slam.filter.dp_slam import FilterSettings
from datagen.slam.loops.pose_graph import loop_pairs, neighbouring_laps, revisit_residuals
from datagen.slam.loops.revisits import Revisit, RevisitSettings
from datagen.slam.segment import SegmentSolver, SolvedSegment, count_laps, heading_drift
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.drives import open_drive, read_truth
from lanenet.data.drives.recording import Commands, Drive
from lanenet.errors import TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import path_lengths

SMALL = MapSettings(
    filter=FilterSettings(particles=80, max_points=80),
    bundle=BundleSettings(points=40),
    revisits=RevisitSettings(max_pairs=30),
)
LAP_FRAMES, LAP_CM = 90, 360.0


def _camera() -> Camera:
    """A wide lens that looks well down, so that many of the few dashes are in view."""
    camera = fisheye(pitch_down_rad=0.42)
    return replace(camera, K=camera.K * np.array([[0.75, 0.0, 1.0], [0.0, 0.75, 1.0], [0.0, 0.0, 1.0]]))


def _drive(frames: int, seed: int = 0) -> tuple[Drive, np.ndarray]:
    drive, poses = loop_drive(_camera(), frames, LAP_FRAMES, LAP_CM, seed)
    speed = Commands(speed_cm_s=np.full(frames, LAP_CM / LAP_FRAMES / 0.05))
    return replace(drive, commands=speed), poses


def _errors_cm(poses: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distance of each frame from the truth, with the whole path laid over it."""
    here, there = (p[:, :2] - p[:, :2].mean(axis=0) for p in (poses, true))
    u, _, v = np.linalg.svd(here.T @ there)
    assert np.linalg.det(u @ v) > 0.0
    return np.linalg.norm(there - here @ u @ v, axis=1)


@pytest.fixture(scope="module")
def solved() -> tuple[SolvedSegment, np.ndarray]:
    drive, poses = _drive(125)
    return SegmentSolver(SMALL, np.random.default_rng(0)).solve(drive, _camera()), poses


def test_laps_side_by_side_are_paired_once_each():
    # Three laps of a circle of 64 cm, the second one 5 cm further out and the third one 30 cm.
    angle = 2.0 * np.pi * np.arange(270) / 90
    radius = 64.0 + np.repeat([0.0, 5.0, 30.0], 90)
    poses = np.column_stack([radius * np.sin(angle), -radius * np.cos(angle), angle])
    pairs = neighbouring_laps(poses, 15.0, RevisitSettings())
    lap_apart = {(later - 90, later) for later in range(90, 180, 3)}
    assert lap_apart <= set(pairs)
    # The third lap is too far away. Where one lap goes over into the next, both are near.
    assert set(pairs) - lap_apart <= {(0, 87), (0, 177), (180, 267)}
    # Driven the other way round, no picture shows the same.
    back = poses.copy()
    back[90:, 2] += np.pi
    turned = neighbouring_laps(back[:180], 15.0, RevisitSettings())
    assert all((earlier < 90) == (later < 90) for earlier, later in turned)


def test_a_lap_is_held_on_each_of_the_three_before_it():
    angle = 2.0 * np.pi * np.arange(450) / 90
    poses = np.column_stack([64.0 * np.sin(angle), -64.0 * np.cos(angle), angle])
    pairs = neighbouring_laps(poses, 15.0, RevisitSettings())
    for later, laps in ((60, 0), (150, 1), (240, 2), (330, 3), (420, 3)):
        expected = [later - 90 * back for back in range(1, laps + 1)]
        assert [earlier for earlier, frame in pairs if frame == later] == expected


def test_two_laps_of_pictures_give_the_true_path(solved):
    segment, true = solved
    error = _errors_cm(segment.poses, true)
    # A thousandth of the path: 5 mm.
    assert np.sqrt(np.mean(error**2)) < 1e-3 * path_lengths(true)[-1]
    assert error.max() < 1.5
    assert segment.path_cm[-1] == pytest.approx(path_lengths(true)[-1], rel=0.01)
    assert segment.poses[-1, 2] - segment.poses[0, 2] == pytest.approx(true[-1, 2], abs=np.deg2rad(2.0))
    # The closure is what makes it so.
    assert np.sqrt(np.mean(_errors_cm(segment.open_poses, true) ** 2)) > 2.0 * np.sqrt(np.mean(error**2))


def test_revisits_are_a_lap_apart_and_meet(solved):
    segment, _ = solved
    assert len(segment.revisits) >= 5
    for revisit in segment.revisits:
        assert abs(revisit.later - revisit.earlier - LAP_FRAMES) <= 2
        assert revisit.turns == 1
    missed = np.median(np.abs(revisit_residuals(segment.poses, segment.revisits)), axis=0)
    assert missed[:2].max() < 1.0 and missed[2] < np.deg2rad(1.0)
    missed_rad = [
        segment.open_poses[r.later, 2] - segment.open_poses[r.earlier, 2] - r.relative[2] - 2.0 * np.pi
        for r in segment.revisits
    ]
    drift = heading_drift(segment.open_poses, segment.revisits)
    assert drift == pytest.approx(float(np.median(missed_rad)), abs=np.deg2rad(1.0))
    # A frame lies where the lap ends: the last bits decide which side of it that is.
    clear = np.abs(segment.path_cm - LAP_CM) > 0.5 * LAP_CM / LAP_FRAMES
    assert clear.sum() >= len(clear) - 1
    np.testing.assert_array_equal(segment.laps[clear], segment.path_cm[clear] > LAP_CM)


def test_a_known_camera_stays_and_the_frames_agree(solved):
    segment, _ = solved
    np.testing.assert_allclose(camera_numbers(segment.camera), camera_numbers(_camera()), rtol=1e-9)
    assert segment.bundle.robust_sd_px < 0.2
    assert len(segment.scans) == 125 and segment.steering is None
    assert np.abs(segment.bundle.tilt).max() < np.deg2rad(1.0)


def test_one_lap_stays_open():
    drive, true = _drive(60)
    told: list[tuple[str, int, int]] = []
    solver = SegmentSolver(SMALL, np.random.default_rng(0), lambda *step: told.append(step))
    segment = solver.solve(drive, _camera())
    # Every stage begins at once and ends, so that nobody waits for minutes before a bar that is full.
    follow, adjust = ([step[1:] for step in told if step[0] == name] for name in dict(s[:2] for s in told))
    assert [s[0] for s in told] == ["follow the drive, %"] * len(follow) + ["adjust poses"] * len(adjust)
    assert follow[-1] == (100, 100) and adjust == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert segment.revisits == []
    assert not segment.laps.any()
    np.testing.assert_array_equal(segment.poses, segment.open_poses)
    # Open, and with few dashes in so short a drive, the length is known to a sixth or so, whatever the seed.
    assert segment.path_cm[-1] == pytest.approx(path_lengths(true)[-1], rel=0.2)


def test_pictures_without_edges_cannot_be_mapped():
    gray = [np.full((120, 160, 3), 90, np.uint8)] * 60
    with pytest.raises(TrackingLostError, match=r"0 edge points per frame.*needs 20"):
        SegmentSolver(SMALL, np.random.default_rng(0)).solve(made_up_drive(gray), _camera())


def test_pairs_around_a_revisit_stay_within_the_drive():
    revisits = [Revisit(4, 60, np.zeros(3), 0.8), Revisit(30, 95, np.zeros(3), 0.8)]
    pairs = loop_pairs(revisits, np.zeros(100, np.int64))
    assert pairs == [(4 + d, 60 + d) for d in range(-4, 13, 4)] + [(30 + d, 95 + d) for d in range(-12, 5, 4)]


def _revisit(earlier: int, later: int) -> Revisit:
    return Revisit(earlier, later, np.zeros(3), 0.8)


def test_laps_are_as_long_as_the_path_between_visits():
    path = 3.0 * np.arange(350)
    revisits = [_revisit(k, k + 100) for k in range(0, 200, 20)]
    laps = count_laps(path, revisits)
    np.testing.assert_array_equal(laps, np.arange(350) // 100)


def test_revisits_that_skip_a_lap_do_not_lengthen_it():
    path = 3.0 * np.arange(350)
    revisits = [_revisit(k, k + 100) for k in range(0, 100, 20)] + [
        _revisit(k, k + 200) for k in range(0, 140, 20)
    ]
    assert count_laps(path, revisits)[-1] == 3


def test_without_revisits_all_is_one_lap():
    laps = count_laps(3.0 * np.arange(50), [])
    assert laps.dtype.kind == "i"
    assert not laps.any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_camera_that_is_off_is_found_once_the_loop_is_closed(seed):
    """From either side: the road closes, and then two starts end at one camera."""
    true = _camera()
    drive, poses = _drive(150, seed)
    found = []
    for factor, pitch_rad in ((1.06, 0.44), (0.94, 0.40)):
        start = replace(true, K=true.K * np.array([[factor, 0.0, 1.0], [0.0, factor, 1.0], [0.0, 0.0, 1.0]]))
        start = start.with_mounting(pitch_down_rad=pitch_rad, yaw_rad=0.0)
        segment = SegmentSolver(SMALL, np.random.default_rng(seed)).solve(drive, start, find_camera=True)
        # The uncertainty it tells is that of a number that was seen, not of the prior; and so short a drive
        # with so few dashes trades focal length for pitch and k1 within what it tells.
        focal_sigma = segment.bundle.sigma["focal"]
        assert focal_sigma < 0.04
        off = np.log(segment.camera.K[0, 0] / true.K[0, 0])
        assert abs(off) < 2.0 * focal_sigma
        pitch_error_rad = segment.camera.mounting.pitch_down_rad - true.mounting.pitch_down_rad
        assert abs(pitch_error_rad) < np.deg2rad(1.2)
        assert _errors_cm(segment.poses, poses).max() < 3.0
        found.append(segment.camera)
    assert found[0].K[0, 0] == pytest.approx(found[1].K[0, 0], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_simulated_drive_is_mapped_to_millimetres(tmp_path: Path, seed):
    settings = SimulationSettings.model_validate(
        {
            "seed": seed,
            "frames": 250,
            "camera": {"width": 160, "height": 120},
            "track": {"closed": True, "length_cm": 500.0, "lanes": 1, "min_radius_cm": 60.0},
        }
    )
    drive = open_drive(simulate_drive(settings, tmp_path / "drive"))
    assert drive.camera is not None
    segment = SegmentSolver(MapSettings(), np.random.default_rng(seed)).solve(drive, drive.camera)
    truth = read_truth(tmp_path / "drive")
    error = _errors_cm(segment.poses, np.stack([truth["x_cm"], truth["y_cm"]], axis=1))
    assert segment.revisits
    assert np.sqrt(np.mean(error**2)) < 1e-3 * segment.path_cm[-1]
    assert error.max() < 2.0
