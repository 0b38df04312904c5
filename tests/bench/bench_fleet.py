"""Throughput of ``label-all`` with two workers against one, what Ray takes of it, and what a drive costs.

    python tests/bench/bench_fleet.py --folder runs/fleet --drives 4

Where others load the machine, wall time says little. Processor time says more: it is what a drive takes of a
core, and what two workers lose to each other; what a worker waits for between two drives is Ray's.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import statistics
import sys
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from datagen.fleet.checksums import with_checksums
from datagen.fleet.engine import Ended, Engine, Task
from datagen.fleet.local_engine import LocalEngine
from datagen.fleet.ray_engine import RayEngine
from datagen.fleet.run import label_all
from datagen.fleet.storage import RESULT_NAME, Storage
from datagen.fleet.task import LABELS, MAPS, FleetDrive, FleetSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings

_LANE_CM, _RATE_HZ = 40.0, 20.0
_CAMERA = {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0}


@dataclass(frozen=True)
class Span:
    """When a worker worked on a drive, and the processor time that it took, [s]."""

    worker: int
    begun_s: float
    ended_s: float
    cpu_s: float


@dataclass(frozen=True)
class Measured:
    """A run: its wall time, and by drive processor time and what its worker waited before it, [s]."""

    engine: str
    workers: int
    drives: int
    wall_s: float
    working_s: float
    cpu_s_per_drive: float
    wait_s_per_drive: float

    @property
    def drives_per_hour(self) -> float:
        """Over the time from the first drive's beginning to the last one's end."""
        return 3600.0 * self.drives / self.working_s


def timed(work: Callable[[Any], Any], task_input: Any) -> tuple[Any, Span]:
    """Do the work; returns its result and when that was."""
    begun_s, cpu_s = time.time(), time.process_time()
    result = work(task_input)
    return result, Span(os.getpid(), begun_s, time.time(), time.process_time() - cpu_s)


@dataclass(frozen=True)
class Timed:
    """An engine that notes when each task was worked on."""

    engine: Engine
    spans: list[Span]

    def run(self, work: Callable[[Any], Any], tasks: Sequence[Task]) -> Generator[Ended, None, None]:
        """Run the tasks; see :class:`datagen.fleet.engine.Engine`."""
        for ended in self.engine.run(partial(timed, work), tasks):
            if ended.error:
                raise SystemExit(f"{tasks[ended.number].name}: {ended.error}")
            result, span = ended.result
            self.spans.append(span)
            yield replace(ended, result=result)


def simulate(folder: Path, drives: int, seconds: float) -> list[FleetDrive]:
    """Simulate drives on a closed road each, as far as that is not done."""
    made = []
    for seed in range(drives):
        path = folder / "drives" / f"{seconds:g}s-{seed}"
        if not path.exists():
            settings = {"seed": seed, "frames": round(_RATE_HZ * seconds), "camera": _CAMERA}
            simulate_drive(SimulationSettings.model_validate(settings), path)
        made.append(FleetDrive(path.name, str(path), "", _LANE_CM))
    return made


def measure(name: str, workers: int, drives: list[FleetDrive], out: Path, pictures: bool) -> Measured:
    """Label the drives anew and take the times."""
    if out.exists():
        shutil.rmtree(out)
    storage = Storage(str(out))
    engine: Engine = LocalEngine(workers) if name == "local" else RayEngine(workers=workers)
    noted = Timed(engine, [])
    checked = with_checksums(drives, storage)
    begun_s = time.time()
    label_all(checked, FleetSettings(pictures=pictures), storage, noted)
    wall_s, spans = time.time() - begun_s, sorted(noted.spans, key=lambda span: span.begun_s)
    waits = []
    for worker in {span.worker for span in spans}:
        own = [span for span in spans if span.worker == worker]
        waits += [after.begun_s - before.ended_s for before, after in pairwise(own)]
    return Measured(
        name,
        workers,
        len(drives),
        wall_s,
        max(span.ended_s for span in spans) - spans[0].begun_s,
        statistics.fmean(span.cpu_s for span in spans),
        statistics.fmean(waits) if waits else math.nan,
    )


def costs(out: Path, drives: list[FleetDrive]) -> dict[str, float]:
    """Return what a drive costs, by what the results say of themselves: the mean, of memory the most."""
    files = [file for drive in drives for file in Path(drive.source).rglob("*") if file.is_file()]
    found = {"drive_mb": sum(file.stat().st_size for file in files) / len(drives) / 1e6}
    peak_bytes = 0
    for kind in (MAPS, LABELS):
        markers = [json.loads(path.read_text()) for path in out.glob(f"{kind}/*/{RESULT_NAME}")]
        found[f"{kind}_mb"] = statistics.fmean(marker["bytes"] for marker in markers) / 1e6
        found[f"{kind}_cpu_s"] = statistics.fmean(marker["took"]["cpu_s"] for marker in markers)
        peak_bytes = max(peak_bytes, *(marker["took"]["peak_bytes"] for marker in markers))
    return {**found, "peak_mb": peak_bytes / 1e6}


def compared(one: Measured, two: Measured) -> dict[str, float]:
    """Return how much two workers do against one, and what of a drive's time one waits between drives."""
    return {
        "throughput_of_two": two.drives_per_hour / one.drives_per_hour,
        "throughput_of_two_by_processor_time": 2.0 * one.cpu_s_per_drive / two.cpu_s_per_drive,
        "waiting_share": one.wait_s_per_drive / (one.cpu_s_per_drive + one.wait_s_per_drive),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, default=Path("runs/fleet"))
    parser.add_argument("--drives", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--engines", nargs="+", default=["local", "ray"])
    parser.add_argument("--pictures", action="store_true")
    args = parser.parse_args()
    # Else 15: where others load the machine, its workers get less of a core than plain processes.
    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112
    drives = simulate(args.folder, args.drives, args.seconds)
    # Compiles the loops, if they are not.
    measure("local", 1, simulate(args.folder, 1, 4.0), args.folder / "warm", args.pictures)
    runs = [
        measure(name, workers, drives, args.folder / f"{name}-{workers}", args.pictures)
        for name in args.engines
        for workers in (1, 2)
    ]
    report: dict[str, Any] = {
        "machine": {"cores": os.cpu_count(), "load": os.getloadavg()},
        "drive": {"seconds": args.seconds, **costs(args.folder / f"{args.engines[-1]}-1", drives)},
        "runs": [asdict(run) for run in runs],
    }
    report |= {one.engine: compared(one, two) for one, two in zip(runs[::2], runs[1::2], strict=True)}
    text = json.dumps(report, indent=2) + "\n"
    (args.folder / "bench.json").write_text(text, encoding="utf-8")
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
