"""The leaderboard follows from what ``make left-out`` measured, from its table as from its page."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest

from lanenet.cli.train import run_settings_schema
from lanenet.config import load_settings
from lanenet.errors import LanenetError

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "bench"))

from bench_leaderboard import WITHOUT, report, results_of_page, results_of_table, times_worse  # noqa: E402
from bench_left_out import LEARN_ON, MORE, real_drives  # noqa: E402

PAGE = (ROOT / "docs" / "results" / "left-out.md").read_text(encoding="utf-8")


def test_the_committed_leaderboard_is_that_of_the_committed_page(tmp_path):
    committed = (ROOT / "docs" / "results" / "leaderboard.md").read_text(encoding="utf-8")
    assert report(PAGE, tmp_path / "none.csv") == committed


def test_a_table_with_the_figures_of_the_page_ranks_alike_and_another_start_is_left_out(tmp_path):
    results = results_of_page(PAGE)
    columns = ["start", "what", "drive", "detector", "rows", "answered", "shared"]
    columns += [
        f"{who}{name}_cm" for who in ("", "shared_", "network_") for name in ("rmse", "median", "p95")
    ]
    table = tmp_path / "left-out.csv"
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        for start, factor in (("9360933b", 1.0), ("00000000", 7.0)):
            for result in results:
                both = result.shared is not None
                row = {"start": start, "what": WITHOUT if both else result.detector, "drive": result.track}
                row |= {"detector": result.detector if both else "network", "rows": "all"}
                row |= {"answered": result.answered.share, "shared": result.shared.share if both else ""}
                parts = {"": result.answered, "shared_": result.shared, "network_": result.network}
                for prefix, figures in parts.items():
                    for name in ("rmse", "median", "p95"):
                        value = "" if figures is None else factor * getattr(figures, f"{name}_cm")
                        row[f"{prefix}{name}_cm"] = value
                writer.writerow(row)
                # Rows of some distances ahead are no result of their own.
                writer.writerow({**row, "rows": "y = 0"})
    # Told apart by what they say, since NaN, of a detector without an answer, is not equal to itself.
    assert list(map(repr, results_of_table(table, "9360933b"))) == list(map(repr, results))
    from_table, from_page = report(PAGE, table), report(PAGE, tmp_path / "none.csv")
    assert from_table.split("\n## ")[1:] == from_page.split("\n## ")[1:]
    assert "the table that `make left-out` keeps" in from_table


def test_who_is_silent_where_it_is_hard_does_not_lead():
    by_name = {r.detector: r for r in results_of_page(PAGE) if r.track == "donkey_circuit"}
    lane_filter, without = by_name["lane-filter"], by_name[WITHOUT]
    # From the page: 0.73 against 0.95 cm on what each answers, 0.73 against 0.38 cm on the same points.
    assert lane_filter.answered.rmse_cm < without.answered.rmse_cm
    assert times_worse(lane_filter, without) == pytest.approx(0.73 / 0.38)


def test_a_page_of_something_else_is_refused(tmp_path):
    with pytest.raises(LanenetError, match="names the weights"):
        report("# Something else", tmp_path / "none.csv")
    with pytest.raises(LanenetError, match="expected the table"):
        results_of_page("# Something else")


def test_what_is_left_out_and_learned_on_is_read_from_the_configs():
    settings = load_settings(run_settings_schema(), ROOT / "configs" / "general.yaml", [*LEARN_ON])
    assert settings.data.synthetic.train == 240 and settings.learn.augment.scale == 0.2
    tubs = load_settings(run_settings_schema(), ROOT / "tests" / "configs" / "tubs.yaml")
    drives = real_drives(tubs.data, Path("drives"))
    assert [drive.path.parent for drive in drives] == [Path("drives")] * 4
    assert {drive.path.name for drive in drives} == {"donkey_circuit", "usi_mat", "garage_tape", *MORE}
    assert {(drive.split, drive.counts_as) for drive in drives} == {("train", 15)}
