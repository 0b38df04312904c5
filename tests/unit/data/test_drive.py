from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from drives import CAMERA, edit, frame_image, write_drive
from made_up_drive import made_up_drive

from lanenet.data.drives import Drive, open_drive, read_truth
from lanenet.data.drives.folder import TRUTH_NAMES, DriveWriter
from lanenet.errors import ConfigError, DriveFormatError, LanenetError
from lanenet.geometry.lane import POINT_NAMES


def test_a_written_drive_reads_back(tmp_path: Path) -> None:
    drive = open_drive(write_drive(tmp_path / "lap"))
    assert (drive.name, len(drive), drive.width, drive.height) == ("lap", 5, 64, 48)
    assert drive.times_trusted
    assert drive.problems == ()
    assert drive.frames.tolist() == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(5), atol=1e-9)
    assert drive.commands.speed_cm_s is not None
    assert drive.commands.steering_rad is not None
    np.testing.assert_allclose(drive.commands.steering_rad, 0.01 * np.arange(5))
    assert drive.commands.angle is None
    assert drive.lane_width_cm == 40.0
    assert drive.notes == "a test"
    assert drive.camera is not None
    assert drive.camera.hash == CAMERA.hash
    assert not drive.deleted.any()
    assert not drive.breaks.any()
    for k in (0, 4, 2):
        assert np.abs(drive.image(k).astype(int) - frame_image(k).astype(int)).mean() < 3.0


def test_a_folder_without_drive_yaml_is_a_drive(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "lap")
    (path / "drive.yaml").unlink()
    drive = open_drive(path)
    assert drive.camera is None
    assert drive.lane_width_cm is None


def test_a_corrupt_image_is_named_by_file_and_frame(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "lap")
    image = path / "images" / "000002.jpg"
    whole = image.read_bytes()
    drive = open_drive(path)
    for broken in (whole[: len(whole) // 2], b"not a picture", b""):
        image.write_bytes(broken)
        with pytest.raises(DriveFormatError, match=r"frame 2: .*000002\.jpg"):
            drive.image(2)
    assert drive.image(3).shape == (48, 64, 3)


def test_a_cut_off_png_is_refused(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "lap")
    edit(path / "frames.csv", "images/000001.jpg", "images/000001.png")
    cv2.imwrite(str(path / "images" / "000001.png"), frame_image(1))
    drive = open_drive(path)
    np.testing.assert_array_equal(drive.image(1), frame_image(1))
    data = (path / "images" / "000001.png").read_bytes()
    (path / "images" / "000001.png").write_bytes(data[: len(data) - 40])
    with pytest.raises(DriveFormatError, match=r"frame 1: .*cut off"):
        drive.image(1)


def test_a_missing_image_is_a_problem_and_an_error(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "lap")
    (path / "images" / "000003.jpg").unlink()
    drive = open_drive(path)
    assert len(drive.problems) == 1
    assert "1 of 5 images are missing (first: frame 3, images/000003.jpg)" in drive.problems[0]
    with pytest.raises(DriveFormatError, match=r"frame 3: .*000003\.jpg: no such file"):
        drive.image(3)


def test_the_size_is_that_of_the_first_readable_image(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "lap")
    (path / "images" / "000000.jpg").write_bytes(b"\xff\xd8 nothing")
    cv2.imwrite(str(path / "images" / "000003.jpg"), frame_image(3, 32, 48))
    drive = open_drive(path)
    assert (drive.width, drive.height) == (64, 48)
    with pytest.raises(DriveFormatError, match=r"frame 3 .*32x48 px, expected 64x48"):
        drive.image(3)


def breaks_of(drive: Drive) -> list[int]:
    return np.flatnonzero(drive.breaks).tolist()


def test_pauses_are_breaks_and_short_gaps_are_not(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "lap", 8)
    lines = (path / "frames.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    for k in range(4, 8):
        rows[k][2] = str(float(rows[k][2]) + 2.5)
    for k in range(6, 8):
        rows[k][0], rows[k][2] = str(int(rows[k][0]) + 3), str(float(rows[k][2]) + 1.5)
    (path / "frames.csv").write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n")
    drive = open_drive(path)
    assert breaks_of(drive) == [4]

    part = drive.subset(slice(3, None))
    assert part.frames.tolist() == [3, 4, 5, 9, 10]
    assert breaks_of(part) == [1]
    np.testing.assert_array_equal(part.image(3), drive.image(6))
    assert part.commands.speed_cm_s is not None
    assert len(part.commands.speed_cm_s) == len(part) == 5

    # A break survives the loss of its own frame, and a left-out frame makes one.
    keep = np.ones(8, dtype=bool)
    keep[[0, 4]] = False
    assert breaks_of(drive.subset(keep)) == [3]
    keep[2] = False
    masked = drive.subset(keep)
    assert masked.frames.tolist() == [1, 3, 5, 9, 10]
    assert breaks_of(masked) == [1, 2]

    thinned = drive.subset(slice(None, None, 2))
    assert thinned.frames.tolist() == [0, 2, 4, 9]
    assert breaks_of(thinned) == [2]
    with pytest.raises(DriveFormatError, match="no frames"):
        drive.subset(slice(0, 0))


def test_frames_are_chosen_by_their_numbers_both_ends_included() -> None:
    drive = made_up_drive(20, [7], first_frame=100)
    part = drive.numbered(105, 109)
    assert part.frames.tolist() == [105, 106, 107, 108, 109] and breaks_of(part) == [2]
    assert len(drive.numbered(0, 10_000)) == 20
    for first, last in ((0, 99), (120, 130)):
        with pytest.raises(DriveFormatError, match="it has 100 to 119"):
            drive.numbered(first, last)


def test_a_drive_that_numbers_every_third_frame_has_no_gaps(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "lap", 5)
    lines = (path / "frames.csv").read_text().splitlines()
    numbered = [f"{3 * k},{line.partition(',')[2]}" for k, line in enumerate(lines[1:])]
    (path / "frames.csv").write_text("\n".join([lines[0], *numbered]))
    assert open_drive(path).frames.tolist() == [0, 3, 6, 9, 12]
    assert not open_drive(path).breaks.any()


def truth_row(k: int) -> dict[str, float]:
    row = {name: float(10 * k + j) for j, name in enumerate(TRUTH_NAMES)}
    return {**row, "right_30_cm": float("nan")}


def test_truth_reads_back_and_keeps_what_is_unknown(tmp_path: Path) -> None:
    with DriveWriter(tmp_path / "sim") as writer:
        for k in range(3):
            writer.add(frame_image(k), 0.1 * k, truth=truth_row(k))
        (writer.folder / "track.json").write_text("{}")
    assert (tmp_path / "sim" / "track.json").is_file()
    truth = read_truth(tmp_path / "sim")
    assert truth is not None
    assert list(truth) == ["frame", *TRUTH_NAMES]
    assert truth["x_cm"].tolist() == [0.0, 10.0, 20.0]
    assert truth["left_0_cm"].tolist() == [3.0, 13.0, 23.0]
    assert np.isnan(truth["right_30_cm"]).all()
    by_file = read_truth(tmp_path / "sim" / "truth.csv")
    assert by_file is not None
    assert by_file["y_cm"].tolist() == truth["y_cm"].tolist()


def test_a_drive_without_truth(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "lap")
    assert read_truth(path) is None
    assert read_truth(path / "truth.csv") is None


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    write_drive(tmp_path / "a")
    write_drive(tmp_path / "b")
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 8
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_an_error_while_writing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), DriveWriter(tmp_path / "lap") as writer:
        writer.add(frame_image(0), 0.0)
        raise ZeroDivisionError
    with pytest.raises(DriveFormatError, match="no frame was added"), DriveWriter(tmp_path / "lap"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_drive_replaces_a_drive_and_nothing_else(tmp_path: Path) -> None:
    for count in (5, 2):
        with DriveWriter(tmp_path / "lap") as writer:
            for k in range(count):
                writer.add(frame_image(k), 0.1 * k, truth=truth_row(k))
    assert len(open_drive(tmp_path / "lap")) == 2
    write_drive(tmp_path / "recorded", 5)
    with pytest.raises(LanenetError, match=r"without truth\.csv, so one that was recorded"):
        write_drive(tmp_path / "recorded", 2)
    assert len(open_drive(tmp_path / "recorded")) == 5
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_text("mine")
    with pytest.raises(LanenetError, match="not replaced"):
        write_drive(tmp_path / "photos")
    assert (tmp_path / "photos" / "cat.jpg").read_text() == "mine"


def test_the_writer_refuses_what_cannot_be_read(tmp_path: Path) -> None:
    with DriveWriter(tmp_path / "lap", CAMERA) as writer:
        with pytest.raises(DriveFormatError, match="frame 0: image of 32x48 px, but the camera has 64x48"):
            writer.add(frame_image(0, 32), 0.0, throttle=0.5)
        with pytest.raises(DriveFormatError, match="frame 0: unknown command 'speed'"):
            writer.add(frame_image(0), 0.0, speed=0.5)
        with pytest.raises(DriveFormatError, match="frame 0: throttle is nan"):
            writer.add(frame_image(0), 0.0, throttle=float("nan"))
        with pytest.raises(DriveFormatError, match=r"frame 0: truth: .*y_cm"):
            writer.add(frame_image(0), 0.0, truth={"x_cm": 0.0}, throttle=0.5)
        with pytest.raises(DriveFormatError, match="frame 0: heading_rad is inf"):
            writer.add(frame_image(0), 0.0, truth={**truth_row(0), "heading_rad": float("inf")}, throttle=0.5)
        writer.add(frame_image(0), 0.0, throttle=0.5)
        with pytest.raises(DriveFormatError, match="frame 1: commands: throttle"):
            writer.add(frame_image(1), 0.1)
        with pytest.raises(DriveFormatError, match="frame 1: t_s 0 after 0 has to increase"):
            writer.add(frame_image(1), 0.0, throttle=0.5)
        with pytest.raises(DriveFormatError, match="frame 1: image of 32x48 px"):
            writer.add(frame_image(1, 32), 0.1, throttle=0.5)
        with pytest.raises(
            DriveFormatError, match="frame 1: truth has to be given for every frame or for none"
        ):
            writer.add(frame_image(1), 0.1, truth=truth_row(1), throttle=0.5)
        writer.add(frame_image(1), 0.1, throttle=0.6)
    assert len(open_drive(tmp_path / "lap")) == 2
    with pytest.raises(ConfigError, match="lane_width_cm"):
        DriveWriter(tmp_path / "lap", lane_width_cm=0.0)
    assert set(POINT_NAMES) < set(TRUTH_NAMES)
