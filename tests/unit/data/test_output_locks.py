"""One writer at a time, folders exchanged in one step, and what is left of runs that were killed."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from lanenet import outputs
from lanenet.errors import LanenetError
from lanenet.outputs import lock_output, put_in_place, restore_output, temporary_output

#: Locks OUT, begins a temporary folder and waits to be killed.
WAITS = """
import sys
from pathlib import Path
from lanenet.outputs import lock_output, temporary_output
out = Path(sys.argv[1])
with lock_output(out), temporary_output(out) as temporary:
    temporary.mkdir()
    print("ready", flush=True)
    sys.stdin.read()
"""
#: Replaces OUT by folders of two equal files again and again; with "renames" without the exchange of names.
REPLACES = """
import itertools, sys
from pathlib import Path
from lanenet import outputs
from lanenet.outputs import lock_output, put_in_place, temporary_output
out = Path(sys.argv[1])
if sys.argv[2] == "renames":
    outputs.exchange = lambda *_: False
for k in itertools.count():
    with lock_output(out), temporary_output(out) as temporary:
        temporary.mkdir()
        (temporary / "a").write_text(str(k))
        (temporary / "b").write_text(str(k))
        put_in_place(temporary, out)
    if k == 2:
        print("ready", flush=True)
"""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def start(program: str, *words: object) -> subprocess.Popen[bytes]:
    """Start a program and wait until it says that it is ready."""
    command = [sys.executable, "-c", program, *map(str, words)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"ready\n"
    return process


def kill(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.communicate()


def a_folder(path: Path, text: str) -> Path:
    path.mkdir(parents=True)
    (path / "a").write_text(text)
    return path


def in_a_thread(path: Path) -> str:
    """Take the lock in another thread; returns the refusal, or an empty text."""
    refusals: list[str] = []

    def take() -> None:
        try:
            with lock_output(path):
                pass
        except LanenetError as error:
            refusals.append(str(error))

    thread = threading.Thread(target=take)
    thread.start()
    thread.join()
    return "".join(refusals)


def test_a_living_run_keeps_its_output_and_a_dead_one_does_not(tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = start(WAITS, out)
    try:
        before = names(tmp_path)
        assert len(before) == 2, "a lock and a temporary folder"
        with pytest.raises(LanenetError, match=rf"{out}: .*process {process.pid} on "), lock_output(out):
            pass
        assert names(tmp_path) == before, "nothing of a living run is cleared"
    finally:
        kill(process)
    with lock_output(out):
        assert names(tmp_path) == [".out.lock"]
    assert names(tmp_path) == []


def test_the_holder_may_take_its_lock_again_and_nobody_else(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with lock_output(out):
        with lock_output(tmp_path / "x" / ".." / "out"):
            pass
        assert str(os.getpid()) in in_a_thread(out), "still locked after the inner block"
        assert in_a_thread(tmp_path / "other") == ""
    assert in_a_thread(out) == ""


def test_a_lock_of_another_program_is_left_alone(tmp_path: Path) -> None:
    lock = tmp_path / ".out.lock"
    lock.write_text("of another program\n")
    with (
        pytest.raises(LanenetError, match=r"\.out\.lock is not a lock of lanenet"),
        lock_output(tmp_path / "out"),
    ):
        pass
    assert lock.read_text() == "of another program\n"
    # Of a run that was killed, with and without room for its name.
    for text in ("process 7 on somewhere\n", ""):
        lock.write_text(text)
        with lock_output(tmp_path / "out"):
            pass
        assert names(tmp_path) == []


def test_a_folder_in_which_nothing_can_be_made_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As /proc, which is a folder that can be entered, and in which no file can be made."""
    whole = os.open

    def no_lock(path: Path, *more: int) -> int:
        if Path(path).name.endswith(".lock"):
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", str(path))
        return whole(path, *more)

    monkeypatch.setattr(os, "open", no_lock)
    with pytest.raises(LanenetError, match="map: cannot be written"), lock_output(tmp_path / "map"):
        raise AssertionError("it has no lock")


def test_a_folder_that_another_run_has_just_removed_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, failed = os.open, []

    def once(path: Path, *more: int) -> int:
        if Path(path).name.endswith(".lock") and not failed:
            failed.append(path)
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", str(path))
        return whole(path, *more)

    monkeypatch.setattr(os, "open", once)
    with lock_output(tmp_path / "maps" / "map"):
        assert failed and (tmp_path / "maps" / ".map.lock").exists()


def test_folders_made_for_a_lock_go_again(tmp_path: Path) -> None:
    with lock_output(tmp_path / "deep" / "er" / "out"):
        assert (tmp_path / "deep" / "er").is_dir()
    assert names(tmp_path) == []
    with lock_output(tmp_path / "deep" / "er" / "out"):
        a_folder(tmp_path / "deep" / "er" / "out", "kept")
    assert (tmp_path / "deep" / "er" / "out" / "a").read_text() == "kept"


def test_left_overs_go_and_neighbours_stay(tmp_path: Path) -> None:
    out = a_folder(tmp_path / "one", "good")
    # The second and the third are names of earlier versions.
    gone = [".one.12-0123abcd.tmp", ".one.0123abcd.tmp", ".one.ffffffff.old.tmp", ".one.1-0123abcd.new.tmp"]
    stay = [".one.b.0123abcd.tmp", ".two.12-0123abcd.tmp", ".one.tmp", ".one.backup99.tmp"]
    for name in gone + stay:
        a_folder(tmp_path / name, "x")
    (tmp_path / ".one.csv.7-0123abcd.tmp.csv").write_text("x")
    with lock_output(out):
        pass
    assert names(tmp_path) == sorted([*stay, ".one.csv.7-0123abcd.tmp.csv", "one"])
    with lock_output(tmp_path / "one.csv"):
        pass
    assert names(tmp_path) == sorted([*stay, "one"])
    assert (out / "a").read_text() == "good"


@pytest.mark.parametrize("left", [("new", "old"), ("old",)])
def test_an_exchange_that_was_killed_between_its_renames_is_finished(
    tmp_path: Path, left: tuple[str, ...]
) -> None:
    for stage in left:
        a_folder(tmp_path / f".one.12-0123abcd.{stage}.tmp", stage)
    restore_output(tmp_path / "one")
    assert names(tmp_path) == ["one"] and (tmp_path / "one" / "a").read_text() == left[0]
    restore_output(tmp_path / "nowhere" / "one")
    restore_output(tmp_path / "another")
    assert names(tmp_path) == ["one"]


def test_a_reader_always_finds_the_folder(tmp_path: Path) -> None:
    """Fails with two renames: a reader comes between them."""
    out = a_folder(tmp_path / "out", "0")
    missing: list[int] = []
    done = threading.Event()

    def read() -> None:
        while not done.is_set():
            try:
                os.stat(out / "a")
            except FileNotFoundError:
                missing.append(1)

    reader = threading.Thread(target=read)
    reader.start()
    with lock_output(out):
        for k in range(100):
            with temporary_output(out) as temporary:
                a_folder(temporary, str(k))
                put_in_place(temporary, out)
    done.set()
    reader.join()
    if not outputs.exchange(a_folder(tmp_path / "x", ""), a_folder(tmp_path / "y", "")):
        pytest.skip("this file system cannot exchange names")
    assert not missing and (out / "a").read_text() == "99"


@pytest.mark.parametrize("how", ["exchange", "renames"])
@pytest.mark.parametrize("kills", [3, pytest.param(100, marks=pytest.mark.slow)])
def test_killed_at_any_moment_there_is_a_whole_folder(tmp_path: Path, how: str, kills: int) -> None:
    out = tmp_path / "out"
    rng = np.random.default_rng(kills)
    for _ in range(kills):
        process = start(REPLACES, out, how)
        # A replacement takes about a millisecond.
        threading.Event().wait(float(rng.uniform(0.0, 0.01)))
        kill(process)
        restore_output(out)
        assert (out / "a").read_text() == (out / "b").read_text() != ""
    with lock_output(out):
        pass
    assert names(tmp_path) == ["out"]


#: Replaces OUT, and is killed at the n-th renaming (before it, or after it).
DIES = """
import os, signal, sys
from pathlib import Path
from lanenet import outputs
from lanenet.outputs import lock_output, put_in_place, temporary_output
out, due, after = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "after"
rename = os.rename
outputs.exchange = lambda *_: False
def dying(*names):
    global due
    due -= 1
    if due == 0 and not after: os.kill(os.getpid(), signal.SIGKILL)
    rename(*names)
    if due == 0: os.kill(os.getpid(), signal.SIGKILL)
with lock_output(out), temporary_output(out) as temporary:
    temporary.mkdir()
    (temporary / "a").write_text("new")
    os.rename = dying
    put_in_place(temporary, out)
"""


@pytest.mark.parametrize("when", ["before", "after"])
def test_killed_at_each_renaming_the_old_or_the_new_folder_is_there(tmp_path: Path, when: str) -> None:
    found = []
    for n in (1, 2, 3):
        out = a_folder(tmp_path / str(n) / "out", "old")
        done = subprocess.run([sys.executable, "-c", DIES, str(out), str(n), when], check=False)
        assert done.returncode == -signal.SIGKILL
        restore_output(out)
        found.append((out / "a").read_text())
        with lock_output(out):
            pass
        assert names(out.parent) == ["out"]
    # While the old folder has its name the run has not happened; from then on it has.
    assert found == (["old", "old", "new"] if when == "before" else ["old", "new", "new"])


@pytest.fixture
def without_flock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of outputs knows no flock, the machine's folder for temporary files does."""
    real, temporary = fcntl.flock, tmp_path / "machine"
    temporary.mkdir()
    shared = tmp_path / "shared"
    shared.mkdir()

    def flock(handle: int, how: int) -> None:
        if os.readlink(f"/proc/self/fd/{handle}").startswith(str(shared)):
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
        real(handle, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    yield shared
    assert names(temporary) == []


def test_without_flock_the_lock_is_this_machines(without_flock: Path) -> None:
    out, left = without_flock / "out", a_folder(without_flock / ".out.12-0123abcd.tmp", "another's?")
    with lock_output(out):
        assert str(os.getpid()) in in_a_thread(out)
        with temporary_output(out) as temporary:
            put_in_place(a_folder(temporary, "new"), out)
    # Its owner may live on another machine.
    assert names(without_flock) == [left.name, "out"]
