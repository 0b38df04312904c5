"""The trials of a sweep as tables: all as CSV, the best and what each choice was worth as Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_BEST = 10
_NAMES = {
    "val_rmse_cm": "RMSE, cm",
    "cell_cm": "cell, cm",
    "far_cm": "far, cm",
    "half_width_cm": "half width, cm",
    "first_channels": "channels",
    "layers": "layers",
    "hidden": "hidden",
    "loss": "loss",
    "evenness": "evenness",
    "learning_rate": "rate",
    "parameters": "parameters",
    "epochs": "epochs",
    "cpu_s": "CPU, s",
}


def trials_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return trials as CSV, a row each, in their order."""
    text = io.StringIO()
    writer = csv.DictWriter(text, ["trial", "state", *_NAMES], lineterminator="\n", restval="")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def trials_table(rows: Sequence[Mapping[str, Any]], choices: Sequence[str]) -> str:
    """Return the best trials, and for each choice the errors of the trials that made it, as Markdown.

    Args:
        rows: Trials by the names of the CSV; ``state`` is ``complete``, or ``pruned`` for those that were
            given up early, which do not count.
        choices: Names of what was chosen from a few values.
    """
    whole = sorted((row for row in rows if row["state"] == "complete"), key=lambda row: row["val_rmse_cm"])
    lines = [
        f"{len(whole)} trials to the end, {len(rows) - len(whole)} given up early. RMSE over the six points "
        "of the validation drives.",
        "",
        "| " + " | ".join(_NAMES.values()) + " |",
        "|" + "---|" * len(_NAMES),
    ]
    lines += ["| " + " | ".join(_shown(row[key]) for key in _NAMES) + " |" for row in whole[:_BEST]]
    lines += ["", "| choice | value | trials | best RMSE, cm | median RMSE, cm |", "|---|---|---|---|---|"]
    for key in choices:
        for value in sorted({row[key] for row in whole}, key=str):
            errors = [row["val_rmse_cm"] for row in whole if row[key] == value]
            figures = f"{len(errors)} | {min(errors):.3f} | {np.median(errors):.3f}"
            lines.append(f"| {_NAMES[key].removesuffix(', cm')} | {_shown(value)} | {figures} |")
    return "\n".join(lines) + "\n"


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else str(value)
