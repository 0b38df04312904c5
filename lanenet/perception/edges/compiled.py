"""The compiled loops, where they are: the bytes of NumPy and OpenCV in a fraction of the time.

``_kernels.cpp`` is built when lanenet is installed and a C++ compiler is at hand. Where there is none the
callers, in which each step is explained, do the work themselves; they also are what tests compare with.
"""

from __future__ import annotations

import importlib
import logging
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.perception.edges.pixels import EdgePixels

log = logging.getLogger(__name__)


def loops_of(package: str) -> ModuleType | None:
    """Return a package's compiled loops; None if there are none, or their source, beside them, is newer."""
    try:
        module = importlib.import_module(f"{package}._kernels")
    except ImportError:
        return None
    built = Path(str(module.__file__))
    for source in (built.with_name("_kernels.cpp"), Path(__file__).parents[1] / "arguments.hpp"):
        if source.exists() and source.stat().st_mtime > built.stat().st_mtime:
            log.warning(
                "%s is newer than what was built of it: slower until `make install` builds it", source
            )
            return None
    return module


_kernels: Any = loops_of("lanenet.perception.edges")

#: Smallest side of an image; OpenCV treats the borders of smaller ones in its own way.
_LEAST_PX = 3


def is_here() -> bool:
    """Tell whether the compiled loops are installed."""
    return _kernels is not None


def finds_in(frame_bgr: UInt8[np.ndarray, "h w *c"]) -> bool:
    """Tell whether :func:`find` can be called for such a frame."""
    return is_here() and min(frame_bgr.shape[:2]) >= _LEAST_PX


class Search(NamedTuple):
    """How edges are found, for all methods but ``colour``.

    Attributes:
        blur_px: Size of the Gauss kernel, 3 or 5; 0 for none.
        low: Lower threshold of the hysteresis.
        high: Upper one.
        colour_weight: Of yellow and red; 0 to leave them out.
        contrast_share: As in the settings; 0 fixes the thresholds.
        subpixel: Move each edge to where the gradient peaks.
        raising: How far the thresholds fall in dim frames: the three constants of ``canny``.
    """

    blur_px: int
    low: float
    high: float
    colour_weight: float
    contrast_share: float
    subpixel: bool
    raising: tuple[float, float, float]


def find(
    frame_bgr: UInt8[np.ndarray, "h w *c"],
    keep: UInt8[np.ndarray, "h w"] | None,
    sample: Int[np.ndarray, " n"] | None,
    search: Search,
) -> EdgePixels:
    """Find edges as :func:`lanenet.perception.edges.canny.find_edges` does.

    Args:
        frame_bgr: Colour or gray image of at least 3 x 3 pixels.
        keep: Mask of pixels that may be edges; None for all.
        sample: Flat indices of the pixels whose contrast counts; may be None if ``contrast_share`` is 0.
        search: How.
    """
    found = _kernels.find(*_frame(frame_bgr, keep, sample), *search)
    return EdgePixels(*np.frombuffer(found).reshape(_blocks(frame_bgr, search), -1, 2))


def extract(
    frame_bgr: UInt8[np.ndarray, "h w *c"],
    keep: UInt8[np.ndarray, "h w"] | None,
    sample: Int[np.ndarray, " n"] | None,
    search: Search,
    table: Float[np.ndarray, "p 6"],
    rows: tuple[int, int],
) -> tuple[np.ndarray, ...]:
    """Find edges and move them to the road: :func:`find` and :func:`lift` without the numbers between them.

    Args:
        frame_bgr: Some rows of a frame.
        keep: As for :func:`find`, of these rows.
        sample: Likewise.
        search: How.
        table: As for :func:`lift`, of the whole image.
        rows: The image's row with which these begin, and the number of its rows.

    Returns:
        Points, normals, and hues if there are any, n x 2 each, float32; all of them finite.
    """
    found = _kernels.extract(*_frame(frame_bgr, keep, sample), *search, table, *rows)
    return tuple(np.frombuffer(found, np.float32).reshape(_blocks(frame_bgr, search), -1, 2))


def _frame(
    frame_bgr: UInt8[np.ndarray, "h w *c"],
    keep: UInt8[np.ndarray, "h w"] | None,
    sample: Int[np.ndarray, " n"] | None,
) -> tuple[np.ndarray | int | None, ...]:
    """Return a frame's arguments, contiguous."""
    kept = None if keep is None else np.ascontiguousarray(keep)
    sampled = None if sample is None else np.ascontiguousarray(sample, np.int64)
    return np.ascontiguousarray(frame_bgr), *frame_bgr.shape[:2], kept, sampled


def _blocks(frame_bgr: UInt8[np.ndarray, "h w *c"], search: Search) -> int:
    """Return the number of arrays in a result: hues are found in colours, if they are wanted."""
    return 3 if frame_bgr.ndim == 3 and search.colour_weight > 0.0 else 2


def lift(
    edges: EdgePixels, table: Float[np.ndarray, "p 6"], size: tuple[int, int], single: bool
) -> tuple[np.ndarray, ...]:
    """Move edge pixels to the road as ``RoadTable.lift`` does.

    Args:
        edges: Edge points of a frame.
        table: Of each pixel the road point and its derivatives, as ``RoadTable`` holds them.
        size: Rows and columns of the image.
        single: Return float32, and leave out the points that are not finite.

    Returns:
        Points, normals, and hues if there are any, n x 2 each.
    """
    hues = None if edges.hues is None else np.ascontiguousarray(edges.hues, np.float64)
    uv_px, normals = (np.ascontiguousarray(x, np.float64) for x in (edges.uv_px, edges.normals))
    found = _kernels.lift(uv_px, normals, hues, table, *size, single)
    return tuple(
        np.frombuffer(found, np.float32 if single else np.float64).reshape(2 if hues is None else 3, -1, 2)
    )


def raster(
    window: BirdseyeWindow,
    looks: tuple[np.ndarray, np.ndarray, np.ndarray | None],
    out: UInt8[np.ndarray, "p r c"],
    middle: int,
    steps: int,
) -> None:
    """Fill a raster as :func:`lanenet.perception.edges.raster.fill_raster` does.

    Args:
        window: Which patch of road, and its cells.
        looks: Points, normals and hues, all float32 or all float64.
        out: Contiguous; written.
        middle: Value for nothing in the planes after the first.
        steps: Values from nothing to 1.
    """
    points, normals, hues = (None if x is None else np.ascontiguousarray(x) for x in looks)
    place = window.left_cm, window.far_cm, window.cell_cm, window.rows, window.columns
    _kernels.raster(points, normals, hues, out, *place, len(out), middle, steps, looks[0].dtype == np.float32)
