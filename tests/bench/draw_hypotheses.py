"""Draw what the lane filter takes for possible in three frames of a car that changes lanes.

``make figures``: edge points, the network's probabilities of places, hypotheses with their shares, the truth.
"""

from __future__ import annotations

import sys

import matplotlib.pyplot as plt
import numpy as np
from bench_ablation import ROOT
from fit_lane import filter_of, replayed, seen

from lanenet.geometry.lane import ROWS_CM, parabolas_from_points
from lanenet.perception.network.lane.shape import points_of

#: A drive of ``bench_ablation.py`` over the line between two lanes, and frames of it. Chosen by eye.
SEED, NUMBER, FRAMES = 520_000, 6, (84, 88, 92)
AHEAD_CM = np.linspace(-3.0, 42.0, 40)


def main() -> None:
    """Draw into the file that is named."""
    drive = seen(ROOT / "checkpoints/general", SEED, NUMBER)
    lane = filter_of(drive)
    figure, axes = plt.subplots(1, len(FRAMES), figsize=(10.5, 4.2), sharey=True, layout="constrained")
    for number, found in replayed(drive, lane):
        step = drive.steps[number]
        if number not in FRAMES or step is None:
            continue
        answer, edges = step
        axis = axes[FRAMES.index(number)]
        axis.plot(*edges.points_cm.T, ".", color="0.6", markersize=1.0)
        weights = np.exp(lane._found.log_weights)
        for share, points_cm in zip(weights / weights.sum(), points_of(lane._found.states), strict=True):
            for line in parabolas_from_points(points_cm):
                axis.plot(np.polyval(line, AHEAD_CM), AHEAD_CM, color="C3", alpha=0.25 + 0.75 * share)
            axis.annotate(f"{share:.0%}", (points_cm[[2, 5]].mean(), 44.0), color="C3", ha="center")
        for side, line in enumerate(parabolas_from_points(drive.true_cm[number])):
            axis.plot(np.polyval(line, AHEAD_CM), AHEAD_CM, color="C2", linewidth=3.0, alpha=0.4, zorder=0)
            for row, ahead_cm in enumerate(ROWS_CM):
                share = np.exp(answer.log_share[len(ROWS_CM) * side + row])
                axis.bar(answer.places_cm, 8.0 * share, width=1.2, bottom=ahead_cm, color=f"C{side}")
        axis.set(xlim=(-70.0, 70.0), ylim=(-5.0, 60.0), xlabel="x, cm", title=found.reason or "answered")
    axes[0].set_ylabel("y, cm")
    figure.savefig(sys.argv[1], dpi=90)


if __name__ == "__main__":
    main()
