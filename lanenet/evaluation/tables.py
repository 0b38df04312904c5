"""A comparison as tables, for a terminal and for a report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich import box
from rich.table import Table

from lanenet.errors import printable
from lanenet.evaluation.comparison import Comparison
from lanenet.evaluation.decisions import SURELY_CM
from lanenet.evaluation.errors import GROUPS, INTERVALS, ErrorStats
from lanenet.evaluation.plain_sight import OFF_CM
from lanenet.geometry.lane import POINT_NAMES, ROWS_CM, SIDES

#: Larger errors make a lane hard to follow. Chosen: a tenth of a 40 cm lane.
LARGE_CM = 4.0
_STATS = ("RMSE", "median", "p95", "worst")
_PRESENCE = ("line precision", "line recall", "absent recall")


@dataclass(frozen=True)
class TextTable:
    """A table as text.

    Attributes:
        title: What it shows.
        header: Of the columns.
        lines: Cells.
        note: How to read it.
        texts: Number of columns, from the left, that are text and not figures.
        grouped: Separate lines where the first cell changes; an empty cell continues the group.
    """

    title: str
    header: Sequence[str]
    lines: Sequence[Sequence[str]]
    note: str
    texts: int = 1
    grouped: bool = False

    def as_markdown(self) -> str:
        """Return title, table and note as Markdown."""
        figures = len(self.header) - self.texts
        rule = [*["---"] * self.texts, *["---:"] * figures]
        rows = "\n".join("| " + " | ".join(line) + " |" for line in [self.header, rule, *self.lines])
        return f"{self.title}\n\n{rows}\n\n{self.note}\n"

    def as_rich(self) -> Table:
        """Return a table narrow enough for a terminal of 80 columns."""
        table = Table(
            title=printable(self.title),
            title_justify="left",
            caption=printable(self.note),
            box=box.SIMPLE,
            pad_edge=False,
        )
        for i, name in enumerate(self.header):
            justify = "left" if i < self.texts else "right"
            table.add_column(printable(name).replace(" ", "\n"), justify=justify, no_wrap=True)  # type: ignore[arg-type]
        nexts = [line[0] for line in self.lines[1:]]
        for line, following in zip(self.lines, [*nexts, ""], strict=True):
            table.add_row(*map(printable, line), end_section=self.grouped and following not in ("", line[0]))
        return table


def lay_out(comparison: Comparison) -> list[TextTable]:
    """Lay out a comparison: by point, with masked ones, shared points, by source and condition, sigma."""
    tables = main_tables(comparison, list(comparison.tables))
    if comparison.whole:
        tables.append(_with_masked(comparison))
    if comparison.shared:
        tables.append(_on_shared_points(comparison))
    if comparison.plain:
        tables.append(_in_plain_sight(comparison))
    if len(comparison.sources) > 1:
        tables.append(_by_source(comparison))
    for condition, by_detector in comparison.breakdown.groups.items():
        groups = by_detector[comparison.first].values()
        # A single group repeats the first table.
        if sum(stats.truth_count > 0 for stats in groups) > 1:
            tables.append(_by_condition(comparison, condition))
    if comparison.breakdown.sigma or comparison.breakdown.presence:
        tables.append(_sigma_and_presence(comparison))
    return tables


def main_tables(comparison: Comparison, names: Sequence[str]) -> list[TextTable]:
    """Lay out the errors by point and the wrong decisions of some of the detectors."""
    return [_by_point(comparison, names), _decided(comparison, names)]


def as_markdown(comparison: Comparison) -> str:
    """Return all tables of a comparison as Markdown."""
    return "\n".join(table.as_markdown() for table in lay_out(comparison))


def _by_point(comparison: Comparison, names: Sequence[str]) -> TextTable:
    lines = []
    for name in names:
        table = comparison.tables[name]
        groups = [table.groups[group] for group in ("all", *POINT_NAMES)]
        values = zip(*(_values(stats) for stats in groups), strict=True)
        rows = [[label, *map(show_cm, row)] for label, row in zip(_STATS, values, strict=True)]
        rows.append(["answered", *map(_percent, groups)])
        lines += [[name if i == 0 else "", *row] for i, row in enumerate(rows)]
    counts = {table.all.truth_count for table in comparison.tables.values()}
    frames = sum(source.frames for source in comparison.sources)
    note = (
        f"{counts.pop()} labelled points of {frames} frames; the columns are the line and the distance ahead "
        "in cm"
    )
    intervals = [
        f"{name} {show_cm(ends[0])} to {show_cm(ends[1])}"
        for name, ends in comparison.breakdown.interval_cm.items()
        if ends is not None and name in names
    ]
    if intervals:
        over = comparison.breakdown.interval_over
        note += f". 95 % intervals of the RMSE over {over}: {', '.join(intervals)}"
    return TextTable(
        title=f"Errors in cm against the {comparison.reference}",
        header=["detector", "", "all", *(f"{side} {row:.0f}" for side in SIDES for row in ROWS_CM)],
        lines=lines,
        note=note,
        texts=2,
        grouped=True,
    )


def _decided(comparison: Comparison, names: Sequence[str]) -> TextTable:
    lines, intervals = [], []
    for name in names:
        found, cells = comparison.decisions[name], list[str]()
        for kind, wrong in (("wrong lane", found.wrong_lane), ("surely wrong", found.surely_wrong)):
            share = wrong.frames / found.frames if found.frames else math.nan
            cells += [f"{1000.0 * share:.1f}" if found.frames else "-", str(wrong.events)]
            if wrong.interval is not None and wrong.frames:
                low, high = (1000.0 * end for end in wrong.interval)
                intervals.append(f"{name}, {kind}: {low:.1f} to {high:.1f}")
        errors = map(show_cm, (found.rmse_cm, found.p95_cm, found.p99_cm))
        lines.append([name, str(found.frames), *cells, *errors])
    note = (
        "per 1000 frames, and as events (runs of frames). Wrong lane: the centre is off by more than half of "
        f"the lane's width; surely wrong: a point by more than three of its sigmas and {SURELY_CM:.0f} cm. "
        "The errors, in cm, are those of the frames that are not in a wrong lane"
    )
    if intervals:
        note += f". 95 % intervals over {comparison.breakdown.interval_over}: {'; '.join(intervals)}"
    return TextTable(
        title="Wrong decisions, and errors where the lane is right",
        header=["detector", "frames", "wrong lane", "events", "surely wrong", "events", "RMSE", "p95", "p99"],
        lines=lines,
        note=note,
    )


def _with_masked(comparison: Comparison) -> TextTable:
    lines = []
    for name, whole in comparison.whole.items():
        groups = {"label": comparison.tables[name].all, "masked": whole.masked, "all": whole.all}
        for i, (points, stats) in enumerate(groups.items()):
            count, values = str(stats.truth_count), map(show_cm, _values(stats))
            lines.append([name if i == 0 else "", points, count, _percent(stats), *values])
    return TextTable(
        title="All points whose place is known, in cm, and those without a label apart",
        header=["detector", "which", "points", "answered", *_STATS],
        lines=lines,
        note="masked: beside the network's window, or of a car that is on the line between two lanes; the "
        "other tables count points with a label only",
        texts=2,
        grouped=True,
    )


def _on_shared_points(comparison: Comparison) -> TextTable:
    first = comparison.first
    lines = []
    for name, shared in comparison.shared.items():
        groups = {"all": shared, **comparison.shared_rows[name]}
        for rows, pair in groups.items():
            for label, stats in ((name, pair.own), (first, pair.first)):
                share = _percent(stats) if label == name else ""
                lines.append([label, rows if label == name else "", share, *map(show_cm, _values(stats))])
    return TextTable(
        title=f"Each detector and {first} on the points that both answered, in cm",
        header=["detector", "rows", "shared", *_STATS],
        lines=lines,
        note=f"two lines each: a detector, and {first} on the same points; shared: of the labelled points. "
        "No frame shows y = 0: a detector that measures edges extrapolates there",
        texts=2,
    )


def _in_plain_sight(comparison: Comparison) -> TextTable:
    lines = []
    for name, found in comparison.plain.items():
        per_1000 = f"{1000.0 * found.off / found.answered:.1f}" if found.answered else "-"
        lines.append([name, *map(str, (found.frames, found.answered, found.off)), per_1000])
    return TextTable(
        title="Frames with both markings in plain sight",
        header=["detector", "frames", "answered", "off", "off per 1000"],
        lines=lines,
        note=f"off: an answer at y = 15 or 30 cm lies more than {OFF_CM:.0f} cm across off a marking",
    )


def _by_source(comparison: Comparison) -> TextTable:
    names = list(comparison.tables)
    mixed = len({source.reference for source in comparison.sources}) > 1
    lines = []
    for source in comparison.sources:
        cells = (source.detectors[name] for name in names)
        shown = [f"{show_cm(s.rmse_cm)} {_percent(s)}" for s in cells]
        # If all sources are alike, the title of the first table says it.
        name = Path(source.name).name + (f" ({source.reference})" if mixed else "")
        lines.append([name, *shown])
    return TextTable(
        title="RMSE in cm by source, with the share of points that were answered",
        header=["source", *names],
        lines=lines,
        note="a detector that answers less may show a smaller error",
    )


def _by_condition(comparison: Comparison, condition: str) -> TextTable:
    unit, groups = GROUPS[condition]
    by_detector = comparison.breakdown.groups[condition]
    lines = []
    for name, _ in groups:
        cells = [by_detector[detector][name] for detector in comparison.tables]
        lines.append([name, str(cells[0].truth_count), *(show_cm(stats.rmse_cm) for stats in cells)])
    return TextTable(
        title=f"RMSE in cm by {condition}",
        header=[condition, "points", *comparison.tables],
        lines=lines,
        note=unit,
    )


def _sigma_and_presence(comparison: Comparison) -> TextTable:
    breakdown, lines = comparison.breakdown, []
    for name in comparison.tables:
        sigma, presence = breakdown.sigma.get(name), breakdown.presence.get(name)
        if sigma is None and presence is None:
            continue
        shares: list[float | None] = [None, None] if sigma is None else list(sigma.coverage.values())
        shares += (
            [None, None, None]
            if presence is None
            else [presence.precision, presence.recall, presence.absent_recall]
        )
        median = "-" if sigma is None else show_cm(sigma.median_sigma_cm)
        lines.append([name, median, *map(show_share, shares)])
    return TextTable(
        title="Predicted uncertainty and presence",
        header=["detector", "sigma", *(f"{name}% interval" for name in INTERVALS), *_PRESENCE],
        lines=lines,
        note="median sigma in cm; share of the errors within the intervals; share of the predicted lines "
        "that can be seen, of the lines that can be seen those predicted, of the absent lines those not",
    )


def show_share(value: float | None) -> str:
    """Show a share in per cent; a dash if it is unknown."""
    return "-" if value is None or math.isnan(value) else f"{100.0 * value:.0f}%"


def _values(stats: ErrorStats) -> tuple[float, float, float, float]:
    return stats.rmse_cm, stats.median_cm, stats.p95_cm, stats.worst_cm


def _percent(stats: ErrorStats) -> str:
    return f"{100.0 * stats.coverage:.0f}%" if stats.truth_count else "-"


def show_cm(value: float) -> str:
    """Show a length, [cm], with about three digits."""
    if math.isnan(value):
        return "-"
    return f"{value:.2f}" if value < 9.995 else f"{value:.1f}" if value < 99.95 else f"{value:.0f}"
