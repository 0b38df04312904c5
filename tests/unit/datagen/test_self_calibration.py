"""The camera from a drive: what is refused and why, and what the uncertainties are worth."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_up_drive import made_up_drive
from scipy.interpolate import make_lsq_spline

import datagen.segments
import datagen.slam.camera.self_calibration
from datagen.calibrate_drive import calibrate_drive, starting_camera, straight_frames
from datagen.lanes.scale import LaneScale, ahead_sigma, fitted_width, spacing_cm, width_sigma
from datagen.lanes.trace import TracedLane
from datagen.prepare import MapRequest, keep_images, prepare
from datagen.segments import fit_height
from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import CAMERA_NAMES, BundleResult, BundleSettings
from datagen.slam.camera.coarse import guessed_camera, nudged
from datagen.slam.camera.self_calibration import (
    FoundCamera,
    check_observable,
    find_camera,
    honest_sigma,
    prior_strain,
    refining,
)
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.loops.revisits import Revisit
from datagen.slam.odometry.scans import pack_scans
from datagen.slam.segment import SegmentSolver, SolvedSegment
from datagen.slam.settings import GuessSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.camera_file import write_camera
from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.maps.line import LaneLine
from lanenet.errors import CalibrationError
from lanenet.perception.edges.road import RoadEdges

CAMERA = guessed_camera(160, 120, 80.0, 15.0, GuessSettings())
SIGMA = dict(zip(CAMERA_NAMES, (0.01, 0.4, 0.4, 0.004, 0.004, 0.003, 0.006, 0.04), strict=True))
REVISIT = Revisit(10, 200, np.zeros(3), 0.8, 1)


def found(heading: np.ndarray, revisits: int = 8, focal_sigma: float = 0.02) -> FoundCamera:
    """A drive of 3 cm per frame with this heading."""
    n = len(heading)
    steps = 3.0 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    poses = np.column_stack([np.cumsum(steps, axis=0), heading])
    nothing = pack_scans([RoadEdges(np.empty((0, 2)), np.empty((0, 2)))] * n, 15.0)
    bundle = BundleResult(
        poses,
        np.zeros((n, 2)),
        CAMERA,
        SIGMA,
        np.zeros(5),
        np.zeros((0, 2), int),
        np.zeros(0, int),
        np.zeros(0),
    )
    trajectory = Trajectory(poses, np.ones(n), np.ones(n), np.zeros(n))
    places = [REVISIT] * revisits
    solved = SolvedSegment(
        np.arange(n), CAMERA, nothing, trajectory, poses, poses, None, places, bundle, np.zeros(n, np.int64)
    )
    return FoundCamera(solved, [], {**SIGMA, "focal": focal_sigma}, False, 0.5)


def write_drive(folder: Path, places_px: np.ndarray, noise: float = 1.0) -> Path:
    """A wall of blobs that passes by, seen from these places."""
    rng = np.random.default_rng(0)
    wall = np.kron(rng.uniform(40.0, 200.0, (4, 60)), np.ones((12, 12)))
    with DriveWriter(folder) as writer:
        for k, place in enumerate(places_px):
            gray = wall[:48, int(place) : int(place) + 64] + noise * rng.standard_normal((48, 64))
            writer.add(
                np.repeat(gray.clip(0, 255).astype(np.uint8)[..., None], 3, axis=2), 0.05 * k, truth=None
            )
    return folder


def test_a_drive_that_is_too_short_is_refused_with_what_to_drive(tmp_path):
    drive = write_drive(tmp_path / "d", np.arange(60) * 3.0)
    with pytest.raises(CalibrationError, match=r"60 frames, expected 200: drive two laps of a closed track"):
        calibrate_drive(drive, 40.0, None, None, MapSettings())


def test_a_car_that_stands_is_refused(tmp_path):
    places = np.concatenate([np.arange(100) * 3.0, np.full(150, 297.0)])
    drive = write_drive(tmp_path / "d", places)
    with pytest.raises(CalibrationError, match=r"1\d\d of 250 frames show a car that moves, expected 200"):
        calibrate_drive(drive, 40.0, None, None, MapSettings())


def test_a_car_that_only_reverses_is_refused(tmp_path):
    with DriveWriter(tmp_path / "d") as writer:
        rng = np.random.default_rng(0)
        for k in range(220):
            image = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
            writer.add(image, 0.05 * k, speed_cm_s=-20.0, truth=None)
    with pytest.raises(CalibrationError, match=r"reverse in frames .*Drive two laps"):
        calibrate_drive(tmp_path / "d", 40.0, None, None, MapSettings())


def test_lengths_and_sizes_have_to_be_known(tmp_path):
    drive = write_drive(tmp_path / "d", np.arange(60) * 3.0)
    with pytest.raises(CalibrationError, match="the lane's width or the camera's height, found neither"):
        calibrate_drive(drive, None, None, None, MapSettings())
    with pytest.raises(CalibrationError, match=r"64x48 px, but the camera to refine is for 160x120"):
        calibrate_drive(drive, None, None, CAMERA, MapSettings())


def test_a_known_camera_is_refined_on_request_only(tmp_path):
    drive = write_drive(tmp_path / "d", np.arange(5) * 3.0)
    path = tmp_path / "camera.yaml"
    write_camera(path, CAMERA, "made up")
    assert starting_camera(drive, None, False) == (None, [])
    start, notes = starting_camera(drive, path, True)
    assert start is not None and start.hash == CAMERA.hash and not notes
    with pytest.raises(CalibrationError, match="--refine"):
        starting_camera(drive, path, False)
    with pytest.raises(CalibrationError, match="no camera to refine"):
        starting_camera(drive, None, True)


def test_an_axis_far_off_the_middle_of_the_image_is_named():
    ordinary = found(np.linspace(0.0, 4.0 * np.pi, 400))
    K = np.array(CAMERA.K)
    K[:2, 2] += [-21.0, 4.0]
    far_off = replace(ordinary, solved=replace(ordinary.solved, camera=replace(CAMERA, K=K)))
    assert "-21, +4 px off the middle of the image" in far_off.note
    assert "off the middle" not in ordinary.note


def test_two_laps_determine_the_camera():
    assert check_observable(found(np.linspace(0.0, 4.0 * np.pi, 400)), "d", False) == []
    # A figure of eight turns as much one way as the other.
    eight = np.abs((np.linspace(0.0, 2.0, 400) % 2.0) - 1.0) * 1.5 * np.pi
    assert check_observable(found(eight), "d", False) == []


@pytest.mark.parametrize(
    ("heading", "revisits", "message"),
    [
        (
            np.zeros(400),
            0,
            "too straight: 400 frames, 80 camera heights long.* within 0 degrees, expected 180",
        ),
        # Swinging along a straight road is no bend, and places seen twice there cannot be.
        (0.4 * np.sin(np.arange(400) / 8.0), 4, "too straight.* within 46 degrees"),
        (np.linspace(0.0, 6.0, 400), 0, "no places were certainly seen twice.* bends of 344 degrees"),
        (np.linspace(0.0, 6.0, 400), 3, "3 places were certainly seen twice, expected 6"),
    ],
)
def test_a_drive_that_leaves_the_focal_length_open_is_refused(heading, revisits, message):
    camera = found(heading, revisits, focal_sigma=0.3)
    with pytest.raises(CalibrationError, match=message) as caught:
        check_observable(camera, "tub", False)
    assert "two laps of a closed track, or of a figure of eight" in str(caught.value)
    assert str(caught.value).startswith("tub: ") and "--accept-open-loop" in str(caught.value)
    (note,) = check_observable(camera, "tub", True)
    assert "the focal length is guessed, give or take 30 %" in note


def test_a_wide_focal_length_is_refused():
    lap = np.linspace(0.0, 4.0 * np.pi, 400)
    assert check_observable(found(lap, focal_sigma=0.049), "d", False) == []
    with pytest.raises(CalibrationError, match=r"6\.0 % .*8 revisits.*expected at most 5 %"):
        check_observable(found(lap, focal_sigma=0.06), "d", True)


def test_pictures_that_bend_the_camera_are_refused():
    camera = found(np.linspace(0.0, 4.0 * np.pi, 400))
    (note,) = check_observable(replace(camera, strain=2.2), "tub", False)
    assert "2.2 standard deviations" in note
    with pytest.raises(
        CalibrationError, match=r"^tub: .*3\.3 standard deviations .*mirrored.*; measure the camera"
    ):
        check_observable(replace(camera, strain=3.3), "tub", True)


def test_strain_widens_uncertainties_and_an_open_loop_knows_no_more_of_the_lens_than_the_prior():
    priors, solved = BundleSettings(), found(np.linspace(0.0, 4.0 * np.pi, 400)).solved
    closed = honest_sigma(solved, 0.4, priors, 320)
    assert closed == SIGMA
    strained = honest_sigma(solved, 3.0, priors, 320)
    assert strained["focal"] == pytest.approx(3.0 * closed["focal"])
    held = dict.fromkeys(CAMERA_NAMES, 1e-9) | {"pitch": 0.002}
    unsure = replace(solved, bundle=replace(solved.bundle, sigma=held), decided=False)
    opened = honest_sigma(unsure, 0.0, priors, 320)
    assert opened["focal"] == priors.focal and opened["k1"] == priors.k1
    assert opened["cx"] == opened["cy"] == 2.0 * priors.centre_px
    assert opened["pitch"] == pytest.approx(0.002)


def test_heading_that_odometry_misses_in_a_lap_may_be_the_lens():
    # 0.3 rad in a lap are what a focal length gives that is 2 % off.
    solved = replace(found(np.linspace(0.0, 4.0 * np.pi, 400)).solved, missed=1.5)
    sigma = honest_sigma(solved, 0.4, BundleSettings(), 320)
    assert sigma["focal"] == pytest.approx(math.hypot(SIGMA["focal"], 0.03))
    assert sigma | {"focal": 0.0} == SIGMA | {"focal": 0.0}


@pytest.mark.parametrize("name", CAMERA_NAMES)
def test_a_nudge_changes_one_number_and_comes_back(name):
    there = nudged(CAMERA, name, 0.02)
    assert there.hash != CAMERA.hash and nudged(there, name, -0.02).hash == CAMERA.hash
    strain = prior_strain(there, CAMERA, BundleSettings())
    expected = {"cx": 0.01, "cy": 0.01, "roll": 0.5}.get(name, 0.0)
    assert strain == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("answers", "starts"),
    [
        # What each start gives: focal length, and whether a loop closed; and the starts that follow.
        ([(81.0, True)], [80.0]),
        ([(90.0, True), (91.0, True)], [80.0, 90.0]),
        ([(90.0, True), (95.0, True), (99.0, True), (110.0, True)], [80.0, 90.0, 95.0, 99.0]),
        # The focal length stays, but the odometry with this camera contradicts the closed loop.
        ([(81.0, True, 2.0), (81.0, True, 0.2)], [80.0, 81.0]),
        ([(80.0, False), (79.0, True)], [80.0, 80.0]),
        ([(80.0, False), (80.0, False), (95.0, True)], [80.0, 80.0, 96.0]),
        ([(90.0, True), (90.0, False)], [80.0, 90.0]),
    ],
)
def test_a_start_that_was_far_off_is_replaced(monkeypatch, answers, starts):
    asked: list[float] = []
    lap = np.linspace(0.0, 4.0 * np.pi, 400)

    def solve(self, drive, camera, find_camera, prior_camera=None):
        asked.append(float(camera.K[0, 0]))
        # Roll and principal point are believed to be as usual, whatever came out before; the drive is
        # followed with what a closed loop has found.
        usual = camera if prior_camera is None else prior_camera
        assert usual.mounting.roll_rad == 0.0 and usual.K[0, 2] == 79.5 and find_camera
        once_closed = any(was_closed for _, was_closed, *_ in answers[: len(asked) - 1])
        assert camera.mounting.roll_rad == pytest.approx(0.04 if once_closed else 0.0)
        focal_px, closed, *missed = answers[len(asked) - 1]
        adjusted = nudged(nudged(nudged(CAMERA, "roll", 0.04), "cx", 2.0), "focal", np.log(focal_px / 80.0))
        solved = found(lap, 8 if closed else 0).solved
        bundle = replace(solved.bundle, camera=adjusted)
        return replace(solved, camera=adjusted, bundle=bundle, missed=float(sum(missed)))

    monkeypatch.setattr(SegmentSolver, "solve", solve)
    monkeypatch.setattr(datagen.slam.camera.self_calibration, "coarse_camera", lambda *_: (CAMERA, []))
    solver = SegmentSolver(MapSettings(), np.random.default_rng(0))
    result = find_camera(made_up_drive(400), None, solver)
    assert asked == pytest.approx(starts)
    closed = [focal_px for focal_px, was_closed, *_ in answers if was_closed]
    assert result.closed and result.camera.K[0, 0] == pytest.approx(closed[-1])
    assert result.strain == pytest.approx(np.hypot(1.0, sum(answers[-1][2:])))
    assert not result.refined and "from the drive" in result.note


def test_priors_about_a_known_camera_are_never_wider():
    wide, close = BundleSettings(), refining(BundleSettings())
    assert close.focal < wide.focal and close.pitch < wide.pitch and close.roll == wide.roll
    own = BundleSettings(focal=0.01)
    assert refining(own).focal == 0.01
    closer = {"focal", "centre_px", "k1", "pitch", "yaw", "lever"}
    assert close.model_dump(exclude=closer) == wide.model_dump(exclude=closer)


def straight_line(side: str, x_cm: float, seen: list[tuple[float, float]]) -> LaneLine:
    """A line along y at x, over 400 cm, seen in some stretches."""
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 400.0, 5), np.full(3, 400.0)])
    greville = np.array([knots[i + 1 : i + 4].mean() for i in range(7)])
    points = np.column_stack([np.full(7, x_cm), greville])
    return LaneLine(side, knots, points, np.array(seen).reshape(-1, 2), 0.1)


def test_the_lane_is_measured_where_both_lines_are_seen():
    left = straight_line("left", -20.3, [(0.0, 150.0), (300.0, 400.0)])
    right = straight_line("right", 20.2, [(100.0, 400.0)])
    beside = replace(straight_line("left", -60.0, [(0.0, 400.0)]), rank=1)
    at = np.arange(5.0, 400.0, 10.0)
    lane = TracedLane(at, at, at, 39.0, 2.0)
    apart = spacing_cm([left, right, beside], at)
    # 100 to 150 cm and 300 to 400 cm.
    np.testing.assert_allclose(apart[np.isfinite(apart)], np.full(15, 40.5))
    assert fitted_width([left, right, beside], lane, at).width_cm == pytest.approx(40.5)
    unseen = straight_line("right", 20.2, [])
    assert fitted_width([left, unseen], lane, at).width_cm == 39.0


def lane_through_bends(straight_cm: float, widening: float) -> list[LaneLine]:
    """Lines of a road that bends by 1 rad, over 100 cm, after every straight; the lane widens there."""
    s = np.arange(0.0, 1200.0, 2.0)
    bends = (np.mod(s, straight_cm + 100.0) >= straight_cm).astype(np.float64)
    heading = np.cumsum(2.0 * bends) / 100.0
    middle = np.cumsum(2.0 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    half_cm = 20.0 * (1.0 + widening * np.convolve(bends, np.full(11, 1.0 / 11.0), "same"))
    knots = np.concatenate([np.full(3, s[0]), np.linspace(s[0], s[-1], 60), np.full(3, s[-1])])
    lines = []
    for side, sign in (("left", 1.0), ("right", -1.0)):
        points = middle + sign * half_cm[:, None] * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
        spline = make_lsq_spline(s, points, knots)
        lines.append(LaneLine(side, knots, spline.c, np.array([[s[0], s[-1]]]), 0.1))
    return lines


def test_the_width_that_people_give_is_that_of_the_straights():
    at = np.arange(0.0, 1198.0, 2.0)
    lane = TracedLane(at, at, at, 39.0, 2.0)
    widens = fitted_width(lane_through_bends(100.0, 0.3), lane, at)
    assert widens.width_cm == pytest.approx(40.0, rel=0.01)
    assert widens.bend_cm == pytest.approx(52.0, rel=0.02)
    same = fitted_width(lane_through_bends(100.0, 0.0), lane, at)
    assert same.width_cm == pytest.approx(40.0, rel=0.01)
    assert same.bend_cm is None and same.open_cm is None
    # Without a straight it is open.
    winding = fitted_width(lane_through_bends(16.0, 0.5), lane, at)
    assert winding.open_cm is not None and winding.open_cm[1] > 1.2 * winding.open_cm[0]


def test_the_width_of_the_lane_depends_on_the_camera_as_the_geometry_says():
    nothing = dict.fromkeys(CAMERA_NAMES, 0.0)
    assert width_sigma(CAMERA, nothing, 40.0) == pytest.approx(0.0, abs=1e-9)
    # Looking further up moves the road away: every width grows in proportion to its distance.
    pitch = width_sigma(CAMERA, {**nothing, "pitch": 0.01}, 40.0)
    assert width_sigma(CAMERA, {**nothing, "pitch": 0.02}, 40.0) == pytest.approx(2.0 * pitch, rel=0.1)
    # A camera at height h sees the road at a distance d under h/d: 0.01 rad are about 0.01 (d/h + h/d).
    assert 0.01 < pitch < 0.05
    # Neither the place on the car nor the direction changes a width.
    assert width_sigma(CAMERA, {**nothing, "lever": 0.5, "yaw": 0.1}, 40.0) == pytest.approx(0.0, abs=1e-9)
    both = width_sigma(CAMERA, {**nothing, "pitch": 0.01, "focal": 0.02}, 40.0)
    focal = width_sigma(CAMERA, {**nothing, "focal": 0.02}, 40.0)
    assert both == pytest.approx(math.hypot(pitch, focal))


def test_what_lies_ahead_is_known_as_well_as_lens_and_place_of_the_camera():
    camera = CAMERA.with_mounting(height_cm=20.0, ahead_of_front_axle_cm=-10.0)
    assert ahead_sigma(camera, {}) == 0.0
    # 5 % of the 40 cm from the camera to the far row, and 0.1 camera heights.
    assert ahead_sigma(camera, {"focal": 0.05}) == pytest.approx(2.0)
    assert ahead_sigma(camera, {"lever": 0.1}) == pytest.approx(2.0)
    assert ahead_sigma(camera, {"lever": 0.1, "focal": 0.05, "yaw": 0.1}) == pytest.approx(
        math.hypot(2.0, 2.0)
    )


def test_pictures_show_where_the_car_drives_straight():
    heading = np.concatenate([np.linspace(0.0, 2.0, 60), np.full(40, 2.0), np.linspace(2.0, 4.0, 50)])
    camera = found(heading)
    first, second = straight_frames(camera.solved.poses, 60.0, 2)
    # 60 cm are 20 frames, all of which lie in the straight.
    assert 59 <= first <= 79 and 75 <= second <= 80
    (only,) = straight_frames(found(np.zeros(4)).solved.poses, 60.0, 1)
    assert 0 <= only < 4


class _Solver(SegmentSolver):
    """Keeps the camera that it starts from, as a drive without a closed loop does."""

    def solve(self, drive, camera, **_) -> SolvedSegment:
        return replace(found(np.zeros(len(drive)), 0).solved, camera=camera)


@pytest.mark.parametrize("slope", [-0.6, -0.75, -0.9])
def test_a_given_height_finds_the_focal_length_where_the_lane_has_its_width(monkeypatch, slope):
    """The lane looks narrower the longer the lens; with 90 px it is 2.5 camera heights wide."""

    def measure(solved, *_):
        width = 2.5 * (solved.camera.K[0, 0] / 90.0) ** slope
        return LaneScale(width * solved.camera.mounting.height_cm, 0.02)

    monkeypatch.setattr(datagen.segments, "measure_lane", measure)
    solver = _Solver(MapSettings(), np.random.default_rng(0))
    alone = found(np.zeros(70), 0, 0.3)
    camera, notes = fit_height(alone, made_up_drive(70), 2.5, MapSettings(), solver)
    assert camera.camera.K[0, 0] == pytest.approx(90.0, rel=0.01) and not notes and camera.height_given
    # The horizon stays where it is in the images.
    before, after = (
        np.tan(one.camera.mounting.pitch_down_rad) * one.camera.K[0, 0] for one in (alone, camera)
    )
    assert after == pytest.approx(before)
    # From height, lane and measurement, by the slope; without them the focal length was a guess.
    by_width = math.hypot(0.03, 0.012, 0.02) / -slope
    assert camera.sigma["focal"] == pytest.approx(math.hypot(by_width, 1.7 * 0.03), rel=0.05)


def test_a_height_that_agrees_with_a_closed_loop_leaves_its_camera_alone(monkeypatch):
    monkeypatch.setattr(datagen.segments, "measure_lane", lambda *_: LaneScale(2.5 * 15.0, 0.02))
    closed = found(np.zeros(300), 8, 0.01)
    solver = _Solver(MapSettings(), np.random.default_rng(0))
    given, _ = fit_height(closed, made_up_drive(300), 2.51, MapSettings(), solver)
    assert given.camera is closed.camera and given.sigma == closed.sigma and given.note == closed.note


def test_a_height_beside_a_known_camera_is_refused(tmp_path):
    drive, path = write_drive(tmp_path / "d", np.arange(70) * 3.0), tmp_path / "camera.yaml"
    write_camera(path, replace(CAMERA, width=64, height=48), "made up")
    with pytest.raises(CalibrationError, match=r"camera\.yaml.* 15 cm .*--camera-height .* 17 cm"):
        prepare(MapRequest(drive, 40.0, path, camera_height_cm=17.0), MapSettings())


@pytest.mark.slow
def test_with_the_height_the_focal_length_of_an_open_road_comes_out_better(tmp_path):
    """A lens of 83 px and a search that came out 20 % too long; nothing is seen twice."""
    camera = {"width": 160, "height": 120, "field_of_view_rad": math.radians(110.0), "height_cm": 22.0}
    settings = SimulationSettings.model_validate({"seed": 4, "frames": 200, "camera": camera})
    drive = keep_images(open_drive(simulate_drive(settings, tmp_path / "d")))
    start = nudged(drive.camera, "focal", math.log(1.2))
    solver = SegmentSolver(MapSettings(find_bumper=False), np.random.default_rng(0))
    solved = solver.solve(drive, start, find_camera=True)
    sigma = honest_sigma(solved, 0.0, BundleSettings(), 160)
    alone = FoundCamera(solved, [], sigma, False, 0.0)
    given, _ = fit_height(alone, drive, drive.lane_width_cm / 22.0, solver.settings, solver)
    true_px = drive.camera.K[0, 0]
    off = [abs(one.camera.K[0, 0] / true_px - 1.0) for one in (alone, given)]
    assert off[0] > 0.15 and off[1] < 0.08 < 2.0 * given.sigma["focal"]
