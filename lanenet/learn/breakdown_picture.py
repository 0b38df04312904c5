"""A comparison's breakdown as a picture: errors by bend, and whether the doubt of each detector is right."""

from __future__ import annotations

from lanenet.learn.breakdown import GROUPS, RELIABILITY_SHARES
from lanenet.learn.compare import Comparison
from lanenet.learn.figure import new_figure, png_bytes


def breakdown_picture(comparison: Comparison) -> bytes | None:
    """Draw the RMSE by curvature of the lane, and the reliability diagram of the standard deviations.

    Returns:
        A PNG, or None where Matplotlib is not installed.
    """
    figure = new_figure(10.0, 4.5)
    if figure is None:
        return None
    bend, doubt = figure.subplots(1, 2)
    names = list(comparison.tables)
    groups = [name for name, _ in GROUPS["bend"][1]]
    width = 0.8 / len(names)
    for i, name in enumerate(names):
        stats = comparison.breakdown.groups["bend"][name]
        places = [k + (i - 0.5 * (len(names) - 1)) * width for k in range(len(groups))]
        bend.bar(places, [stats[group].rmse_cm for group in groups], width, color=f"C{i}", label=name)
    bend.set_xticks(range(len(groups)), groups, fontsize=8)
    bend.set_ylabel("RMSE, cm")
    bend.set_title(f"By bend, against the {comparison.reference}", fontsize=10)
    bend.grid(True, axis="y", alpha=0.3)
    bend.legend(fontsize=8)
    doubt.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linestyle="--", label="right")
    for i, name in enumerate(names):
        own = comparison.breakdown.doubt.get(name)
        if own is not None:
            doubt.plot(RELIABILITY_SHARES, own.reliability, marker="o", color=f"C{i}", label=name)
    doubt.set_xlabel("share of the errors that the interval promises")
    doubt.set_ylabel("share that lies in it")
    doubt.set_title("Above the line: too careful; below: too sure", fontsize=10)
    doubt.set_xlim(0.0, 1.0)
    doubt.set_ylim(0.0, 1.0)
    doubt.grid(True, alpha=0.3)
    doubt.legend(fontsize=8)
    return png_bytes(figure)
