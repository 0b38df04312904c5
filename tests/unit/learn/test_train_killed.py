from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from safetensors.numpy import load_file
from synthetic_labels import make_label_set

from lanenet.data.label_set import write_labels
from lanenet.geometry.birdseye import BirdseyeWindow

EPOCHS = 6
#: A training of the small network that says which epochs it has finished.
PROGRAM = f"""
import sys
from pathlib import Path
from lanenet.learn.config import LearnSettings
from lanenet.learn.train import train
train_path, val_path, out, told = map(Path, sys.argv[1:])
def tell(epoch, *_):
    with told.open("a") as file:
        file.write(f"{{epoch}}\\n")
train(LearnSettings(epochs={EPOCHS}, threads=1), [train_path], [val_path], out, tell)
"""


def start(folder: Path, out: Path) -> subprocess.Popen[bytes]:
    files = [folder / "train.parquet", folder / "val.parquet", out, out.with_suffix(".txt")]
    return subprocess.Popen([sys.executable, "-c", PROGRAM, *map(str, files)])


def finished_epochs(out: Path) -> list[int]:
    told = out.with_suffix(".txt")
    return [int(line) for line in told.read_text().splitlines()] if told.exists() else []


def kill_after_epoch(folder: Path, out: Path, epoch: int) -> None:
    """Train, and kill the process within the epoch that follows."""
    process = start(folder, out)
    try:
        end_s = time.monotonic() + 300.0
        while epoch not in finished_epochs(out):
            assert process.poll() is None and time.monotonic() < end_s, f"epoch {epoch} was not reached"
            time.sleep(0.01)
        time.sleep(0.1)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert process.returncode == -signal.SIGKILL and not (out / "model.onnx").exists()


def hash_weights(out: Path) -> str:
    """Hash of names, shapes and bytes; the file's own description of itself comes in any order."""
    total = hashlib.sha256()
    for name, value in sorted(load_file(out / "weights.safetensors").items()):
        total.update(f"{name} {tuple(value.shape)}".encode() + value.tobytes())
    return total.hexdigest()


@pytest.mark.slow
def test_a_run_that_is_killed_twice_ends_with_the_same_weights(tmp_path: Path) -> None:
    # 20 steps an epoch, so that the kill falls between two of them.
    for name, n, seed in (("train", 1280, 0), ("val", 60, 1)):
        write_labels(tmp_path / f"{name}.parquet", make_label_set(n, seed, window=BirdseyeWindow()))
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert start(tmp_path, whole).wait(timeout=600.0) == 0
    kill_after_epoch(tmp_path, killed, 2)
    kill_after_epoch(tmp_path, killed, 4)
    assert start(tmp_path, killed).wait(timeout=600.0) == 0
    # The state is written before an epoch is told, and what came after it is computed again.
    assert finished_epochs(whole) == finished_epochs(killed) == list(range(1, EPOCHS + 1))
    assert hash_weights(whole) == hash_weights(killed)
