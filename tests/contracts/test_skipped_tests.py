"""A target whose tests were all skipped has tested nothing, and fails; so does one that may skip none."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PASSES, SKIPPED = "def test_one(): pass\n", "def test_two(shared_data): pass\n"
CONFTEST = Path(__file__).resolve().parents[1] / "conftest.py"


@pytest.mark.parametrize(
    ("tests", "options", "code"),
    [
        (SKIPPED, ["--fail-on-skips", "all"], 1),
        (PASSES + SKIPPED, ["--fail-on-skips", "all"], 0),
        # As in make test-data, where the first one is of all targets. By several processes, as there.
        (PASSES + SKIPPED, ["--fail-on-skips", "all", "--fail-on-skips", "any", "-n", "1"], 1),
    ],
)
def test_too_many_skips_fail_and_give_their_reasons(
    tmp_path: Path, tests: str, options: list[str], code: int
) -> None:
    shutil.copy(CONFTEST, tmp_path)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n  data: of real drives\n")
    (tmp_path / "test_it.py").write_text(tests)
    # Nothing there: a path that is named but is no folder is as good as none.
    support = os.pathsep.join([str(CONFTEST.parent / "support"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "LANENET_SHARED_DATA": str(tmp_path / "nowhere"), "PYTHONPATH": support}
    words = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", *options]
    ran = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == code, ran.stdout + ran.stderr
    assert "needs real drives: LANENET_SHARED_DATA has to name their folder" in ran.stdout
    assert ("tests were skipped" in ran.stdout) == (code == 1)
