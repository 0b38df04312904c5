"""Label all: each drive once, by content and settings; what fails stops nothing, and nothing varies."""

from __future__ import annotations

import json
import shutil
import uuid
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fleet_runs import SETTINGS, copy_of, drives_of, labels_in, run
from fleet_work import HereEngine

from datagen.fleet import work
from datagen.fleet.checksums import with_checksums
from datagen.fleet.engine import Ended, Task
from datagen.fleet.run import label_all
from datagen.fleet.source import checksum
from datagen.fleet.storage import MARK_NAME, OWN_NAMES, Storage
from datagen.fleet.task import FleetSettings
from datagen.fleet.work import Outcome
from datagen.settings import MapSettings
from lanenet.data.drives import open_drive
from lanenet.data.drives.content import image_marks
from lanenet.data.label_set import read_labels
from lanenet.data.maps.folder import read_map


def test_a_drive_becomes_a_map_and_a_label_set(tiny: Path, labelled: Path):
    (index,) = json.loads((labelled / "drives.json").read_text())["drives"]
    assert index["name"] == "tiny" and index["verdict"] == "good" and index["reason"] == ""
    labels = read_labels(labelled / index["labels"])
    assert set(labels.drive) == {"tiny"} and len(labels) > 60
    mapped = json.loads((labelled / index["map"] / "result.json").read_text())
    assert mapped["frames"] == 70 and mapped["driven_s"] == pytest.approx(69 * 0.05)
    assert mapped["took"]["cpu_s"] > 0 and mapped["took"]["peak_bytes"] > 1e8 and mapped["bytes"] > 1e5
    assert (labelled / index["map"] / "thumbnail.jpg").read_bytes()[:2] == b"\xff\xd8"
    assert not list(labelled.glob("*/.*"))
    # The map knows its drive again by the bytes of its images.
    assert read_map(labelled / index["map"]).marks == tuple(image_marks(open_drive(tiny)))
    # All of which the storage asks whether others have it.
    assert {path.name for path in labelled.iterdir()} <= {*OWN_NAMES, MARK_NAME}


def test_a_second_run_does_nothing(tiny: Path, labelled: Path):
    written = ("drives.json", "index.html")  # they say how the drives stand, after each run
    before = {path: path.stat().st_mtime_ns for path in labelled.rglob("*") if path.name not in written}
    result, names = run(labelled, drives_of(tiny))
    assert names == [] and [drive.verdict for drive in result.drives] == ["good"]
    assert not any(drive.new for drive in result.drives)
    after = {path: path.stat().st_mtime_ns for path in labelled.rglob("*") if path.name not in written}
    assert before.keys() == after.keys()
    files = [path for path in before if path.is_file()]
    assert [before[path] for path in files] == [after[path] for path in files]


def test_the_same_bytes_in_this_process_and_in_an_object_store(tiny: Path, labelled: Path):
    url, memory = f"memory://{uuid.uuid4().hex}", fsspec.filesystem("memory")
    memory.put(str(tiny), f"{url}/drives/tiny", recursive=True)
    (result,) = run(f"{url}/out", drives_of(f"{url}/drives/tiny"))[0].drives
    assert result.verdict == "good"
    found = memory.cat_file(f"{url}/out/labels/{result.labels_key}/labels.parquet")
    assert labels_in(labelled) == {result.labels_key: found}
    kept = Path(labelled / "maps" / result.map_key)
    for name in (
        "poses.csv",
        "lanes.json",
        "edges.parquet",
        "camera.yaml",
        "trajectory.tum",
        "thumbnail.jpg",
    ):
        assert memory.cat_file(f"{url}/out/maps/{result.map_key}/{name}") == (kept / name).read_bytes(), name
    # The map names its drive by the place that all machines know.
    assert (
        f"drive: {url}/drives/tiny\n" in memory.cat_file(f"{url}/out/maps/{result.map_key}/map.yaml").decode()
    )
    memory.rm(url, recursive=True)


def test_a_changed_setting_redoes_what_it_touches(tiny: Path, tmp_path: Path, mapping: list[str]):
    drives = drives_of(tiny)
    run(tmp_path, drives)
    assert mapping == ["tiny"]
    other = SETTINGS.model_copy(update={"colour_weight": 0.25})
    assert run(tmp_path, drives, other)[1] == ["tiny"]
    assert mapping == ["tiny"] and len(labels_in(tmp_path)) == 2
    # Back again there is nothing to do; another setting of the mapping maps again.
    assert run(tmp_path, drives)[1] == []
    run(tmp_path, drives, FleetSettings(map=MapSettings(find_bumper=False, seed=5)))
    assert mapping == ["tiny", "tiny"] and len(labels_in(tmp_path)) == 3


def test_another_name_or_place_keeps_the_map(tiny: Path, tmp_path: Path, mapping: list[str]):
    run(tmp_path / "out", drives_of(tiny))
    moved = tmp_path / "elsewhere"
    shutil.copytree(tiny, moved)
    assert run(tmp_path / "out", drives_of(moved, names=("tiny",)))[1] == []
    assert run(tmp_path / "out", drives_of(moved, names=("renamed",)))[1] == ["renamed"]
    assert mapping == ["tiny"]
    assert len(set(labels_in(tmp_path / "out").values())) == 2


def test_a_changed_recording_is_another_drive(tiny: Path, tmp_path: Path, mapping: list[str]):
    drive = copy_of(tiny, tmp_path / "tub")
    run(tmp_path / "out", drives_of(drive))
    table = drive / "frames.csv"
    table.write_text(table.read_text().rstrip("\n") + "\n\n")
    run(tmp_path / "out", drives_of(drive))
    assert mapping == ["tub", "tub"]


def test_a_recording_given_twice_is_labelled_once(tiny: Path, tmp_path: Path, mapping: list[str]):
    shutil.copytree(tiny, tmp_path / "copy")
    result, names = run(tmp_path / "out", drives_of(tiny, tmp_path / "copy"))
    assert names == ["tiny"] and [drive.verdict for drive in result.drives] == ["good", "duplicate"]
    assert result.drives[1].reason == "is the same recording as tiny"
    assert len(labels_in(tmp_path / "out")) == 1


def test_what_fails_or_is_refused_stops_nothing(tiny: Path, tmp_path: Path, mapping: list[str]):
    names = ("lost", "bug", "reject", "memory", "fine")
    drives = drives_of(*(copy_of(tiny, tmp_path / "drives" / name) for name in names))
    counts: list[tuple[int, int, int, int]] = []
    result, _ = run(
        tmp_path / "out",
        drives,
        progress=lambda c: counts.append((c.done, c.refused, c.failed, c.total)),
    )
    assert [(drive.verdict, drive.reason) for drive in result.drives] == [
        ("refused", "the car stands still"),
        ("failed", "ZeroDivisionError: by zero"),
        ("reject", "the lines are not where they seem"),
        ("failed", "out of memory"),
        ("good", ""),
    ]
    assert counts == [(0, 0, 0, 5), (0, 1, 0, 5), (0, 1, 1, 5), (0, 2, 1, 5), (0, 2, 2, 5), (1, 2, 2, 5)]
    assert not list((tmp_path / "out").glob("*/.*"))
    # What was refused stays so; what failed is tried again.
    mapping.clear()
    run(tmp_path / "out", drives)
    assert mapping == ["bug", "memory"]
    mapping.clear()
    run(tmp_path / "out", drives, refused_again=True)
    assert mapping == ["lost", "bug", "memory"]


@pytest.mark.parametrize("kind", ["maps", "labels"])
def test_a_result_whose_marker_is_torn_is_made_again_and_the_others_stay(
    tiny: Path, tmp_path: Path, mapping: list[str], kind: str
):
    drives = drives_of(copy_of(tiny, tmp_path / "a"), copy_of(tiny, tmp_path / "b"))
    result, _ = run(tmp_path / "out", drives)
    keys = {"maps": result.drives[1].map_key, "labels": result.drives[1].labels_key}
    (tmp_path / "out" / kind / keys[kind] / "result.json").write_text('{"verdict": "go')
    again, names = run(tmp_path / "out", drives)
    assert names == ["b"] and [drive.verdict for drive in again.drives] == ["good", "good"]
    assert run(tmp_path / "out", drives)[1] == []


def test_a_full_disk_ends_the_run_and_keeps_what_is_finished(tiny: Path, tmp_path: Path, mapping: list[str]):
    drives = drives_of(*(copy_of(tiny, tmp_path / "drives" / name) for name in ("a", "full", "z")))
    result, names = run(tmp_path / "out", drives)
    assert names == ["a", "full"]
    assert [drive.verdict for drive in result.drives] == ["good", "failed", "left"]
    assert "full" in result.disk_full and "cannot be written" in result.disk_full
    assert not list((tmp_path / "out").glob("*/.*"))
    assert run(tmp_path / "out", drives_of(drives[2].source))[1] == ["z"]


def test_ctrl_c_leaves_what_is_finished(tiny: Path, tmp_path: Path, mapping: list[str]):
    drives = drives_of(*(copy_of(tiny, tmp_path / "drives" / name) for name in ("a", "b")))

    def interrupt(counts: Any) -> None:
        if counts.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "out", drives, progress=interrupt)
    assert len(labels_in(tmp_path / "out")) == 1
    result, names = run(tmp_path / "out", drives)
    assert names == ["b"] and [drive.verdict for drive in result.drives] == ["good", "good"]


def test_a_task_that_the_engine_gave_up_is_a_failure(tiny: Path, tmp_path: Path):
    class Losing:
        def run(self, work: Callable[[Any], Any], tasks: Sequence[Task]) -> Generator[Ended, None, None]:
            yield Ended(0, error="its machine was lost")

    storage = Storage(str(tmp_path))
    result = label_all(with_checksums(drives_of(tiny), storage), SETTINGS, storage, Losing())
    assert [(drive.verdict, drive.reason) for drive in result.drives] == [("failed", "its machine was lost")]


def test_results_that_went_to_another_storage_are_a_failure(tiny: Path, tmp_path: Path):
    class Elsewhere:
        def run(self, work: Callable[[Any], Any], tasks: Sequence[Task]) -> Generator[Ended, None, None]:
            yield Ended(0, Outcome("good"))

    storage = Storage(str(tmp_path / "out"))
    (drive,) = label_all(with_checksums(drives_of(tiny), storage), SETTINGS, storage, Elsewhere()).drives
    assert drive.verdict == "failed" and f"not in the {tmp_path / 'out'} of this machine" in drive.reason


def test_a_worker_with_another_version_does_nothing(tiny: Path, tmp_path: Path):
    (drive,) = with_checksums(drives_of(tiny), Storage(str(tmp_path)))
    outcome = work.label_drive(work.Job(drive, SETTINGS, str(tmp_path), "lanenet 0.1"))
    assert outcome.verdict == "" and "the run needs lanenet 0.1" in outcome.reason


def test_a_drive_that_is_not_on_the_worker_has_failed_and_is_not_refused(tiny: Path, tmp_path: Path):
    storage = Storage(str(tmp_path / "out"))
    drive = copy_of(tiny, tmp_path / "tub")
    checked = with_checksums(drives_of(drive), storage)
    shutil.rmtree(drive)
    result = label_all(checked, SETTINGS, storage, HereEngine())
    assert (
        result.drives[0].verdict == "failed" and "storage that all machines share" in result.drives[0].reason
    )


def test_a_drive_that_changes_in_the_run_has_failed_and_nothing_of_it_is_kept(tiny: Path, tmp_path: Path):
    storage = Storage(str(tmp_path / "out"))
    drive = copy_of(tiny, tmp_path / "tub")
    checked = with_checksums(drives_of(drive), storage)
    whole = (drive / "frames.csv").read_bytes()
    for other in (b"junk", whole + b"\n"):
        (drive / "frames.csv").write_bytes(other)
        (found,) = label_all(checked, SETTINGS, storage, HereEngine()).drives
        assert found.verdict == "failed" and "tub: its files have changed since the run began" in found.reason
    (drive / "frames.csv").write_bytes(whole)
    (found,) = label_all(checked, SETTINGS, storage, HereEngine()).drives
    assert found.verdict == "good"


def test_drives_that_are_gone_and_broken_cameras_are_named_and_stop_nothing(
    tiny: Path, tmp_path: Path, mapping: list[str]
):
    out, good, other = tmp_path / "out", copy_of(tiny, tmp_path / "tub"), copy_of(tiny, tmp_path / "other")
    (tmp_path / "camera.yaml").write_text("junk")
    drives = drives_of(tmp_path / "nowhere", good, tmp_path / "gone", other)
    drives[3] = replace(drives[3], camera=str(tmp_path / "camera.yaml"))
    result, names = run(out, drives)
    assert names == ["tub"] == mapping
    assert [drive.verdict for drive in result.drives] == ["failed", "good", "failed", "failed"]
    reasons = [drive.reason for drive in result.drives]
    assert "nowhere: no such drive" in reasons[0] and "gone: no such drive" in reasons[2]
    assert "camera.yaml: expected a mapping" in reasons[3]
    assert "nowhere: no such drive" in (out / "index.html").read_text()
    index = json.loads((out / "drives.json").read_text())["drives"]
    assert [drive["map"] is not None for drive in index] == [False, True, False, False]
    # They are tried again once they are there.
    copy_of(tiny, tmp_path / "nowhere")
    result, names = run(out, drives)
    assert names == ["nowhere"] and result.drives[0].verdict == "good"


def test_files_are_read_again_only_if_they_changed(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    drive, storage = copy_of(tiny, tmp_path / "tub"), Storage(str(tmp_path / "out"))
    read: list[str] = []
    monkeypatch.setattr(
        "datagen.fleet.checksums.checksum", lambda source: (read.append(source), checksum(source))[1]
    )
    (first,) = with_checksums(drives_of(drive), storage)
    assert with_checksums(drives_of(drive), storage) == [first] and read == [str(drive)]
    (drive / "images" / "more.txt").write_text("x")
    (second,) = with_checksums(drives_of(drive), storage)
    assert second.checksum != first.checksum and len(read) == 2


def test_a_video_has_the_checksum_of_its_files_under_any_name(tmp_path: Path):
    (tmp_path / "one.avi").write_bytes(b"video")
    (tmp_path / "one.csv").write_bytes(b"t_s")
    before = checksum(str(tmp_path / "one.avi"))
    for name in ("one.avi", "one.csv"):
        (tmp_path / name).rename(tmp_path / name.replace("one", "two"))
    (tmp_path / "three.csv").write_bytes(b"of another one")
    assert checksum(str(tmp_path / "two.avi")) == before
    (tmp_path / "two.csv").write_bytes(b"other")
    assert checksum(str(tmp_path / "two.avi")) != before
