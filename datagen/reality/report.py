"""Real drives beside synthetic ones: a table, a JSON file, histograms, and a sheet of those most alike."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.reality.drives import RealitySettings
from datagen.reality.measure import BANDS, HEIGHT_CM, STATISTICS, MeasuredDrive
from lanenet.data.files import write_json, write_text
from lanenet.evaluation.report import new_figure
from lanenet.perception.edges.canny import find_edges
from lanenet.perception.edges.road import RoadTable

FORMAT = "lanenet-reality/1"
#: Quantiles over the synthetic drives between which a real drive counts as inside.
SPREAD: tuple[float, float, float] = (0.025, 0.5, 0.975)
#: Width of one image of a sheet.
_TILE_PX = 240
_HEADER_PX, _GAP_PX = 20, 6
_GROUND, _TEXT_BGR = 245, (20, 20, 20)
_FIGURE_COLUMNS = 4

#: Images and sheets of one call differ in size.
Sheet = UInt8[np.ndarray, "_ _ 3"]
Image = UInt8[np.ndarray, "_ _ *_"]


@dataclass(frozen=True)
class Row:
    """One statistic.

    Attributes:
        name: See :data:`datagen.reality.measure.STATISTICS`.
        low: 2.5 % of the synthetic drives lie below.
        median: Of the synthetic drives.
        high: 2.5 % lie above.
        real: Value of each real drive.
        below: Share of the synthetic drives below each of them.
    """

    name: str
    low: float
    median: float
    high: float
    real: tuple[float, ...]
    below: tuple[float, ...]

    @property
    def label(self) -> str:
        """Name and unit, for people."""
        unit = STATISTICS[self.name][0]
        return self.name.removesuffix("_px").replace("_", " ") + (f", {unit}" if unit else "")

    @property
    def inside(self) -> tuple[bool, ...]:
        """Whether each real drive lies within the synthetic spread; NaN does not."""
        return tuple(self.low <= value <= self.high for value in self.real)


def compare(real: Sequence[MeasuredDrive], synthetic: Sequence[MeasuredDrive]) -> list[Row]:
    """Return a row per statistic.

    A synthetic drive without edge points is left out of the statistics that need one.

    Args:
        real: Real drives.
        synthetic: Synthetic drives, at least one.
    """
    rows = []
    for name in STATISTICS:
        values = np.array([drive.statistics[name] for drive in synthetic])
        values = values[np.isfinite(values)]
        spread = np.quantile(values, SPREAD) if values.size else np.full(3, np.nan)
        found = tuple(drive.statistics[name] for drive in real)
        below = tuple(float(np.mean(values < value)) if values.size else float("nan") for value in found)
        low, median, high = map(float, spread)
        rows.append(Row(name, low, median, high, found, below))
    return rows


def nearest_synthetic(
    real: MeasuredDrive, synthetic: Sequence[MeasuredDrive], count: int
) -> list[MeasuredDrive]:
    """Return the synthetic drives most like a real one, by the mean square of standardised differences."""
    table = np.array([_values(drive) for drive in synthetic])
    deviation = np.nanstd(table, axis=0)
    off = (table - _values(real)) / np.where(deviation > 0.0, deviation, 1.0)
    distance = np.sqrt(np.nan_to_num(off**2, nan=9.0).mean(axis=1))
    return [synthetic[i] for i in np.argsort(distance, kind="stable")[:count]]


def table(rows: Sequence[Row], names: Sequence[str]) -> list[list[str]]:
    """Return the table as text, its headers first; a real drive's value outside is marked ``out``."""
    headers = ["statistic", "2.5 %", "median", "97.5 %", *names]
    lines = [headers]
    for row in rows:
        cells = [_figure(value) for value in (row.low, row.median, row.high)]
        for value, inside in zip(row.real, row.inside, strict=True):
            cells.append(_figure(value) + ("" if inside else " out"))
        lines.append([row.label, *cells])
    return lines


def summary(rows: Sequence[Row], names: Sequence[str]) -> list[str]:
    """Say for each real drive in how many statistics it lies inside, and where it does not."""
    lines = []
    for k, name in enumerate(names):
        out = [row.name for row in rows if not row.inside[k]]
        outside = f"; outside: {', '.join(out)}" if out else ""
        lines.append(f"{name}: {len(rows) - len(out)} of {len(rows)} statistics inside{outside}")
    return lines


def write_report(
    out: Path, settings: dict[str, Any], real: Sequence[MeasuredDrive], synthetic: Sequence[MeasuredDrive]
) -> list[Path]:
    """Write ``reality.md`` and ``reality.json``; returns their paths.

    Args:
        out: Folder.
        settings: How the drives were made and measured, for the JSON file.
        real: Real drives.
        synthetic: Synthetic drives.
    """
    rows, names = compare(real, synthetic), [drive.name for drive in real]
    headers, *lines = table(rows, names)
    bands = ", ".join(f"{low:g} to {high:g}" for low, high in pairwise(BANDS))
    text = [
        f"# {len(real)} real drives beside {len(synthetic)} synthetic ones",
        "",
        "Each number is of a whole drive; the first three columns are over the synthetic drives. All cameras "
        f"are taken to be {HEIGHT_CM:g} cm high, distances are from below the camera; near, middle and far "
        f"are {bands} camera heights.",
        "",
        "| " + " | ".join(headers) + " |",
        "|---|" + "---:|" * (len(headers) - 1),
        *("| " + " | ".join(line) + " |" for line in lines),
        "",
        *(f"- {line}" for line in summary(rows, names)),
        "",
        "What each statistic means:",
        "",
        *(f"- `{name}`: {meaning}" for name, (_, meaning) in STATISTICS.items()),
        "",
    ]
    data = {
        "format": FORMAT,
        "settings": settings,
        "spread": SPREAD,
        "camera_height_cm": HEIGHT_CM,
        "statistics": [
            {
                **{name: getattr(row, name) for name in ("name", "low", "median", "high")},
                "unit": STATISTICS[row.name][0],
                "meaning": STATISTICS[row.name][1],
                "real": dict(zip(names, row.real, strict=True)),
                "share_below": dict(zip(names, row.below, strict=True)),
                "inside": dict(zip(names, row.inside, strict=True)),
            }
            for row in rows
        ],
        "drives": [
            {"name": drive.name, "kind": kind, "statistics": drive.statistics}
            for kind, drives in (("real", real), ("synthetic", synthetic))
            for drive in drives
        ],
    }
    paths = [out / "reality.md", out / "reality.json"]
    write_text(paths[0], "\n".join(text))
    write_json(paths[1], data)
    return paths


def _values(drive: MeasuredDrive) -> Float[np.ndarray, "k"]:
    return np.array([drive.statistics[name] for name in STATISTICS])


def _figure(value: float) -> str:
    if not np.isfinite(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.1f}" if abs(value) >= 10.0 else f"{value:.2f}"


def sheet(
    real: Sequence[MeasuredDrive],
    synthetic: Sequence[MeasuredDrive],
    settings: RealitySettings,
    beside: int = 5,
) -> Sheet:
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


def strip(drives: Sequence[MeasuredDrive], settings: RealitySettings, tile_px: int = _TILE_PX) -> Sheet:
    """Draw drives side by side, as in :func:`sheet`."""
    columns = [_column(drive, settings, tile_px) for drive in drives]
    height = max(column.shape[0] for column in columns)
    return np.hstack([_padded(column, height - column.shape[0], _GAP_PX) for column in columns])


def _column(drive: MeasuredDrive, settings: RealitySettings, tile_px: int) -> Sheet:
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


def _scaled(image: Image, width_px: int) -> Sheet:
    colour = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    size = (width_px, round(image.shape[0] * width_px / image.shape[1]))
    # Downsampling by the mean keeps single edge pixels visible.
    kind = cv2.INTER_NEAREST if width_px >= image.shape[1] else cv2.INTER_AREA
    return np.asarray(cv2.resize(colour, size, interpolation=kind))


def _padded(image: Sheet, below_px: int, right_px: int) -> Sheet:
    ground = (_GROUND,) * 3
    return np.asarray(cv2.copyMakeBorder(image, 0, below_px, 0, right_px, cv2.BORDER_CONSTANT, value=ground))


def histograms(
    rows: Sequence[Row], real: Sequence[MeasuredDrive], synthetic: Sequence[MeasuredDrive]
) -> bytes | None:
    """Draw how each statistic spreads over the synthetic drives, with the real drives as lines.

    The grey band is the synthetic spread, from 2.5 to 97.5 %.

    Returns:
        A PNG, or None where Matplotlib is not installed.
    """
    lines = math.ceil(len(rows) / _FIGURE_COLUMNS)
    figure = new_figure(3.0 * _FIGURE_COLUMNS, 1.5 * lines + 0.5, dpi=90)
    if figure is None:
        return None
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
