"""Targets of the Makefile and stages of CI, with everything that takes long replaced."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A checkout without Git, below a folder that has nothing else."""
    for name in ("Makefile", ".ci/run"):
        (tmp_path / "copy" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPO / name, tmp_path / "copy" / name)
    return tmp_path / "copy"


def ran(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    # Not the options of a make that runs the tests.
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("MAKE", "LANENET_"))}
    return subprocess.run(
        words, cwd=folder, env=kept | environment, capture_output=True, text=True, check=False, timeout=60
    )


def made(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Make targets in an environment the programs of which do nothing."""
    stamps = [f"--old-file=.venv/.stamp-{name}" for name in ("dev", "train")]
    program = folder / ".venv" / "bin" / "python"
    program.parent.mkdir(parents=True, exist_ok=True)
    for path in (program, program.with_name("lanenet")):
        path.write_text("#!/bin/sh\nexit 0\n")
        path.chmod(0o755)
    return ran(folder, "make", *stamps, *words, **environment)


def test_cleaning_keeps_maps_and_labels(copy: Path) -> None:
    for name in ("runs/my_map/map.yaml", "build/a.o", "lanenet/a.py", "datagen/a.py", "tests/a.py"):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).touch()
    cleaned = made(copy, "clean")
    assert cleaned.returncode == 0, cleaned.stderr
    assert (copy / "runs" / "my_map" / "map.yaml").exists() and not (copy / "build").exists()


@pytest.mark.parametrize("target", ["test-data", "pictures", "left-out"])
def test_without_real_drives_what_needs_them_fails(copy: Path, target: str) -> None:
    for environment in ({}, {"LANENET_SHARED_DATA": "nowhere"}):
        found = made(copy, target, **environment)
        assert found.returncode == 2 and "needs real drives, but LANENET_SHARED_DATA" in found.stderr
    found = made(copy, target, LANENET_SHARED_DATA=str(copy))
    assert found.returncode == 0, found.stderr


def test_the_moving_picture_is_of_any_drive(copy: Path) -> None:
    found = made(copy, "pictures", "DRIVE=my_tub")
    assert found.returncode == 0 and "lanenet map my_tub" in found.stdout


def test_where_there_are_real_drives_the_golden_runs_skip_none(copy: Path) -> None:
    assert "--fail-on-skips any" not in made(copy, "golden").stdout
    assert "--fail-on-skips any" in made(copy, "golden", LANENET_SHARED_DATA=str(copy)).stdout


@pytest.mark.parametrize("place", ["nowhere", "named", "beside"])
def test_ci_tests_real_drives_where_there_are_any(copy: Path, place: str) -> None:
    drives = copy.parent / "shared" / "data"
    if place != "nowhere":
        drives.mkdir(parents=True)
    fake = copy.parent / "bin" / "make"
    fake.parent.mkdir()
    fake.write_text('#!/bin/sh\necho "make $* with ${LANENET_SHARED_DATA:-none}"\n')
    fake.chmod(0o755)
    named = {"LANENET_SHARED_DATA": str(drives)} if place == "named" else {}
    found = ran(copy, ".ci/run", PATH=f"{fake.parent}:{os.environ['PATH']}", **named)
    assert found.returncode == 0, found.stderr
    lines = found.stdout.splitlines()
    assert "make test with none" in lines
    if place == "nowhere":
        assert "make golden with none" in lines and not any("make test-data" in line for line in lines)
        assert any("tests-on-real-drives: left out" in line for line in lines)
    else:
        assert {f"make {target} with {drives}" for target in ("test-data", "golden")} <= set(lines)
