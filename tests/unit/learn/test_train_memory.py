"""Training from shards of five times the memory that the process may have."""

from __future__ import annotations

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

#: What a stream may take, [MiB], and how much more the process is allowed than it has before it reads: the
#: stream and the network's own values.
MEMORY_MB, MORE_MB = 32, 160
#: Trains on the files, in as much memory as the settings say. All that is imported, compiled and started by a
#: small training before counts as the process itself; the limit is on what it may write to (``ulimit -d``).
PROGRAM = f"""
import resource, sys
from pathlib import Path
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.train import train
from lanenet.reading import MEBIBYTE
small, val, out, memory_mb, *paths = sys.argv[1:]
settings = LearnSettings(epochs=1, network=NetworkSettings(channels=(4, 8), hidden=16))
train(settings.model_copy(update={{"memory_mb": 8}}), [Path(small)], [Path(val)], Path(out, "small"))
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
limit = int(status["VmData"].split()[0]) * 1024 + {MORE_MB} * MEBIBYTE
resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
print("limited", flush=True)
settings = settings.model_copy(update={{"memory_mb": int(memory_mb)}})
train(settings, [Path(path) for path in paths], [Path(val)], Path(out, "large"))
"""


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A validation set, a small one, and a large one that other names stand for, too."""
    folder = tmp_path_factory.mktemp("shards")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(label_set, "GROUP_ROWS", 16)
        for name, n, times in (("val", 40, 1), ("small", 100, 2), ("large", 400, 8)):
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
    words = [folder / "small.parquet", folder / "val.parquet", out, memory_mb, *paths]
    # One heap for all threads, and Arrow's in it, so that what is set aside and not used counts little.
    plain = {"MALLOC_ARENA_MAX": "1", "ARROW_DEFAULT_MEMORY_POOL": "system", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *map(str, words)],
        capture_output=True,
        text=True,
        env=os.environ | plain,
        timeout=900.0,
        check=False,
    )
    assert done.stdout, done.stderr
    return done.returncode, done.stderr


@pytest.mark.slow
def test_five_times_the_memory_is_trained_on_and_is_too_much_to_be_read_at_once(
    shards: Path, tmp_path: Path
) -> None:
    unpacked = read_shards([shards / "large.parquet"]).unpacked_bytes
    n_files = -(-5 * MORE_MB * MEBIBYTE // unpacked)
    code, told = train_in_a_limit(shards, tmp_path / "streamed", MEMORY_MB, n_files)
    assert code == 0, told
    # More than all of them unpack to, so that they are read at once.
    code, told = train_in_a_limit(shards, tmp_path / "whole", 10_000, n_files)
    assert code != 0 and ("MemoryError" in told or "alloc" in told), told
    assert not (tmp_path / "whole" / "large").exists()
    assert (tmp_path / "streamed" / "large" / "metrics.json").is_file()
