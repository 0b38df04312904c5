"""Segments of a drive: each keeps its own poses, and one that cannot be mapped leaves the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_up_drive import made_up_drive

from datagen import prepare
from datagen import segments as drive_segments
from datagen.lanes.find import MappedSegment, _in_order, check_lane
from datagen.lanes.trace import TracedLane
from datagen.segments import LanesOfDrive, SolvedDrive, sigma_of_earlier
from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import CAMERA_NAMES, BundleResult
from datagen.slam.camera.coarse import Candidate, Look, guessed_camera
from datagen.slam.camera.self_calibration import FoundCamera
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.loops.revisits import Revisit
from datagen.slam.odometry.scans import pack_scans
from datagen.slam.segment import SegmentSolver, SolvedSegment
from datagen.slam.settings import GuessSettings
from lanenet.data.camera_file import sigma_residuals, write_camera
from lanenet.data.drives.recording import Drive
from lanenet.data.files import write_json, write_text
from lanenet.data.maps.line import LaneLine, Side
from lanenet.errors import CalibrationError, MapFormatError, NoLaneError, TrackingLostError
from lanenet.perception.edges.road import RoadEdges

CAMERA = guessed_camera(160, 120, 80.0, 15.0, GuessSettings())
SETTINGS = MapSettings(find_bumper=False)


def _solved(n: int) -> SolvedSegment:
    poses = np.column_stack([3.0 * np.arange(n), np.zeros(n), np.zeros(n)])
    nothing = pack_scans([RoadEdges(np.empty((0, 2)), np.empty((0, 2)))] * n, 15.0)
    bundle = BundleResult(
        poses, np.zeros((n, 2)), CAMERA, {}, np.zeros(5), np.zeros((0, 2), int), np.zeros(0, int), np.zeros(0)
    )
    trajectory = Trajectory(poses, np.ones(n), np.ones(n), np.zeros(n))
    return SolvedSegment(
        np.arange(n), CAMERA, nothing, trajectory, poses, poses, None, [], bundle, np.zeros(n, np.int64)
    )


def _prepared(drive: Drive) -> prepare.PreparedDrive:
    return prepare.PreparedDrive(
        request=prepare.MapRequest(drive.path, 40.0),
        drive=drive,
        held_out=np.zeros(len(drive), dtype=bool),
        settings=SETTINGS,
        camera=CAMERA,
        notes=(),
    )


def _in_parts(drive: Drive, revisits: list[Revisit]) -> SolvedSegment:
    return replace(_solved(len(drive)), part=np.cumsum(drive.breaks), revisits=revisits)


def _solve(monkeypatch: pytest.MonkeyPatch, drive: Drive, revisits: list[Revisit]) -> SolvedDrive:
    monkeypatch.setattr(SegmentSolver, "solve", lambda self, part, camera: _in_parts(part, revisits))
    prepared, solver = _prepared(drive), SegmentSolver(SETTINGS, np.random.default_rng(0))
    return drive_segments.solve_drive(prepared, drive_segments.camera_of_drive(prepared, solver), solver)


def test_parts_that_show_the_same_places_are_one_segment(monkeypatch):
    drive = made_up_drive(300, [70, 100, 200], first_frame=1000)
    # The second part, of thirty frames, lies on the road of the fourth; the others on none.
    solved = _solve(monkeypatch, drive, [Revisit(80, 250, np.zeros(3), 0.8)])
    rows = [np.r_[0:70], np.r_[70:100, 200:300], np.r_[100:200]]
    for segment, expected in zip(solved.segments, rows, strict=True):
        np.testing.assert_array_equal(segment.rows, expected)
        np.testing.assert_array_equal(segment.poses[:, 0], 3.0 * expected)
    (visit,) = solved.segments[1].revisits
    assert (visit.earlier, visit.later) == (10, 80)
    assert not solved.refused


def test_a_short_part_on_no_known_road_is_left_out_and_said(monkeypatch):
    solved = _solve(monkeypatch, made_up_drive(200, [70, 100], first_frame=1000), [])
    assert [(int(s.rows[0]), int(s.rows[-1])) for s in solved.segments] == [(0, 69), (100, 199)]
    (left_out,) = solved.refused
    assert left_out.note(made_up_drive(200, first_frame=1000)).startswith(
        "frames 1070-1099 left out: 30 frames"
    )


def test_frames_that_nothing_ties_are_said_in_one_note_as_are_short_parts(monkeypatch):
    drive = made_up_drive(300, [100, 101, 110, 111], first_frame=1000)
    tied = np.setdiff1d(np.arange(300), [100, 110, *range(200, 220, 2)])
    whole = _in_parts(drive, [])
    monkeypatch.setattr(SegmentSolver, "solve", lambda self, part, camera: whole.only(tied))
    prepared, solver = _prepared(drive), SegmentSolver(SETTINGS, np.random.default_rng(0))
    camera = drive_segments.camera_of_drive(prepared, solver)
    solved = drive_segments.solve_drive(prepared, camera, solver)
    short, untied = (one.note(drive) for one in solved.refused)
    assert short.startswith("frames 1101-1109 left out: 9 frames that show no place")
    assert untied.startswith(
        "frames 1100, 1110, 1200, 1202, 1204 and 7 further runs left out: nothing ties them"
    )
    # Neither is why a segment has no lane.
    monkeypatch.setattr(drive_segments, "find_lane", _no_lane)
    with pytest.raises(TrackingLostError, match="no lane in 179 frames"):
        drive_segments.fit_lanes(prepared, solved.segments, [replace(solved.refused[0], rows=np.arange(300))])


def test_a_drive_of_which_little_is_tied_says_how_much(monkeypatch):
    drive = made_up_drive(150, [4])
    few = _in_parts(drive, []).only(np.arange(4))
    monkeypatch.setattr(SegmentSolver, "solve", lambda self, part, camera: few)
    prepared, solver = _prepared(drive), SegmentSolver(SETTINGS, np.random.default_rng(0))
    with pytest.raises(TrackingLostError, match=r"4 frames in 1 part .*, and 146 frames that nothing ties"):
        drive_segments.solve_drive(prepared, drive_segments.CameraOfDrive(CAMERA), solver)


def _no_lane(segment: SolvedSegment, *_: object) -> MappedSegment:
    raise TrackingLostError(f"no lane in {len(segment.rows)} frames")


def test_a_drive_of_scraps_cannot_be_mapped(monkeypatch):
    with pytest.raises(TrackingLostError, match=r"120 frames in 3 parts.* 50 frames.* 60"):
        _solve(monkeypatch, made_up_drive(120, [50, 90]), [])


def test_a_drive_that_was_solved_for_its_camera_is_not_solved_again(monkeypatch):
    def solve(*_: object) -> None:
        raise AssertionError

    drive = made_up_drive(100)
    monkeypatch.setattr(SegmentSolver, "solve", solve)
    solver = SegmentSolver(SETTINGS, np.random.default_rng(0))
    camera = drive_segments.CameraOfDrive(CAMERA, solved=_solved(100))
    (segment,) = drive_segments.solve_drive(_prepared(drive), camera, solver).segments
    np.testing.assert_array_equal(segment.poses, camera.solved.poses)


def _line(side: Side, until_cm: float) -> LaneLine:
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 3000.0, 6), np.full(3, 3000.0)])
    along = np.array([knots[k + 1 : k + 4].mean() for k in range(8)])
    beside = np.full(8, 20.0 if side == "left" else -20.0)
    return LaneLine(side, knots, np.column_stack([along, beside]), np.array([[0.0, until_cm]]), 0.1)


def _map(
    monkeypatch: pytest.MonkeyPatch,
    drive: Drive,
    no_lane: tuple[int, ...] = (),
    one_line: tuple[int, ...] = (),
    other_lane: tuple[int, ...] = (),
    doubt: str = "",
) -> LanesOfDrive:
    """Map a drive whose segments of some lengths show no lane, one line only, or another lane."""

    def find_lane(segment: SolvedSegment, *_: object) -> MappedSegment:
        n = len(segment.rows)
        if n in no_lane:
            raise TrackingLostError(f"no pair of lines in {n} frames")
        if n in other_lane:
            raise CalibrationError(f"a lane of 30 cm in {n} frames, expected 40 cm")
        lane = TracedLane(np.zeros(2), np.zeros(2), np.zeros(2), 40.0, 2.0)
        # The right line ends early where there is one line only.
        lines = [_line("left", 3.0 * n), _line("right", 0.3 * n if n in one_line else 3.0 * n)]
        return MappedSegment(segment, 3.0 * np.arange(n), np.zeros(n, np.int64), lane, lines)

    monkeypatch.setattr(drive_segments, "find_lane", find_lane)
    solved = _solve(monkeypatch, drive, [])
    return drive_segments.fit_lanes(_prepared(drive), solved.segments, solved.refused, doubt)


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ({"no_lane": (70,)}, "no pair of lines in 70 frames"),
        ({"one_line": (70,)}, "one line only bounds the driven lane"),
        ({"other_lane": (70,)}, "a lane of 30 cm in 70 frames, expected 40 cm"),
    ],
)
def test_a_segment_that_cannot_be_mapped_is_left_out_and_said(monkeypatch, bad, why):
    mapped = _map(monkeypatch, made_up_drive(1000, [300, 370], first_frame=1000), **bad)
    assert [(int(s.rows[0]), int(s.rows[-1])) for s in mapped.segments] == [(0, 299), (370, 999)]
    (note,) = mapped.notes
    assert note.startswith(f"frames 1300-1369 left out: {why}")


def test_the_longest_segment_says_why_nothing_could_be_mapped(monkeypatch):
    drive = made_up_drive(200, [70], first_frame=1000)
    with pytest.raises(TrackingLostError, match="no pair of lines in 130 frames"):
        _map(monkeypatch, drive, no_lane=(130,), other_lane=(70,))
    with pytest.raises(CalibrationError, match="a lane of 30 cm in 130 frames"):
        _map(monkeypatch, drive, no_lane=(70,), other_lane=(130,))


def test_a_doubtful_camera_is_why_nothing_could_be_mapped(monkeypatch):
    with pytest.raises(
        CalibrationError, match="made-up: no such camera, and with it no pair of lines in 130 frames"
    ):
        _map(monkeypatch, made_up_drive(130), no_lane=(130,), doubt="no such camera")


def test_an_unlikely_camera_is_described_and_an_ordinary_one_is_not_in_doubt(monkeypatch):
    drive = made_up_drive(130)
    camera = guessed_camera(160, 120, 80.0, 15.0, GuessSettings()).with_mounting(roll_rad=0.2094)
    solved = replace(_solved(130), camera=camera)
    sigma = dict.fromkeys(CAMERA_NAMES, 0.01)
    monkeypatch.setattr(drive_segments, "check_edges", lambda *_: None)
    prepared = replace(_prepared(drive), camera=None)
    solver = SegmentSolver(MapSettings(), np.random.default_rng(0))
    doubts = []
    unclear = Candidate(Look(80.0, 15.0), 0.2, 0.05)
    clear = replace(unclear, fit=0.3)
    for strain, tried in ((1.9, []), (5.2, []), (1.9, [clear, unclear]), (1.9, [unclear])):
        found = FoundCamera(solved, tried, sigma, refined=False, strain=strain)
        monkeypatch.setattr(drive_segments, "find_camera", lambda *_, found=found: found)
        doubts.append(drive_segments.camera_of_drive(prepared, solver).doubt)
    assert doubts[0] == doubts[2] == ""
    assert "with none of the 1 cameras that were tried do the edges of an image" in doubts[3]
    assert "5.2 standard deviations off: principal point at 80, 60 px of 160x120, rolled by 12" in doubts[1]


def test_marks_on_the_floor_that_were_joined_are_no_line(monkeypatch):
    drive = made_up_drive(200)
    (whole,) = _map(monkeypatch, drive).segments
    one = replace(whole, lines=[_line("left", 30.0), _line("right", 600.0)])
    with pytest.raises(TrackingLostError, match="one line only"):
        check_lane(one, drive)
    seldom = np.where(np.arange(100) % 4 == 0, 0.0, np.nan)
    with pytest.raises(TrackingLostError, match="no line"):
        check_lane(
            replace(one, lane=replace(one.lane, left_cm=seldom, right_cm=seldom, centre_cm=np.zeros(100))),
            drive,
        )


def test_lines_that_cross_bound_no_lane(monkeypatch):
    drive = made_up_drive(200)
    (whole,) = _map(monkeypatch, drive).segments
    left, right = whole.lines
    assert left.lies_left_of(right) and not right.lies_left_of(left)
    swapped = [replace(right, side="left"), replace(left, side="right")]
    with pytest.raises(NoLaneError):
        check_lane(replace(whole, lines=swapped), drive)


def test_a_line_of_the_next_lane_on_the_wrong_side_is_left_out_with_those_beyond_it(monkeypatch):
    left, right = _map(monkeypatch, made_up_drive(200)).segments[0].lines
    next_one, beyond = replace(left, side="right", rank=1), replace(right, side="right", rank=2)
    assert _in_order([left, right, next_one, beyond]) == [left, right]
    assert _in_order([left, right, replace(left, rank=1)]) == [left, right]


def test_nothing_is_said_where_all_is_mapped(monkeypatch):
    mapped = _map(monkeypatch, made_up_drive(200, [70], first_frame=1000))
    assert len(mapped.segments) == 2 and not mapped.notes


@pytest.mark.parametrize(
    "report", [{"calibration": {"sigma": {"focal": 0.02}}}, {"camera_sigma": {"focal": 0.02}}]
)
def test_a_camera_of_an_earlier_map_brings_its_uncertainty_along(tmp_path, report):
    camera = guessed_camera(160, 120, 80.0, 15.0, GuessSettings())
    # Maps of earlier versions have them in their report alone.
    write_camera(tmp_path / "camera.yaml", camera, "found")
    write_text(tmp_path / "map.yaml", "")
    write_json(tmp_path / "report.json", report)
    assert sigma_of_earlier(tmp_path) == sigma_of_earlier(tmp_path / "camera.yaml") == {"focal": 0.02}
    assert sigma_of_earlier(None) == {}
    elsewhere = tmp_path / "elsewhere" / "car.yaml"
    write_camera(elsewhere, camera, "measured")
    assert sigma_of_earlier(elsewhere) == {}
    write_camera(elsewhere, camera, "found", sigma_residuals(camera, {"focal": 0.03, "pitch": 0.01}))
    assert sigma_of_earlier(elsewhere) == pytest.approx({"focal": 0.03, "pitch": 0.01})
    write_json(tmp_path / "report.json", {"calibration": {"sigma": {"focal": "wide"}}})
    with pytest.raises(MapFormatError, match=r"report\.json: sigmas of the camera"):
        sigma_of_earlier(tmp_path)
