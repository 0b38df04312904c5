"""How exactly a camera sees the road: pixels per ground cell, and the steering error that follows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera


class AnalysisSettings(Settings):
    """Grid and look-ahead of the analysis; the defaults are those of Kozlowski et al. 2024, section 2.3.

    Attributes:
        cell_cm: Side of a ground cell.
        side_cm: The grid reaches so far to the left and to the right.
        far_cm: And so far ahead of the front axle.
        lookahead_cm: Distance at which the centre of the lane is taken.
        lane_width_cm: Between the middles of the lane's lines, which lie half of it to either side there.
        filter_grid_cm: Grid of the lane filter.
    """

    cell_cm: float = Field(default=5.26, gt=0.0)
    side_cm: float = Field(default=50.0, gt=0.0)
    far_cm: float = Field(default=100.0, gt=0.0)
    lookahead_cm: float = Field(default=15.0, gt=0.0)
    lane_width_cm: float = Field(default=40.0, gt=0.0)
    filter_grid_cm: float = Field(default=0.2, ge=0.0)


@dataclass(frozen=True)
class ErrorAnalysis:
    """What a camera's pixels allow.

    Row 0 of the cells is the nearest one, column 0 the leftmost.

    Attributes:
        settings: Grid and look-ahead.
        pixels: Pixel centres in each cell.
        line_pixels: Pixel centres in the cells of the left and the right line's point at the look-ahead.
        line_cm_per_px: Most that one pixel's step along a row or a column moves the road point sideways, at
            these two points; NaN outside the image.
        position_error_cm: Worst sideways error of the lane's centre: a pixel and the filter's grid.
    """

    settings: AnalysisSettings
    pixels: Int[np.ndarray, "r c"]
    line_pixels: tuple[int, int]
    line_cm_per_px: tuple[float, float]
    position_error_cm: float

    @property
    def steering_error_rad(self) -> float:
        """Steering error that the position error causes; Kozlowski et al. 2024, eq. 3 and section 2.3."""
        return math.atan2(self.position_error_cm, self.settings.lookahead_cm)


def analyse_errors(camera: Camera, settings: AnalysisSettings | None = None) -> ErrorAnalysis:
    """Count pixels per ground cell and derive the worst errors at the look-ahead.

    Args:
        camera: Camera with its mounting.
        settings: Grid and look-ahead; None for the paper's.

    Returns:
        The densities and errors. Where the camera sees neither line at the look-ahead, the errors are NaN;
        where it sees one, they are that one's.

    Raises:
        CalibrationError: If no pixel of the camera sees the grid.

    Source:
        Kozlowski et al. 2024, section 2.3 and figure 7. The paper takes one pixel at the sparser of the two
        lines; here it is the larger sideways step to a neighbouring pixel, from the camera model.
    """
    chosen = AnalysisSettings() if settings is None else settings
    # An even number of columns, so that the car's middle is a border between cells.
    half_columns = max(1, round(chosen.side_cm / chosen.cell_cm))
    rows, columns = max(1, round(chosen.far_cm / chosen.cell_cm)), 2 * half_columns
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    road = camera.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1))
    cells = _cells_of(road[np.isfinite(road).all(axis=1)], chosen.cell_cm, half_columns)
    inside = ((cells >= 0) & (cells < [rows, columns])).all(axis=1)
    if not inside.any():
        raise CalibrationError(
            f"camera: no pixel sees the road within {chosen.side_cm:g} cm to the side and {chosen.far_cm:g} "
            "cm ahead; check height and pitch"
        )
    pixels = np.zeros((rows, columns), np.int64)
    np.add.at(pixels, (cells[inside, 0], cells[inside, 1]), 1)

    half_lane = 0.5 * chosen.lane_width_cm
    lines = np.array([[-half_lane, chosen.lookahead_cm], [half_lane, chosen.lookahead_cm]])
    line_steps = sideways_cm_per_px(camera, lines)
    seen = line_steps[np.isfinite(line_steps)]
    error_cm = float(seen.max()) + chosen.filter_grid_cm if seen.size else math.nan
    left, right = (_count(pixels, cell) for cell in _cells_of(lines, chosen.cell_cm, half_columns))
    steps = float(line_steps[0]), float(line_steps[1])
    return ErrorAnalysis(chosen, pixels, (left, right), steps, error_cm)


def figures(analysis: ErrorAnalysis) -> list[tuple[str, str, str]]:
    """Return rows of name, value and the paper's value for its camera, for a table."""
    left, right = analysis.line_pixels
    sideways = ", ".join(_shown(10.0 * cm) for cm in analysis.line_cm_per_px)
    degrees = math.degrees(analysis.steering_error_rad)
    return [
        (
            f"pixels per {10.0 * analysis.settings.cell_cm:.1f} mm cell at L and R",
            f"{left}, {right}",
            "10, 24",
        ),
        ("mm per pixel, sideways, at L and R", sideways, "6"),
        ("position error with the filter's grid, mm", _shown(10.0 * analysis.position_error_cm), "<= 10"),
        (f"steering error at {analysis.settings.lookahead_cm:g} cm, degrees", _shown(degrees), "3.8"),
    ]


def _shown(value: float) -> str:
    """A figure, or a dash where the place that it is of is not seen."""
    return f"{value:.1f}" if math.isfinite(value) else "-"


def _cells_of(points_cm: np.ndarray, cell_cm: float, half_columns: int) -> np.ndarray:
    """Row and column of the cell that holds each point."""
    row = np.floor(points_cm[:, 1] / cell_cm)
    column = np.floor(points_cm[:, 0] / cell_cm) + half_columns
    return np.stack([row, column], axis=1).astype(np.int64)


def _count(pixels: np.ndarray, cell: np.ndarray) -> int:
    row, column = (int(i) for i in cell)
    rows, columns = pixels.shape
    return int(pixels[row, column]) if 0 <= row < rows and 0 <= column < columns else 0


def sideways_cm_per_px(camera: Camera, points_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    """Return how far a step of one pixel, along u or v, moves road points sideways; NaN if unseen."""
    at = camera.project_ground(points_cm)
    half = 0.5
    size = [camera.width - half, camera.height - half]
    with np.errstate(invalid="ignore"):
        visible = ((at >= -half) & (at <= size)).all(axis=1)
    # Central differences over one pixel; a step that leaves the road is NaN and stays so.
    along_u = camera.intersect_ground(at + [half, 0.0]) - camera.intersect_ground(at - [half, 0.0])
    along_v = camera.intersect_ground(at + [0.0, half]) - camera.intersect_ground(at - [0.0, half])
    steps = np.maximum(np.abs(along_u[:, 0]), np.abs(along_v[:, 0]))
    return np.where(visible, steps, np.nan)


_CELL_PX = 36
_FOOT_PX = 86
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_DARK_BGR, _LINE_BGR, _MISSING_BGR = (30, 30, 30), (40, 40, 220), (225, 225, 225)


def draw_analysis(analysis: ErrorAnalysis) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the density of each cell as figure 7 of Kozlowski et al. 2024 does.

    The car's front axle is at the middle of the lower edge of the grid. The points L, A and R at the
    look-ahead are marked; cells that no pixel sees are gray.

    Args:
        analysis: What :func:`lanenet.perception.error_analysis.analyse_errors` found.

    Returns:
        The image.
    """
    pixels = analysis.pixels[::-1]  # The far edge on top.
    rows, columns = pixels.shape
    most = math.log1p(float(pixels.max()))
    shade = (55.0 + 200.0 * np.log1p(pixels) / most).astype(np.uint8)
    colours = cv2.applyColorMap(shade, cv2.COLORMAP_VIRIDIS)
    colours[pixels == 0] = _MISSING_BGR
    grid = cv2.resize(colours, (columns * _CELL_PX, rows * _CELL_PX), interpolation=cv2.INTER_NEAREST)
    image = np.full((rows * _CELL_PX + _FOOT_PX, columns * _CELL_PX, 3), 255, np.uint8)
    image[: rows * _CELL_PX] = grid
    for row, column in np.ndindex(rows, columns):
        text = str(pixels[row, column])
        (width, height), _ = cv2.getTextSize(text, _FONT, 0.38, 1)
        at = (column * _CELL_PX + (_CELL_PX - width) // 2, row * _CELL_PX + (_CELL_PX + height) // 2)
        dark = shade[row, column] > 150 or pixels[row, column] == 0
        cv2.putText(image, text, at, _FONT, 0.38, _DARK_BGR if dark else (255, 255, 255), 1, cv2.LINE_AA)
    _mark_points(image, analysis, rows, columns)
    for index, (name, found, _) in enumerate(figures(analysis)):
        place = (8, rows * _CELL_PX + 19 + 20 * index)
        cv2.putText(image, f"{name}: {found}", place, _FONT, 0.48, _DARK_BGR, 1, cv2.LINE_AA)
    return image


def _mark_points(image: np.ndarray, analysis: ErrorAnalysis, rows: int, columns: int) -> None:
    chosen = analysis.settings
    scale = _CELL_PX / chosen.cell_cm
    half_lane = 0.5 * chosen.lane_width_cm
    v = round(rows * _CELL_PX - chosen.lookahead_cm * scale)
    for name, x_cm in (("L", -half_lane), ("A", 0.0), ("R", half_lane)):
        u = round(columns * _CELL_PX / 2 + x_cm * scale)
        cv2.circle(image, (u, v), 6, _LINE_BGR, 2, cv2.LINE_AA)
        cv2.putText(image, name, (u + 8, v - 6), _FONT, 0.6, _LINE_BGR, 2, cv2.LINE_AA)
