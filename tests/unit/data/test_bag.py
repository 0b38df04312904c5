from __future__ import annotations

import contextlib
import pickle
import shutil
import sqlite3
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from bags import (
    EARLIER_NS,
    START_NS,
    STEP_NS,
    Messages,
    ackermann,
    compressed,
    message,
    raw_image,
    twist,
    usual,
    write_bag,
    write_foxglove,
)
from drives import CAMERA, edit, frame_image

from lanenet.data.camera_file import write_camera
from lanenet.data.drives import open_drive
from lanenet.errors import DriveFormatError, MissingExtraError


def at(k: int) -> int:
    return START_NS + k * STEP_NS


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("single", [False, True])
def test_a_bag_is_a_drive(tmp_path: Path, storage: str, single: bool) -> None:
    path = write_bag(tmp_path / "lap", usual(), storage)
    if single:
        path = path / f"lap.{storage.replace('sqlite', 'db')}"
    drive = open_drive(path)
    assert (drive.name, len(drive), drive.width, drive.height) == ("lap", 6, 64, 48)
    assert (drive.problems, drive.times_trusted, drive.breaks.any()) == ((), True, False)
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(6), atol=1e-9)
    # Metres to centimetres; positive left on both sides.
    assert drive.commands.speed_cm_s is not None
    np.testing.assert_allclose(drive.commands.speed_cm_s, 50.0 + 10.0 * np.arange(6), rtol=1e-6)
    assert drive.commands.steering_rad is not None
    np.testing.assert_allclose(drive.commands.steering_rad, 0.02 * np.arange(6), rtol=1e-6)
    assert drive.commands.yaw_rate_rad_s is None
    for k in (0, 1, 4, 3, 3, 5, 0):
        np.testing.assert_array_equal(drive.image(k), frame_image(k))
    again = pickle.loads(pickle.dumps(drive))
    np.testing.assert_array_equal(again.image(2), frame_image(2))


def test_a_distant_image_is_sought(tmp_path: Path) -> None:
    drive = open_drive(write_bag(tmp_path / "lap", usual(40), "mcap"))
    for k in (0, 39, 2, 30):
        np.testing.assert_array_equal(drive.image(k), frame_image(k))


def test_a_bag_in_several_files_is_one_drive(tmp_path: Path) -> None:
    topics = usual(20)
    late = {name: messages[10:] for name, messages in topics.items()}
    early = {name: messages[:10] for name, messages in topics.items()}
    path = write_bag(tmp_path / "late", late)
    # In the wrong order in the metadata, too.
    shutil.copy(write_bag(tmp_path / "early", early) / "early.db3", path)
    edit(path / "metadata.yaml", "  - late.db3\n", "  - late.db3\n  - early.db3\n")
    drive = open_drive(path)
    assert len(drive) == 20
    for k in (15, 0, 19):
        np.testing.assert_array_equal(drive.image(k), frame_image(k))
    assert drive.commands.speed_cm_s is not None
    np.testing.assert_allclose(drive.commands.speed_cm_s, 50.0 + 10.0 * np.arange(20), rtol=1e-6)


def test_a_bag_that_rosbag2_compressed_says_how_to_unpack_it(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "lap", usual())
    edit(path / "metadata.yaml", "compression_mode: ''", "compression_mode: message")
    with pytest.raises(
        DriveFormatError, match=r"mode message.* rosbags-convert --src \S+/lap --dst lap_unpacked"
    ):
        open_drive(path)


def test_a_bag_of_ros_1_says_how_to_convert_it(tmp_path: Path) -> None:
    (tmp_path / "lap.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(DriveFormatError, match=r"rosbags-convert --src \S+/lap\.bag --dst lap"):
        open_drive(tmp_path / "lap.bag")


def test_a_twist_gives_speed_and_yaw_rate(tmp_path: Path) -> None:
    topics = usual(4)
    topics["/cmd_vel"] = [(at(k) - EARLIER_NS, twist(0.3, 0.5)) for k in range(4)]
    both = open_drive(write_bag(tmp_path / "both", topics))
    assert (both.commands.steering_rad is not None, both.commands.yaw_rate_rad_s) == (True, None)
    del topics["/drive"]
    drive = open_drive(write_bag(tmp_path / "twist", topics))
    assert drive.commands.speed_cm_s is not None and drive.commands.yaw_rate_rad_s is not None
    np.testing.assert_allclose(drive.commands.speed_cm_s, 30.0)
    np.testing.assert_allclose(drive.commands.yaw_rate_rad_s, 0.5)
    assert drive.commands.steering_rad is None


def test_a_command_holds_for_two_seconds(tmp_path: Path) -> None:
    topics = usual(80)
    topics["/drive"] = [
        (at(10), ackermann(0.5, 0.1)),
        (at(12), ackermann(0.7, 0.1)),
        (at(70), ackermann(1, 0)),
    ]
    drive = open_drive(write_bag(tmp_path / "lap", topics))
    speed = drive.commands.speed_cm_s
    assert speed is not None
    assert np.flatnonzero(np.isnan(speed)).tolist() == [*range(10), *range(53, 70)]
    np.testing.assert_allclose(speed[[10, 11, 12, 52, 70]], [50.0, 50.0, 70.0, 70.0, 100.0], rtol=1e-6)
    assert (
        "27 of 80 frames have no command of /drive in the 2 s before them (first: frame 0)"
        in drive.problems[0]
    )


def test_stamps_go_before_times_of_recording_unless_of_another_clock(tmp_path: Path) -> None:
    topics = usual(4)
    name = "/camera/image_raw/compressed"
    topics[name] = [(at(k) + 7_000_000 * (k % 2), compressed(frame_image(k), at(k))) for k in range(4)]
    np.testing.assert_allclose(
        open_drive(write_bag(tmp_path / "a", topics)).t_s, 0.05 * np.arange(4), atol=1e-9
    )
    topics[name] = [(at(k), compressed(frame_image(k), 5 * 10**9 + k)) for k in range(4)]
    np.testing.assert_allclose(
        open_drive(write_bag(tmp_path / "b", topics)).t_s, 0.05 * np.arange(4), atol=1e-9
    )


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("back_s", [0.3, 5, 40 * 86400])
def test_a_clock_that_was_set_back_goes_on(tmp_path: Path, back_s: float, storage: str) -> None:
    back_ns = round(back_s * 10**9)
    topics = usual(12)
    name = "/camera/image_raw/compressed"
    topics[name][6:] = [(at(k), compressed(frame_image(k), at(k) - back_ns)) for k in range(6, 12)]
    # As a recorder writes: in the order of arrival, with the time of the clock.
    path = write_bag(tmp_path / "lap", topics, storage, lambda t_ns: t_ns - back_ns * (t_ns > at(5)))
    drive = open_drive(path)
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(12), atol=1e-6)
    assert "goes back or stands 1 times, first at frame 6" in drive.problems[0] and len(drive.problems) == 1
    assert drive.commands.speed_cm_s is not None
    np.testing.assert_allclose(drive.commands.speed_cm_s, 50.0 + 10.0 * np.arange(12), rtol=1e-6)
    for k in (11, 5, 6, 0):
        np.testing.assert_array_equal(drive.image(k), frame_image(k))


def test_messages_a_little_out_of_order_are_read_in_order(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "lap", {"/camera": usual(12)["/camera/image_raw/compressed"]})
    with contextlib.closing(sqlite3.connect(path / "lap.db3")) as database:
        # Rows 5 and 6 change places.
        database.executescript(
            "".join(f"UPDATE messages SET id = {b} WHERE id = {a};" for a, b in ((5, 99), (6, 5), (99, 6)))
        )
    drive = open_drive(path)
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(12), atol=1e-9)
    np.testing.assert_array_equal(drive.image(4), frame_image(4))


def test_an_image_that_is_not_later_is_left_out_and_said_so(tmp_path: Path) -> None:
    topics = usual(5)
    name = "/camera/image_raw/compressed"
    topics[name][2] = (at(2), compressed(frame_image(2), at(1)))
    drive = open_drive(write_bag(tmp_path / "lap", topics))
    assert drive.frames.tolist() == [0, 1, 3, 4]
    np.testing.assert_array_equal(drive.image(2), frame_image(3))
    assert "1 images are not later" in drive.problems[0]


def as_encoding(bgr: np.ndarray, encoding: str) -> np.ndarray:
    """The opposite of what is read; the Bayer patterns by their letters."""
    if encoding.startswith("bayer"):
        out = np.empty(bgr.shape[:2], np.uint8)
        for place, letter in enumerate(encoding[6:10]):
            out[place // 2 :: 2, place % 2 :: 2] = bgr[place // 2 :: 2, place % 2 :: 2, "bgr".index(letter)]
        return out
    codes = {
        **{"bgr8": None, "8UC3": None, "rgb8": cv2.COLOR_BGR2RGB, "bgra8": cv2.COLOR_BGR2BGRA},
        **{"rgba8": cv2.COLOR_BGR2RGBA, "mono8": cv2.COLOR_BGR2GRAY},
    }
    code = codes[encoding]
    return bgr if code is None else cv2.cvtColor(bgr, code)


ENCODINGS = [
    "bgr8",
    "8UC3",
    "rgb8",
    "bgra8",
    "rgba8",
    "mono8",
    *(f"bayer_{p}8" for p in ("rggb", "bggr", "gbrg", "grbg")),
]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_raw_images_of_each_encoding(tmp_path: Path, encoding: str) -> None:
    # Even colour survives a Bayer pattern; rows are padded.
    colour = np.full((8, 12, 3), (200, 200, 200) if encoding == "mono8" else (30, 90, 200), np.uint8)
    topics: Messages = {
        "/camera": [
            (at(k), raw_image(as_encoding(colour, encoding), encoding, at(k), padding=4)) for k in range(2)
        ]
    }
    drive = open_drive(write_bag(tmp_path / "lap", topics))
    np.testing.assert_array_equal(drive.image(1), colour)
    assert "no topic of commands, expected ackermann_msgs" in drive.problems[0]


@pytest.mark.parametrize("encoding", [f"{name}16" for name in ("mono", "rgb", "bgra", "bayer_rggb")])
@pytest.mark.parametrize("big", [False, True])
def test_of_16_bits_the_upper_ones_are_read(tmp_path: Path, encoding: str, big: bool) -> None:
    gray = encoding == "mono16"
    colour = np.full((8, 12, 3), (200, 200, 200) if gray else (30, 90, 200), np.uint8)
    eight = as_encoding(colour, encoding.replace("16", "8")).reshape(8, 12, -1)
    pixels = np.stack([eight, np.full_like(eight, 7)][:: 1 if big else -1], axis=-1)
    image = replace(raw_image(pixels, encoding, at(0)), is_bigendian=int(big))
    drive = open_drive(write_bag(tmp_path / "lap", {"/camera": [(at(0), image)]}))
    np.testing.assert_array_equal(drive.image(0), colour)


def test_an_encoding_in_capitals_is_the_same(tmp_path: Path) -> None:
    topics: Messages = {"/camera": [(at(0), raw_image(frame_image(2), "BGR8", at(0)))]}
    np.testing.assert_array_equal(open_drive(write_bag(tmp_path / "lap", topics)).image(0), frame_image(2))


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv")])
def test_raw_images_of_half_the_colours(tmp_path: Path, encoding: str, order: str) -> None:
    # BT.601: a red of y = 81, u = 90, v = 240.
    values = {"y": 81, "u": 90, "v": 240}
    pixels = np.tile(np.array([values[letter] for letter in order], np.uint8).reshape(1, 2, 2), (8, 6, 1))
    topics: Messages = {"/camera": [(at(0), raw_image(pixels, encoding, at(0)))]}
    drive = open_drive(write_bag(tmp_path / "lap", topics))
    np.testing.assert_allclose(drive.image(0)[0, 0], (0, 0, 255), atol=3)


def test_the_same_images_with_and_without_loss_are_one_topic(tmp_path: Path) -> None:
    topics = usual(4)
    topics["/camera/image_raw"] = [(at(k), raw_image(frame_image(9), "bgr8", at(k))) for k in range(4)]
    depth = np.zeros((48, 64, 2), np.uint8)
    topics["/depth"] = [(at(k), raw_image(depth, "16UC1", at(k))) for k in range(4)]
    topics["/depth/x"] = [(at(0), compressed(frame_image(1), 0, "16UC1; compressedDepth png"))]
    drive = open_drive(write_bag(tmp_path / "lap", topics))
    np.testing.assert_array_equal(drive.image(0), frame_image(9))


def test_two_cameras_ask_which(tmp_path: Path) -> None:
    topics = usual(4)
    topics["/rear"] = [(at(k), compressed(frame_image(k + 3), at(k))) for k in range(4)]
    path = write_bag(tmp_path / "lap", topics)
    with pytest.raises(
        DriveFormatError, match=r"2 topics of images: .*/rear \(sensor_msgs/msg/CompressedImage, 4 mes"
    ):
        open_drive(path)
    (path / "drive.yaml").write_text("format: lanenet-drive/1\ntopics: [/rear, /drive]\n")
    drive = open_drive(path)
    np.testing.assert_array_equal(drive.image(0), frame_image(3))
    assert drive.commands.speed_cm_s is not None
    (path / "drive.yaml").write_text("format: lanenet-drive/1\ntopics: [/rear, /drve]\n")
    with pytest.raises(DriveFormatError, match=r"key 'topics': no topic /drve; found .*/drive \(ackermann"):
        open_drive(path)


def test_two_topics_of_commands_ask_which(tmp_path: Path) -> None:
    topics = usual(4)
    topics["/planned"] = topics["/drive"]
    path = write_bag(tmp_path / "lap", topics, "mcap") / "lap.mcap"
    with pytest.raises(DriveFormatError, match=r"2 topics of commands: .*lap\.drive\.yaml"):
        open_drive(path)
    text = "format: lanenet-drive/1\ntopics: [/camera/image_raw/compressed, /planned]\nlane_width_cm: 40\n"
    (path.parent / "lap.drive.yaml").write_text(text + "camera: camera.yaml\n")
    write_camera(path.parent / "camera.yaml", CAMERA, "by hand")
    drive = open_drive(path)
    assert (drive.lane_width_cm, drive.camera is not None) == (40.0, True)


def test_a_bag_without_images_lists_its_topics(tmp_path: Path) -> None:
    topics = {"/drive": usual(3)["/drive"], "/name": [(at(0), message("std_msgs/msg/String", data="x"))]}
    with pytest.raises(
        DriveFormatError, match=r"no topic of images, .*found /drive .*/name \(std_msgs/msg/String, 1 mess"
    ):
        open_drive(write_bag(tmp_path / "lap", topics))


def test_an_unknown_encoding_is_named(tmp_path: Path) -> None:
    topics: Messages = {"/camera": [(at(0), raw_image(np.zeros((4, 4, 2), np.uint8), "32FC1", at(0)))]}
    with pytest.raises(
        DriveFormatError, match=r"image 0 of /camera: images in '32FC1', expected one of bgr8"
    ):
        open_drive(write_bag(tmp_path / "lap", topics))


def test_angles_in_degrees_are_left_out_and_said_so(tmp_path: Path) -> None:
    topics = usual(3)
    topics["/drive"] = [(at(k) - EARLIER_NS, ackermann(0.5, 12.0 * k)) for k in range(3)]
    drive = open_drive(write_bag(tmp_path / "lap", topics))
    assert drive.commands.steering_rad is not None
    assert np.isnan(drive.commands.steering_rad).tolist() == [False, True, True]
    assert "2 of 3 messages of /drive have steering_rad outside -1.5708 to 1.5708" in drive.problems[0]


def test_images_of_foxglove(tmp_path: Path) -> None:
    drive = open_drive(write_foxglove(tmp_path / "lap.mcap"))
    assert (drive.name, len(drive)) == ("lap", 6)
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(6), atol=1e-9)
    np.testing.assert_array_equal(drive.image(4), frame_image(4))


def test_a_recording_that_was_cut_off_says_how_to_mend_it(tmp_path: Path) -> None:
    whole = (write_bag(tmp_path / "lap", usual(), "mcap") / "lap.mcap").read_bytes()
    path = tmp_path / "half.mcap"
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DriveFormatError, match=r"half\.mcap: .*mcap recover"):
        open_drive(path)


def test_a_missing_package_is_named_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path / "lap", usual())
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(MissingExtraError, match=r"rosbags .*pip install 'lanenet\[bags\]'"):
        open_drive(path)


def test_a_link_out_of_the_bag_is_refused(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "lap", usual())
    shutil.move(path / "lap.db3", tmp_path / "elsewhere.db3")
    (path / "lap.db3").symlink_to(tmp_path / "elsewhere.db3")
    with pytest.raises(DriveFormatError, match="expected a file in"):
        open_drive(path)


def test_a_database_of_something_else_is_refused(tmp_path: Path) -> None:
    with contextlib.closing(sqlite3.connect(tmp_path / "lap.db3")) as database:
        database.execute("CREATE TABLE topics (id INTEGER)")
        database.execute("CREATE VIEW messages AS SELECT 1 AS topic_id")
        database.commit()
    with pytest.raises(DriveFormatError, match="expected the tables 'topics' and 'messages'"):
        open_drive(tmp_path / "lap.db3")
