from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from drives import VIDEO_FRAMES as N
from drives import write_video

from lanenet.data.detections import DetectionTable
from lanenet.data.drives import open_drive
from lanenet.data.drives.video import VideoImages
from lanenet.errors import DriveFormatError
from lanenet.perception.estimate import LaneEstimate


def number_of(image: np.ndarray) -> int:
    return round((float(image.mean()) - 1.0) / 5.0)


def test_a_video_alone_is_a_drive(tmp_path: Path) -> None:
    drive = open_drive(write_video(tmp_path / "lap.avi"))
    assert (drive.name, len(drive), drive.width, drive.height) == ("lap", N, 64, 48)
    assert drive.times_trusted
    assert drive.problems == ()
    np.testing.assert_allclose(drive.t_s, np.arange(N) / 25.0)
    assert drive.commands.speed_cm_s is None
    assert not drive.breaks.any()


def test_frames_come_in_any_order(tmp_path: Path) -> None:
    drive = open_drive(write_video(tmp_path / "lap.avi"))
    order = [0, 1, 2, 2, 10, 39, 38, 0, 20, 21]
    assert [number_of(drive.image(i)) for i in order] == order


def test_another_process_opens_the_video_again(tmp_path: Path) -> None:
    drive = open_drive(write_video(tmp_path / "lap.avi"))
    sent = pickle.loads(pickle.dumps(drive))
    assert [number_of(sent.image(i)) for i in (7, 2)] == [7, 2]


def test_drawing_on_a_frame_does_not_change_it(tmp_path: Path) -> None:
    drive = open_drive(write_video(tmp_path / "lap.avi"))
    drive.image(3)[:] = 255
    assert number_of(drive.image(3)) == 3


def test_answers_beside_it_are_not_its_commands(tmp_path: Path) -> None:
    """Their steering is a detector's, not the driver's."""
    video = write_video(tmp_path / "lap.avi")
    answers = DetectionTable()
    answers.add(4, 0.5, LaneEstimate(*(np.full(6, np.nan),) * 2, steering_rad=0.1, confidence=0.5))
    answers.write(tmp_path / "lap.csv")
    drive = open_drive(video)
    assert len(drive) == N and drive.commands.steering_rad is None and not drive.problems


def test_the_csv_beside_it_gives_times_and_commands(tmp_path: Path) -> None:
    write_video(tmp_path / "lap.avi")
    (tmp_path / "lap.csv").write_text("frame,t_s,angle\n4,0.5,-0.1\n6,0.6,0.2\n38,2.7,0\n")
    drive = open_drive(tmp_path / "lap.avi")
    assert drive.frames.tolist() == [4, 6, 38]
    assert drive.t_s.tolist() == [0.5, 0.6, 2.7]
    assert drive.commands.angle is not None
    assert drive.commands.angle.tolist() == [-0.1, 0.2, 0.0]
    assert [number_of(drive.image(i)) for i in range(3)] == [4, 6, 38]
    assert np.flatnonzero(drive.breaks).tolist() == [2]
    part = drive.subset(np.array([False, True, True]))
    assert number_of(part.image(0)) == 6


def test_rows_beyond_the_video_are_left_out_and_said_so(tmp_path: Path) -> None:
    write_video(tmp_path / "lap.avi")
    rows = "".join(f"{k},{0.04 * k}\n" for k in range(N + 5))
    (tmp_path / "lap.csv").write_text("frame,t_s\n" + rows)
    drive = open_drive(tmp_path / "lap.avi")
    assert len(drive) == N
    assert f"5 rows lie beyond the video's {N} frames (first: frame {N})" in drive.problems[0]
    (tmp_path / "lap.csv").write_text("frame,t_s\n500,0.1\n")
    with pytest.raises(DriveFormatError, match=r"lap\.csv: no row belongs"):
        open_drive(tmp_path / "lap.avi")


def test_a_cut_off_video_tells_how_much_is_left(tmp_path: Path) -> None:
    whole = write_video(tmp_path / "whole.avi").read_bytes()
    path = tmp_path / "lap.avi"
    path.write_bytes(whole[: len(whole) // 2])
    drive = open_drive(path)
    assert 0 < len(drive) < N
    assert f"cut off: {len(drive)} of {N} frames" in drive.problems[0]
    assert number_of(drive.image(5)) == 5


@pytest.mark.parametrize("beyond", [N, N + 1, N + 500])
def test_a_frame_beyond_the_end_is_an_error_and_no_more(tmp_path: Path, beyond: int) -> None:
    images = VideoImages(write_video(tmp_path / "lap.avi"))
    assert number_of(images.read(N - 1)) == N - 1
    with pytest.raises(DriveFormatError, match=rf"lap\.avi: video frame {beyond} cannot be decoded"):
        images.read(beyond)
    assert number_of(images.read(2)) == 2


def test_a_real_video(shared_data: Path) -> None:
    drive = open_drive(shared_data / "road" / "udacity_test_video.mp4")
    assert (len(drive), drive.width, drive.height) == (38, 1280, 720)
    in_order = [drive.image(i) for i in range(12)]
    # A codec with key frames has to land on the right one after a jump.
    drive.image(37)
    np.testing.assert_array_equal(drive.image(7), in_order[7])
