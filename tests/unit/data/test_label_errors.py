"""Predicted errors of labels: which are withheld, and what a map's folder keeps of them."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_map import N, small_map

from lanenet.data.maps.folder import read_map, write_map
from lanenet.data.maps.label_errors import MAX_OFF_1, MAX_OFF_3, LabelErrors
from lanenet.errors import MapFormatError


def written(folder: Path, errors: LabelErrors, **changes: np.ndarray) -> Path:
    write_map(folder, replace(small_map(), errors=errors, **changes), {"frame": np.arange(2)}, {}, "given")
    return folder / "poses.csv"


def with_columns(poses: Path, dropped: str, added: dict[str, list[int]]) -> None:
    """Take columns whose names match out of a table, and add others."""
    rows = list(csv.DictReader(poses.read_text().splitlines()))
    rows = [{name: cell for name, cell in row.items() if not re.search(dropped, name)} for row in rows]
    rows = [row | {name: str(cells[k]) for name, cells in added.items()} for k, row in enumerate(rows)]
    poses.write_text("\n".join(",".join(row) for row in [rows[0], *(row.values() for row in rows)]) + "\n")


@pytest.mark.parametrize(
    ("off_1", "off_3", "withheld"),
    [
        (MAX_OFF_1, MAX_OFF_3, False),
        (MAX_OFF_1 + 1e-4, 0.0, True),
        (MAX_OFF_1, MAX_OFF_3 + 1e-4, True),
        (np.nan, 0.0, True),
        (0.0, np.nan, True),
    ],
)
def test_a_label_is_withheld_that_is_likely_off_or_cannot_be_judged(off_1, off_3, withheld):
    errors = LabelErrors(*(np.full((2, 6), value) for value in (0.1, off_1, off_3)))
    assert (errors.withheld == withheld).all()
    # What cannot be judged is not doubted.
    assert (errors.doubted == (withheld and off_3 == off_3)).all()


def test_labels_that_nobody_doubts_and_those_that_are_said_to_be_wrong():
    assert not LabelErrors.none(3).withheld.any() and LabelErrors.none(3).off_1.shape == (3, 6)
    wrong = np.random.default_rng(0).random((5, 6)) < 0.5
    np.testing.assert_array_equal(LabelErrors.withholding(wrong).withheld, wrong)


def test_errors_are_read_back_and_unknown_ones_stay_unknown(tmp_path):
    drawn = np.round(np.random.default_rng(1).random((3, N, 6)), 4)
    drawn[:, 4, 2] = drawn[:, 7] = np.nan
    poses = written(tmp_path, LabelErrors(*drawn))
    found = read_map(tmp_path).errors
    np.testing.assert_array_equal(np.stack(found), drawn)
    assert found.withheld[7].all()
    # Each number stands under its own name.
    rows = list(csv.DictReader(poses.read_text().splitlines()))
    for name, at in (("sigma_cm_left_15", (0, 1)), ("off_1_right_0", (1, 3)), ("off_3_right_30", (2, 5))):
        assert float(rows[5][name]) == drawn[at[0], 5, at[1]]
    assert rows[7]["off_1_left_0"] == ""


def test_an_older_map_gives_no_labels_where_images_contradict_it_or_do_not_match(tmp_path):
    left, right = ([int(k % every == 0) for k in range(N)] for every in (2, 5))
    match = np.where(np.arange(N) == 7, 0.14, 0.16)
    match[9] = np.nan
    poses = written(tmp_path, LabelErrors.none(N), match=match)
    with_columns(poses, "_(left|right)_", {"contradicted_left": left, "contradicted_right": right})
    withheld = read_map(tmp_path).errors.withheld
    wrong = np.repeat(np.array([left, right]).T > 0, 3, axis=1)
    wrong[[7, 9]] = True
    np.testing.assert_array_equal(withheld, wrong)


@pytest.mark.parametrize(
    ("dropped", "added", "named"),
    [
        ("off_1_right_15", (), "off_1_right_15"),
        # Neither a map of today nor an older one: all labels would be given.
        ("_(left|right)_", (), "sigma_cm_left_0"),
        ("_(left|right)_", ("contradicted_left",), "contradicted_right"),
    ],
)
def test_a_map_that_lost_its_errors_is_refused(tmp_path, dropped, added, named):
    poses = written(tmp_path, LabelErrors.none(N))
    with_columns(poses, dropped, {name: [0] * N for name in added})
    with pytest.raises(MapFormatError, match=rf"poses\.csv.*{named}"):
        read_map(tmp_path)
