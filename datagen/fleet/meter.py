"""What a piece of work took: time, processor time and memory of this process."""

from __future__ import annotations

import resource
import sys
import time
from contextlib import suppress
from pathlib import Path

_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
#: Written to ``clear_refs``, resets the peak (``proc(5)``).
_RESET_PEAK = "5"


class Meter:
    """Measures from its making on."""

    def __init__(self) -> None:
        with suppress(OSError):  # not Linux, or not allowed: the peak is then that of the whole process
            _CLEAR.write_text(_RESET_PEAK, encoding="ascii")
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def taken(self) -> dict[str, float]:
        """Return the figures so far."""
        return {
            "wall_s": round(time.perf_counter() - self._wall_s, 3),
            "cpu_s": round(time.process_time() - self._cpu_s, 3),
            "peak_bytes": peak_bytes(),
        }


def peak_bytes() -> int:
    """Return the most memory that this process has had in RAM since the last reset."""
    try:
        lines = _STATUS.read_text(encoding="utf-8").splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        # In bytes on a Mac, else in KiB.
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
