"""Training from shards of five times the memory that the process is given."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_labels import make_label_set

from lanenet.data import label_set
from lanenet.data.label_set import write_labels
from lanenet.reading import MEBIBYTE
from lanenet.samples.shards import read_shards

#: What the process is given, [MiB]: all that it may write to (``ulimit -d``), from its start on, with what
#: torch and the compiled loops need. Measured: with 1150 it fails, with 1200 it trains, and 890 are taken
#: once everything is imported. Its address space is no measure: most of torch's 3.6 GB is never touched.
LIMIT_MB = 1250
#: What a stream may take, [MiB], and how many times the limit the shards unpack to. Counted as their footers
#: say, which is their size before it is packed; the files themselves are 8 % smaller.
MEMORY_MB, TIMES = 16, 5
#: Trains on the files, in as much memory as the settings say. Frames stay as they are: changing them takes
#: longer and no memory.
PROGRAM = """
import sys
from pathlib import Path
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.train import train
from lanenet.samples.settings import AugmentSettings
val, out, memory_mb, *paths = sys.argv[1:]
print("imported", flush=True)
settings = LearnSettings(
    epochs=1,
    memory_mb=int(memory_mb),
    network=NetworkSettings(channels=(4, 8), hidden=16),
    augment=AugmentSettings(preset="none"),
)
train(settings, [Path(path) for path in paths], [Path(val)], Path(out))
"""


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A validation set, and a large one that other names stand for, too, so that the disk holds them."""
    folder = tmp_path_factory.mktemp("shards")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(label_set, "GROUP_ROWS", 16)
        for name, n, times in (("val", 40, 1), ("large", 400, 8)):
            labels, rng = make_label_set(n, n), np.random.default_rng(n)
            # As many edge points as frames full of clutter have, and as real ones, which no encoding makes
            # smaller.
            many = [np.tile(edge, (times, 1)) for edge in labels.edges]
            edges = [edge + 1e-3 * rng.standard_normal(edge.shape) for edge in many]
            write_labels(folder / f"{name}.parquet", replace(labels, edges=edges))
    return folder


def train_in_a_limit(folder: Path, out: Path, memory_mb: int, n_files: int) -> tuple[int, str]:
    """Train in a process of its own; returns its code and its last words."""
    paths = []
    for k in range(n_files):
        paths.append(folder / f"large{k}.parquet")
        if not paths[-1].exists():
            os.link(folder / "large.parquet", paths[-1])
    words = [folder / "val.parquet", out, memory_mb, *paths]
    limited = f'ulimit -d {LIMIT_MB * 1024}; exec "$0" "$@"'
    # One heap for all threads, and Arrow's in it, so that what is set aside and not used counts little.
    plain = {"MALLOC_ARENA_MAX": "1", "ARROW_DEFAULT_MEMORY_POOL": "system", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        ["sh", "-c", limited, sys.executable, "-c", PROGRAM, *map(str, words)],
        capture_output=True,
        text=True,
        env=os.environ | plain,
        timeout=1800.0,
        check=False,
    )
    assert "imported" in done.stdout, done.stderr
    return done.returncode, done.stderr


@pytest.mark.slow
def test_five_times_the_memory_is_trained_on_and_is_too_much_to_be_read_at_once(
    shards: Path, tmp_path: Path
) -> None:
    index = read_shards([shards / "large.parquet"])
    n_files = -(-TIMES * LIMIT_MB * MEBIBYTE // index.unpacked_bytes)
    code, told = train_in_a_limit(shards, tmp_path / "streamed", MEMORY_MB, n_files)
    assert code == 0, told
    metrics = json.loads((tmp_path / "streamed" / "metrics.json").read_text())
    assert metrics["train_frames"] == 400 * n_files
    # More than all of them unpack to, so that they are read at once.
    code, told = train_in_a_limit(shards, tmp_path / "whole", 100_000, n_files)
    assert code != 0 and ("MemoryError" in told or "alloc" in told), told
    assert not (tmp_path / "whole" / "metrics.json").exists()
