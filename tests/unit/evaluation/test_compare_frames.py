from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lanenet.data.maps.mapped_drive import LabelledFrames
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError, LabelFormatError
from lanenet.evaluation.answers import Compared, answer_frames, choose_names
from lanenet.evaluation.errors import GROUPS
from lanenet.evaluation.report import WorstFrame, draw_worst, find_worst
from lanenet.geometry.camera import Camera
from lanenet.onboard.bench import example_camera, example_frames
from lanenet.onboard.safety import SafetySettings
from lanenet.page import jpeg_bytes
from lanenet.perception.draw import LEFT_BGR, RIGHT_BGR, TRUTH_BGR
from lanenet.perception.edges.road import PerceptionSettings, RangeSettings
from lanenet.perception.estimate import LaneEstimate
from lanenet.perception.hough.detector import HoughTracker
from lanenet.perception.lane_filter import LaneFilter
from lanenet.perception.registry import compared_names

NAN = float("nan")

#: Below the frames of a sheet.
LEGEND_PX = 24


def half_camera() -> Camera:
    whole = example_camera()
    K = whole.K * [[0.5], [0.5], [1.0]]
    return replace(whole, width=whole.width // 2, height=whole.height // 2, K=K)


def labelled(n=4, starts=(), camera: Camera | None = None, **changes) -> LabelledFrames:
    """Gray frames whose brightness is their number; labels at +-20 cm."""
    camera = example_camera() if camera is None else camera
    start = np.zeros(n, bool)
    start[list(starts)] = True
    values = {
        "name": "drives/gray",
        "reference": "truth",
        "camera": camera,
        "lane_width_cm": 40.0,
        "marking_cm": 2.0,
        "perception": PerceptionSettings(),
        "frames": np.arange(100, 100 + n),
        "starts": start,
        "points_cm": np.tile(np.repeat([-20.0, 20.0], 3), (n, 1)),
        "image": lambda i: np.full((camera.height, camera.width, 3), i, np.uint8),
    }
    return LabelledFrames(**(values | changes))


class Counter:
    """Answers with the frames since the last reset, and the brightness of the frame."""

    def __init__(self) -> None:
        self.since = -1

    def reset(self) -> None:
        self.since = 0

    def detect(self, frame_bgr):
        self.since += 1
        points = np.array([self.since, frame_bgr[0, 0, 0], NAN, NAN, NAN, NAN], np.float64)
        return LaneEstimate(
            points,
            sigma_cm=np.full(6, float(self.since)),
            presence=np.array([0.25, 0.75]),
            confidence=1.0 / self.since,
        )


def test_frames_come_in_order_with_a_reset_at_breaks():
    seen = []
    answers = answer_frames(
        labelled(6, starts=(3,)), {"a": Counter(), "b": Counter()}, lambda *done: seen.append(done)
    )
    np.testing.assert_array_equal(answers.brightness, np.arange(6))
    for name in ("a", "b"):
        # Also where a source does not say so, the first frame starts afresh.
        np.testing.assert_array_equal(answers.points_cm[name][:, 0], [1, 2, 3, 1, 2, 3])
        np.testing.assert_array_equal(answers.points_cm[name][:, 1], np.arange(6))
        assert np.isnan(answers.points_cm[name][:, 2:]).all()
        np.testing.assert_array_equal(answers.sigma_cm[name][:, 0], [1, 2, 3, 1, 2, 3])
        np.testing.assert_array_equal(answers.presence[name], np.tile([0.25, 0.75], (6, 1)))
        np.testing.assert_array_equal(1.0 / answers.confidence[name], [1, 2, 3, 1, 2, 3])
    assert seen == [(k, 6) for k in range(1, 7)]


def test_the_groups_by_confidence_are_what_the_car_does():
    safety = SafetySettings()
    limits = [low for _, low in GROUPS["confidence"][1]]
    assert limits == [0.0, safety.stop_below, safety.slow_below]


def test_a_bad_frame_is_named():
    def corrupt(i: int):
        raise DriveFormatError(f"frame {100 + i}: corrupt")

    with pytest.raises(DriveFormatError, match="drives/gray: frame 100: corrupt"):
        answer_frames(labelled(image=corrupt), {"a": Counter()})
    small = labelled(image=lambda i: np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(CalibrationError, match=r"drives/gray, frame 100: .*8x8"):
        answer_frames(small, Compared(["lane-filter"]).build(small))


def test_all_detectors_but_the_network_see_a_rendered_lane():
    camera = example_camera()
    pictures = example_frames(camera, 3, np.random.default_rng(1))
    frames = labelled(3, camera=camera, image=lambda i: pictures[i])
    names = compared_names(lambda kind: not kind.needs_model)
    answers = answer_frames(frames, Compared(names).build(frames))
    assert list(answers.points_cm) == names
    for name in ("lane-filter", "hough-value", "painter"):
        assert np.isfinite(answers.points_cm[name]).any(), name


def test_detectors_are_built_for_the_source():
    hidden = PerceptionSettings(range=RangeSettings(bottom_rows=24))
    frames = labelled(perception=hidden, marking_cm=3.5, lane_width_cm=33.0)
    built = Compared(["lane-filter", "hough", "hough-value"]).build(frames)
    lane_filter = built["lane-filter"]
    assert isinstance(lane_filter, LaneFilter)
    assert (lane_filter.settings.lane_width_cm, lane_filter.settings.marking_cm) == (33.0, 3.5)
    given = Compared(["lane-filter"], marking_cm=5.0).build(frames)["lane-filter"]
    assert isinstance(given, LaneFilter) and given.settings.marking_cm == 5.0
    # Only the brightness differs between the two trackers.
    plain, value = built["hough"], built["hough-value"]
    assert isinstance(plain, HoughTracker) and isinstance(value, HoughTracker)
    assert value.settings.edges.channel == "value" and plain.settings == type(plain.settings)()
    with pytest.raises(ConfigError, match="--model"):
        Compared(["network"]).build(frames)


def test_hidden_rows_are_hidden_from_the_lane_filter():
    camera = example_camera()
    picture = example_frames(camera, 1, np.random.default_rng(1))[0]
    answers = []
    for rows in (0, 140):
        hidden = PerceptionSettings(range=RangeSettings(bottom_rows=rows))
        frames = labelled(1, camera=camera, perception=hidden, image=lambda i: picture)
        found = answer_frames(frames, Compared(["lane-filter"]).build(frames))
        answers.append(np.isfinite(found.points_cm["lane-filter"]).any())
    assert answers == [True, False]


def test_names_come_in_the_order_of_the_tables():
    assert choose_names("painter, network") == ("network", "painter")
    for text, found in (("eagle,painter", "'eagle'"), (" ,", "no detector")):
        with pytest.raises(ConfigError, match=f"found {found}.*hough-value"):
            choose_names(text)


def test_the_worst_frames_are_found_and_are_no_neighbours():
    first, second = labelled(60), labelled(60)
    answers = [first.points_cm.copy(), second.points_cm.copy()]
    answers[0][20] += 9.0
    answers[0][21] += 8.0  # a neighbour of the worst
    answers[1][21, 4] -= 7.0
    answers[1][50, 2] = NAN  # unanswered is not wrong
    answers[0][50, 1:] = NAN
    answers[0][50, 0] += 3.0
    worst = find_worst([first, second], answers, 3)
    assert worst == [WorstFrame(0, 20, 9.0), WorstFrame(1, 21, 7.0), WorstFrame(0, 50, 3.0)]
    assert find_worst([first], [np.full((60, 6), NAN)]) == []
    with pytest.raises(LabelFormatError, match=r"drives/gray.*\(59, 6\).*\(60, 6\)"):
        find_worst([first], [answers[0][1:]])


def test_the_sheet_shows_truth_and_answer():
    source = labelled(40)
    answer = source.points_cm + 5.0
    worst = find_worst([source], [answer], 2)
    sheet = draw_worst([source], [answer], worst)
    height, width = source.camera.height, source.camera.width
    tiles, legend = sheet[:height], sheet[height:]
    assert tiles.shape == (height, 2 * width, 3) and len(legend) == LEGEND_PX

    def is_magenta(picture):
        return (np.abs(picture.astype(int) - TRUTH_BGR) < 60).all(axis=2).sum()

    assert is_magenta(tiles) > 100
    for colour in (TRUTH_BGR, LEFT_BGR, RIGHT_BGR):
        assert (np.abs(legend.astype(int) - colour) < 60).all(axis=2).sum() > 10
    # Where the answer is exact it covers the truth.
    exact = draw_worst([source], [source.points_cm], [WorstFrame(0, 1, 0.0)])
    assert is_magenta(exact[:height]) < 0.2 * is_magenta(tiles[:, :width])
    assert jpeg_bytes(sheet)[:2] == b"\xff\xd8"


def test_tiles_of_another_camera_are_fitted_in():
    large, small = labelled(3), labelled(3, camera=half_camera())
    answers = [large.points_cm, small.points_cm]
    five = [WorstFrame(1, 0, 1.0), *(WorstFrame(0, k, 1.0) for k in range(3)), WorstFrame(1, 2, 1.0)]
    sheet = draw_worst([large, small], answers, five)
    height, width = small.camera.height, small.camera.width
    scale = draw_worst([large, small], answers, five[:1]).shape[1] // width
    height, width = scale * height, scale * width
    assert sheet.shape == (2 * height + LEGEND_PX, 4 * width, 3)
    assert not sheet[height : 2 * height, width:].any()
