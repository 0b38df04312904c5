"""The loop that runs detectors over frames."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from lanenet.data.drives.sources import Source
from lanenet.errors import CalibrationError, DriveFormatError
from lanenet.perception.estimate import Detector, LaneEstimate

if TYPE_CHECKING:
    from lanenet.data.maps.mapped_drive import LabelledFrames


@dataclass(frozen=True)
class SeenFrame:
    """One frame and what detectors say about it.

    Attributes:
        index: Its position.
        image: None if it cannot be read.
        problem: Why it cannot be read.
        estimates: By detector; empty estimates for a frame that cannot be read.
        seconds: What each detector took; none for a frame that cannot be read.
    """

    index: int
    image: UInt8[np.ndarray, "h w *c"] | None
    problem: str | None
    estimates: Mapping[str, LaneEstimate]
    seconds: Mapping[str, float]


def run_detectors(
    frames: Source | LabelledFrames, detectors: Mapping[str, Detector], *, skip_unreadable: bool = False
) -> Iterator[SeenFrame]:
    """Run detectors over frames in order; each image is read once.

    The detectors are reset at the first frame and wherever the source is interrupted.

    Args:
        frames: The source.
        detectors: By name.
        skip_unreadable: Yield a frame that cannot be read with empty estimates.

    Raises:
        DriveFormatError: If a frame cannot be read; names it.
        CalibrationError: If a frame does not fit the camera; names it.
    """
    for i in range(len(frames)):
        if i == 0 or frames.starts[i]:
            for detector in detectors.values():
                detector.reset()
        try:
            image = frames.image(i)
        except DriveFormatError as error:
            if not skip_unreadable:
                raise DriveFormatError(f"{frames.name}: {error}") from None
            yield SeenFrame(i, None, str(error), dict.fromkeys(detectors, LaneEstimate()), {})
            continue
        estimates, seconds = {}, {}
        for name, detector in detectors.items():
            start_s = time.perf_counter()
            try:
                estimates[name] = detector.detect(image)
            except CalibrationError as error:
                raise CalibrationError(f"{frames.name}, frame {frames.frames[i]}: {error}") from None
            seconds[name] = time.perf_counter() - start_s
        yield SeenFrame(i, image, None, estimates, seconds)
