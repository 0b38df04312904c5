import io
import json
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from lanenet.data.files import write_json
from lanenet.evaluation.comparison import SourceAnswers, compare_detectors
from lanenet.evaluation.errors import (
    RELIABILITY_SHARES,
    bootstrap_segments,
    errors_by_group,
    lane_curvature,
    lines_shown,
    presence_stats,
    rmse_interval_cm,
    sigma_stats,
)
from lanenet.evaluation.report import plot_breakdown
from lanenet.evaluation.tables import as_markdown, lay_out
from lanenet.geometry.lane import POINTS_FROM_PARABOLA
from lanenet.image_header import image_size

NAN = float("nan")
TRUTH = np.zeros((200, 6))


def test_curvature_is_that_of_circles():
    radius, centre = 150.0, np.array([150.0, 15.0])
    y = np.array([0.0, 15.0, 30.0])
    lines = [centre[0] - np.sqrt(r * r - (y - centre[1]) ** 2) for r in (radius + 20.0, radius - 20.0)]
    found = lane_curvature(np.concatenate(lines)[None])
    # The mean of both lines; a parabola through three points of a circle is a little flatter or sharper.
    assert found[0] == pytest.approx(0.5 * (1 / 170.0 + 1 / 130.0), rel=0.02)
    np.testing.assert_allclose(lane_curvature(-np.concatenate(lines)[None]), found)
    straight = (np.array([[0.0, 0.3, -20.0], [0.0, 0.3, 20.0]]) @ POINTS_FROM_PARABOLA.T).reshape(1, 6)
    assert lane_curvature(straight)[0] == pytest.approx(0.0, abs=1e-12)
    half = np.concatenate([lines[0], [NAN, 20.0, 20.0]])[None]
    assert lane_curvature(half)[0] == pytest.approx(1 / 170.0, rel=0.02)
    assert np.isnan(lane_curvature(np.full((1, 6), NAN))[0])


def test_groups_take_the_frames_between_their_limits():
    errors = np.tile(np.arange(5.0)[:, None], (1, 6))
    errors[4, 3:] = NAN
    labelled = np.ones((5, 6), bool)
    groups = errors_by_group("light", np.array([10.0, 59.9, 60.0, NAN, 200.0]), errors, labelled)
    assert [g.truth_count for g in groups.values()] == [12, 6, 6]
    assert [g.worst_cm for g in groups.values()] == [1.0, 2.0, 4.0]
    assert groups["over 140"].coverage == 0.5


def test_a_frame_shows_none_one_or_both_lines():
    visible = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [NAN, 0.0], [1.0, NAN], [NAN, NAN]])
    shown = lines_shown(visible)
    np.testing.assert_array_equal(shown, [0.0, 1.0, 2.0, 0.5, 1.5, NAN])
    groups = errors_by_group("lines", shown, np.tile(np.arange(6.0)[:, None], (1, 6)), np.ones((6, 6), bool))
    assert [(g.count, g.worst_cm) for g in groups.values()] == [(6, 0.0), (6, 3.0), (12, 4.0), (6, 2.0)]


def test_the_interval_is_over_drives_and_not_over_frames():
    rng = np.random.default_rng(3)
    # Ten drives with errors of their own size: thousands of frames do not make the mean any surer.
    sizes = np.linspace(0.5, 2.0, 10)
    drives = [np.full((1000, 6), size) for size in sizes]
    low, high = rmse_interval_cm(drives, rng)
    rmse = np.sqrt(np.mean(sizes**2))
    assert low < rmse < high
    # The mean square of ten drives has a standard error of std / sqrt(10).
    expected = 1.96 * np.std(sizes**2) / np.sqrt(10.0) / (2.0 * rmse)
    assert 0.5 * (high - low) == pytest.approx(expected, rel=0.2)
    assert rmse_interval_cm([np.full((20, 6), 1.0)] * 5, rng) == pytest.approx((1.0, 1.0))
    assert rmse_interval_cm(drives[:2], rng) is None
    # A drive without an answer is no drive.
    assert rmse_interval_cm([*drives[:2], np.full((5, 6), NAN)], rng) is None


def test_of_few_drives_stretches_are_drawn():
    cuts, over = bootstrap_segments([100, 7, 30])
    assert cuts.tolist() == [100, 107] and over == "drives like these"
    # A rest of less than half a stretch belongs to the one before; no stretch reaches into another drive.
    cuts, over = bootstrap_segments([115, 70])
    assert cuts.tolist() == [40, 80, 115, 155] and over == "segments of 40 frames"
    assert bootstrap_segments([99])[0].tolist() == [40]
    assert bootstrap_segments([10])[0].tolist() == []
    alike = np.repeat([1.0, 3.0], 60)[:, None] * np.ones((1, 6))
    low, high = rmse_interval_cm(np.split(alike, bootstrap_segments([120])[0]), np.random.default_rng(0))
    # Three segments, of mean squares 1, 5 and 9, drawn three at a time.
    assert low == pytest.approx(1.0) and high == pytest.approx(3.0)


def test_honest_doubt_is_on_the_diagonal():
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.3, 2.0, (20_000, 6))
    errors = np.abs(rng.normal(0.0, sigma))
    honest = sigma_stats(errors, sigma)
    assert honest.coverage["68"] == pytest.approx(0.683, abs=0.005)
    assert honest.coverage["95"] == pytest.approx(0.95, abs=0.005)
    np.testing.assert_allclose(honest.reliability, RELIABILITY_SHARES, atol=0.006)
    assert sigma_stats(errors, 0.5 * sigma).coverage["68"] < 0.4
    errors[:, 0] = NAN
    assert sigma_stats(errors, sigma).count == 100_000
    assert sigma_stats(errors, np.full_like(sigma, NAN)) is None


def test_presence_is_counted_both_ways():
    said = np.array([[0.9, 0.1], [0.6, 0.5], [0.2, NAN], [0.8, 0.3]])
    there = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [NAN, 0.0]])
    found = presence_stats(said, there)
    assert (found.there, found.absent) == (3, 3)
    assert found.precision == pytest.approx(2 / 3) and found.recall == pytest.approx(2 / 3)
    assert found.absent_recall == pytest.approx(2 / 3)
    assert presence_stats(said, np.full_like(there, NAN)) is None
    everywhere = presence_stats(np.ones((4, 2)), np.ones((4, 2)))
    assert everywhere.recall == 1.0 and np.isnan(everywhere.absent_recall)


def sources():
    """Three drives: a straight one and two bends; the network is less sure where it is wrong."""
    rng, found = np.random.default_rng(1), []
    for number, a in enumerate((0.0, 0.002, 0.01)):
        parabolas = np.array([[a, 0.0, -20.0], [a, 0.0, 20.0]])
        truth = np.tile((parabolas @ POINTS_FROM_PARABOLA.T).ravel(), (200, 1))
        sigma = np.full((200, 6), 0.3 + number)
        answers = {"network": truth + rng.normal(0.0, sigma), "painter": truth + 1.0}
        found.append(
            SourceAnswers(
                f"runs/{number}",
                "simulated drive",
                "truth",
                truth,
                answers,
                sigma_cm={"network": sigma},
                presence={"network": np.full((200, 2), 0.9)},
                visible=np.tile([1.0, 1.0 if number else 0.0], (200, 1)),
                conditions={"light": np.full(200, 50.0 + 50.0 * number)} if number else {},
            )
        )
    return found


def test_a_comparison_tells_where_errors_come_from(tmp_path):
    found = compare_detectors(sources())
    bends = found.breakdown.groups["bend"]["network"]
    rmse = [stats.rmse_cm for stats in bends.values()]
    assert rmse == pytest.approx([0.3, 1.3, 2.3], rel=0.1)
    assert found.breakdown.sigma["network"].coverage["68"] == pytest.approx(0.683, abs=0.03)
    assert "painter" not in found.breakdown.sigma and "painter" not in found.breakdown.presence
    told = found.breakdown.presence["network"]
    assert (told.there, told.absent, told.recall, told.absent_recall) == (1000, 200, 1.0, 0.0)
    # The light of the first drive is unknown.
    assert sum(s.truth_count for s in found.breakdown.groups["light"]["painter"].values()) == 2400
    markdown = as_markdown(found)
    assert "RMSE in cm by bend" in markdown and "RMSE in cm by light" in markdown
    assert "95 % intervals of the RMSE over drives like these: network" in markdown
    assert "| network | 1.30 | 6" in markdown
    write_json(tmp_path / "t.json", found.as_dict())
    network = json.loads((tmp_path / "t.json").read_text())["detectors"]["network"]
    assert network["doubt"]["coverage_68"] == pytest.approx(0.683, abs=0.03)
    assert network["presence"]["absent_recall"] == 0.0
    assert network["rmse_95_interval_cm"][0] < network["groups"]["all"]["rmse_cm"]
    assert network["conditions"]["bend"]["under 1 m"]["rmse_cm"] == pytest.approx(2.3, rel=0.1)
    # Five detectors have room in a terminal of 80 columns.
    five = dict.fromkeys(("network", "lane-filter", "hough", "hough-value", "painter"), TRUTH)
    wide = compare_detectors([replace(source, answers_cm=five) for source in sources()])
    console = Console(width=80, file=io.StringIO(), record=True)
    for table in lay_out(wide):
        console.print(table.as_rich())
    assert "by light" in (text := console.export_text()) and "…" not in text
    size = image_size(plot_breakdown(found))
    assert size is not None and min(size) > 200
