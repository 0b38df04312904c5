"""Long run of the drive loop: ``python tests/bench/bench_drive.py DRIVE MODEL [--minutes 30]``.

Replays a drive in rounds at 30 frames per second, as a camera would give them, through the detector, the
controller, the limits and the guard's process with an actuator that only notes. Prints JSON: memory of the
loop's process after the first minute and at the end, and the deadlines missed. A deadline is missed by a
frame that nobody read because the loop was late, and by a command that came after the next frame was due.
The time that the system let the loop wait for a core counts as well: with other work on the machine, look
at ``late_by_cpu``, which leaves it out.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import sys
import time
from pathlib import Path

import cv2

from lanenet.onboard.drive import DriveSettings, build_loop
from lanenet.onboard.loop import LatencyHistogram, Step

RATE_HZ = 30.0


def memory_mb() -> float:
    """Memory that this process holds just now (resident, without what it shares with files)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) / 1024.0
    raise RuntimeError("no RssAnon in /proc/self/status: this needs Linux")


class Watch:
    """Samples memory once per second, and the CPU time of every turn."""

    def __init__(self) -> None:
        self.begin_s = self.sampled_s = time.monotonic()
        self.memory: list[tuple[float, float]] = []
        # The first turn comes after the start of the guard, which is no turn's work.
        self.cpu_s = math.inf
        self.late_by_cpu = 0

    def __call__(self, step: Step) -> None:
        cpu_s, now_s = time.thread_time(), time.monotonic()
        self.late_by_cpu += cpu_s - self.cpu_s > 1.0 / RATE_HZ
        if now_s - self.sampled_s >= 1.0:
            self.sampled_s = now_s
            self.memory.append((now_s - self.begin_s, memory_mb()))
        self.cpu_s = time.thread_time()

    def memory_at(self, t_s: float) -> float:
        return next((mb for at_s, mb in self.memory if at_s >= t_s), self.memory[-1][1])


def _percentiles_ms(times: LatencyHistogram) -> dict[str, float]:
    return {"median": times.percentile_ms(50.0), "p99": times.percentile_ms(99.0)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=Path, help="drive folder with its camera")
    parser.add_argument("model", type=Path)
    parser.add_argument("--minutes", type=float, default=30.0)
    arguments = parser.parse_args()
    settings = DriveSettings.model_validate(
        {
            "source": {"kind": "replay", "path": arguments.drive, "rate_hz": RATE_HZ, "loop": True},
            "camera": arguments.drive / "camera.yaml",
            "detector": {"model": arguments.model, "any_camera": True},
            "control": {"steering": {"wheelbase_cm": 26.0}},
            # The replay begins again and again, and no run ends for a fault.
            "safety": {"countdown_s": 0.0, "end_after_s": 1e9},
            "actuator": {"kind": "recorder"},
        }
    )
    watch = Watch()
    loop = build_loop(settings, arm=True, watch=watch)
    frames = round(60.0 * RATE_HZ * arguments.minutes)
    report = loop.run(frames)
    settled_s = min(60.0, 0.5 * report.seconds)
    late = report.work.above(1.0 / RATE_HZ)
    missed = report.skipped + late
    result = {
        "minutes": report.seconds / 60.0,
        "frames": report.frames,
        "rate_hz": report.rate_hz,
        "memory_settled_mb": watch.memory_at(settled_s),
        "memory_end_mb": watch.memory[-1][1],
        "memory_growth_mb": watch.memory[-1][1] - watch.memory_at(settled_s),
        "settled_after_s": settled_s,
        "frames_not_read": report.skipped,
        "commands_late": late,
        "missed_share": missed / (report.frames + report.skipped),
        "late_by_cpu": watch.late_by_cpu,
        "work_ms": _percentiles_ms(report.work),
        "frame_to_command_ms": _percentiles_ms(report.latency),
        "states": {str(state): count for state, count in report.states.items()},
        "machine": {
            "platform": platform.platform(),
            "cores": os.cpu_count(),
            "load": os.getloadavg()[0],
            "opencv": cv2.__version__,
        },
    }
    json.dump(result, sys.stdout, indent=2)
    sys.stdout.write("\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
