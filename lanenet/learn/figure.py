"""Pictures by Matplotlib, where it is installed."""

from __future__ import annotations

import io
from typing import Any


def new_figure(width_in: float, height_in: float) -> Any | None:
    """Return an empty figure; None where Matplotlib is not installed.

    It is made without pyplot, which would pick a window system and keep global state.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return None
    figure = Figure(figsize=(width_in, height_in), dpi=100)
    FigureCanvasAgg(figure)
    return figure


def png_bytes(figure: Any) -> bytes:
    """Return a figure as a PNG, cut to what is drawn."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", bbox_inches="tight")
    return picture.getvalue()
