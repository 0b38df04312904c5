from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from detections import read_detections

from lanenet.data.drives import Commands
from lanenet.data.drives.sources import Source
from lanenet.errors import CalibrationError, DriveFormatError, LabelFormatError
from lanenet.evaluation.answers import answer_edges
from lanenet.evaluation.detect import run_detector
from lanenet.onboard.bench import LANE_WIDTH_CM, example_camera, example_frames
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.lane_filter import LaneFilter, LaneFilterSettings

CAMERA = example_camera()


class Scripted:
    """Answers with the number that is painted into the frame, and notes what it is asked."""

    def __init__(self) -> None:
        self.log: list[int | str] = []

    def reset(self) -> None:
        self.log.append("reset")

    def detect(self, frame_bgr: np.ndarray) -> LaneEstimate:
        value = int(frame_bgr[0, 0, 0])
        self.log.append(value)
        if value == 99:
            raise CalibrationError("frame of another size")
        if value == 98:
            raise RuntimeError("a fault in the detector")
        points = np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0]) + value
        return LaneEstimate(points, steering_rad=0.01 * value, confidence=0.5)


def source_of(values: list[int | None], breaks: list[int] | None = None) -> Source:
    def image(i: int) -> np.ndarray:
        value = values[i]
        if value is None:
            raise DriveFormatError(f"images/{i:06d}.jpg: cannot be read")
        return np.full((CAMERA.height, CAMERA.width, 3), value, np.uint8)

    n = len(values)
    starts = np.zeros(n, bool)
    starts[[0, *(breaks or [])]] = True
    return Source("test drive", 10 + np.arange(n), 0.05 * np.arange(n), starts, 20.0, image)


class Following(Scripted):
    """Notes how the car moved as well."""

    def moved(self, travel_cm: float, turn_rad: float, wheelbase_cm: float) -> None:
        self.log.append(f"{travel_cm:.1f} cm, {turn_rad:.2f} rad")
        assert wheelbase_cm == CAMERA.wheelbase_cm


def test_a_detector_is_told_how_the_car_was_commanded(tmp_path: Path) -> None:
    commands = Commands(speed_cm_s=np.array([20.0, 40.0, np.nan, 40.0, 40.0]), steering_rad=np.zeros(5))
    source = dataclasses.replace(source_of([1, 2, 3, 4, 5], breaks=[4]), commands=commands)
    detector = Following()
    run_detector(source, detector, CAMERA, tmp_path / "l.csv")
    assert detector.log == [
        "reset", 1, "1.0 cm, 0.00 rad", 2, "2.0 cm, 0.00 rad", 3, 4, "reset", 5,
    ]  # fmt: skip


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_table_holds_what_the_detector_said(tmp_path: Path, ending: str) -> None:
    out = tmp_path / f"lanes{ending}"
    seen: list[tuple[int, int]] = []
    report = run_detector(source_of([1, 2, 3]), Scripted(), CAMERA, out, progress=lambda *a: seen.append(a))
    table = read_detections(out)
    assert table.frame.tolist() == [10, 11, 12]
    assert table.t_s == pytest.approx([0.0, 0.05, 0.1])
    assert table.points_cm[:, 0] == pytest.approx([-19.0, -18.0, -17.0])
    assert table.parabolas[:, 1] == pytest.approx(np.array([[0.0, 0.0, v] for v in (21.0, 22.0, 23.0)]))
    assert table.steering_rad == pytest.approx([0.01, 0.02, 0.03])
    assert (report.frames, report.complete, report.steered) == (3, 3, 3)
    assert 0.0 < report.median_ms <= report.p99_ms
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_state_is_forgotten_at_breaks(tmp_path: Path) -> None:
    detector = Scripted()
    run_detector(source_of([1, 2, 3, 4], breaks=[2]), detector, CAMERA, tmp_path / "l.csv")
    assert [entry for entry in detector.log if entry != "reset"] == [1, 2, 3, 4]
    assert "reset" in detector.log[:2]
    assert detector.log[detector.log.index(2) + 1] == "reset"
    assert detector.log[-1] == 4 and detector.log[-2] == 3


def test_unreadable_frame_is_an_error_or_an_empty_row_and_a_problem(tmp_path: Path) -> None:
    out, video = tmp_path / "l.csv", tmp_path / "l.mp4"
    source = source_of([1, None, 3])
    with pytest.raises(DriveFormatError, match=r"000001\.jpg"):
        run_detector(source, Scripted(), CAMERA, out, video)
    assert list(tmp_path.iterdir()) == []
    report = run_detector(source, Scripted(), CAMERA, out, video, skip_unreadable=True)
    table = read_detections(out)
    assert table.frame.tolist() == [10, 11, 12]
    assert np.isnan(table.points_cm[1]).all() and table.confidence[1] == 0.0
    assert report.complete == 2
    assert len(report.problems) == 1 and "000001.jpg" in report.problems[0]
    assert count_frames(video) == 3


def test_nothing_readable_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DriveFormatError, match=r"none of its 2 frames.*000000\.jpg"):
        run_detector(source_of([None, None]), Scripted(), CAMERA, tmp_path / "l.csv", skip_unreadable=True)
    assert list(tmp_path.iterdir()) == []


def test_frame_that_does_not_fit_the_camera_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="test drive, frame 11"):
        run_detector(source_of([1, 99]), Scripted(), CAMERA, tmp_path / "l.csv")


def test_failure_leaves_no_files(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        run_detector(source_of([1, 98]), Scripted(), CAMERA, tmp_path / "l.csv", tmp_path / "l.mp4")
    assert list(tmp_path.iterdir()) == []


def test_endings_are_checked(tmp_path: Path) -> None:
    with pytest.raises(LabelFormatError, match=r"\.parquet"):
        run_detector(source_of([1]), Scripted(), CAMERA, tmp_path / "l.txt")
    with pytest.raises(DriveFormatError, match=r"\.mp4"):
        run_detector(source_of([1]), Scripted(), CAMERA, tmp_path / "l.csv", tmp_path / "l.gif")


def test_of_one_photo_a_picture_is_drawn(tmp_path: Path) -> None:
    for ending in (".png", ".jpg"):
        picture = tmp_path / f"l{ending}"
        report = run_detector(source_of([1]), Scripted(), CAMERA, tmp_path / "l.csv", picture)
        drawn = cv2.imread(str(report.video))
        assert drawn is not None and drawn.shape == (480, 640, 3) and drawn.std() > 5.0
    with pytest.raises(DriveFormatError, match=r"\.mp4.*single photo"):
        run_detector(source_of([1, 2]), Scripted(), CAMERA, tmp_path / "l.csv", picture)


def test_video_has_every_frame_and_a_lane_in_it(tmp_path: Path) -> None:
    video = tmp_path / "l.mp4"
    run_detector(source_of([1, 2, 3, 4]), Scripted(), CAMERA, tmp_path / "l.csv", video)
    assert count_frames(video) == 4
    capture = cv2.VideoCapture(str(video))
    read, frame = capture.read()
    capture.release()
    assert read and frame.shape == (480, 640, 3)
    # The source frames are uniform, so what varies was drawn.
    assert frame.std() > 5.0


def count_frames(video: Path) -> int:
    capture = cv2.VideoCapture(str(video))
    count = 0
    while capture.read()[0]:
        count += 1
    capture.release()
    return count


def test_lane_filter_end_to_end(tmp_path: Path) -> None:
    frames = example_frames(CAMERA, 6, np.random.default_rng(2))
    source = dataclasses.replace(source_of([0] * 6), image=lambda i: frames[i])
    lane_filter = LaneFilter(
        RoadEdgeExtractor(CAMERA, PerceptionSettings()), LaneFilterSettings(lane_width_cm=LANE_WIDTH_CM)
    )
    report = run_detector(source, lane_filter, CAMERA, tmp_path / "l.parquet")
    assert report.complete == 6
    table = read_detections(tmp_path / "l.parquet")
    width = table.points_cm[:, 4] - table.points_cm[:, 1]
    assert np.abs(width - LANE_WIDTH_CM).max() < 3.0


def test_lane_filter_on_label_sets_starts_again_after_gaps() -> None:
    """Two lanes side by side: the state decides which one is followed, a gap in the frames forgets it."""
    from lanenet.data.label_set import LabelMeta, LabelSet
    from lanenet.geometry.birdseye import BirdseyeWindow

    y = np.arange(5.0, 60.0, 0.25)

    def edges(shift: float) -> np.ndarray:
        # Bright markings: their two edges face each other.
        lines = [(x + side - shift, -side) for x in (-60.0, -20.0, 20.0, 60.0) for side in (-1.0, 1.0)]
        return np.concatenate(
            [np.stack([0 * y + x, y, 0 * y + to, 0 * y, 0 * y, 0 * y], axis=1) for x, to in lines]
        )

    shifts = [0.0, 8.0, 16.0, 24.0, 24.0]
    n = len(shifts)
    labels = LabelSet(
        LabelMeta(BirdseyeWindow(), "c" * 16, 26.0, 40.0, "truth"),
        drive=["a"] * n,
        file=[""] * n,
        frame=np.array([0, 1, 2, 3, 9]),
        t_s=np.arange(n, dtype=np.float64),
        lap=np.zeros(n, np.int64),
        poses=np.zeros((n, 3)),
        points_cm=np.full((n, 6), np.nan),
        edges=[edges(shift) for shift in shifts],
        lines=[(np.zeros((2, 2)), np.zeros((2, 2)))] * n,
        quality=np.ones(n),
        divides=np.zeros((n, 2), dtype=bool),
    )
    lane_filter = LaneFilter(None, LaneFilterSettings(lane_width_cm=40.0))
    centres = answer_edges(labels, lane_filter)[:, [1, 4]].mean(axis=1)
    assert centres == pytest.approx([0.0, -8.0, -16.0, -24.0, 16.0], abs=0.2)
    # The directions in the label set are used: there is no dark marking.
    dark = answer_edges(labels, LaneFilter(None, LaneFilterSettings(lane_width_cm=40.0, polarity="dark")))
    assert np.isnan(dark).all()
