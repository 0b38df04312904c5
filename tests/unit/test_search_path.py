from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import lanenet
from lanenet.search_path import without_working_folder

ROOT = Path(lanenet.__file__).resolve().parents[1]
STDLIB = str(Path(os.__file__).resolve().parent)


@pytest.mark.parametrize(
    ("entries", "kept"),
    [
        (["", "/opt/x"], ["/opt/x"]),
        (["/opt/x", "."], ["/opt/x"]),
        (["{here}", "/opt/x", "{here}/", "{here}/deeper"], ["/opt/x", "{here}/deeper"]),
    ],
)
def test_the_working_folder_is_left_out(tmp_path, monkeypatch, entries, kept):
    monkeypatch.chdir(tmp_path)
    found, expected = ([entry.format(here=tmp_path) for entry in path] for path in (entries, kept))
    assert without_working_folder(found) == expected


def test_a_checkout_comes_last(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert without_working_folder(["", str(ROOT), "/opt/x"]) == ["/opt/x", str(ROOT)]


def test_pythons_own_folders_stay(monkeypatch):
    monkeypatch.chdir(STDLIB)
    assert without_working_folder(["", "/opt/x", STDLIB]) == ["/opt/x", STDLIB]


def test_a_folder_that_was_deleted(tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert without_working_folder(["", "/opt/x"]) == ["/opt/x"]


def test_what_lies_in_the_working_folder_is_not_run(tmp_path):
    (tmp_path / "yaml.py").write_text("raise SystemExit('this is not the package')")
    (tmp_path / "car.yaml").write_text("actuator: {kind: recorder}")
    words = [sys.executable, "-m", "lanenet", "stop", "car.yaml"]
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:"}
    done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "recorder" in done.stdout, done.stderr
