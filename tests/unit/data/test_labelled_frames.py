from __future__ import annotations

import numpy as np
import pytest

from lanenet.data.drives.folder import TRUTH_NAMES, DriveWriter
from lanenet.data.maps.mapped_drive import read_truth_frames
from lanenet.errors import DriveFormatError, LabelFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera, Mounting

K = np.array([[30.0, 0.0, 31.5], [0.0, 30.0, 23.5], [0.0, 0.0, 1.0]])
CAMERA = Camera("fisheye", 64, 48, K, np.zeros(4), Mounting(15.0, 0.4), 20.0)
TIMES = [0.0, 0.05, 0.1, 5.0, 5.05]


def write_drive(path, camera=CAMERA, with_truth=True):
    with DriveWriter(path, camera=camera, lane_width_cm=40.0) as writer:
        for k, t_s in enumerate(TIMES):
            values = [0.0, 0.0, 0.0, -20.0 - k, -20.0, -60.0, 20.0, 20.0, float("nan")]
            truth = dict(zip(TRUTH_NAMES, values, strict=True)) if with_truth else None
            writer.add(np.full((48, 64, 3), 40 * k, np.uint8), t_s, truth, speed_cm_s=50.0)
    return path


def test_truth_becomes_labels(tmp_path):
    frames = read_truth_frames(write_drive(tmp_path / "d"))
    assert (frames.reference, frames.lane_width_cm, len(frames)) == ("truth", 40.0, 5)
    assert frames.camera.hash == CAMERA.hash
    np.testing.assert_array_equal(frames.frames, np.arange(5))
    # The first frame follows nothing, and a car is out of sight after five seconds.
    np.testing.assert_array_equal(frames.starts, [True, False, False, True, False])
    np.testing.assert_array_equal(frames.points_cm[:, 0], [-20.0, -21.0, -22.0, -23.0, -24.0])
    # -60 cm lies beside the window, and the truth has no right line at 30 cm.
    assert np.isnan(frames.points_cm[:, [2, 5]]).all() and np.isfinite(frames.points_cm[:, [1, 3, 4]]).all()
    wide = read_truth_frames(tmp_path / "d", BirdseyeWindow(left_cm=-80.0, columns=200))
    assert (wide.points_cm[:, 2] == -60.0).all()


def test_a_part_keeps_frames_labels_and_images_together(tmp_path):
    whole = read_truth_frames(write_drive(tmp_path / "d"))
    part = whole.numbered(2, 3)
    np.testing.assert_array_equal(part.frames, [2, 3])
    np.testing.assert_array_equal(part.starts, [False, True])
    for i in range(2):
        np.testing.assert_array_equal(part.points_cm[i], whole.points_cm[2 + i])
        np.testing.assert_array_equal(part.image(i), whole.image(2 + i))
    assert abs(int(part.image(1).mean()) - 120) < 5
    with pytest.raises(LabelFormatError, match="no frame from 7 to 9"):
        whole.numbered(7, 9)


def test_a_drive_without_truth_or_camera_is_refused(tmp_path):
    write_drive(tmp_path / "real", with_truth=False)
    with pytest.raises(DriveFormatError, match=r"real: comes without truth\.csv, expected.*map it"):
        read_truth_frames(tmp_path / "real")
    write_drive(tmp_path / "blind", camera=None)
    with pytest.raises(DriveFormatError, match="without a camera"):
        read_truth_frames(tmp_path / "blind")


def test_truth_of_other_frames_is_refused(tmp_path):
    file = write_drive(tmp_path / "d") / "truth.csv"
    file.write_text("\n".join(file.read_text().splitlines()[:-1]) + "\n")
    with pytest.raises(DriveFormatError, match=r"truth\.csv: 4 rows for 5 frames"):
        read_truth_frames(tmp_path / "d")
