"""The error analysis as a picture: pixels per ground cell, seen from above."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import UInt8

from lanenet.perception.error_analysis import ErrorAnalysis

_CELL_PX = 36
_FOOT_PX = 66
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_DARK_BGR, _LINE_BGR, _MISSING_BGR = (30, 30, 30), (40, 40, 220), (225, 225, 225)


def draw_analysis(analysis: ErrorAnalysis) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the density of each cell as figure 7 of Kozlowski et al. 2024 does.

    The car's front axle is at the middle of the lower edge of the grid. The points L, A and R at the
    look-ahead are marked; cells that no pixel sees are gray.

    Args:
        analysis: What :func:`lanenet.perception.error_analysis.analyse_errors` found.

    Returns:
        The picture.
    """
    pixels = analysis.pixels[::-1]  # The far edge on top.
    rows, columns = pixels.shape
    most = math.log1p(float(pixels.max()))
    shade = (55.0 + 200.0 * np.log1p(pixels) / most).astype(np.uint8)
    colours = cv2.applyColorMap(shade, cv2.COLORMAP_VIRIDIS)
    colours[pixels == 0] = _MISSING_BGR
    grid = cv2.resize(colours, (columns * _CELL_PX, rows * _CELL_PX), interpolation=cv2.INTER_NEAREST)
    picture = np.full((rows * _CELL_PX + _FOOT_PX, columns * _CELL_PX, 3), 255, np.uint8)
    picture[: rows * _CELL_PX] = grid
    for row, column in np.ndindex(rows, columns):
        text = str(pixels[row, column])
        (width, height), _ = cv2.getTextSize(text, _FONT, 0.38, 1)
        at = (column * _CELL_PX + (_CELL_PX - width) // 2, row * _CELL_PX + (_CELL_PX + height) // 2)
        dark = shade[row, column] > 150 or pixels[row, column] == 0
        cv2.putText(picture, text, at, _FONT, 0.38, _DARK_BGR if dark else (255, 255, 255), 1, cv2.LINE_AA)
    _mark_points(picture, analysis, rows, columns)
    _write_figures(picture, analysis, rows * _CELL_PX)
    return picture


def _mark_points(picture: np.ndarray, analysis: ErrorAnalysis, rows: int, columns: int) -> None:
    chosen = analysis.settings
    scale = _CELL_PX / chosen.cell_cm
    half_lane = 0.5 * chosen.lane_width_cm
    v = round(rows * _CELL_PX - chosen.lookahead_cm * scale)
    for name, x_cm in (("L", -half_lane), ("A", 0.0), ("R", half_lane)):
        u = round(columns * _CELL_PX / 2 + x_cm * scale)
        cv2.circle(picture, (u, v), 6, _LINE_BGR, 2, cv2.LINE_AA)
        cv2.putText(picture, name, (u + 8, v - 6), _FONT, 0.6, _LINE_BGR, 2, cv2.LINE_AA)


def figure_lines(analysis: ErrorAnalysis) -> list[str]:
    """Return the lines of text below the grid; they say so where L, R or both are not seen."""
    chosen = analysis.settings
    lines = [
        f"pixels per cell of {10.0 * chosen.cell_cm:.1f} mm; at L and R: "
        f"{analysis.line_pixels[0]} and {analysis.line_pixels[1]} px",
    ]
    # max() over NaN depends on the order.
    seen = [step for step in analysis.line_cm_per_px if math.isfinite(step)]
    if seen:
        lines += [
            f"sideways {10.0 * max(seen):.1f} mm/px, "
            f"with the filter's grid {10.0 * analysis.position_error_cm:.1f} mm"
            + ("" if len(seen) == 2 else ", at the one of them that is seen"),
            f"steering error at {chosen.lookahead_cm:g} cm: "
            f"{math.degrees(analysis.steering_error_rad):.1f} degrees at most",
        ]
    else:
        lines.append(f"neither L nor R is seen at {chosen.lookahead_cm:g} cm: no errors to tell")
    return lines


def _write_figures(picture: np.ndarray, analysis: ErrorAnalysis, top: int) -> None:
    for index, line in enumerate(figure_lines(analysis)):
        cv2.putText(picture, line, (8, top + 19 + 20 * index), _FONT, 0.48, _DARK_BGR, 1, cv2.LINE_AA)
