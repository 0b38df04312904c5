"""What a second training process brings: ``python tests/bench/bench_processes.py LABELS...``.

Takes label sets, and a config for the rest (default ``configs/general.yaml``, whose window the sets need).
Trains a few epochs in one process and in several by turns, each in a program of its own, and prints as JSON
the samples per second of the median epoch but the first, the processor time of all epochs, and the load of
the machine beside it. Wall times mean something on an idle machine alone.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from lanenet.cli.train import run_settings_schema
from lanenet.config import load_settings
from lanenet.learn.train import train


def measure(config: Path, paths: list[Path], processes: int, epochs: int) -> dict[str, Any]:
    """Train in so many processes; the first set validates, too."""
    run_settings: Any = load_settings(run_settings_schema(), config)
    learn = run_settings.learn.model_copy(update={"processes": processes, "epochs": epochs})
    rates: list[float] = []
    before = os.getloadavg()[0]
    start_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        train(learn, paths, paths[:1], Path(folder) / "out", lambda *record: rates.append(record[-1]))
    wall_s = time.monotonic() - start_s
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return {
        "processes": processes,
        "samples_per_s": float(np.median(rates[1:])),
        "wall_s": wall_s,
        "cpu_s": sum(one.ru_utime + one.ru_stime for one in used),
        "load_before": before,
    }


def main() -> None:
    """Measure by turns, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("labels", type=Path, nargs="+")
    parser.add_argument("--config", type=Path, default=Path("configs/general.yaml"))
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--epochs", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--alone", action="store_true", help="Measure one number of processes, here.")
    told = parser.parse_args()
    if told.alone:
        found = measure(told.config, told.labels, told.processes[0], told.epochs)
        sys.stdout.write(json.dumps(found) + "\n")
        return
    for _ in range(told.rounds):
        for count in told.processes:
            words = ["--alone", "--processes", str(count), "--epochs", str(told.epochs)]
            command = [sys.executable, __file__, *map(str, told.labels), "--config", str(told.config), *words]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            sys.stdout.write(done.stdout)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
