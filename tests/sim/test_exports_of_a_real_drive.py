"""Labels of a real drive in each format, read back as that format's tools read it; run with ``-m slow``."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path

import numpy as np
import pytest

from datagen.pipeline import MapRequest, MapSettings, label_map, map_drive
from lanenet.data.exports import export_labels
from lanenet.data.label_set import LabelSet, read_labels
from lanenet.data.maps.folder import DriveMap, read_map
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES, ROWS_CM

pytestmark = pytest.mark.slow
#: What a format may cost: the points as they were labelled, in the picture and on the ground.
MOST_PX, MOST_CM = 0.5, 0.05


def made_from(folder: Path, tmp_path: Path) -> tuple[Path, LabelSet, DriveMap]:
    """Label a map; its label set, that read again, and the map."""
    label_map(folder, tmp_path / "labels.parquet", window=BirdseyeWindow())
    return tmp_path / "labels.parquet", read_labels(tmp_path / "labels.parquet"), read_map(folder)


def in_picture(labels: LabelSet, lane: DriveMap, row: int) -> np.ndarray:
    """The six labels in the picture, [px]; NaN where masked or outside."""
    camera = lane.camera_at(int(np.flatnonzero(lane.frames == labels.frame[row])[0]))
    ground = np.column_stack([labels.points_cm[row], np.tile(ROWS_CM, 2)])
    pixels = camera.project_ground(ground)
    last = (camera.width - 1.0, camera.height - 1.0)
    pixels[~((pixels >= 0.0) & (pixels <= last)).all(axis=1)] = np.nan
    return pixels


def check_huggingface(out: Path, labels: LabelSet, lane: DriveMap) -> int:
    datasets = pytest.importorskip("datasets")
    datasets.disable_progress_bars()
    found = datasets.load_dataset(str(out), split="train", cache_dir=str(out.parent / "cache"))
    assert found["frame"][:] == labels.frame.tolist()
    points = np.column_stack([np.array(found[name][:], dtype=float) for name in POINT_NAMES])
    np.testing.assert_allclose(points, labels.points_cm, atol=MOST_CM)
    return int(np.isfinite(points).sum())


def check_coco(out: Path, labels: LabelSet, lane: DriveMap) -> int:
    coco_module = pytest.importorskip("pycocotools.coco")
    with contextlib.redirect_stdout(io.StringIO()):
        coco = coco_module.COCO(out / "annotations.json")
    rows = {int(frame): row for row, frame in enumerate(labels.frame)}
    compared = 0
    for number in coco.getImgIds():
        row = rows[coco.loadImgs(number)[0]["frame"]]
        want = in_picture(labels, lane, row)
        annotations = coco.loadAnns(coco.getAnnIds(imgIds=number))
        if not annotations:
            assert np.isnan(want[:, 0]).all()
            continue
        got = np.array(annotations[0]["keypoints"], dtype=float).reshape(6, 3)
        visible = got[:, 2] == 2
        np.testing.assert_array_equal(visible, np.isfinite(want[:, 0]))
        np.testing.assert_allclose(got[visible, :2], want[visible], atol=MOST_PX)
        np.testing.assert_allclose(
            np.array(annotations[0]["points_cm"], dtype=float), labels.points_cm[row], atol=MOST_CM
        )
        compared += int(visible.sum())
    return compared


def x_at(v: float, rows: np.ndarray, across: np.ndarray) -> tuple[float, float, float]:
    """x of a line given at rows, at a height between two of them, [px].

    Straight from the one row to the other, and the least and the most if the pair of rows before or after
    goes on; these differ where the line has a corner.
    """
    straight = float(np.interp(v, rows, across))
    pair = int(np.searchsorted(rows, v).clip(1, len(rows) - 1)) - 1
    legs = [i for i in (pair - 1, pair + 1) if 0 <= i < len(rows) - 1]
    goes_on = [
        across[i] + (v - rows[i]) * (across[i + 1] - across[i]) / (rows[i + 1] - rows[i]) for i in legs
    ]
    return straight, min(straight, *goes_on), max(straight, *goes_on)


def check_tusimple(out: Path, labels: LabelSet, lane: DriveMap) -> int:
    texts = (out / "label_data.json").read_text().splitlines()
    assert len(texts) == len(labels)
    compared = corners = 0
    for row, text in enumerate(texts):
        picture = json.loads(text)
        heights = np.array(picture["h_samples"], dtype=float)
        for k, (u, v) in enumerate(in_picture(labels, lane, row)):
            across = np.array(picture["lanes"][k // 3], dtype=float)
            seen = across >= 0
            if not np.isfinite(u) or not seen.any():
                continue
            if heights[seen][0] <= v <= heights[seen][-1]:
                straight, least, most = x_at(v, heights[seen], across[seen])
                assert least - MOST_PX < u < most + MOST_PX, (labels.frame[row], k)
                corners += abs(straight - u) >= MOST_PX
                compared += 1
    # The tip of a corner between two rows is cut off: the format has x at whole rows only.
    assert corners <= 0.001 * compared
    return compared


def test_labels_of_a_mat_come_back_from_each_format(shared_data, tmp_path):
    folder = tmp_path / "map"
    map_drive(
        MapRequest(shared_data / "usi_mat", 41.0, wheelbase_cm=17.0), MapSettings(), folder, pictures=False
    )
    path, labels, lane = made_from(folder, tmp_path)
    assert len(labels) > 1000
    for name, check in (
        ("huggingface", check_huggingface),
        ("coco", check_coco),
        ("tusimple", check_tusimple),
    ):
        report = export_labels(path, folder, name, tmp_path / name)
        assert not report.problems
        assert check(tmp_path / name, labels, lane) > 3000, name
