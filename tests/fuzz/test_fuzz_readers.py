"""Damaged and hostile files: every reader reads them or refuses them, and does nothing else.

A case is a seed and a number. One that fails is kept in `corpus/READER/SEED-NUMBER--FILE`, and read again by
every run. `LANENET_FUZZ_S=600 make test-slow` goes on for that many seconds, with cases that are new.
"""

from __future__ import annotations

import collections
import json
import os
import selectors
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).resolve().parent
CASES, SEED = 2000, 1
#: A case takes 20 ms. One that takes this long hangs.
HANG_S = 10.0
#: Loading the packages, and reading everything once.
START_S = 300.0
#: A file above this is not kept: its seed and number stand in the report.
KEPT_BYTES = 64 * 1024
FINE = ("read", "refused")


def cases(work: Path, *words: object) -> Iterator[dict[str, Any]]:
    """Run cases in a process of their own; one that hangs or ends the process is told as such."""
    command = [sys.executable, str(HERE / "worker.py"), str(work), *map(str, words)]
    environment = {**os.environ, "OPENCV_LOG_LEVEL": "SILENT", "PYTHONPATH": str(HERE.parents[1])}
    with (
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, env=environment
        ) as process,
        selectors.DefaultSelector() as ready,
    ):
        assert process.stdout is not None and process.stderr is not None
        for stream in (process.stdout, process.stderr):
            ready.register(stream, selectors.EVENT_READ)
        begun: dict[str, Any] | None = None
        said, errors = b"", b""
        since_s = time.monotonic()
        while ready.get_map():
            for key, _ in ready.select(1.0):
                data = os.read(key.fd, 65_536)
                if not data:
                    ready.unregister(key.fileobj)
                elif key.fileobj is process.stderr:
                    errors = (errors + data)[-3000:]
                else:
                    *lines, said = (said + data).split(b"\n")
                    for line in lines:
                        since_s = time.monotonic()
                        told = json.loads(line)
                        begun = told if "begin" in told else None
                        if begun is None:
                            yield told
            if time.monotonic() - since_s > (HANG_S if begun else START_S):
                process.kill()
                break
        hung = process.wait() == -9
        if begun is not None:
            found = "hang" if hung else "died"
            yield {
                **begun,
                "case": begun["begin"],
                "found": found,
                "why": errors.decode(errors="replace"),
                "s": HANG_S,
            }
        else:
            assert process.returncode == 0, errors.decode(errors="replace")


def keep(work: Path, case: dict[str, Any], seed: int) -> None:
    """Put the damaged file of a case that failed into the corpus."""
    path = work / "case" / case["file"].replace("+", "/")
    if path.is_file() and not path.is_symlink() and path.stat().st_size <= KEPT_BYTES:
        folder = HERE / "corpus" / case["reader"]
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, folder / f"{seed}-{case['case']}--{case['file']}")


@pytest.mark.slow
def test_damaged_files_are_read_or_refused_and_nothing_else(tmp_path: Path) -> None:
    seconds = float(os.environ.get("LANENET_FUZZ_S", "0"))
    end_s = time.monotonic() + seconds
    seed = SEED if seconds == 0.0 else int(time.time())
    counts: collections.Counter[str] = collections.Counter()
    failed, slowest_s, most_bytes = [], 0.0, 0
    for case in cases(tmp_path, "--corpus"):
        counts["of the corpus"] += 1
        if case["found"] not in FINE:
            failed.append(case)
    number = 0
    while number < CASES or time.monotonic() < end_s:
        # A process that died or hung is followed by another one, after the case that did it.
        for case in cases(tmp_path, seed, number, 500):
            number = case["case"] + 1
            counts[case["found"]] += 1
            slowest_s, most_bytes = max(slowest_s, case["s"]), max(most_bytes, case.get("bytes", 0))
            if case["found"] not in FINE:
                failed.append(case)
                keep(tmp_path, case, seed)
    worst = f"{slowest_s:.1f} s, {most_bytes / 2**20:.0f} MB at most"
    print(f"fuzz: seed {seed}, {number} cases: {dict(counts)}, {worst}")  # noqa: T201 (pytest -s shows it)
    assert not failed, "\n".join(json.dumps(case) for case in failed[:20])
    # Both happen, or the damage is none, or too much.
    assert min(counts[found] for found in FINE) > number / 20
