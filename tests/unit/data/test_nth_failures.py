"""Files, folders and recordings, with each call that can fail failing in turn."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from drives import CAMERA, frame_image, write_drive
from nth_failure import DISK, MEMORY, Failure, check_each, every_failure, report
from small_map import small_map

from lanenet import outputs
from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import TRUTH_NAMES, DriveWriter
from lanenet.data.drives.recorder import DriveRecorder, RecordingSettings
from lanenet.data.files import atomic_folder, write_json, write_text
from lanenet.data.maps.folder import check_map_files, read_map, write_map
from lanenet.data.tables import ParquetTable, write_columns
from lanenet.errors import LanenetError


def test_a_failure_that_is_swallowed_is_seen(tmp_path: Path) -> None:
    """A writer that is not atomic does not pass."""

    def careless(number: int) -> None:
        (tmp_path / "a.txt").write_text(str(number))

    with pytest.raises(AssertionError):
        check_each(careless, lambda: int((tmp_path / "a.txt").read_text()), tmp_path, [DISK])


def test_a_file(tmp_path: Path) -> None:
    calls = check_each(
        lambda number: write_json(tmp_path / "a.json", {"number": number}),
        lambda: int(json.loads((tmp_path / "a.json").read_text())["number"]),
        tmp_path,
        [DISK, MEMORY],
    )
    assert [call.partition(" ")[0] for call in calls].count("fsync") == 2
    assert {"write", "replace", "allocation"} <= {call.partition(" ")[0] for call in calls}


def test_a_table(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    calls = check_each(
        lambda number: write_columns(path, {"number": np.full(3, number)}, {}),
        lambda: int(ParquetTable(path).ints("number")[2]),
        tmp_path,
        [DISK, MEMORY],
    )
    assert any(call.startswith("write_table") for call in calls)


@pytest.mark.parametrize("exchanges", [True, False])
def test_a_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchanges: bool) -> None:
    if not exchanges:
        monkeypatch.setattr(outputs, "exchange", lambda *_: False)

    def write(number: int) -> None:
        with DriveWriter(tmp_path / "one", CAMERA) as writer:
            for k in range(2):
                # Only what was simulated is replaced.
                writer.add(
                    frame_image(k), 0.05 * k, dict.fromkeys(TRUTH_NAMES, 0.0), speed_cm_s=float(number)
                )

    def read() -> int:
        drive = open_drive(tmp_path / "one")
        assert not drive.problems and drive.image(1).shape and drive.camera is not None
        assert drive.commands.speed_cm_s is not None
        return int(drive.commands.speed_cm_s[1])

    calls = check_each(write, read, tmp_path, [DISK, MEMORY])
    report("drive folder", calls)
    assert len(calls) > 20
    assert sum(call.startswith("rename ") for call in calls) == (0 if exchanges else 3)


@pytest.mark.slow
def test_the_files_of_a_map(tmp_path: Path) -> None:
    def write(number: int) -> None:
        with atomic_folder(tmp_path / "one", "map", check_map_files) as folder:
            report = {"number": number}
            write_map(folder, small_map(), {"frame": np.arange(2)}, report, "given")
            write_text(folder / "settings.yaml", "seed: 0\n")

    def read() -> int:
        read_map(tmp_path / "one")
        return int(json.loads((tmp_path / "one" / "report.json").read_text())["number"])

    calls = check_each(write, read, tmp_path, [DISK, MEMORY])
    report("files of a map", calls)
    assert len(calls) > 25


def test_a_recording(tmp_path: Path) -> None:
    """Whatever fails, it never raises, and what was recorded before is a drive."""
    recorders: list[DriveRecorder] = []
    write_drive(tmp_path / "earlier", 2)

    def record() -> None:
        settings = RecordingSettings(min_free_mb=0.0, sync_s=0.1)
        recorder = DriveRecorder(tmp_path / f"drive{len(recorders)}", settings, CAMERA)
        recorders.append(recorder)
        for k in range(3):
            recorder.add(frame_image(k), 0.05 * k, throttle=0.1)
        recorder.close()

    kept: list[Path] = []

    def look(failure: Failure) -> None:
        assert failure.error is None or isinstance(failure.error, LanenetError | MemoryError), failure
        if failure.error is None:
            recorder = recorders[-1]
            assert recorder.recorded + recorder.dropped == 3
            assert bool(recorder.problem) or recorder.recorded == 3, failure
            if recorder.recorded:
                drive = open_drive(recorder.path)
                assert len(drive) == recorder.recorded and not drive.problems
                assert drive.image(len(drive) - 1).shape == (48, 64, 3)
                assert not [path for path in recorder.path.rglob(".*") if path.suffix != ".lock"]
                kept.append(recorder.path)
        assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "earlier", *kept]), failure

    calls = []
    for failure in every_failure(record, [DISK, MEMORY]):
        calls.append(failure.call)
        look(failure)
    report("recording", calls)
    assert len(open_drive(recorders[-1].path)) == 3 and len(open_drive(tmp_path / "earlier")) == 2
    assert len(calls) > 25
