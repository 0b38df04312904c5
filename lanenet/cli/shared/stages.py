"""The stages of a long command by name, with how long each took, on the screen and in a log file."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from lanenet.cli.shared import console

_STAGE = re.compile(r"\[\d+/\d+\] (\w+)(:|$)")
_FINISHED = "all stages are done"
#: What went before tells how fast the computer is if it was expected to take this long. Chosen.
_TELLING_S = 20.0


class Stages:
    """The stages of a run, each with the seconds that it is expected to take; 0 where that is not known.

    What is left is the sum of what is expected, times how much longer than expected the run took so far.
    """

    def __init__(self, expected_s: Mapping[str, float]) -> None:
        self._expected_s = dict(expected_s)
        self._begun_s = time.monotonic()

    @contextmanager
    def begin(self, name: str) -> Iterator[None]:
        """Announce a stage with what is left of the run, and say at its end how long it took."""
        names, expected = list(self._expected_s), list(self._expected_s.values())
        number = names.index(name)
        begun_s, before_s, left_s = time.monotonic(), sum(expected[:number]), sum(expected[number:])
        slower = (begun_s - self._begun_s) / before_s if before_s >= _TELLING_S else 1.0
        left = f": about {console.duration(slower * left_s)} left in all" if left_s else ""
        console.say(f"[{number + 1}/{len(names)}] {name}{left}")
        yield
        console.say(f"  {name} took {console.duration(time.monotonic() - begun_s)}")

    def finish(self) -> None:
        """Say how long all of it took."""
        console.say(f"{_FINISHED}: {console.duration(time.monotonic() - self._begun_s)}")


def stopped_in(log: Path) -> str | None:
    """Return the stage in which the last run of a log file stopped; None if it finished or there is none."""
    try:
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    for line in reversed(lines):
        if _FINISHED in line:
            return None
        if found := _STAGE.search(line):
            return found[1]
    return None
