"""A picture of the frames that a detector got most wrong: its lane beside the one that is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.data.labelled_frames import LabelledFrames
from lanenet.errors import LabelFormatError
from lanenet.perception.draw import LEFT_BGR, RIGHT_BGR, TRUTH_BGR, draw_estimate
from lanenet.perception.estimate import LaneEstimate

_TILE_WIDTH_PX = 400
_COLUMNS = 4
_LEGEND_PX = 24
#: Neighbours look alike: of frames this close only the worst is shown.
_APART_FRAMES = 15
_JPEG_QUALITY = 88


@dataclass(frozen=True)
class WorstFrame:
    """A frame and how wrong the answer is.

    Attributes:
        source: Position of its source.
        row: Position of the frame in its source.
        error_cm: Largest error of its answered points.
    """

    source: int
    row: int
    error_cm: float


def find_worst(
    sources: Sequence[LabelledFrames], answers_cm: Sequence[Float[np.ndarray, "_ 6"]], count: int = 12
) -> list[WorstFrame]:
    """Return the frames with the largest errors, the worst first, no two of them neighbours.

    Args:
        sources: Frames and labels.
        answers_cm: A detector's six points for each frame of each source; NaN where it has no answer.
        count: How many, at most.
    """
    candidates = []
    for k, (source, answer) in enumerate(zip(sources, answers_cm, strict=True)):
        if answer.shape != source.points_cm.shape:
            raise LabelFormatError(
                f"{source.name}: answers of shape {answer.shape}, expected {source.points_cm.shape}"
            )
        error = np.nan_to_num(np.abs(answer - source.points_cm), nan=-1.0).max(axis=1)
        candidates += [WorstFrame(k, int(i), float(error[i])) for i in np.flatnonzero(error >= 0.0)]
    candidates.sort(key=lambda frame: -frame.error_cm)
    chosen: list[WorstFrame] = []
    for frame in candidates:
        near = (f for f in chosen if f.source == frame.source and abs(f.row - frame.row) < _APART_FRAMES)
        if len(chosen) < count and not any(near):
            chosen.append(frame)
    return chosen


def draw_worst(
    sources: Sequence[LabelledFrames],
    answers_cm: Sequence[Float[np.ndarray, "_ 6"]],
    worst: Sequence[WorstFrame],
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw frames side by side, and below them what the colours mean.

    The labels are magenta, the answer is green (left) and orange (right).

    Args:
        sources: As for :func:`find_worst`.
        answers_cm: As for :func:`find_worst`.
        worst: At least one frame.

    Raises:
        DriveFormatError: If a frame cannot be read.
    """
    tiles: list[UInt8[np.ndarray, "h w 3"]] = []
    for item in worst:
        source = sources[item.source]
        answer = answers_cm[item.source][item.row]
        picture = draw_estimate(
            source.image(item.row),
            LaneEstimate(points_cm=answer),
            source.camera,
            max(1, round(_TILE_WIDTH_PX / source.camera.width)),
            f"{Path(source.name).name} {source.frames[item.row]}: {item.error_cm:.1f} cm",
            truth_cm=source.points_cm[item.row],
        )
        if tiles and picture.shape != tiles[0].shape:
            # Cameras of different sources may differ in size.
            height, width = tiles[0].shape[:2]
            picture = np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))
        tiles.append(picture)
    columns = min(_COLUMNS, len(tiles))
    while len(tiles) % columns:
        tiles.append(np.zeros_like(tiles[0]))
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    return np.vstack([*rows, _legend(rows[0].shape[1])])


def _legend(width_px: int) -> UInt8[np.ndarray, "h w 3"]:
    strip = np.zeros((_LEGEND_PX, width_px, 3), dtype=np.uint8)
    x = y = _LEGEND_PX // 3
    for text, colour in (("labels", TRUTH_BGR), ("answer: left", LEFT_BGR), ("right", RIGHT_BGR)):
        font, size = cv2.FONT_HERSHEY_SIMPLEX, _LEGEND_PX / 50.0
        cv2.putText(strip, text, (x, _LEGEND_PX - y), font, size, colour, 1, cv2.LINE_AA)
        x += cv2.getTextSize(text, font, size, 1)[0][0] + _LEGEND_PX // 2
    return strip


def jpeg_bytes(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Encode a picture as JPEG: a sheet of photographs is a tenth of its size as PNG."""
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return bytes(data.tobytes())
