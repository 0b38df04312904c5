"""Sheets of frames with what is found in them, and histograms of the statistics."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from datagen.reality.drives import RealitySettings
from datagen.reality.measure import MeasuredDrive
from datagen.reality.report import Row, nearest_synthetic
from lanenet.perception.edges.canny import find_edges
from lanenet.perception.edges.road import RoadTable

#: Width of one image of a sheet.
_TILE_PX = 240
_HEADER_PX, _GAP_PX = 20, 6
_GROUND, _TEXT_BGR = 245, (20, 20, 20)
_FIGURE_COLUMNS = 4

#: Images and pictures of one call differ in size.
Picture = UInt8[np.ndarray, "_ _ 3"]
Image = UInt8[np.ndarray, "_ _ *_"]


def sheet(
    real: Sequence[MeasuredDrive],
    synthetic: Sequence[MeasuredDrive],
    settings: RealitySettings,
    beside: int = 5,
) -> Picture:
    """Draw each real drive beside the synthetic ones most like it.

    Each drive is a column: its frame with the median number of points, the edges found in it, and the
    bird's-eye raster that a network is given.

    Args:
        real: Real drives, a row of the sheet each.
        synthetic: Synthetic drives.
        settings: How edges are found, and the window.
        beside: Synthetic drives beside each.
    """
    rows = [strip([drive, *nearest_synthetic(drive, synthetic, beside)], settings) for drive in real]
    width = max(row.shape[1] for row in rows)
    return np.vstack([_padded(row, _GAP_PX, width - row.shape[1]) for row in rows])


def strip(drives: Sequence[MeasuredDrive], settings: RealitySettings, tile_px: int = _TILE_PX) -> Picture:
    """Draw drives side by side, as in :func:`sheet`."""
    columns = [_column(drive, settings, tile_px) for drive in drives]
    height = max(column.shape[0] for column in columns)
    return np.hstack([_padded(column, height - column.shape[0], _GAP_PX) for column in columns])


def _column(drive: MeasuredDrive, settings: RealitySettings, tile_px: int) -> Picture:
    table = RoadTable(drive.camera, settings.perception.range, drive.mask)
    pixels = find_edges(drive.shown, settings.perception.edges, table.keep, table.scale)
    height, width = drive.shown.shape[:2]
    edges = np.zeros((height, width), np.uint8)
    at = np.rint(pixels.uv_px).astype(np.intp)
    edges[np.clip(at[:, 1], 0, height - 1), np.clip(at[:, 0], 0, width - 1)] = 255
    raster = settings.window.rasterise(table.lift(pixels).points_cm)
    header = np.full((_HEADER_PX, tile_px, 3), _GROUND, np.uint8)
    cv2.putText(header, drive.name[:28], (2, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _TEXT_BGR, 1, cv2.LINE_AA)
    return np.vstack([header, *(_scaled(image, tile_px) for image in (drive.shown, edges, raster))])


def _scaled(image: Image, width_px: int) -> Picture:
    colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    size = (width_px, round(image.shape[0] * width_px / image.shape[1]))
    # Downsampling by the mean keeps single edge pixels visible.
    kind = cv2.INTER_NEAREST if width_px >= image.shape[1] else cv2.INTER_AREA
    return np.asarray(cv2.resize(colour, size, interpolation=kind))


def _padded(picture: Picture, below_px: int, right_px: int) -> Picture:
    ground = (_GROUND,) * 3
    return np.asarray(
        cv2.copyMakeBorder(picture, 0, below_px, 0, right_px, cv2.BORDER_CONSTANT, value=ground)
    )


def histograms(
    rows: Sequence[Row], real: Sequence[MeasuredDrive], synthetic: Sequence[MeasuredDrive]
) -> bytes | None:
    """Draw how each statistic spreads over the synthetic drives, with the real drives as lines.

    The grey band is the synthetic spread, from 2.5 to 97.5 %.

    Returns:
        A PNG, or None where Matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return None
    lines = math.ceil(len(rows) / _FIGURE_COLUMNS)
    # Without pyplot, which would choose a window system and keep global state.
    figure = Figure(figsize=(3.0 * _FIGURE_COLUMNS, 1.5 * lines + 0.5), dpi=90)
    FigureCanvasAgg(figure)
    for k, row in enumerate(rows):
        axes = figure.add_subplot(lines, _FIGURE_COLUMNS, k + 1)
        values = np.array([drive.statistics[row.name] for drive in synthetic])
        values = values[np.isfinite(values)]
        if values.size:
            axes.axvspan(row.low, row.high, color="0.92")
            axes.hist(values, bins=15, color="0.6")
        for i, value in enumerate(row.real):
            if math.isfinite(value):
                axes.axvline(value, color=f"C{i}", label=real[i].name)
        axes.set_title(row.label, fontsize=8)
        axes.tick_params(labelsize=7)
        axes.set_yticks([])
        if k == 0 and real:
            handles, labels = axes.get_legend_handles_labels()
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.96))
    if real and rows:
        figure.legend(handles, labels, loc="upper center", ncols=len(labels), fontsize=8, frameon=False)
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": ""})
    return file.getvalue()
