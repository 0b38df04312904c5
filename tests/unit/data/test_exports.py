from __future__ import annotations

import contextlib
import io
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from bags import START_NS, STEP_NS, compressed, write_bag
from drives import frame_image
from small_map import CAMERA, small_map
from synthetic_labels import make_label_set

from lanenet.cli.export import FormatName
from lanenet.data.camera_file import read_camera, write_camera
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.exports import EXPORTS, export_labels
from lanenet.data.label_set import LabelSet, read_labels, write_labels
from lanenet.data.maps.folder import DriveMap, write_map
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.tables import write_csv
from lanenet.errors import ConfigError, DriveFormatError, LabelFormatError, LanenetError
from lanenet.geometry.lane import POINT_NAMES, ROWS_CM

N = 6
#: What rounding in a file, or a straight line between two rows of the picture, may cost.
MOST_PX, MOST_CM = 0.5, 0.05


@pytest.fixture
def made(tmp_path: Path) -> tuple[Path, Path, LabelSet, DriveMap]:
    """A label set, its map, and both in memory; one label is masked."""
    with DriveWriter(tmp_path / "d") as writer:
        for k in range(N):
            writer.add(frame_image(k, 160, 120), 0.05 * k)
    whole = small_map()
    cut = {
        name: getattr(whole, name)[:N]
        for name in (
            "t_s",
            "poses",
            "lap",
            "segment",
            "s_cm",
            "match",
            "tilt_rad",
            "held_out",
        )
    }
    meta = whole.meta.model_copy(update={"drive": str(tmp_path / "d")})
    lane = replace(
        whole, meta=meta, frames=np.arange(N), lines={0: whole.lines[0]}, errors=LabelErrors.none(N), **cut
    )
    write_map(tmp_path / "map", lane, {"frame": np.arange(3)}, {"frames": N}, "by hand")
    (tmp_path / "map" / "settings.yaml").write_text("{}\n")
    labels = make_label_set(N, 3, camera_hash=CAMERA.hash)
    labels = replace(labels, poses=lane.poses)
    labels.points_cm[2, 4] = np.nan
    # The map has them all, the label set leaves one out.
    labels = labels.subset(np.array([0, 1, 2, 4, 5]))
    write_labels(tmp_path / "a.parquet", labels)
    return tmp_path / "a.parquet", tmp_path / "map", read_labels(tmp_path / "a.parquet"), lane


def expected_px(labels: LabelSet, lane: DriveMap, row: int) -> np.ndarray:
    """The six labels in the picture; NaN where masked or outside."""
    ground = np.column_stack([labels.points_cm[row], np.tile(ROWS_CM, 2)])
    pixels = lane.camera_at(int(labels.frame[row])).project_ground(ground)
    pixels[~((pixels >= 0.0) & (pixels <= (159.0, 119.0))).all(axis=1)] = np.nan
    return pixels


def test_huggingface_reads_the_same_points(
    made: tuple[Path, Path, LabelSet, DriveMap], tmp_path: Path
) -> None:
    path, frames, labels, lane = made
    report = export_labels(path, frames, "huggingface", tmp_path / "hf")
    assert (report.frames, report.points, report.problems) == (5, 29, ())
    datasets = pytest.importorskip("datasets")
    datasets.disable_progress_bars()
    found = datasets.load_dataset(str(tmp_path / "hf"), split="train", cache_dir=str(tmp_path / "cache"))
    assert found["frame"][:] == [0, 1, 2, 4, 5]
    for row, each in enumerate(found):
        points = np.array([each[name] for name in POINT_NAMES], dtype=float)
        np.testing.assert_array_equal(points, labels.points_cm[row])
        names = [name.removesuffix("_cm") for name in POINT_NAMES]
        pixels = np.array([[each[f"{name}_{axis}_px"] for axis in "uv"] for name in names], dtype=float)
        np.testing.assert_allclose(pixels, expected_px(labels, lane, row), atol=1e-9)
        image = np.array(each["image"])[..., ::-1]
        original = cv2.imread(str(tmp_path / "d" / "images" / f"{each['frame']:06d}.jpg"))
        np.testing.assert_allclose(image.astype(int), original.astype(int), atol=6)
    card = (tmp_path / "hf" / "README.md").read_text().split("---\n")
    assert yaml.safe_load(card[1])["size_categories"] == ["n<1K"]
    assert "5 labelled frames, 160x120 px, lane of 40 cm" in " ".join(card[2].split())
    # The label set itself goes with it.
    np.testing.assert_array_equal(read_labels(tmp_path / "hf" / "labels.parquet").points_cm, labels.points_cm)
    assert read_camera(tmp_path / "hf" / "camera.yaml").hash == CAMERA.hash


def test_coco_reads_the_same_points(made: tuple[Path, Path, LabelSet, DriveMap], tmp_path: Path) -> None:
    path, frames, labels, lane = made
    export_labels(path, frames, "coco", tmp_path / "coco")
    pycocotools = pytest.importorskip("pycocotools.coco")
    with contextlib.redirect_stdout(io.StringIO()):
        coco = pycocotools.COCO(tmp_path / "coco" / "annotations.json")
    (category,) = coco.loadCats(coco.getCatIds())
    assert category["keypoints"] == list(POINT_NAMES)
    seen = 0
    for row, number in enumerate(coco.getImgIds()):
        (image,) = coco.loadImgs(number)
        assert cv2.imread(str(tmp_path / "coco" / "images" / image["file_name"])).shape == (120, 160, 3)
        want = expected_px(labels, lane, row)
        (annotation,) = coco.loadAnns(coco.getAnnIds(imgIds=number))
        got = np.array(annotation["keypoints"], dtype=float).reshape(6, 3)
        np.testing.assert_array_equal(got[:, 2], np.where(np.isnan(want[:, 0]), 0, 2))
        visible = got[:, 2] == 2
        seen += int(visible.sum())
        np.testing.assert_allclose(got[visible, :2], want[visible], atol=1e-3)
        ground = lane.camera_at(int(labels.frame[row])).intersect_ground(got[visible, :2])
        np.testing.assert_allclose(ground[:, 0], labels.points_cm[row][visible], atol=MOST_CM)
        np.testing.assert_allclose(np.array(annotation["points_cm"], float), labels.points_cm[row], atol=1e-4)
        assert annotation["num_keypoints"] == visible.sum()
    assert seen > 10


def test_tusimple_reads_the_same_points(made: tuple[Path, Path, LabelSet, DriveMap], tmp_path: Path) -> None:
    path, frames, labels, lane = made
    export_labels(path, frames, "tusimple", tmp_path / "tusimple")
    lines = (tmp_path / "tusimple" / "label_data.json").read_text().splitlines()
    compared = 0
    for row, text in enumerate(lines):
        picture = json.loads(text)
        camera = lane.camera_at(int(labels.frame[row]))
        stem = tmp_path / "d" / "images" / f"{int(labels.frame[row]):06d}.jpg"
        assert (tmp_path / "tusimple" / picture["raw_file"]).read_bytes() == stem.read_bytes()
        assert np.diff(picture["h_samples"]).tolist() == [1] * 119
        # TuSimple's own rule: the points of a lane are those with x >= 0.
        lanes = [
            np.array([(x, y) for x, y in zip(xs, picture["h_samples"], strict=True) if x >= 0])
            for xs in picture["lanes"]
        ]
        assert all(x == -2 or 0 <= x <= 159 for xs in picture["lanes"] for x in xs)
        for k, (u, v) in enumerate(expected_px(labels, lane, row)):
            points = lanes[k // 3]
            if np.isfinite(u) and points[0, 1] <= v <= points[-1, 1]:
                x = np.interp(v, points[:, 1], points[:, 0])
                assert abs(x - u) < MOST_PX
                ground = camera.intersect_ground(np.array([[x, v]]))
                assert np.linalg.norm(ground[0] - (labels.points_cm[row, k], ROWS_CM[k % 3])) < 5.0 * MOST_CM
                compared += 1
    assert (len(lines), compared > 10) == (5, True)


def test_pictures_of_a_bag_become_png(made: tuple[Path, Path, LabelSet, DriveMap], tmp_path: Path) -> None:
    path, _, _, lane = made
    messages = [(START_NS + k * STEP_NS, compressed(frame_image(k, 160, 120))) for k in range(N)]
    bag = write_bag(tmp_path / "bag" / "d", {"/camera": messages})
    moved = replace(lane, meta=lane.meta.model_copy(update={"drive": str(bag)}))
    write_map(tmp_path / "map2", moved, {"frame": np.arange(3)}, {"frames": N}, "by hand")
    (tmp_path / "map2" / "settings.yaml").write_text("{}\n")
    export_labels(path, tmp_path / "map2", "coco", tmp_path / "coco")
    image = cv2.imread(str(tmp_path / "coco" / "images" / "d_000004.png"))
    np.testing.assert_array_equal(image, frame_image(4, 160, 120))


def test_a_picture_that_cannot_be_read_is_left_out_and_said_so(
    made: tuple[Path, Path, LabelSet, DriveMap], tmp_path: Path
) -> None:
    path, frames, *_ = made
    (tmp_path / "d" / "images" / "000001.jpg").write_bytes(b"no picture")
    report = export_labels(path, frames, "huggingface", tmp_path / "hf")
    assert report.frames == 4
    assert "frame 1: " in report.problems[0] and report.problems[0].endswith("; left out")
    for image in (tmp_path / "d" / "images").iterdir():
        image.write_bytes(b"no picture")
    with pytest.raises(LanenetError, match="none of the 6 frames"):
        export_labels(path, frames, "coco", tmp_path / "coco")
    assert not (tmp_path / "coco").exists()


@pytest.mark.parametrize("name", EXPORTS)
def test_nothing_is_replaced_unasked(
    made: tuple[Path, Path, LabelSet, DriveMap], tmp_path: Path, name: str
) -> None:
    path, frames, *_ = made
    out = tmp_path / "out"
    export_labels(path, frames, name, out)
    with pytest.raises(ConfigError, match=r"holds an export already.*--force"):
        export_labels(path, frames, name, out)
    export_labels(path, frames, name, out, force=True)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("x")
    with pytest.raises(LanenetError, match=r"holds no export\.yaml"):
        export_labels(path, frames, name, tmp_path / "mine", force=True)


def test_labels_of_another_camera_drive_or_frame_are_refused(
    made: tuple[Path, Path, LabelSet, DriveMap], tmp_path: Path
) -> None:
    _, frames, labels, _ = made
    wrong = {
        "expected what the labels were made from": replace(labels, drive=["e"] * 5),
        "camera other; .* camera": replace(labels, meta=replace(labels.meta, camera_hash="other")),
        "frame 9 is not in": replace(labels, frame=np.array([0, 1, 2, 4, 9])),
    }
    for words, changed in wrong.items():
        write_labels(tmp_path / "b.parquet", changed)
        with pytest.raises(LabelFormatError, match=words):
            export_labels(tmp_path / "b.parquet", frames, "coco", tmp_path / "out")


def test_labels_of_a_simulated_drive_that_was_made_anew_are_refused(
    made: tuple[Path, Path, LabelSet, DriveMap], tmp_path: Path
) -> None:
    _, _, labels, _ = made
    drive = tmp_path / "d"
    write_camera(drive / "camera.yaml", CAMERA, "simulated")
    (drive / "drive.yaml").write_text("format: lanenet-drive/1\ncamera: camera.yaml\n")
    poses = dict(zip(labels.frame.tolist(), labels.poses, strict=True))

    def simulate(off_cm: float) -> None:
        xyh = np.array([poses.get(k, np.zeros(3)) + (off_cm, 0.0, 0.0) for k in range(N)])
        columns = {"frame": np.arange(N), **dict(zip(("x_cm", "y_cm", "heading_rad"), xyh.T, strict=True))}
        write_csv(drive / "truth.csv", columns | {name: np.ones(N) for name in POINT_NAMES})

    write_labels(tmp_path / "b.parquet", replace(labels, meta=replace(labels.meta, source="truth")))
    simulate(0.0)
    assert export_labels(tmp_path / "b.parquet", drive, "coco", tmp_path / "out").frames == 5
    simulate(2.0)
    with pytest.raises(LabelFormatError, match=r"poses lie up to 2 cm from .*d, which was simulated anew"):
        export_labels(tmp_path / "b.parquet", drive, "coco", tmp_path / "again")
    (drive / "truth.csv").write_text((drive / "truth.csv").read_text().rstrip().rpartition("\n")[0] + "\n")
    with pytest.raises(DriveFormatError, match=r"truth\.csv: expected a row for each frame"):
        export_labels(tmp_path / "b.parquet", drive, "coco", tmp_path / "again")


def test_the_command_knows_every_format() -> None:
    assert [str(name) for name in FormatName] == list(EXPORTS)
