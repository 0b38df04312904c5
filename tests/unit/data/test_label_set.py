from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lanenet.data.camera_file import camera_data, read_camera
from lanenet.data.label_set import (
    LabelMeta,
    LabelSet,
    read_label_index,
    read_labels,
    read_places,
    write_labels,
)
from lanenet.errors import LabelFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import POINT_NAMES

CAMERA = read_camera(Path(__file__).resolve().parents[3] / "checkpoints" / "small" / "camera.yaml")
META = LabelMeta(
    window=BirdseyeWindow(left_cm=-24.0, cell_cm=1.5, rows=32, columns=32),
    camera_hash="0123456789abcdef",
    wheelbase_cm=26.0,
    lane_width_cm=40.0,
    source="truth",
    config_hash="feed",
)


def make_labels(n: int = 6, seed: int = 0) -> LabelSet:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 20.0, (n, 6))
    points[rng.random((n, 6)) < 0.3] = np.nan
    edges, lines = [], []
    for k in range(n):
        # The first frame shows nothing.
        m = 0 if k == 0 else int(rng.integers(5, 60))
        angle = rng.uniform(0.0, 2.0 * np.pi, m)
        xy = rng.uniform([-30.0, -5.0], [30.0, 60.0], (m, 2))
        hues = rng.uniform(-1.0, 1.0, (m, 2))
        edges.append(np.column_stack([xy, np.cos(angle), np.sin(angle), hues]).astype(np.float32))
        left = rng.normal(size=(k, 2)).astype(np.float32)
        right = rng.normal(size=(4, 2)).astype(np.float32)
        right[2] = np.nan
        lines.append((left, right))
    return LabelSet(
        meta=META,
        drive=["lap one"] * n,
        file=["" if k % 2 else f"images/{k:06d}.jpg" for k in range(n)],
        frame=np.arange(10, 10 + n),
        t_s=0.05 * np.arange(n),
        lap=np.arange(n) // 3,
        poses=rng.normal(0.0, 300.0, (n, 3)),
        points_cm=points,
        edges=edges,
        lines=lines,
        quality=rng.random(n),
        divides=rng.random((n, 2)) < 0.5,
    )


def assert_same(a: LabelSet, b: LabelSet) -> None:
    assert a.meta == b.meta
    assert a.drive == b.drive
    assert a.file == b.file
    for name in ("frame", "t_s", "lap", "poses", "points_cm", "quality", "divides"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for edge_a, edge_b in zip(a.edges, b.edges, strict=True):
        np.testing.assert_array_equal(edge_a, edge_b)
    for pair_a, pair_b in zip(a.lines, b.lines, strict=True):
        for line_a, line_b in zip(pair_a, pair_b, strict=True):
            np.testing.assert_array_equal(line_a, line_b)


def test_the_camera_travels_with_the_set(tmp_path: Path) -> None:
    path, meta = tmp_path / "labels.parquet", replace(META, camera=CAMERA, camera_hash=CAMERA.hash)
    write_labels(path, replace(make_labels(), meta=meta))
    for found in (read_labels(path).meta, read_label_index(path).meta, read_places(path).meta):
        assert found == meta and found.camera is not None and found.camera.hash == CAMERA.hash
        assert found.camera.mounting == CAMERA.mounting


def test_a_set_of_the_format_before_has_no_camera(tmp_path: Path) -> None:
    path = rewritten(tmp_path, {"format": "lanenet-labels/2"}, without=("camera",))
    assert_same(read_labels(path), make_labels())
    assert read_labels(path).meta.camera is None


NARROW, WIDE = BirdseyeWindow(left_cm=-30.0, columns=80), BirdseyeWindow(left_cm=-60.0, columns=160)


def lane_at(source: str, *x_cm: float, masked: tuple[int, ...] = ()) -> LabelSet:
    """Frames with straight lines, 40 cm apart, the left one at ``x_cm``; ``masked`` ones have no labels."""
    y = np.array([-20.0, 90.0])
    lines = [(np.stack([0 * y + x, y], axis=1), np.stack([0 * y + x + 40.0, y], axis=1)) for x in x_cm]
    n = len(x_cm)
    points = NARROW.labelled(np.array([np.repeat([x, x + 40.0], 3) for x in x_cm]))
    points[list(masked)] = np.nan
    meta = replace(META, window=NARROW, source=source)
    return replace(make_labels(n), meta=meta, lines=lines, points_cm=points)


@pytest.mark.parametrize("source", ["map", "truth"])
def test_another_window_shows_what_lies_beside_the_first(source: str) -> None:
    labels = lane_at(source, -20.0, -45.0, 15.0)
    assert np.isfinite(labels.points_cm).all(axis=1).tolist() == [True, False, False]
    wide = labels.in_window(WIDE)
    expected = [np.repeat([x, x + 40.0], 3) for x in (-20.0, -45.0, 15.0)]
    np.testing.assert_allclose(wide.points_cm, expected)
    assert wide.meta.window == WIDE and wide.raster(1).shape[1:] == (WIDE.rows, WIDE.columns)
    np.testing.assert_array_equal(wide.in_window(NARROW).points_cm, labels.points_cm)
    assert labels.in_window(NARROW) is labels


def test_another_window_shows_no_label_that_was_masked_for_another_reason() -> None:
    labels = lane_at("map", -20.0, -20.0, -45.0, masked=(1, 2))
    labels.points_cm[0, 4] = np.nan
    wide = labels.in_window(WIDE).points_cm
    # One point of a line, and frames that were not to be labelled.
    np.testing.assert_array_equal(wide, labels.points_cm)
    # A map's line that crosses a row too obliquely has no place in it, a simulator's has.
    oblique = np.array([[-58.0, -20.0], [200.0, 90.0]])
    for source, known in (("map", False), ("truth", True)):
        one = replace(lane_at(source, -45.0), lines=[(oblique, lane_at(source, -45.0).lines[0][1])])
        assert np.isfinite(one.in_window(WIDE).points_cm[0, :3]).any() == known


@pytest.mark.parametrize("n", [0, 1, 6])
def test_round_trip(tmp_path: Path, n: int) -> None:
    labels = make_labels(n)
    write_labels(tmp_path / "labels.parquet", labels)
    back = read_labels(tmp_path / "labels.parquet")
    assert_same(back, labels)
    assert all(edge.dtype == np.float32 and edge.shape[1] == 6 for edge in back.edges)
    assert [p.name for p in tmp_path.iterdir()] == ["labels.parquet"]


def test_the_picture_is_the_raster(tmp_path: Path) -> None:
    labels = make_labels()
    path = tmp_path / "labels.parquet"
    write_labels(path, labels)
    back = read_labels(path)
    images = pq.read_table(path).column("image").to_pylist()
    for i, image in enumerate(images):
        picture = cv2.imdecode(np.frombuffer(image["bytes"], np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(picture, back.raster(i)[0])
        np.testing.assert_array_equal(picture, labels.raster(i)[0])
        assert image["path"] == f"lap one_{10 + i:06d}.png"
    assert back.raster(0).shape == (5, 32, 32)
    assert back.raster(0)[0].max() == 0
    assert back.raster(1)[0].max() == 255


def test_other_tools_see_nulls_units_and_an_image(tmp_path: Path) -> None:
    labels = make_labels()
    path = tmp_path / "labels.parquet"
    write_labels(path, labels)
    table = pq.read_table(path)
    for k, name in enumerate(POINT_NAMES):
        assert table.column(name).null_count == int(np.isnan(labels.points_cm[:, k]).sum())
    assert table.schema.field("image").type == pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    hugging_face = json.loads(table.schema.metadata[b"huggingface"])
    assert hugging_face["info"]["features"]["image"] == {"_type": "Image"}
    meta = json.loads(table.schema.metadata[b"lanenet"])
    assert meta["format"] == "lanenet-labels/3"
    assert meta["rows_cm"] == [0.0, 15.0, 30.0]
    assert meta["order"] == list(POINT_NAMES)
    assert meta["window"] == {"left_cm": -24.0, "near_cm": 0.0, "cell_cm": 1.5, "rows": 32, "columns": 32}
    assert (meta["camera_hash"], meta["source"], meta["config_hash"]) == ("0123456789abcdef", "truth", "feed")


def test_the_verdict_on_the_map_is_kept_and_older_files_have_none(tmp_path: Path) -> None:
    labels = make_labels()
    rejected = replace(labels, meta=replace(META, source="map", verdict="reject"))
    path = tmp_path / "labels.parquet"
    write_labels(path, rejected)
    assert_same(read_labels(path), rejected)
    table = pq.read_table(path)
    meta = json.loads(table.schema.metadata[b"lanenet"])
    del meta["verdict"]
    pq.write_table(table.replace_schema_metadata({"lanenet": json.dumps(meta)}), path)
    assert read_label_index(path).meta.verdict is None


def test_several_row_groups_read_as_one(tmp_path: Path) -> None:
    labels = make_labels(9)
    path = tmp_path / "labels.parquet"
    write_labels(path, labels)
    pq.write_table(pq.read_table(path), path, row_group_size=2)
    assert_same(read_labels(path), labels)


def test_a_subset_keeps_rows_together() -> None:
    labels = make_labels()
    part = labels.subset(np.array([4, 1]))
    assert part.frame.tolist() == [14, 11]
    np.testing.assert_array_equal(part.raster(0), labels.raster(4))
    assert part.lines[1][0].shape == (1, 2)
    assert labels.subset(labels.frame > 13).frame.tolist() == [14, 15]
    assert len(labels.subset(slice(None, None, 2))) == 3


def test_lists_of_different_length_are_refused() -> None:
    labels = make_labels()
    with pytest.raises(LabelFormatError, match="6 frames, but 5 of 'edges'"):
        replace(labels, edges=labels.edges[:5])


def with_value(labels: LabelSet, name: str, value: float) -> LabelSet:
    changed = getattr(labels, name).copy()
    changed[3] = value
    return replace(labels, **{name: changed})


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("t_s", np.nan, "column 't_s': not finite in row 3"),
        ("poses", np.inf, "column 'x_cm', row 3: found inf"),
        ("poses", np.nan, "column 'x_cm', row 3: found nan"),
        ("poses", 1e300, "column 'x_cm', row 3: found 1e.300"),
        ("points_cm", -np.inf, "column 'left_0_cm', row 3: found -inf"),
        ("points_cm", -1e9, "column 'left_0_cm', row 3: found -1e.09"),
        ("quality", 1.5, "column 'quality': outside 0..1 in row 3"),
        ("quality", np.nan, "column 'quality': outside 0..1 in row 3"),
    ],
)
def test_writing_refuses_what_reading_would(tmp_path: Path, name: str, value: float, message: str) -> None:
    with pytest.raises(LabelFormatError, match=message):
        write_labels(tmp_path / "labels.parquet", with_value(make_labels(), name, value))
    assert list(tmp_path.iterdir()) == []


def test_writing_refuses_edges_and_lines_that_are_not_finite(tmp_path: Path) -> None:
    labels = make_labels()
    labels.edges[2][1, 0] = np.nan
    with pytest.raises(LabelFormatError, match=r"'edges_.*row 2"):
        write_labels(tmp_path / "labels.parquet", labels)
    labels = make_labels()
    labels.lines[4][1][0, 1] = np.inf
    with pytest.raises(LabelFormatError, match=r"_line_.*row 4"):
        write_labels(tmp_path / "labels.parquet", labels)


def rewritten(
    tmp_path: Path, meta: dict[str, Any] | None = None, without: tuple[str, ...] = (), **columns: Any
) -> Path:
    """A label set with metadata or columns replaced; a column that is None is dropped."""
    path = tmp_path / "labels.parquet"
    write_labels(path, make_labels())
    table = pq.read_table(path)
    metadata = dict(table.schema.metadata)
    if meta is not None:
        data = json.loads(metadata[b"lanenet"]) | meta
        kept = {key: value for key, value in data.items() if key not in without}
        metadata[b"lanenet"] = json.dumps(kept).encode()
    for name, values in columns.items():
        place = table.column_names.index(name)
        table = table.remove_column(place) if values is None else table.set_column(place, name, [values])
    pq.write_table(table.replace_schema_metadata(metadata), path)
    return path


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"format": "lanenet-labels/4"}, "expected format 'lanenet-labels/3', found 'lanenet-labels/4'"),
        ({"format": None}, "expected format 'lanenet-labels/3', found None"),
        ({"camera": {"format": "lanenet-camera/1"}}, "key 'camera.model' is missing"),
        (
            {"camera": camera_data(CAMERA)},
            f"its camera has the hash {CAMERA.hash}, but its edge points are of",
        ),
        ({"rows_cm": [0, 10, 20]}, "expected labels at rows"),
        ({"order": list(POINT_NAMES[::-1])}, "in the order"),
        ({"source": "hand"}, "key 'source'"),
        ({"wheelbase_cm": 0}, "key 'wheelbase_cm'"),
        ({"new_key": 1}, "unknown key 'new_key'"),
        (
            {"window": {"left_cm": -24, "near_cm": 0, "cell_cm": 1.5, "rows": 16, "columns": 32}},
            "column 'image', row 0: found 32x32 px, expected 32x16 px for the window",
        ),
    ],
)
def test_metadata_is_checked(tmp_path: Path, meta: dict[str, Any], message: str) -> None:
    with pytest.raises(LabelFormatError) as caught:
        read_labels(rewritten(tmp_path, meta))
    assert "labels.parquet: " in str(caught.value)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "name", ["t_s", "left_15_cm", "edges_normal_y", "right_line_x_cm", "image", "quality", "left_divides"]
)
def test_a_missing_column_is_named(tmp_path: Path, name: str) -> None:
    with pytest.raises(LabelFormatError, match=rf"labels\.parquet: column '{name}' is missing"):
        read_labels(rewritten(tmp_path, **{name: None}))


SIX = [0.0, 0.0, 0.0, 0.0, float("inf"), 0.0]


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("right_30_cm", SIX, "column 'right_30_cm', row 4: found inf"),
        ("x_cm", SIX, "column 'x_cm', row 4: found inf"),
        ("y_cm", [0.0, None, 0.0, 0.0, 0.0, 0.0], "column 'y_cm', row 1: found nan"),
        ("quality", [0.5, 0.5, 7.0, 0.5, 0.5, 0.5], "column 'quality': outside 0..1 in row 2"),
        ("t_s", ["a"] * 6, "column 't_s': expected numbers"),
        ("frame", [1, 2, None, 4, 5, 6], "column 'frame' holds empty values"),
        ("drive", [1] * 6, "column 'drive': expected texts"),
        ("edges_x_cm", [[], [1.0, float("inf")], [], [], [], []], "column 'edges_x_cm', row 1: found inf"),
        ("edges_x_cm", [1.0] * 6, "column 'edges_x_cm': expected lists of numbers"),
        ("left_line_y_cm", [[9.0], [], [], [], [], []], "column 'left_line_y_cm', row 0: found 1 values"),
        ("image", [None] * 6, "column 'image', row 0: found no PNG"),
    ],
)
def test_a_wrong_column_is_named(tmp_path: Path, name: str, values: list[Any], message: str) -> None:
    with pytest.raises(LabelFormatError) as caught:
        read_labels(rewritten(tmp_path, **{name: pa.array(values)}))
    assert "labels.parquet: " in str(caught.value)
    assert message in str(caught.value)


def test_what_is_no_label_set(tmp_path: Path) -> None:
    path = tmp_path / "labels.parquet"
    with pytest.raises(LabelFormatError, match="no such file"):
        read_labels(path)
    path.write_bytes(b"PAR1 not really")
    with pytest.raises(LabelFormatError, match="not a readable Parquet file"):
        read_labels(path)
    pq.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(LabelFormatError, match="without lanenet's metadata"):
        read_labels(path)
