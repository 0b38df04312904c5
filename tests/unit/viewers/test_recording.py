"""Recordings: their files, and the thread that keeps a car from waiting."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from watched import SCENE, frames

from lanenet.errors import ConfigError, LanenetError, MissingExtraError
from lanenet.viewers import recording as recordings
from lanenet.viewers.drawing import Artist, Drawing
from lanenet.viewers.recording import (
    BackgroundRecording,
    Recording,
    check_targets,
    record,
    record_in_background,
)
from lanenet.viewers.registry import VIEWERS

REPO = Path(__file__).resolve().parents[3]


class Slow:
    """A viewer that waits to be released, and fails at a frame."""

    def __init__(self, fails_at: int = -1) -> None:
        self.release, self.frames, self.fails_at = threading.Event(), [], fails_at

    def begin(self, artist: Artist) -> None:
        pass

    def add(self, drawing: Drawing) -> None:
        self.release.wait(10.0)
        if drawing.seen.frame == self.fails_at:
            raise OSError("no space left")
        self.frames.append(drawing.seen.frame)

    def close(self) -> None:
        pass


def test_files_with_another_ending_are_refused(tmp_path: Path) -> None:
    assert check_targets({"rerun": "live"}) == check_targets({"rerun": "rerun+http://pi:9876/proxy"}) == []
    assert check_targets({"mcap": str(tmp_path / "a.mcap")}) == [tmp_path / "a.mcap"]
    with pytest.raises(ConfigError, match=r"--mcap a\.rrd: expected FILE\.mcap"):
        check_targets({"mcap": "a.rrd"})
    with pytest.raises(ConfigError, match=r"--rerun a\.mcap: expected FILE\.rrd or live"):
        check_targets({"rerun": "a.mcap"})


@pytest.mark.parametrize("name", list(VIEWERS))
def test_a_missing_package_is_named_with_its_extra(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'lanenet\[viewers\]'"):
        check_targets({name: str(tmp_path / f"a{VIEWERS[name].ending}")})


def test_all_viewers_get_all_frames_and_files_their_names_at_the_end(tmp_path: Path) -> None:
    targets = {name: str(tmp_path / f"drive{kind.ending}") for name, kind in VIEWERS.items()}
    with record(targets, SCENE, "first") as recording:
        for seen in frames():
            recording.add(seen)
        assert not list(tmp_path.glob("drive*"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive-first.mcap", "drive-first.rrd"]


def test_an_error_leaves_no_file(tmp_path: Path) -> None:
    targets = {name: str(tmp_path / f"drive{kind.ending}") for name, kind in VIEWERS.items()}
    with pytest.raises(LanenetError, match="bad frame"), record(targets, SCENE) as recording:
        recording.add(frames()[0])
        raise LanenetError("bad frame")
    assert not list(tmp_path.iterdir())


def test_what_a_car_saw_before_an_error_is_kept(tmp_path: Path) -> None:
    target = {"mcap": str(tmp_path / "drive.mcap")}
    with (
        pytest.raises(LanenetError, match="the camera is gone"),
        record_in_background(target, SCENE) as background,
    ):
        background.add(frames()[0])
        raise LanenetError("the camera is gone")
    assert (tmp_path / "drive.mcap").stat().st_size > 1000


def test_a_car_does_not_wait_for_a_slow_viewer() -> None:
    slow = Slow()
    background = BackgroundRecording(Recording(Artist(SCENE), [slow]))
    for seen in frames() * 10:
        background.add(seen)
    # One is being drawn, eight wait.
    assert 30 - background.dropped in (8, 9)
    slow.release.set()
    background.close()
    assert len(slow.frames) == 30 - background.dropped


def test_a_viewer_that_fails_stops_the_recording_and_not_the_car(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = Slow(fails_at=8)
    slow.release.set()
    kind = VIEWERS["rerun"]
    monkeypatch.setitem(recordings.VIEWERS, "rerun", type(kind)(**{**vars(kind), "open": lambda _: slow}))
    driven = 0
    with (
        pytest.raises(LanenetError, match="viewers stopped before the end: no space left"),
        record_in_background({"rerun": "live"}, SCENE) as background,
    ):
        for seen in frames():
            background.add(seen)
            driven += 1
    assert driven == 3 and slow.frames == [7]


#: Writes more than a process may; ends at once, since Rerun's SDK waits for its writer, which has given up.
FULL_DISK = """
import os, resource, signal, sys
from dataclasses import replace
import numpy as np
from watched import SCENE, frames
from lanenet.errors import LanenetError
from lanenet.viewers.recording import record
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    with record({sys.argv[1]: sys.argv[2]}, SCENE) as recording:
        noise = np.random.default_rng(0).integers(0, 256, (40, 120, 160, 3), np.uint8)
        for image in noise:
            recording.add(replace(frames()[0], image_bgr=image))
except LanenetError as error:
    os.write(1, str(error).encode())
os._exit(0)
"""


@pytest.mark.parametrize("name", list(VIEWERS))
def test_a_full_disk_leaves_no_half_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"drive{VIEWERS[name].ending}"
    folders = [str(REPO), str(REPO / "tests" / "support")]
    result = subprocess.run(
        [sys.executable, "-c", FULL_DISK, name, str(path)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert f"{path}: cannot be written" in result.stdout
    assert not list(tmp_path.glob("drive*"))
