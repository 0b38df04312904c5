"""How far markings lie from the projected lines, and the figures of a label set."""

from __future__ import annotations

import json

import numpy as np
import pytest

from datagen.labels.label_map import frame_residual_cm, label_report, labelled_text
from lanenet.data.label_set import LabelMeta, LabelSet
from lanenet.data.maps.frame_lines import FrameLines
from lanenet.data.maps.mapped_drive import BETWEEN_LANES
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES

TAPE_CM = 2.0


def _line(x_cm: float) -> np.ndarray:
    y = np.arange(-30.0, 100.0, 2.0)
    return np.column_stack([np.full_like(y, x_cm), y])


def _borders(x_cm: float, shift_cm: float = 0.0) -> np.ndarray:
    """Edge points on both sides of a tape."""
    y = np.arange(10.0, 50.0, 1.0)
    sides = [np.column_stack([np.full_like(y, x_cm + shift_cm + b), y]) for b in (-1.0, 1.0)]
    return np.concatenate(sides)


def _lane(left: np.ndarray, right: np.ndarray, *markings_cm: float) -> FrameLines:
    widths_cm = tuple(np.full(len(left), width_cm) for width_cm in markings_cm)
    return FrameLines(left, right, np.full(6, np.nan), widths_cm or None)


LINES = _lane(_line(-20.0), _line(20.0))


@pytest.mark.parametrize("shift", [0.0, 0.3, -0.7])
def test_residual_is_the_shift_between_marking_and_line(shift):
    points = np.concatenate([_borders(-20.0, shift), _borders(20.0, shift)])
    assert frame_residual_cm(points, LINES, TAPE_CM) == pytest.approx(abs(shift), abs=1e-9)


def test_each_line_has_its_own_marking():
    # A narrow middle line beside a wide outer one.
    points = np.concatenate([_borders(-20.0), _borders(20.0) + np.tile([[1.5, 0.0]], (80, 1))])
    points[80:120, 0] -= 3.0
    lane = _lane(_line(-20.0), _line(20.0), 2.0, 5.0)
    assert frame_residual_cm(points, lane, TAPE_CM) == pytest.approx(0.0, abs=1e-9)
    assert frame_residual_cm(points[80:], LINES, 5.0) == pytest.approx(0.0, abs=1e-9)
    assert frame_residual_cm(points[80:], LINES, TAPE_CM) == pytest.approx(1.5, abs=1e-9)


def test_clutter_away_from_the_lines_does_not_count():
    rng = np.random.default_rng(0)
    points = _borders(-20.0, 0.2)
    clutter = np.column_stack([rng.uniform(-12.0, 12.0, 500), rng.uniform(5.0, 60.0, 500)])
    far = np.column_stack([rng.uniform(-25.0, 25.0, 500), rng.uniform(61.0, 90.0, 500)])
    everything = np.concatenate([points, clutter, far])
    assert frame_residual_cm(everything, LINES, TAPE_CM) == pytest.approx(0.2, abs=1e-9)


def test_residual_is_measured_across_a_slanting_line():
    y = np.arange(-30.0, 100.0, 2.0)
    line = np.column_stack([0.5 * y, y])
    normal = np.array([1.0, -0.5]) / np.hypot(1.0, 0.5)
    on_line = line[(y > 5.0) & (y < 50.0)]
    points = np.concatenate([on_line + (1.0 + 0.4) * normal, on_line - (1.0 - 0.4) * normal])
    assert frame_residual_cm(points, _lane(line, LINES.right_cm + [60.0, 0.0]), TAPE_CM) == pytest.approx(
        0.4, abs=1e-9
    )


def test_too_few_points_give_no_residual():
    assert np.isnan(frame_residual_cm(_borders(-20.0)[:9], LINES, TAPE_CM))
    assert frame_residual_cm(_borders(-20.0)[:10], LINES, TAPE_CM) == pytest.approx(0.0)
    assert np.isnan(frame_residual_cm(np.empty((0, 2)), LINES, TAPE_CM))
    unknown = np.full((65, 2), np.nan)
    assert np.isnan(frame_residual_cm(_borders(-20.0), _lane(unknown, unknown), TAPE_CM))


def test_an_unsupported_line_does_not_take_part():
    points = np.concatenate([_borders(-20.0, 0.5), _borders(20.0, 0.0)])
    unknown = np.full((65, 2), np.nan)
    assert frame_residual_cm(points, _lane(LINES.left_cm, unknown), TAPE_CM) == pytest.approx(0.5, abs=1e-9)


def _labels(points_cm: np.ndarray) -> LabelSet:
    n = len(points_cm)
    nothing = np.empty((0, 2))
    return LabelSet(
        meta=LabelMeta(BirdseyeWindow(), "camera", 17.0, 40.0, "map"),
        drive=["drive"] * n,
        file=[""] * n,
        frame=np.arange(n),
        t_s=0.1 * np.arange(n),
        lap=np.zeros(n, dtype=np.int64),
        poses=np.zeros((n, 3)),
        points_cm=points_cm,
        edges=[np.empty((0, 6), np.float32)] * n,
        lines=[(nothing, nothing)] * n,
        quality=np.ones(n),
        divides=np.zeros((n, 2), dtype=bool),
    )


def test_report_gives_shares_of_all_mapped_frames():
    points = np.tile([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0], (8, 1))
    points[:3, 0] = np.nan
    points[:, 5] = np.nan
    residual = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 2.0, np.nan, np.nan])
    report = label_report(_labels(points), residual, 10, {"deleted": 2}, {"left": 0.9, "right": 0.8})
    assert report["format"] == "lanenet-label-report/1"
    assert report["frames_mapped"] == 10
    assert report["frames_labelled"] == 8
    assert report["labelled_share"] == pytest.approx(0.8)
    assert report["frames_left_out"] == {"deleted": 2}
    shares = report["points_labelled_share"]
    assert list(shares) == list(POINT_NAMES)
    np.testing.assert_allclose(list(shares.values()), [0.5, 0.8, 0.8, 0.8, 0.8, 0.0])
    assert report["residual_cm"]["frames"] == 6
    assert report["residual_cm"]["median"] == pytest.approx(0.35)
    assert 0.5 < report["residual_cm"]["p95"] < 2.0
    json.dumps(report, allow_nan=False)


def test_report_without_any_residual_is_nan_not_zero():
    report = label_report(
        _labels(np.full((2, 6), 1.0)), np.full(2, np.nan), 2, {}, {"left": 1.0, "right": 1.0}
    )
    assert report["residual_cm"]["frames"] == 0
    assert np.isnan(report["residual_cm"]["median"])
    assert np.isnan(report["residual_cm"]["p95"])


def test_deleted_frames_are_counted_as_the_verdict_of_the_map_counts_them():
    assert labelled_text(80, 100, {"deleted": 0, "pose uncertain": 20}) == "80 of 100 frames labelled (80 %)"
    told = labelled_text(72, 100, {"deleted": 10, BETWEEN_LANES: 10, "pose uncertain": 8})
    assert told == "72 of 100 frames labelled (72 %; 90 % of those that should have labels)"
