"""Recordings as people have them: what is read of them, and what is said.

The kinds are those of public reports; docs/formats.md has the table of what is done.
"""

from __future__ import annotations

import contextlib
import json
import pickle
import shutil
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bags import START_NS, Messages, message, usual, write_bag
from commands import refused
from drives import edit, frame_image, record, write_drive, write_tub
from mcap.writer import Writer as McapWriter
from mp4 import Change, change_boxes, timed, turned
from PIL import Image
from typer.testing import CliRunner

from lanenet.calibration.chessboard import common_turn, read_picture
from lanenet.cli.app import app
from lanenet.data.drives import open_drive
from lanenet.data.drives.sources import open_source
from lanenet.data.exports.pictures import Pictures
from lanenet.errors import DriveFormatError

CASES = Path(__file__).resolve().parents[1] / "support/cases"
Make = Callable[[Path], Path]


@dataclass(frozen=True)
class Case:
    """A source and what is expected of it.

    Attributes:
        name: What people have.
        make: Makes it in a folder and returns its path.
        frames: Frame numbers that are read; none if it is refused.
        words: Words of the problems, or of the refusal.
    """

    name: str
    make: Make
    frames: list[int]
    words: tuple[str, ...] = ()

    def check(self, folder: Path) -> Any:
        if not self.frames:
            with pytest.raises(DriveFormatError) as caught:
                open_source(self.make(folder)).image(0)
            said = str(caught.value)
            assert "\n" not in said
        else:
            source = open_source(self.make(folder))
            assert source.frames.tolist() == self.frames
            for i in range(len(source)):
                assert source.image(i).ndim == 3
            said = "; ".join(source.problems)
            assert bool(said) == bool(self.words), said
        for word in self.words:
            assert word in said


def table(cases: list[Case]) -> Any:
    assert len({case.name for case in cases}) == len(cases)
    return pytest.mark.parametrize("case", cases, ids=lambda case: case.name)


def number(image: np.ndarray) -> int:
    """The number that :func:`frame_image` paints, below 13."""
    return round(float(image[..., 0].mean()) / 20)


# Tubs: the catalogs hold the drive, the manifest may be anything.


def tub_case(name: str) -> Make:
    """A tub of another project, with images of our own in the places of its own."""

    def make(folder: Path) -> Path:
        path = shutil.copytree(CASES / name, folder / "tub")
        (path / "images").mkdir()
        k = 0
        for catalog in sorted(path.glob("*.catalog")):
            for line in catalog.read_text().splitlines():
                for value in json.loads(line).values():
                    if str(value).endswith(".jpg"):
                        cv2.imwrite(str(path / "images" / value), frame_image(k))
                k += 1
        return path

    return make


def tub(
    edit: Callable[[Path], None] = lambda path: None,
    rows: list[Any] | None = None,
    deleted: list[int] | None = None,
    per_catalog: int = 4,
) -> Make:
    """A tub of eight frames in two catalogs, changed."""

    def make(folder: Path) -> Path:
        path = write_tub(folder / "tub", rows or [record(k) for k in range(8)], deleted, per_catalog)
        edit(path)
        return path

    return make


def stale(path: Path) -> None:
    text = (path / "manifest.json").read_text()
    (path / "manifest.json").write_text(text.replace(', "catalog_1.catalog"', ""))


def listed_as_text(path: Path) -> None:
    listing(paths=sorted(file.name for file in path.glob("*.catalog")))(path)


def listing(**changes: Any) -> Callable[[Path], None]:
    """Change the last line of a manifest."""

    def change(path: Path) -> None:
        *lines, last = (path / "manifest.json").read_text().splitlines()
        last = json.dumps(json.loads(last) | changes)
        (path / "manifest.json").write_text("\n".join([*lines, last]))

    return change


def with_mark(path: Path) -> None:
    for catalog in path.glob("*.catalog"):
        catalog.write_bytes(b"\xef\xbb\xbf" + catalog.read_bytes())


def in_windows(path: Path) -> None:
    text = (path / "manifest.json").read_text()
    (path / "manifest.json").write_text(text.replace("catalog_", "data\\\\catalog_"))
    (path / "data").mkdir()
    for catalog in path.glob("*.catalog"):
        catalog.rename(path / "data" / catalog.name)


def listed_before(before: str) -> Make:
    """A tub whose manifest names each catalog with a folder before it."""
    return tub(lambda path: edit(path / "manifest.json", '"catalog_', f'"{before}catalog_'))


def version_1(folder: Path) -> Path:
    for k in range(12):
        cv2.imwrite(str(folder / f"{k}_cam-image_array_.jpg"), frame_image(k))
        (folder / f"record_{k}.json").write_text("{}")
    return folder


def with_image(k: int, name: str, **more: Any) -> dict[str, Any]:
    return record(k, **{"cam/image_array": name}, **more)


def in_folders(folder: Path) -> Path:
    """Images in a folder for each session, with the same names in both."""
    names = [f"{'ab'[k // 2]}/{k % 2}.jpg" for k in range(4)]
    path = write_tub(folder / "tub", [])
    rows = [json.dumps(with_image(k, name)) for k, name in enumerate(names)]
    (path / "catalog_0.catalog").write_text("\n".join(rows))
    for k, name in enumerate(names):
        (path / "images" / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path / "images" / name), frame_image(k))
    return path


def renamed_in_rows(before: str) -> Make:
    """A tub whose rows name each image with a folder before it."""

    def edit(path: Path) -> None:
        for catalog in path.glob("*.catalog"):
            text = catalog.read_text().replace('array": "', f'array": "{before}')
            catalog.write_text(text)

    return tub(edit)


EIGHT = list(range(8))
DAY_MS = 86_400_000
TUBS = [
    Case(
        "a manifest that was cut",
        tub_case("tub_manifest_cut"),
        list(range(10)),
        ("line 5 is torn", "deleted"),
    ),
    Case("rows counted anew in each catalog", tub_case("tub_local_index"), list(range(10)), ("begins anew",)),
    Case(
        "two cameras",
        tub_case("tub_two_cameras"),
        [],
        ("cam/image_array_a, cam/image_array_b", "drive.yaml", "topics: [cam/image_array_a]"),
    ),
    Case("a manifest that lists half", tub(stale), EIGHT, ("does not list catalog_1.catalog",)),
    Case("no manifest", tub(lambda path: (path / "manifest.json").unlink()), EIGHT, ("not there",)),
    Case(
        "an empty manifest", tub(lambda path: (path / "manifest.json").write_bytes(b"")), EIGHT, ("is empty",)
    ),
    Case(
        "a zeroed manifest",
        tub(lambda path: (path / "manifest.json").write_bytes(bytes(300))),
        EIGHT,
        ("empty",),
    ),
    Case("a manifest of one line less", tub(lambda path: edit_lines(path, -1)), EIGHT, ("five lines",)),
    Case("a manifest without its first lines", tub(lambda path: edit_lines(path, 3)), EIGHT),
    *(
        Case(f"deleted frames as {value}", tub(listing(deleted_indexes=value)), EIGHT, words)
        for value, words in [
            (None, ("'deleted_indexes' is no list",)),
            ({"a": 1}, ("'deleted_indexes' is no list",)),
            (["1"], ()),
            ([1.0], ()),
        ]
    ),
    Case("catalogs listed as null", tub(listing(paths=None)), EIGHT, ("'paths' is no list",)),
    Case("catalogs with a byte order mark", tub(with_mark), EIGHT),
    Case(
        "a manifest with another name of the camera",
        tub(lambda path: edit(path / "manifest.json", '"cam/image_array"', '"cam/left"')),
        EIGHT,
    ),
    Case(
        "an index with a flipped bit",
        tub(rows=[record(k, _index=k + (2**20 if k == 2 else 0)) for k in range(8)]),
        [0, 1, 3, 4, 5, 6, 7],
        ("1 rows repeat",),
    ),
    Case(
        "two tubs in one catalog",
        tub(rows=[with_image(k % 4, f"{k}.jpg", _timestamp_ms=50 * k) for k in range(8)], per_catalog=8),
        EIGHT,
        ("begins anew, first after frame 3",),
    ),
    Case(
        "deleted frames by numbers that occur twice",
        tub(rows=[with_image(k % 4, f"{k}.jpg", _timestamp_ms=50 * k) for k in range(8)], deleted=[1]),
        EIGHT,
        ("begins anew", "which 1 frames were deleted cannot be told"),
    ),
    Case(
        "catalogs listed in the order of text",
        tub(listed_as_text, [record(k) for k in range(24)], per_catalog=2),
        list(range(24)),
    ),
    Case("a tub of Windows", tub(in_windows), EIGHT),
    Case("catalogs named as on the car", listed_before("/home/pi/mycar/data/tub_1/"), EIGHT),
    Case("catalogs named as in Windows", listed_before("C:\\\\mycar\\\\data\\\\"), EIGHT),
    Case("catalogs named from elsewhere", listed_before("../data/"), EIGHT),
    Case("images named with their folder", renamed_in_rows("images/"), EIGHT),
    Case("images named as on the car", renamed_in_rows("/home/pi/mycar/data/tub_1/images/"), EIGHT),
    Case("images named as in Windows", renamed_in_rows("C:\\\\mycar\\\\data\\\\images\\\\"), EIGHT),
    Case("images in folders", in_folders, [0, 1, 2, 3]),
    Case(
        "a clock set forward by 40 days",
        tub(rows=[record(k, _timestamp_ms=50 * k + (40 * DAY_MS if k > 3 else 0)) for k in range(8)]),
        EIGHT,
        ("the clock goes forward", "40.0 days at frame 4"),
    ),
    Case("a tub of version 1", version_1, [], ("version 1", "convert_to_tub_v2.py --tub=", "--output=")),
]


def edit_lines(path: Path, first: int) -> None:
    """Leave the lines of a manifest from one on; all but the last for -1."""
    lines = (path / "manifest.json").read_text().splitlines()
    kept = lines[:-1] if first < 0 else lines[first:]
    (path / "manifest.json").write_text("\n".join(kept) + "\n")


@table(TUBS)
def test_tubs(tmp_path: Path, case: Case) -> None:
    case.check(tmp_path)


@pytest.mark.parametrize("value", [["1"], [1.0]])
def test_deleted_frames_are_whole_numbers_however_written(tmp_path: Path, value: list[Any]) -> None:
    drive = open_drive(tub(listing(deleted_indexes=value))(tmp_path))
    assert np.flatnonzero(drive.deleted).tolist() == [1]


def test_the_order_of_a_tub_is_that_of_its_catalogs(tmp_path: Path) -> None:
    source = open_source(tub_case("tub_local_index")(tmp_path))
    assert [number(source.image(i)) for i in range(10)] == list(range(10))
    np.testing.assert_allclose(source.t_s, 0.05 * np.arange(10), atol=1e-9)
    source = open_source(in_folders(tmp_path / "folders"))
    assert [number(source.image(i)) for i in range(4)] == [0, 1, 2, 3]


def test_of_two_cameras_the_one_that_is_named_is_read(tmp_path: Path) -> None:
    path = tub_case("tub_two_cameras")(tmp_path)
    rear = np.zeros((48, 64, 3), np.uint8)
    for k in range(10):
        cv2.imwrite(str(path / "images" / f"{k}_cam_image_array_b_.jpg"), rear)
    for topic, mean in (("a", 20.0), ("b", 0.0)):
        (path / "drive.yaml").write_text(f"format: lanenet-drive/1\ntopics: [cam/image_array_{topic}]\n")
        assert open_drive(path).image(1)[..., 0].mean() == pytest.approx(mean, abs=2.0)
    (path / "drive.yaml").write_text("format: lanenet-drive/1\ntopics: [cam/other]\n")
    with pytest.raises(DriveFormatError, match=r"'topics': found cam/other, expected one of .*_a, .*_b"):
        open_drive(path)


@pytest.mark.parametrize("kind", ["tub", "folder"])
def test_a_clock_that_was_set_forward_is_no_break(tmp_path: Path, kind: str) -> None:
    ahead = 40 * DAY_MS
    if kind == "tub":
        rows = [record(k, _timestamp_ms=50 * k + (ahead if k > 3 else 0)) for k in range(8)]
        drive = open_drive(write_tub(tmp_path / "tub", rows))
    else:
        path = write_drive(tmp_path / "lap", 8)
        lines = (path / "frames.csv").read_text().splitlines()
        for k in range(4, 8):
            cells = lines[k + 1].split(",")
            cells[2] = str(float(cells[2]) + ahead / 1000)
            lines[k + 1] = ",".join(cells)
        (path / "frames.csv").write_text("\n".join(lines) + "\n")
        drive = open_drive(path)
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(8), atol=1e-6)
    assert not drive.breaks.any() and "40.0 days" in drive.problems[0]
    # A day later in another session is another day.
    rows = [
        record(k, _session_id=str(k > 3), _timestamp_ms=50 * k + (ahead if k > 3 else 0)) for k in range(8)
    ]
    assert np.flatnonzero(open_drive(write_tub(tmp_path / "two", rows)).breaks).tolist() == [4]


@pytest.mark.parametrize(
    "before", ["images\\", "/home/pi/lap/images/", "C:\\lap\\images\\", "../lap/images/", "images/../../a/"]
)
def test_a_table_names_its_images_as_on_another_computer(tmp_path: Path, before: str) -> None:
    path = write_drive(tmp_path / "lap", 3)
    text = (path / "frames.csv").read_text()
    (path / "frames.csv").write_text(text.replace("images/", before))
    drive = open_drive(path)
    assert not drive.problems and number(drive.image(2)) == 2
    for file in path.glob("images/*"):
        file.rename(path / file.name)
    assert number(open_drive(path).image(2)) == 2


@pytest.mark.parametrize("name", ["../secret.jpg", "images/../../secret.jpg", "/dev/zero", "..", "/"])
def test_no_name_leads_out_of_a_drive(tmp_path: Path, name: str) -> None:
    cv2.imwrite(str(tmp_path / "secret.jpg"), frame_image(1))
    path = write_drive(tmp_path / "lap", 3)
    edit(path / "frames.csv", "images/000001.jpg", name)
    drive = open_drive(path)
    assert f"1 of 3 images are missing (first: frame 1, {name})" in drive.problems[0]
    with pytest.raises(DriveFormatError, match="frame 1"):
        drive.image(1)
    path = write_tub(tmp_path / "tub", [record(0), with_image(1, "b.jpg"), record(2)])
    edit(path / "catalog_0.catalog", '"b.jpg"', f'"{name}"')
    edit(path / "manifest.json", '"catalog_0', f'"{name}", "catalog_0')
    drive = open_drive(path)
    assert drive.frames.tolist() == [0, 2]
    assert f"catalogs listed but not there: {name}" in drive.problems[0]


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_a_clock_that_was_set_back_goes_on(tmp_path: Path, kind: str) -> None:
    times = [0.05 * k - (1.0 if k > 4 else 0.0) for k in range(12)]
    if kind == "video":
        path = video()(tmp_path)
        rows = [f"{k},{t:.2f}" for k, t in enumerate(times)]
        (tmp_path / "clip.csv").write_text("\n".join(["frame,t_s", *rows]))
    else:
        path = write_drive(tmp_path / "lap", 12)
        head, *lines = [line.split(",") for line in (path / "frames.csv").read_text().splitlines()]
        lines = [[*line[:2], f"{t:.2f}", *line[3:]] for line, t in zip(lines, times, strict=True)]
        (path / "frames.csv").write_text("\n".join(map(",".join, [head, *lines])) + "\n")
    drive = open_drive(path)
    np.testing.assert_allclose(drive.t_s, 0.05 * np.arange(12), atol=1e-9)
    assert "the clock goes back or stands 1 times, first at frame 5" in "; ".join(drive.problems)


def test_an_unreadable_image_names_the_option_that_goes_on(tmp_path: Path) -> None:
    path = write_drive(tmp_path / "lap", 3)
    (path / "images" / "000002.jpg").write_bytes(b"")
    out = tmp_path / "lanes.csv"
    words = ["detect", str(path), "--detector", "hough", "--out", str(out)]
    line = refused(tmp_path, *words)
    assert "000002.jpg: the image file is empty" in line and "--skip-unreadable" in line
    assert CliRunner().invoke(app, [*words, "--skip-unreadable"]).exit_code == 0
    assert len(out.read_text().splitlines()) == 4


# Videos: a container may lack times, or have any.


def video(
    changes: dict[bytes, Change] | None = None, name: str = "clip.mp4", codec: str = "mp4v", frames: int = 12
) -> Make:
    """A video of 20 frames/s, changed in its boxes."""

    def make(folder: Path) -> Path:
        path = folder / name
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 20.0, (64, 48))
        assert writer.isOpened()
        for k in range(frames):
            writer.write(frame_image(k))
        writer.release()
        if changes:
            change_boxes(path, changes)
        return path

    return make


def raw_mjpeg(folder: Path) -> Path:
    path = folder / "clip.mjpeg"
    path.write_bytes(b"".join(cv2.imencode(".jpg", frame_image(k))[1].tobytes() for k in range(12)))
    return path


def holding(name: str, start: bytes, folder: str = "") -> Make:
    """A file that begins with these bytes; the folder of it is opened if it has a name."""

    def make(parent: Path) -> Path:
        (parent / folder).mkdir(exist_ok=True)
        (parent / folder / name).write_bytes(start + bytes(2000))
        return parent / folder if folder else parent / name

    return make


TWELVE = list(range(12))
SPS = b"\0\0\0\1\x67\x42\xc0\x1e"
CUT = b"\0\0\0\x18ftypisom\0\0\0\1isomavc1\0\0\1\0mdat"


def empty_video(folder: Path) -> Path:
    (folder / "clip.mp4").touch()
    return folder / "clip.mp4"


VIDEOS = [
    Case("a constant rate", video(), TWELVE),
    Case("a constant rate in another container", video(name="clip.mkv"), TWELVE),
    Case("a rate that varies", video(timed((6, 1), (6, 3))), TWELVE, ("rate varies, steps of 50 to 150 ms",)),
    Case("times that stand", video(timed((6, 0), (6, 1))), TWELVE, ("do not increase", "as its header says")),
    Case("nothing but JPEGs", raw_mjpeg, TWELVE, ("no times", "20 frames/s", "clip.csv")),
    Case("a phone held upright", video(turned(90)), TWELVE),
    Case(
        "H.264 of rpicam-vid", holding("clip.h264", SPS), [], ("raw", "ffmpeg -r RATE -i", "-c copy clip.mp4")
    ),
    Case(
        "H.264 with another name",
        holding("clip.mp4", SPS),
        [],
        ("raw", "ffmpeg -r RATE -i", "clip_timed.mp4"),
    ),
    Case("H.265 as a stream", holding("a.h265", b"\0\0\0\1\x40\1"), [], ("ffmpeg -r RATE", "-c copy a.mp4")),
    Case(
        "AV1",
        lambda folder: Path(shutil.copy(CASES / "video_av1/clip.mp4", folder)),
        [],
        ("AV1", "ffmpeg -i", "-c:v libx264 clip_h264.mp4"),
    ),
    Case(
        "a video that was cut off",
        holding("clip.mp4", CUT),
        [],
        ("untrunc WHOLE.mp4", "ffmpeg -i"),
    ),
    Case("an empty video", empty_video, [], ("is empty",)),
    Case("an archive as a video", holding("clip.mp4", b"PK\3\4"), [], ("is an archive: unzip",)),
    Case("a pointer of Git LFS", holding("clip.mp4", b"version https://git-lfs"), [], ("git lfs pull",)),
    Case("a stream of a server", holding("a.mp4", b"--boundary\r\n"), [], ("-f mpjpeg -i", "a.mjpeg")),
    Case("no video at all", holding("a.mp4", b"abc"), [], ("begins with b'abc", "ffmpeg -i")),
    Case("another container", holding("clip.ts", b"G"), [], ("ffmpeg -i", "clip.mp4")),
    Case("photos of an iPhone", holding("IMG_1.HEIC", b"\0\0\0\x18ftypheic", "photos"), [], ("IMG_1.jpg",)),
    Case("a bag of ROS 1 that is open", holding("a.bag.active", b"#ROSBAG"), [], ("rosbag reindex",)),
    Case("a packed bag", holding("a_0.db3.zstd", b"(\xb5/\xfd"), [], ("zstd -d", "-o a_0.db3")),
    Case("a packed recording", holding("a.mcap.gz", b"\x1f\x8b"), [], ("gunzip -k",)),
    Case("an archive", holding("tub.tar.gz", b"\x1f\x8b"), [], ("tar -xf",)),
]


@table(VIDEOS)
def test_videos_and_what_becomes_one(tmp_path: Path, case: Case) -> None:
    case.check(tmp_path)


def test_the_times_of_a_video_are_those_of_its_frames(tmp_path: Path) -> None:
    drive = open_drive(video(timed((20, 1), (20, 3)), frames=40)(tmp_path))
    np.testing.assert_allclose(np.diff(drive.t_s), [0.05] * 20 + [0.15] * 19, atol=1e-4)
    assert drive.times_trusted
    in_order = [drive.image(i) for i in range(40)]
    # OpenCV finds a frame by its number times the mean rate.
    for i in (39, 5, 30, 21, 19, 0, 38):
        np.testing.assert_array_equal(drive.image(i), in_order[i])
    sent = pickle.loads(pickle.dumps(drive))
    np.testing.assert_array_equal(sent.image(33), in_order[33])
    assert not open_drive(raw_mjpeg(tmp_path)).times_trusted
    assert not open_drive(video(timed((6, 0), (6, 1)), "stands.mp4")(tmp_path)).times_trusted


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_a_video_is_turned_as_it_says(tmp_path: Path, degrees: int) -> None:
    upright = open_drive(video()(tmp_path)).image(3)
    drive = open_drive(video(turned(degrees), "turned.mp4")(tmp_path))
    assert (drive.height, drive.width) == ((48, 64) if degrees % 180 == 0 else (64, 48))
    np.testing.assert_array_equal(drive.image(3), np.rot90(upright, -degrees // 90))


# Bags: metadata are written when the recording ends.


def bag(
    change: Callable[[Path], None] = lambda path: None, storage: str = "mcap", topics: Messages | None = None
) -> Make:
    def make(folder: Path) -> Path:
        path = write_bag(folder / "lap", topics or usual(), storage)
        change(path)
        return path

    return make


def split(metadata: Callable[[Path], None]) -> Make:
    """A bag in eleven files, one for each image, numbered as rosbag2 does; with other metadata."""

    def make(folder: Path) -> Path:
        topics = usual(11)
        for k in range(11):
            part = {name: messages[k : k + 1] for name, messages in topics.items()}
            write_bag(folder / f"lap_{k}", part)
        path = folder / "lap_0"
        for k in range(1, 11):
            shutil.move(folder / f"lap_{k}" / f"lap_{k}.db3", path)
        metadata(path)
        return path

    return make


def half_in_the_log(path: Path) -> None:
    """As a recorder leaves a bag that is killed."""
    file = path / "lap.db3"
    live = path.with_name("live.db3")
    shutil.copy(file, live)
    with contextlib.closing(sqlite3.connect(live)) as database:
        rows = database.execute("SELECT * FROM messages ORDER BY timestamp").fetchall()
        database.execute("DELETE FROM messages")
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[:6])
        database.commit()
        database.execute("PRAGMA journal_mode = wal")
        database.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[6:])
        database.commit()
        for ending in ("", "-wal"):
            shutil.copy(f"{live}{ending}", f"{file}{ending}")
    live.unlink()


def many_topics() -> Messages:
    times = [(START_NS + k, message("std_msgs/msg/String", data="x")) for k in range(2)]
    return {**{f"/robot/part_{k}/state": times for k in range(180)}, **usual()}


def with_qualities(path: Path) -> None:
    """As rosbag2 writes the metadata, with the quality of service of each publisher."""
    time = "{sec: 9223372036, nsec: 854775807}"
    profile = (
        "{history: keep_last, depth: 10, reliability: reliable, durability: volatile, "
        f"deadline: {time}, lifespan: {time}, liveliness: automatic, liveliness_lease_duration: {time}, "
        "avoid_ros_namespace_conventions: false}"
    )
    text = (path / "metadata.yaml").read_text()
    profiles = f"offered_qos_profiles: [{', '.join([profile] * 3)}]"
    (path / "metadata.yaml").write_text(text.replace("offered_qos_profiles: []", profiles))


def foreign(schema: str, encoding: str, schema_encoding: str) -> Make:
    """Images of another recorder as an MCAP file."""

    def make(folder: Path) -> Path:
        with (folder / "race.mcap").open("wb") as stream:
            writer = McapWriter(stream)
            writer.start()
            number = writer.register_schema(schema, schema_encoding, b"")
            channel = writer.register_channel("/camera", encoding, number)
            writer.add_message(channel, START_NS, b"0123", START_NS)
            writer.finish()
        return folder / "race.mcap"

    return make


def images_as(form: str, data: bytes = b"\0\0\0\1\x67" + bytes(99)) -> Messages:
    name, messages = next(iter(usual().items()))
    packed = [(t, replace(each, format=form, data=np.frombuffer(data, np.uint8))) for t, each in messages]
    return {name: packed, "/drive": usual()["/drive"]}


def listed_as_packed(path: Path) -> None:
    """As after ``zstd -d`` of the file that the metadata list; of a bag in parts, a second one is packed."""
    text = (path / "metadata.yaml").read_text().replace("compression_mode: ''", "compression_mode: FILE")
    for ending in ("mcap", "db3"):
        text = text.replace(f".{ending}\n", f".{ending}.zstd\n")
    if (path / "lap_1.db3").exists():
        text = text.replace("- lap_0.db3.zstd\n", "- lap_0.db3.zstd\n  - lap_1.db3.zstd\n")
        (path / "lap_1.db3").rename(path / "lap_1.db3.zstd")
    (path / "metadata.yaml").write_text(text)


def renamed(path: Path, name: str) -> None:
    (path / "metadata.yaml").unlink()
    next(path.iterdir()).rename(path / name)


DEPTH = cv2.imencode(".png", np.full((48, 64), 900, np.uint16))[1].tobytes()


def depth_beside() -> Messages:
    name, messages = next(iter(images_as("16UC1; png compressed 16UC1", DEPTH).items()))
    return {**usual(), f"{name}/depth": messages}


def no_metadata(path: Path) -> None:
    (path / "metadata.yaml").unlink()


SIX, ELEVEN = list(range(6)), list(range(11))
NO_FILE = ("metadata.yaml: names no file",)
UNPACKED = ("compression_mode: ''", "compression_mode: NONE")
BAGS = [
    Case("unpacked by hand", bag(lambda path: edit(path / "metadata.yaml", *UNPACKED)), SIX),
    Case("unpacked by hand, with metadata of the packed one", bag(listed_as_packed), SIX),
    Case("half of it unpacked by hand", split(listed_as_packed), [], ("mode file", "rosbags-convert")),
    Case("MCAP named SQLite", bag(lambda path: renamed(path, "lap.db3")), SIX, NO_FILE),
    Case("SQLite named MCAP", bag(lambda path: renamed(path, "lap.mcap"), "sqlite3"), SIX, NO_FILE),
    Case(
        "ROS 1 named SQLite",
        holding("a.db3", b"#ROSBAG V2.0\n"),
        [],
        ("ROS 1", "a.db3 a.bag; rosbags-convert --src a.bag --dst a"),
    ),
    Case("no metadata", bag(no_metadata), SIX, NO_FILE),
    Case("no metadata, in parts", split(no_metadata), ELEVEN, ("names no file",)),
    Case(
        "empty metadata", bag(lambda path: (path / "metadata.yaml").write_bytes(b"")), SIX, ("names no file",)
    ),
    Case(
        "zeroed metadata",
        bag(lambda path: (path / "metadata.yaml").write_bytes(bytes(99))),
        SIX,
        ("no file",),
    ),
    Case("old metadata", split(lambda path: None), ELEVEN, ("does not list lap_1.db3, lap_2.db3",)),
    Case(
        "metadata of Windows",
        bag(lambda path: edit(path / "metadata.yaml", "- lap.mcap", "- 'C:\\bags\\lap\\lap.mcap'")),
        SIX,
    ),
    Case("the newest half in the log", bag(half_in_the_log, "sqlite3"), SIX),
    Case("180 topics", bag(with_qualities, topics=many_topics()), SIX),
    Case(
        "180 topics and no image",
        bag(topics={name: each for name, each in many_topics().items() if "camera" not in name}),
        [],
        ("no topic of images", "found /drive (ackermann_msgs", "and 169 more"),
    ),
    Case(
        "ROS 1 in MCAP",
        foreign("sensor_msgs/CompressedImage", "ros1", "ros1msg"),
        [],
        ("messages of ROS 1", "rosbags-convert --src race.bag --dst race"),
    ),
    Case(
        "Protobuf", foreign("foxglove.CompressedImage", "protobuf", "protobuf"), [], ("record them in CDR",)
    ),
    Case("a video in MCAP", foreign("foxglove.CompressedVideo", "json", "jsonschema"), [], ("republish",)),
    Case("H.264 as an image", bag(topics=images_as("h264")), [], ("'h264'", "JPEG or PNG", "republish")),
    *(
        Case(f"depth alone, {form}", bag(topics=images_as(form, DEPTH)), [], ("depths in", "of a camera"))
        for form in ("16UC1; png compressed 16UC1", "32FC1; tiff")
    ),
    Case("depth beside colours", bag(topics=depth_beside()), SIX),
    *(
        Case(f"H.264 as {form!r}", bag(topics=images_as(form)), [], ("images in H.264 or", "republish"))
        for form in ("H.264", "avc1", "", "jpeg")
    ),
    Case("no image as an image", bag(topics=images_as("jpeg", bytes(99))), [], ("not a readable image",)),
]


@table(BAGS)
def test_bags(tmp_path: Path, case: Case) -> None:
    case.check(tmp_path)


def test_nothing_is_written_beside_a_bag_that_was_not_closed(tmp_path: Path) -> None:
    path = bag(half_in_the_log, "sqlite3")(tmp_path)
    before = {file: file.read_bytes() for file in sorted(path.iterdir())}
    assert len(before) == 3 and len(open_drive(path)) == 6
    assert {file: file.read_bytes() for file in sorted(path.iterdir())} == before


def test_a_bag_in_parts_is_in_order(tmp_path: Path) -> None:
    drive = open_drive(split(no_metadata)(tmp_path))
    assert [number(drive.image(k)) for k in range(11)] == ELEVEN
    # Several recordings in a folder are several drives.
    (tmp_path / "folder").mkdir()
    for name in ("monday", "tuesday"):
        shutil.copy(write_bag(tmp_path / name, usual(), "mcap") / f"{name}.mcap", tmp_path / "folder")
    with pytest.raises(
        DriveFormatError, match=r"there are drives in it: type .*monday\.mcap, .*tuesday\.mcap"
    ):
        open_drive(tmp_path / "folder")


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_a_mosaic_is_one_in_a_compressed_image(tmp_path: Path, pattern: str, bits: int) -> None:
    """image_transport packs what the camera gives, and says only in the format what it is."""
    colour = np.array([30, 90, 200], np.uint8)
    mosaic = np.empty((8, 12), np.uint8)
    for place, letter in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = colour["bgr".index(letter)]
    stored = mosaic.astype(np.uint16) * 257 if bits == 16 else mosaic
    data = cv2.imencode(".png", stored)[1].tobytes()
    topics = images_as(f"bayer_{pattern}{bits}; png compressed ", data)
    image = open_drive(write_bag(tmp_path / "lap", topics)).image(0)
    np.testing.assert_array_equal(image, np.broadcast_to(colour, (8, 12, 3)))


@pytest.mark.parametrize(
    ("form", "swapped"),
    [("rgb8; jpeg compressed bgr8", False), ("bgr8; png compressed rgb8", True), ("png", False), ("", False)],
)
def test_the_colours_of_a_compressed_image(tmp_path: Path, form: str, swapped: bool) -> None:
    image = frame_image(3)
    data = cv2.imencode(".png", image[..., ::-1] if swapped else image)[1].tobytes()
    np.testing.assert_array_equal(
        open_drive(write_bag(tmp_path / "lap", images_as(form, data))).image(0), image
    )


# Photos.


def turned_photo(path: Path, image_bgr: np.ndarray, orientation: int) -> None:
    """A photo as it is shown: stored otherwise, with the orientation that brings it back."""
    back = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}[orientation]
    stored = {
        **{1: image_bgr, 2: image_bgr[:, ::-1], 3: image_bgr[::-1, ::-1], 4: image_bgr[::-1]},
        **{5: image_bgr.swapaxes(0, 1), 6: np.rot90(image_bgr, -1), 8: np.rot90(image_bgr)},
        7: np.rot90(image_bgr, 2).swapaxes(0, 1),
    }[back]
    exif = Image.Exif()
    exif[274] = orientation
    how = {"lossless": True} if path.suffix == ".webp" else {"quality": 98} if path.suffix == ".jpg" else {}
    Image.fromarray(np.ascontiguousarray(stored[..., ::-1])).save(path, exif=exif, **how)


@pytest.mark.parametrize("ending", ["jpg", "png", "webp", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_image_is_as_it_is_shown_whoever_reads_it(tmp_path: Path, ending: str, orientation: int) -> None:
    """OpenCV's versions differ in the formats that they turn, and calibration turned none."""
    shown = frame_image(5)
    (tmp_path / "images").mkdir()
    file = tmp_path / "images" / f"a.{ending}"
    turned_photo(file, shown, orientation)
    (tmp_path / "frames.csv").write_text(f"frame,file,t_s\n0,images/a.{ending},0\n")
    drive = open_drive(tmp_path)
    for image in (drive.image(0), open_source(file).image(0), read_picture(file)):
        assert np.abs(image.astype(int) - shown).max() <= (12 if ending == "jpg" else 0)
    # Of photos of a lens, all are turned as most of them are.
    assert common_turn([file, file]) == orientation
    assert read_picture(file, 1).shape == ((48, 64, 3) if orientation < 5 else (64, 48, 3))


@pytest.mark.parametrize("orientation", [1, 3])
def test_an_exported_picture_is_shown_alike_by_every_tool(tmp_path: Path, orientation: int) -> None:
    """Some turn an image as its Exif data say, some do not; the labels are those of the turned one."""
    (tmp_path / "images").mkdir()
    turned_photo(tmp_path / "images" / "a.jpg", frame_image(5), orientation)
    (tmp_path / "frames.csv").write_text("frame,file,t_s\n0,images/a.jpg,0\n")
    pictures = object.__new__(Pictures)
    pictures.drive = open_drive(tmp_path)
    data, ending = pictures._file(0)
    assert ending == (".jpg" if orientation == 1 else ".png")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), flags), pictures.drive.image(0))


def test_photos_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for k in range(12):
        cv2.imwrite(str(tmp_path / f"frame{k}.jpg"), frame_image(k))
    source = open_source(tmp_path)
    assert [number(source.image(i)) for i in range(12)] == list(range(12))
