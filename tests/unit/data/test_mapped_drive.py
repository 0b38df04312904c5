"""A straight road on a map, and the drive that it was made of."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import lanenet
from datagen.labels.label_map import label_map
from datagen.settings import MapSettings
from datagen.tracks.visit import read_visit
from lanenet.cli.app import app
from lanenet.config import dump_settings
from lanenet.data.drives import Drive
from lanenet.data.drives.content import image_marks
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.label_set import read_labels, write_labels
from lanenet.data.maps.folder import FORMAT, SETTINGS_NAME, DriveMap, MapMeta, write_map
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.line import LaneLine, Side
from lanenet.data.maps.mapped_drive import (
    AWAY,
    BETWEEN_LANES,
    DELETED,
    DOUBTFUL,
    NO_LINE,
    NOT_TO_LABEL,
    OUTSIDE,
    label_frame,
    label_frames,
    labelled_points,
    lines_at,
    open_mapped_drive,
    points_in_window,
    read_map_frames,
)
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError, MapFormatError
from lanenet.evaluation.sources import open_tests
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera, Mounting
from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.road import PerceptionSettings, RangeSettings
from lanenet.viewers.mapped import MapToSee

N = 30
K = np.array([[40.0, 0.0, 31.5], [0.0, 40.0, 23.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("fisheye", 64, 48, K, np.zeros(4), Mounting(15.0, 0.4), 20.0)
HIDDEN = PerceptionSettings(range=RangeSettings(bottom_rows=4))
#: Frames of the map; the drive has 0 to 29, of which 12 to 15 were not mapped.
MAPPED = np.concatenate([np.arange(12), np.arange(16, N)])


def straight_line(side: Side, y_cm: float) -> LaneLine:
    knots = np.concatenate([np.full(3, -100.0), np.linspace(-100.0, 400.0, 11), np.full(3, 400.0)])
    # At the means of three knots a cubic spline's control points lie on the straight line itself.
    s = np.array([knots[i + 1 : i + 4].mean() for i in range(13)])
    supported = np.array([[-100.0, 400.0 if side == "left" else 60.0]])
    return LaneLine(side, knots, np.column_stack([s, np.full(13, y_cm)]), supported, 0.1)


def doubted(frame: int, point: slice | int = slice(None)) -> LabelErrors:
    """Errors by which one label of a frame is withheld, or several."""
    wrong = np.zeros((len(MAPPED), 6), dtype=bool)
    wrong[frame, point] = True
    return LabelErrors.withholding(wrong)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The car drives along +x, 2 cm to the left of the middle of the lane."""
    rng = np.random.default_rng(0)
    with DriveWriter(tmp_path / "drive", lane_width_cm=40.0) as writer:
        for k in range(N):
            writer.add(rng.integers(0, 255, (48, 64, 3)).astype(np.uint8), 0.05 * k, speed_cm_s=20.0)
    n = len(MAPPED)
    s_cm = 1.0 * MAPPED
    match = np.full(n, 0.6)
    match[[0, 12]] = np.nan
    lines = [straight_line("left", 18.0), straight_line("right", -22.0)]
    drive_map = DriveMap(
        meta=MapMeta(
            format=FORMAT,
            drive=str(tmp_path / "drive"),
            lane_width_cm=40.0,
            mapped_lane_cm=40.1,
            tape_cm=2.3,
            scale_from="camera",
            laps=0,
        ),
        camera=CAMERA,
        frames=MAPPED,
        t_s=0.05 * MAPPED,
        poses=np.column_stack([s_cm, np.zeros(n), np.zeros(n)]),
        lap=np.zeros(n, np.int64),
        segment=np.repeat([0, 1], [12, n - 12]),
        s_cm=s_cm,
        match=match,
        lines={0: lines, 1: lines},
        tilt_rad=np.zeros((n, 2)),
        held_out=np.zeros(n, dtype=bool),
        errors=doubted(5),
    )
    out = tmp_path / "map"
    out.mkdir()
    write_map(out, drive_map, {"frame": np.arange(2)}, {}, "given")
    (out / SETTINGS_NAME).write_text(dump_settings(MapSettings(perception=HIDDEN)))
    return out


def test_the_map_gives_labels_and_keeps_the_frames_without(folder):
    frames = read_map_frames(folder)
    assert (frames.reference, frames.lane_width_cm, frames.marking_cm) == ("map", 40.1, 2.3)
    # The rows in which the car sees itself stay hidden.
    assert frames.perception == HIDDEN and frames.camera.hash == CAMERA.hash
    np.testing.assert_array_equal(frames.frames, MAPPED)
    assert np.isnan(frames.points_cm[5]).all()
    others = np.delete(frames.points_cm, 5, axis=0)
    np.testing.assert_allclose(others[:, :3], -18.0, atol=1e-6)
    # The right line is supported up to s = 60 cm: 30 cm ahead of the front axle only at first.
    np.testing.assert_allclose(others[:, 3], 22.0, atol=1e-6)
    seen_far = np.isfinite(np.delete(frames.points_cm, 5, axis=0)[:, 5])
    assert seen_far[:5].all() and not seen_far[-10:].any()


def test_points_that_a_found_camera_leaves_open_are_not_labelled(folder):
    mapped = open_mapped_drive(folder)
    slanted = [
        replace(line, coefficients_cm=line.coefficients_cm + np.outer(line.coefficients_cm[:, 0], [0.0, 1.3]))
        for line in mapped.drive_map.lines[0]
    ]
    drive_map = replace(mapped.drive_map, lines={0: slanted, 1: slanted})
    # 1.3 cm across for one along: with 0.04 lane widths, 1.6 cm, the sigma along may be 1.2 cm.
    for sigma_cm, labelled in ((0.0, True), (1.1, True), (1.4, False)):
        drive_map = replace(drive_map, meta=drive_map.meta.model_copy(update={"ahead_sigma_cm": sigma_cm}))
        assert np.isfinite(lines_at(drive_map, 3).points_cm[:3]).all() == labelled
        # A complete map would not label them either.
        window = BirdseyeWindow(left_cm=-150.0, columns=400)
        assert points_in_window(drive_map, 3, window)[:3].all() == labelled


def with_marks(folder: Path) -> Drive:
    """Write the map again as it is made today: it knows its images."""
    mapped = open_mapped_drive(folder)
    marks = tuple(image_marks(mapped.drive.subset(mapped.rows)))
    write_map(folder, replace(mapped.drive_map, marks=marks), {"frame": np.arange(2)}, {}, "given")
    return mapped.drive


def record_anew(drive: Drive, times_s: float = 0.05) -> None:
    """Record other images into the drive's folder, under the names that it had."""
    rng = np.random.default_rng(7)
    for path in drive.images.paths:
        image = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
        path.write_bytes(cv2.imencode(".jpg", image)[1].tobytes())
    table = drive.path / "frames.csv"
    rows = [line.split(",") for line in table.read_text().splitlines()]
    for row in rows[1:]:
        row[rows[0].index("t_s")] = f"{times_s * int(row[0]):.4f}"
    table.write_text("".join(f"{','.join(row)}\n" for row in rows))


def test_a_drive_that_was_recorded_anew_is_refused_by_every_reader_of_its_map(folder, tmp_path):
    record_anew(with_marks(folder))
    said = (
        rf"of {len(MAPPED)} frames of .*map the images of {len(MAPPED)} are not those .* lanenet map .*drive "
    )
    for read in (
        lambda: open_mapped_drive(folder),
        lambda: label_map(folder, tmp_path / "l.parquet"),
        lambda: read_map_frames(folder),
        lambda: MapToSee(folder),
        lambda: read_visit(folder),
    ):
        with pytest.raises(DriveFormatError, match=said):
            read()
    assert not (tmp_path / "l.parquet").exists()


def test_detect_says_that_a_map_is_of_an_earlier_recording(folder, tmp_path):
    drive = with_marks(folder)
    words = ["--detector", "hough", "--out", str(tmp_path / "a.csv")]

    def run(*source: object) -> Any:
        return CliRunner().invoke(app, ["detect", *map(str, source), *words], env={"COLUMNS": "2000"})

    assert run(folder).exit_code == 0 and "anew" not in run(drive.path, "--camera", folder).stderr
    record_anew(drive)
    refused = run(folder)
    assert refused.exit_code == 1
    assert "recorded anew" in refused.stderr and f"give {drive.path} with --camera {folder}" in refused.stderr
    found = run(drive.path, "--camera", folder)
    assert found.exit_code == 0 and "its camera is used all the same" in found.stderr


def test_one_other_image_is_never_labelled(folder, tmp_path):
    """The sample may miss it where sizes agree; labelling reads all."""
    drive = with_marks(folder)
    path = drive.images.paths[MAPPED[5]]
    path.write_bytes(path.read_bytes() + b"x")
    with pytest.raises(DriveFormatError, match=r"images of 1 are not .*first: frame 5\)"):
        label_map(folder, tmp_path / "l.parquet")
    # A frame that was not mapped may be another one.
    path.write_bytes(path.read_bytes()[:-1])
    drive.images.paths[13].write_bytes(b"x")
    label_map(folder, tmp_path / "l.parquet")


def test_the_same_images_at_other_times_are_refused(folder):
    drive = with_marks(folder)
    images = [path.read_bytes() for path in drive.images.paths]
    record_anew(drive, 0.06)
    for path, image in zip(drive.images.paths, images, strict=True):
        path.write_bytes(image)
    with pytest.raises(DriveFormatError, match="the times of 25 are not those"):
        open_mapped_drive(folder)


def test_a_moved_drive_is_the_same(folder, tmp_path):
    drive = with_marks(folder)
    shutil.copytree(drive.path, tmp_path / "moved", copy_function=shutil.copyfile)
    shutil.rmtree(drive.path)
    assert len(open_mapped_drive(folder, tmp_path / "moved").rows) == len(MAPPED)


def test_a_map_of_an_earlier_version_is_used_with_a_warning(folder, caplog):
    drive = open_mapped_drive(folder).drive
    assert "is a map of an earlier version, which does not know the images" in caplog.text
    caplog.clear()
    record_anew(drive)
    assert len(open_mapped_drive(folder).rows) == len(MAPPED) and not caplog.text  # once is enough
    # What such a map knows of its drive is its times.
    record_anew(drive, 0.06)
    with pytest.raises(DriveFormatError, match="the times of 25 are not those"):
        open_mapped_drive(folder)


def test_a_damaged_mark_is_refused(folder):
    with_marks(folder)
    table = folder / "poses.csv"
    table.write_text(table.read_text().replace("-", "+"))
    with pytest.raises(MapFormatError):
        open_mapped_drive(folder)


def test_frames_after_an_unmapped_stretch_start_afresh(folder):
    frames = read_map_frames(folder)
    assert list(np.flatnonzero(frames.starts)) == [0, 12]
    drive = open_mapped_drive(folder).drive
    np.testing.assert_array_equal(frames.image(12), drive.image(16))
    # Detectors answer in other processes.
    sent = pickle.loads(pickle.dumps(frames))
    np.testing.assert_array_equal(sent.image(12), drive.image(16))


def test_labels_are_those_of_the_label_set(folder, tmp_path):
    label_map(folder, tmp_path / "l.parquet")
    labels, frames = read_labels(tmp_path / "l.parquet"), read_map_frames(folder)
    # As measured, 40.0 cm were given: the camera sets the scale of this map.
    assert labels.meta.lane_width_cm == frames.lane_width_cm == 40.1
    rows = np.searchsorted(frames.frames, labels.frame)
    np.testing.assert_array_equal(frames.points_cm[rows], labels.points_cm)
    left_out = np.delete(frames.points_cm, rows, axis=0)
    assert len(left_out) == 1 and np.isnan(left_out).all()


def test_python_labels_as_the_command_does(folder, tmp_path):
    report = lanenet.label(folder, str(tmp_path / "python.parquet"))
    result = CliRunner().invoke(app, ["label", str(folder), "--out", str(tmp_path / "command.parquet")])
    assert result.exit_code == 0 and report.lines[0] in result.stdout
    assert json.loads((tmp_path / "python.json").read_text()) == report.figures
    python, command = (tmp_path / f"{name}.parquet" for name in ("python", "command"))
    assert python.read_bytes() == command.read_bytes()
    with pytest.raises(ConfigError, match=r"\.parquet"):
        lanenet.label(folder, tmp_path / "labels.csv")
    with pytest.raises(ConfigError, match="is a file of"):
        lanenet.label(folder, next(folder.glob("*.parquet")))


def test_a_test_part_is_opened_with_its_own_frames_only(folder, tmp_path):
    label_map(folder, tmp_path / "whole.parquet", colour_weight=0.5)
    part = tmp_path / "part.parquet"
    write_labels(part, read_labels(tmp_path / "whole.parquet").subset(slice(18, None)))
    (opened,) = open_tests([part], [folder])
    assert opened.path == folder and opened.frames is not None
    labels = read_labels(part)
    np.testing.assert_array_equal(opened.frames.frames, labels.frame)
    np.testing.assert_array_equal(opened.frames.points_cm, labels.points_cm)
    # The model knows how its own edges are found; the others leave out the same rows, and see gray.
    assert opened.frames.perception == open_mapped_drive(folder).perception
    assert labels.meta.perception == opened.frames.perception.with_colours(0.5)
    (without,) = open_tests([part], [tmp_path / "gone"])
    assert without.path == part and without.frames is None


def test_why_a_frame_gets_no_labels(folder):
    mapped = open_mapped_drive(folder)
    window = BirdseyeWindow()
    assert label_frame(mapped, 5, window) == DOUBTFUL
    # The first one matches no map yet.
    assert not isinstance(label_frame(mapped, 0, window), str)
    dashed = [replace(line, unpainted=0.4) for line in mapped.drive_map.lines[0][:1]]
    on_dashes = replace(
        mapped.drive_map,
        poses=mapped.drive_map.poses + [0.0, 17.0, 0.0],
        lines={0: dashed + mapped.drive_map.lines[0][1:], 1: mapped.drive_map.lines[1]},
    )
    assert label_frame(replace(mapped, drive_map=on_dashes), 6, window) == BETWEEN_LANES
    # Behind a solid line there is no lane: the second segment.
    assert not isinstance(label_frame(replace(mapped, drive_map=on_dashes), 20, window), str)
    beside = replace(mapped.drive_map, poses=mapped.drive_map.poses + [0.0, 35.0, 0.0])
    assert label_frame(replace(mapped, drive_map=beside), 6, window) == AWAY
    assert label_frame(mapped, 3, BirdseyeWindow(left_cm=100.0)) == "no line in the window"
    deleted = replace(mapped.drive, deleted=np.arange(N) == 16)
    # Frame 16 of the drive is the 12th of the map.
    assert label_frame(replace(mapped, drive=deleted), 12, window) == DELETED
    assert not isinstance(label_frame(replace(mapped, drive=deleted), 13, window), str)


def test_lines_beside_the_window_count_against_a_map_only_where_it_is_doubted(folder):
    mapped, window = open_mapped_drive(folder), BirdseyeWindow(left_cm=100.0)
    assert label_frames(mapped, window).reasons[3] == OUTSIDE
    assert OUTSIDE in NOT_TO_LABEL
    assert label_frames(mapped, window).reasons[5] == NO_LINE


def test_the_rows_that_lie_in_a_contradicted_section_get_no_labels(folder):
    mapped = open_mapped_drive(folder)
    lines = mapped.drive_map.lines
    # The front axle of the 6th frame is at 26 cm.
    wrong = [replace(lines[0][0], contradicted_cm=np.array([[35.0, 50.0]])), lines[0][1]]
    withheld = replace(mapped, drive_map=replace(mapped.drive_map, lines={**lines, 0: wrong}))
    found = label_frame(withheld, 6, BirdseyeWindow())
    assert not isinstance(found, str)
    assert np.isfinite(found[1]).tolist()[:3] == [True, False, True]
    # A complete map would have labelled it.
    assert points_in_window(withheld.drive_map, 6, BirdseyeWindow())[:3].all()


@pytest.mark.parametrize("point", range(6))
def test_a_label_that_is_doubted_is_masked_with_its_piece_of_the_line(folder, point):
    mapped, window = open_mapped_drive(folder), BirdseyeWindow()
    whole = label_frame(mapped, 0, window)
    doubting = replace(mapped, drive_map=replace(mapped.drive_map, errors=doubted(0, point)))
    masked = label_frame(doubting, 0, window)
    assert not isinstance(whole, str) and not isinstance(masked, str)
    others = np.arange(6) != point
    assert np.isfinite(whole[1]).all() and np.isnan(masked[1][point])
    np.testing.assert_array_equal(masked[1][others], whole[1][others])
    # The line goes up to half-way to the next labels, or a shifted view would get labels of it.
    lines, before = ((frame.left_cm, frame.right_cm) for frame in (masked[0], whole[0]))
    own, row_cm = point // 3, ROWS_CM[point % 3]
    np.testing.assert_array_equal(lines[1 - own], before[1 - own])
    y_cm = before[own][:, 1]
    nearest = np.abs(y_cm[:, None] - np.array(ROWS_CM)).min(axis=1) == np.abs(y_cm - row_cm)
    np.testing.assert_array_equal(
        np.isnan(lines[own]).all(axis=1), nearest | np.isnan(before[own]).all(axis=1)
    )


def test_nothing_is_left_where_the_line_is_doubted_and_the_other_lies_beside_the_window(folder):
    mapped, far = open_mapped_drive(folder), BirdseyeWindow(left_cm=-48.0, columns=64)
    doubting = replace(mapped, drive_map=replace(mapped.drive_map, errors=doubted(6, slice(3))))
    assert not isinstance(label_frame(mapped, 6, far), str)
    assert label_frame(doubting, 6, far) == DOUBTFUL


def test_points_that_the_map_lacks_are_missed_and_those_beside_the_window_are_not(folder):
    mapped = open_mapped_drive(folder)
    drive_map, n = mapped.drive_map, len(MAPPED)
    labels = read_map_frames(folder).points_cm

    def shares(window: BirdseyeWindow, drive_map: DriveMap = drive_map) -> dict[str, float]:
        in_window = np.array([points_in_window(drive_map, k, window) for k in range(n)])
        return labelled_points(window.labelled(labels), in_window)

    # One frame of the map has no labels at all, and the right line ends while the car drives on.
    whole = BirdseyeWindow()
    assert shares(whole)["left"] == pytest.approx((n - 1) / n)
    assert shares(whole)["right"] == pytest.approx(np.isfinite(labels[:, 3:]).mean())
    assert 0.5 < shares(whole)["right"] < 0.9
    # Where the map ends the right line is expected beside the left one, 40 cm away: outside this window.
    assert shares(BirdseyeWindow(columns=90)) == {"left": pytest.approx((n - 1) / n)}
    points = np.array([points_in_window(drive_map, k, BirdseyeWindow(columns=90)) for k in range(n)])
    np.testing.assert_array_equal(points, np.tile([True] * 3 + [False] * 3, (n, 1)))
    # Where neither line is known, all points are missed.
    gone = [replace(line, supported_cm=np.empty((0, 2))) for line in drive_map.lines[0]]
    nothing = replace(drive_map, lines={0: gone, 1: gone})
    assert points_in_window(nothing, 6, whole).all()
    assert labelled_points(np.zeros((6, 6)), np.ones((6, 6), dtype=bool), not_mapped=2) == {
        "left": 0.75,
        "right": 0.75,
    }


def test_a_drive_that_does_not_fit_is_refused(folder, tmp_path):
    with pytest.raises(MapFormatError, match="is not a map"):
        read_map_frames(tmp_path / "drive")
    with DriveWriter(tmp_path / "short") as writer:
        for k in range(10):
            writer.add(np.zeros((48, 64, 3), np.uint8), 0.05 * k)
    with pytest.raises(
        DriveFormatError, match=r"short: frame 10 of .*map is not in it; .*: lanenet map .*short "
    ):
        read_map_frames(folder, drive_path=tmp_path / "short")
    with DriveWriter(tmp_path / "large") as writer:
        writer.add(np.zeros((96, 128, 3), np.uint8), 0.0)
    with pytest.raises(CalibrationError, match=r"64x48 px.*128x96"):
        read_map_frames(folder, drive_path=tmp_path / "large")
    shutil.rmtree(tmp_path / "drive")
    with pytest.raises(DriveFormatError, match=r"drive of .*map is not there"):
        read_map_frames(folder)
