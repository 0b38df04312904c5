"""Trainings that several processes share: as by one, after a kill, and on more than fits into memory."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file
from synthetic_labels import make_label_set

from lanenet.data import label_set
from lanenet.data.label_set import write_labels
from lanenet.errors import ConfigError
from lanenet.learn.parallel import start_processes

EPOCHS = 4
#: Trains on three label sets, with settings as a dict; tells of each finished epoch. A shared training starts
#: programs anew, which must not train themselves.
PROGRAM = f"""
import sys
from pathlib import Path
from lanenet.errors import LanenetError
from lanenet.learn import parallel
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.learn.train import train

def main():
    folder, out = map(Path, sys.argv[1:3])
    settings = LearnSettings(
        epochs={EPOCHS}, batch_size=16, balance="drive", network=NetworkSettings(channels=(4, 8), hidden=16),
        **eval(sys.argv[3]),
    )
    paths = [folder / f"{{name}}.parquet" for name in "abc"]
    def tell(epoch, *_):
        with out.with_suffix(".txt").open("a") as file:
            file.write(f"{{epoch}}\\n")
    try:
        if parallel.follows():
            parallel.follow()
        else:
            train(settings, paths, [folder / "val.parquet"], out, tell)
    except LanenetError as error:
        sys.exit(f"error: {{error}}")

if __name__ == "__main__":
    main()
"""
#: Two hundred steps and more: 820 samples in batches of 16, of which the last one has 4.
SIZES = {"a": 400, "b": 220, "c": 200, "val": 40}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("labels")
    (folder / "program.py").write_text(PROGRAM)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(label_set, "GROUP_ROWS", 32)
        for seed, (name, n) in enumerate(SIZES.items()):
            labels = make_label_set(n, seed)
            # Unknown labels, which are not as many in each part of a batch.
            labels.points_cm[np.random.default_rng(seed).random(labels.points_cm.shape) < 0.2] = np.nan
            write_labels(folder / f"{name}.parquet", labels)
    return folder


@pytest.fixture(scope="module")
def by_one(data: Path) -> Path:
    return finish(data, data / "one")


@pytest.fixture(scope="module")
def by_two(data: Path) -> Path:
    return finish(data, data / "two", processes=2)


def start(data: Path, out: Path, *launcher: str, **settings: object) -> subprocess.Popen[str]:
    program = [sys.executable, *launcher, str(data / "program.py"), str(data), str(out), repr(settings)]
    return subprocess.Popen(program, stderr=subprocess.PIPE, text=True)


def finish(data: Path, out: Path, *launcher: str, **settings: object) -> Path:
    process = start(data, out, *launcher, **settings)
    _, told = process.communicate(timeout=600.0)
    assert process.returncode == 0, told
    return out


def torchrun(*options: str) -> list[str]:
    return ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", *options]


def finished_epochs(out: Path) -> list[int]:
    told = out.with_suffix(".txt")
    return [int(line) for line in told.read_text().splitlines()] if told.exists() else []


def await_epoch(process: subprocess.Popen[str], out: Path, epoch: int) -> None:
    end_s = time.monotonic() + 300.0
    while epoch not in finished_epochs(out):
        assert process.poll() is None and time.monotonic() < end_s, f"epoch {epoch} was not reached"
        time.sleep(0.005)


def children(pid: int) -> list[int]:
    """Processes that a process has started to share its training."""
    found = [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return [
        child for child in found if b"resource_tracker" not in Path(f"/proc/{child}/cmdline").read_bytes()
    ]


def weights(out: Path) -> dict[str, np.ndarray]:
    return load_file(out / "weights.safetensors")


def furthest(one: Path, other: Path) -> float:
    """Largest difference of two networks' weights."""
    a, b = weights(one), weights(other)
    assert a.keys() == b.keys()
    return max(float(np.abs(a[name].astype(np.float64) - b[name]).max()) for name in a)


def same_bits(one: Path, other: Path) -> bool:
    a, b = weights(one), weights(other)
    return a.keys() == b.keys() and all(a[name].tobytes() == b[name].tobytes() for name in a)


@pytest.mark.slow
def test_two_processes_train_as_one(by_one: Path, by_two: Path) -> None:
    assert finished_epochs(by_one) == finished_epochs(by_two) == list(range(1, EPOCHS + 1))
    moved = max(float(np.abs(value).max()) for value in weights(by_one).values())
    assert moved > 0.1 and furthest(by_one, by_two) < 1e-5


@pytest.mark.slow
def test_five_processes_train_as_one_from_shards(data: Path) -> None:
    # More than the last batch has samples.
    one, five = (finish(data, data / f"stream{n}", memory_mb=2, processes=n) for n in (1, 5))
    assert furthest(one, five) < 1e-5


@pytest.mark.slow
def test_a_process_that_is_killed_is_named_and_the_run_goes_on_exactly(data: Path, by_two: Path) -> None:
    out = data / "killed"
    process = start(data, out, processes=2)
    await_epoch(process, out, 2)
    (other,) = children(process.pid)
    os.kill(other, signal.SIGKILL)
    _, told = process.communicate(timeout=60.0)
    assert process.returncode == 1 and told.count("error:") == 1 and "Traceback" not in told
    assert re.search(r"process 2 of 2 of the training was killed \(signal 9\).*run the command again", told)
    assert not (out / "model.onnx").exists() and not [p for p in out.iterdir() if ".tmp" in p.name]
    before = finished_epochs(out)
    assert before[-1] < EPOCHS
    finish(data, out, processes=2)
    assert finished_epochs(out) == list(range(1, EPOCHS + 1)) and same_bits(out, by_two)


@pytest.mark.slow
def test_no_process_outlives_the_first_one(data: Path, by_two: Path) -> None:
    out = data / "first_killed"
    process = start(data, out, processes=2)
    await_epoch(process, out, 1)
    (other,) = children(process.pid)
    process.kill()
    process.communicate(timeout=60.0)
    end_s = time.monotonic() + 30.0
    while Path(f"/proc/{other}").exists():
        assert time.monotonic() < end_s, "the other process goes on"
        time.sleep(0.05)
    finish(data, out, processes=2)
    assert finished_epochs(out) == list(range(1, EPOCHS + 1)) and same_bits(out, by_two)


@pytest.mark.slow
def test_torchrun_starts_a_killed_process_again(data: Path, by_two: Path) -> None:
    out = data / "torchrun"
    process = start(data, out, *torchrun("--max-restarts", "1"))
    await_epoch(process, out, 2)
    os.kill(children(process.pid)[1], signal.SIGKILL)
    _, told = process.communicate(timeout=300.0)
    assert process.returncode == 0, told
    assert finished_epochs(out) == list(range(1, EPOCHS + 1)) and same_bits(out, by_two)
    # The others are not left to wait where there is nothing to do.
    finish(data, out, *torchrun())
    assert finished_epochs(out) == list(range(1, EPOCHS + 1))


def test_a_process_needs_a_gpu_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    message = r"learn.processes: 2, but PyTorch finds 1 GPU; expected one each"
    with pytest.raises(ConfigError, match=message), start_processes(2, True, print, None):
        pass
