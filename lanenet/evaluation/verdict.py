"""The verdict on a model in one sentence: how far it is off, where it is worst, and whether the map knows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lanenet.data.maps.folder import read_map
from lanenet.errors import MapFormatError
from lanenet.evaluation.comparison import Comparison, SeenSource
from lanenet.evaluation.report import find_worst
from lanenet.evaluation.tables import LARGE_CM, show_cm

#: A map is asked about this many frames before and after the worst one. Chosen: a second at 20 frames/s.
_NEAR_FRAMES = 20
#: Share of answered points below which, and share of large errors above which, nobody should drive with it.
#: Chosen: a car that knows its lane less than every other time, or errs once in two seconds.
_LEAST_ANSWERED, _MOST_LARGE = 0.5, 0.1


def verdict_sentence(comparison: Comparison, seen: Sequence[SeenSource], where: str) -> str:
    """Say how good the first detector of a comparison is.

    Args:
        comparison: The figures.
        seen: Its answers on the sources that have frames.
        where: On what it was measured, as "on the last lap, which it had not seen".
    """
    stats = comparison.tables[comparison.first].all
    if not stats.count:
        return f"not fit to drive with: {where} it answers none of the {stats.truth_count} points"
    errors = comparison.errors_cm[comparison.first]
    large = float((errors[np.isfinite(errors)] > LARGE_CM).mean())
    unfit = "not fit to drive with: " if stats.coverage < _LEAST_ANSWERED or large > _MOST_LARGE else ""
    said = (
        f"{unfit}{where} it lies {show_cm(stats.median_cm)} cm from the {comparison.reference} (median; "
        f"95 % of its answers within {show_cm(stats.p95_cm)} cm) and answers {100.0 * stats.coverage:.0f} % "
        "of the points"
    )
    if not large:
        return f"{said}; no answer is off by more than {LARGE_CM:g} cm"
    said = f"{said}; {100.0 * large:.2g} % of its answers are off by more than {LARGE_CM:g} cm"
    worst = find_worst([source.frames for source in seen], [source.answers_cm for source in seen], 1)
    if not worst:
        return said
    source = seen[worst[0].source].frames
    frame = int(source.frames[worst[0].row])
    of = f" of {Path(source.name).name}" if len(comparison.sources) > 1 else ""
    doubt = ", where the map itself is in doubt" if _doubted(source.name, frame) else ""
    return f"{said}, the worst near frame {frame}{of} by {show_cm(worst[0].error_cm)} cm{doubt}"


def _doubted(source: str, frame: int) -> bool:
    """Tell whether labels around a frame are doubted by the map that they come from."""
    if not (Path(source) / "map.yaml").is_file():
        return False
    try:
        drive_map = read_map(Path(source))
    except MapFormatError:  # its frames could be read; without its figures there is nothing to say
        return False
    near = np.abs(drive_map.frames - frame) <= _NEAR_FRAMES
    return bool(drive_map.errors.doubted[near].any())
