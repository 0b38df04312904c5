"""A comparison as a picture: how the errors of each detector spread, by row."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.learn.compare import Comparison
from lanenet.learn.figure import new_figure, png_bytes

#: Below this the simulator's own rounding shows; on a logarithmic axis it would only stretch the picture.
_LEAST_CM = 0.01


def error_picture(comparison: Comparison) -> bytes | None:
    """Draw a box per detector and row: quartiles and median of the error, whiskers at 5 and 95 %.

    Below each box stands the share of the labelled points that were answered.

    Returns:
        A PNG, or None where Matplotlib is not installed.
    """
    figure = new_figure(9.0, 5.0)
    if figure is None:
        return None
    from matplotlib.patches import Patch

    names = list(comparison.tables)
    axes = figure.add_subplot()
    for i, name in enumerate(names):
        for k in range(len(ROWS_CM)):
            x = k + (i + 0.5) / (len(names) + 1.0) - 0.5 + 0.5 / (len(names) + 1.0)
            found = _row_errors(comparison.errors_cm[name], k)
            if found.size:
                axes.boxplot(
                    [found],
                    positions=[x],
                    widths=0.8 / (len(names) + 1.0),
                    whis=(5, 95),
                    showfliers=False,
                    patch_artist=True,
                    boxprops={"facecolor": f"C{i}"},
                    medianprops={"color": "black"},
                )
            stats = comparison.tables[name].groups[f"y = {ROWS_CM[k]:.0f} cm"]
            share = "-" if np.isnan(stats.coverage) else f"{100.0 * stats.coverage:.0f}%"
            axes.annotate(
                share, (x, 0.01), xycoords=("data", "axes fraction"), ha="center", fontsize=8, color=f"C{i}"
            )
    axes.set_yscale("log")
    axes.set_xlim(-0.5, len(ROWS_CM) - 0.5)
    axes.set_xticks(range(len(ROWS_CM)), [f"y = {row:.0f} cm" for row in ROWS_CM])
    axes.set_ylabel("error, cm")
    axes.set_title(
        f"Against the {comparison.reference}. Quartiles, whiskers at 5 and 95 %; below: points answered",
        fontsize=10,
    )
    axes.grid(True, axis="y", which="major", alpha=0.3)
    # The boxes of a log axis end where they end; the shares need room below them.
    low, high = axes.get_ylim()
    axes.set_ylim(low * (low / high) ** 0.08, high)
    handles = [Patch(facecolor=f"C{i}", label=name) for i, name in enumerate(names)]
    # Under the axes, where no box can lie below it.
    axes.legend(
        handles=handles, fontsize=9, ncols=len(names), loc="upper center", bbox_to_anchor=(0.5, -0.07)
    )
    return png_bytes(figure)


def _row_errors(errors_cm: Float[np.ndarray, "n 6"], row: int) -> Float[np.ndarray, "_"]:
    """The answered errors of both lines on a row."""
    found = errors_cm[:, [side * len(ROWS_CM) + row for side in range(len(SIDES))]].ravel()
    return np.maximum(found[np.isfinite(found)], _LEAST_CM)
