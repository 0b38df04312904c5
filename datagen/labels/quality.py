"""How well the projected lines lie on the markings that each frame shows."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from lanenet.data.label_set import LabelSet
from lanenet.data.maps.frame_lines import FrameLines
from lanenet.geometry.lane import POINT_NAMES

REPORT_FORMAT = "lanenet-label-report/1"

_REACH_CM = 60.0


def frame_residual_cm(points_cm: Float[np.ndarray, "m 2"], lines: FrameLines, tape_cm: float) -> float:
    """Median distance between the marking's borders and where the projected line says they are.

    Args:
        points_cm: Edge points of the frame, frame car.
        lines: The frame's lane.
        tape_cm: Width of a marking whose own one is not known.

    Returns:
        [cm]; NaN where the frame shows fewer than ten edge points near the lines.
    """
    near = points_cm[points_cm[:, 1] <= _REACH_CM]
    distances = []
    for side, line in enumerate((lines.left_cm, lines.right_cm)):
        known = line[np.isfinite(line[:, 0])]
        if len(known) < 2 or not len(near):
            continue
        offset = np.abs(_distance_to_polyline(near, known))
        marking_cm = lines.marking_cm(side, tape_cm)
        distances.append(np.abs(offset[offset < 1.5 * marking_cm + 1.0] - 0.5 * marking_cm))
    found = np.concatenate(distances) if distances else np.empty(0)
    return float(np.median(found)) if found.size >= 10 else float("nan")


def _distance_to_polyline(
    points: Float[np.ndarray, "m 2"], line: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "m"]:
    start, step = line[:-1], np.diff(line, axis=0)
    step_x, step_y = step.T
    length2 = np.maximum(step_x * step_x + step_y * step_y, 1e-12)
    to_x, to_y = points[:, :1] - start[:, 0], points[:, 1:] - start[:, 1]
    t = np.clip((to_x * step_x + to_y * step_y) / length2, 0.0, 1.0)
    off_x, off_y = to_x - t * step_x, to_y - t * step_y
    return np.sqrt((off_x * off_x + off_y * off_y).min(axis=1))


def label_report(
    labels: LabelSet,
    residual_cm: Float[np.ndarray, "n"],
    mapped_frames: int,
    skipped: dict[str, int],
    point_shares: dict[str, float],
) -> dict[str, Any]:
    """Figures of a label set's quality, for ``report.json`` and the printed summary.

    Args:
        labels: The labels.
        residual_cm: What each frame's markings miss, see :func:`frame_residual_cm`.
        mapped_frames: Frames of the map.
        skipped: How many of them have no labels, and why.
        point_shares: See :func:`lanenet.data.maps.mapped_drive.labelled_points`.
    """
    known = np.isfinite(labels.points_cm)
    finite = residual_cm[np.isfinite(residual_cm)]

    def percentile(q: float) -> float:
        return float(np.percentile(finite, q)) if finite.size else float("nan")

    return {
        "format": REPORT_FORMAT,
        "frames_mapped": mapped_frames,
        "frames_labelled": len(labels),
        "labelled_share": len(labels) / max(mapped_frames, 1),
        "frames_left_out": skipped,
        "points_in_window_labelled_share": point_shares,
        "points_labelled_share": {
            name: float(known[:, i].sum()) / max(mapped_frames, 1) for i, name in enumerate(POINT_NAMES)
        },
        "residual_cm": {"median": percentile(50.0), "p95": percentile(95.0), "frames": int(finite.size)},
        "residual_of": "edge points within 60 cm, of frames that made the map, from the marking's borders",
    }
