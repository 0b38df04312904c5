"""What may find lines in a drive that has no good map: the command lines, ready to be copied."""

from __future__ import annotations

import shlex
from pathlib import Path

#: The network that is shipped, seen from the project's root as in the documents.
_SHIPPED = Path("checkpoints") / "general"


def commands_without_map(drive: Path, out: Path, lane_width_cm: float | None) -> list[tuple[str, str]]:
    """Name the detectors that need no good map, and the command line of each.

    Args:
        drive: The recording.
        out: The folder that the map is, or was to be, in: the results are named after it.
        lane_width_cm: Width of the lane, for the shipped network, which looks through the camera of a
            rejected map; None where there is no map, and thus no camera.
    """

    def detect(name: str, *words: str) -> str:
        beside = out.with_name(f"{out.name}-{name}.csv")
        outs = ("--out", str(beside), "--video", str(beside.with_suffix(".mp4")))
        return shlex.join(["lanenet", "detect", str(drive), *words, *outs])

    found = [("to try without a map or a camera", detect("hough", "--detector", "hough"))]
    if lane_width_cm is not None:
        words = ("--model", str(_SHIPPED), "--camera", str(out), "--lane-width", f"{lane_width_cm:g}")
        through = "to try with the shipped network, through this map's camera, doubtful as the map is"
        found.append((through, detect("network", *words)))
    return found


def hints_without_map(drive: Path, out: Path, lane_width_cm: float | None) -> list[str]:
    """Return :func:`commands_without_map` as lines below an error."""
    return [f"{what}: {line}" for what, line in commands_without_map(drive, out, lane_width_cm)]
