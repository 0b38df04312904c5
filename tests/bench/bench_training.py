"""What a training step costs, and the loader's share: ``python tests/bench/bench_training.py LABELS...``.

Takes label sets, such as ``runs/small/synthetic/labels/train_*.parquet``, and a config for the rest (default
``configs/small.yaml``). Each batch is first made by the loader alone, then learned from, in one thread: the
processor time of each, median and 99th percentile, the loader's share of a step (both together are what a
training costs where the loader has no core of its own), and the samples per second. Prints JSON.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lanenet.cli.train import run_settings_schema
from lanenet.config import load_settings
from lanenet.data.label_set import read_labels
from lanenet.errors import LanenetError
from lanenet.learn.config import LearnSettings
from lanenet.learn.train import TrainingRun
from lanenet.samples.dataset import LaneSamples

_WARM_UP = 10


def measure(config: Path, paths: list[Path], steps: int) -> dict[str, Any]:
    """Time the loader and the steps of a training, [ms] of processor time."""
    run_settings: Any = load_settings(run_settings_schema(), config)
    settings: LearnSettings = run_settings.learn
    samples = LaneSamples([read_labels(path) for path in paths], [str(path) for path in paths])
    torch.set_num_threads(1)
    run = TrainingRun(settings, samples)
    run.network.train()
    order, streams = samples.order(settings.seed, 0, settings.balance)
    rng = np.random.default_rng(settings.seed)
    loader_ms, step_ms = [], []
    for number in range(steps + _WARM_UP):
        rows = rng.integers(len(order), size=settings.batch_size)
        start = time.process_time()
        batch = samples.augmented_batch(order[rows], settings.augment, settings.seed, 0, streams[rows])
        made = time.process_time()
        run.learn_from(batch, settings.learning_rate)
        if number >= _WARM_UP:
            loader_ms.append(1e3 * (made - start))
            step_ms.append(1e3 * (time.process_time() - made))
    both = np.add(loader_ms, step_ms)
    return {
        "config": str(config),
        "batch_size": settings.batch_size,
        "steps": steps,
        "loader_ms": {"median": float(np.median(loader_ms)), "p99": float(np.quantile(loader_ms, 0.99))},
        "step_ms": {"median": float(np.median(step_ms)), "p99": float(np.quantile(step_ms, 0.99))},
        "loader_share": float(np.sum(loader_ms) / np.sum(both)),
        "samples_per_cpu_s": float(1e3 * settings.batch_size * steps / np.sum(both)),
    }


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("labels", nargs="+", type=Path)
    parser.add_argument("--config", type=Path, default=Path("configs/small.yaml"))
    parser.add_argument("--steps", type=int, default=200)
    given = parser.parse_args()
    try:
        sys.stdout.write(json.dumps(measure(given.config, given.labels, given.steps), indent=1) + "\n")
    except LanenetError as error:
        sys.stderr.write(f"error: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
