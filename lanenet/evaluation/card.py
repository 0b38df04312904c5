"""The model card: what a network was trained on, how good it is, and where it fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lanenet.data.label_set import LabelSet
from lanenet.errors import counted
from lanenet.evaluation.comparison import Comparison
from lanenet.evaluation.errors import GROUPS
from lanenet.evaluation.robustness import RobustRow, robust_table
from lanenet.evaluation.sources import of_one_map
from lanenet.evaluation.tables import LARGE_CM, show_cm, show_share
from lanenet.geometry.lane import POINT_NAMES
from lanenet.perception.network.model_file import ModelMeta

CARD_NAME = "MODEL_CARD.md"
#: A group whose RMSE is this many times that of the whole is a weakness. Chosen.
_WORSE = 1.5
#: Worst sources that are looked at. Chosen.
_N_SOURCES = 3


def model_card(
    name: str,
    meta: ModelMeta,
    metrics: Mapping[str, Any],
    training: Sequence[LabelSet],
    tests: Sequence[LabelSet],
    comparison: Comparison,
    robustness: Sequence[RobustRow],
) -> str:
    """Write the card of a trained network as Markdown.

    Args:
        name: Of the checkpoint.
        meta: Description in the model's file.
        metrics: Content of ``metrics.json``.
        training: The label sets that it learned from, each once.
        tests: The label sets of the test.
        comparison: Its errors on the test drives; the network is the first detector.
        robustness: Its errors when something is wrong; may be empty.
    """
    rejected = of_rejected_maps([*training, *tests])
    parts = [
        f"# {name}\n\n{_what(meta, metrics)}",
        f"**{rejected}**" if rejected else "",
        f"## What it was trained on\n\n{_training(meta, metrics, training)}",
        f"## How good it is\n\n{_errors(comparison)}{_one_recording(training, tests)}",
        f"## Where it fails\n\n{_failures(meta, comparison)}",
    ]
    if robustness:
        parts.append("## " + robust_table(robustness).as_markdown())
    return "\n\n".join(part.rstrip() for part in parts if part) + "\n"


def of_rejected_maps(labels: Sequence[LabelSet]) -> str:
    """Say which drives have labels of a map that was rejected; empty if none has.

    Args:
        labels: What was learned from and tested on.
    """
    drives = sorted({name for one in labels if one.meta.verdict == "reject" for name in one.drive})
    if not drives:
        return ""
    return (
        f"The map of {', '.join(drives)} was rejected, and labelled all the same (lanenet label --force): "
        "its lines may be wrong, in what was learned and in the errors that are given here."
    )


def _what(meta: ModelMeta, metrics: Mapping[str, Any]) -> str:
    window = meta.window
    right_cm = window.left_cm + window.columns * window.cell_cm
    far_cm = window.near_cm + window.rows * window.cell_cm
    seen = "brightness and colour" if meta.perception.edges.colour_weight else "brightness"
    if meta.planes > 1:
        seen += ", with their directions and hues"
    return (
        f"A network of {metrics['parameters']:,} weights. In: the bird's-eye image of the edges of {seen}, "
        f"{window.rows} x {window.columns} cells of {window.cell_cm:g} cm, from {window.left_cm:g} to "
        f"{right_cm:g} cm across and {window.near_cm:g} to {far_cm:g} cm ahead.\n"
        "Out: x of the left and the right line 0, 15 and 30 cm ahead of the front axle, the uncertainty of "
        "each, and whether each line is there.\nIt sees nothing beside the window or further ahead."
    )


def _training(meta: ModelMeta, metrics: Mapping[str, Any], training: Sequence[LabelSet]) -> str:
    sources = " and ".join(sorted({labels.meta.source for labels in training}))
    low, high = _widths_cm(meta)
    widths = f"{low} cm" if low == high else f"{low} to {high} cm"
    count = len({labels.meta.camera_hash for labels in training})
    frames = counted(sum(map(len, training)), "frame")
    return (
        f"{frames} of {counted(len(training), 'label set')}, labels from the {sources}; "
        f"{counted(count, 'camera')}; lanes of {widths}.\n{metrics['epochs']} epochs, the best "
        f"one ({metrics['best_epoch']}) chosen by {metrics['val_frames']} frames of other drives or laps "
        f"(RMSE {show_cm(metrics['val_rmse_cm'])} cm).\nDrives, lanes, lenses and roads: `DATA_SHEET.md`; "
        "the whole config: `run.yaml`."
    )


def _errors(comparison: Comparison) -> str:
    name, rest = comparison.first, comparison.breakdown
    stats, interval = comparison.tables[name].all, rest.interval_cm[name]
    frames = counted(sum(source.frames for source in comparison.sources), "frame")
    spread = ""
    if interval is not None:
        spread = f" ({show_cm(interval[0])} to {show_cm(interval[1])} over {rest.interval_over})"
    lines = [
        f"On {frames} of {counted(len(comparison.sources), 'test drive')} held out from the "
        f"training, against the {comparison.reference}: RMSE {show_cm(stats.rmse_cm)} cm{spread}, median "
        f"{show_cm(stats.median_cm)}, 95 % below {show_cm(stats.p95_cm)}, worst {show_cm(stats.worst_cm)}."
    ]
    sigma, presence = rest.sigma.get(name), rest.presence.get(name)
    if sigma is not None:
        lines.append(f"{show_share(sigma.coverage['68'])} of the errors lie within one predicted sigma.")
    if presence is not None:
        found, gaps = show_share(presence.recall), show_share(presence.absent_recall)
        absent = f"; of the {presence.absent} that cannot, it calls {gaps} absent" if presence.absent else ""
        lines.append(f"Of the lines that can be seen it finds {found}{absent}.")
    lines.append("All tables, with the other detectors: `results.md`.")
    return "\n".join(lines)


def _one_recording(training: Sequence[LabelSet], tests: Sequence[LabelSet]) -> str:
    """Say how many of the tests are parts of a recording that was also learned from; a paragraph."""
    shared = sum(any(of_one_map(test, labels) for labels in training) for test in tests)
    if not shared:
        return ""
    which = (
        "Test and training" if shared == len(tests) else f"{shared} of the {len(tests)} tests and training"
    )
    return (
        f"\n\n{which} are parts of one recording and come from one map. A mistake of the map is in both and "
        "does not show here; other light, another day or another road were not tried."
    )


def _failures(meta: ModelMeta, comparison: Comparison) -> str:
    errors = comparison.errors_cm[comparison.first]
    known = np.isfinite(errors)
    share = float((errors[known] > LARGE_CM).mean()) if known.any() else 0.0
    lines = [
        f"{100.0 * share:.2f} % of the points are off by more than {LARGE_CM:g} cm; the worst frames are in "
        "`results-worst.jpg`."
    ]
    weak = _weak_spots(comparison)
    if weak:
        lines += [f"RMSE more than {_WORSE:g} times that of the whole:", "\n".join(weak)]
    else:
        lines.append(f"No group of frames, point or drive has an RMSE of {_WORSE:g} times that of the whole.")
    low, high = _widths_cm(meta)
    other = (
        f"of another width than {low} cm" if low == high else f"narrower than {low} or wider than {high} cm"
    )
    lines.append(f"Its training had no lanes {other}, and no roads without painted lines.")
    return "\n\n".join(lines)


def _weak_spots(comparison: Comparison) -> list[str]:
    """Return where the network is much worse than on the whole, a line each."""
    name = comparison.first
    groups = comparison.tables[name].groups
    spots = [
        # The card is about one detector.
        (f"{GROUPS[condition][0].replace('the first detector', 'the network')} {group}", stats)
        for condition, by_detector in comparison.breakdown.groups.items()
        for group, stats in by_detector[name].items()
    ]
    spots += [(f"{p.removesuffix('_cm').replace('_', ' line, ')} cm ahead", groups[p]) for p in POINT_NAMES]
    ranked = sorted(comparison.sources, key=lambda source: -source.detectors[name].rmse_cm)
    spots += [(f"`{s.name.rsplit('/', 1)[-1]}`", s.detectors[name]) for s in ranked[:_N_SOURCES]]
    return [
        f"- {where}: RMSE {show_cm(stats.rmse_cm)} cm, median {show_cm(stats.median_cm)}"
        for where, stats in spots
        if stats.count and stats.rmse_cm > _WORSE * groups["all"].rmse_cm
    ]


def _widths_cm(meta: ModelMeta) -> tuple[str, str]:
    low, high = meta.lane_width_range_cm or (meta.lane_width_cm, meta.lane_width_cm)
    return f"{low:.0f}", f"{high:.0f}"
