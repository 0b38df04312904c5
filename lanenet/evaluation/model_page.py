"""The report page of a model: how far it is off, where, and beside what."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lanenet.errors import counted
from lanenet.evaluation.comparison import Comparison, SeenSource
from lanenet.evaluation.report import (
    draw_answer,
    find_worst,
    new_figure,
    plot_breakdown,
    plot_errors,
    png_bytes,
)
from lanenet.evaluation.tables import LARGE_CM, TextTable, lay_out, show_cm, show_share
from lanenet.evaluation.verdict import verdict_sentence
from lanenet.geometry.lane import POINT_NAMES, ROWS_CM, SIDES
from lanenet.page import (
    PLOT_DPI,
    PLOT_WIDTH_IN,
    SMALL_PX,
    Picture,
    Row,
    details,
    gallery,
    note,
    page_of,
    plot,
    section,
    subsection,
    table,
)

#: Frames of a kind, and sources named and drawn frame by frame. Chosen: what a person looks at.
_PICTURES, _SOURCES = 8, 3
_COLOURS = "Magenta: the lines by the {reference}; green and orange: left and right line of the answer."


def model_page(
    name: str, comparison: Comparison, seen: Sequence[SeenSource], where: str, doubt: str = ""
) -> str:
    """Write the report of a model, or of another detector, as HTML.

    Args:
        name: What the title calls it.
        comparison: The figures; the detector that the page is about is the first.
        seen: Its answers on the sources that have frames.
        where: On what it was measured, as for :func:`verdict_sentence`.
        doubt: What to know before the figures; may be empty.

    Raises:
        DriveFormatError: If a frame that it shows cannot be read.
    """
    colours, reference = _COLOURS.format(reference=comparison.reference), comparison.reference
    worst = _pictures(seen, [source.answers_cm for source in seen])
    off = _pictures(seen, [source.off_cm for source in seen])
    frames = counted(sum(source.frames for source in comparison.sources), "frame")
    names = [Path(source.name).name for source in comparison.sources]
    sources = ", ".join(names) if len(names) <= _SOURCES else f"{len(names)} drives"
    body = [
        note(doubt) if doubt else "",
        table(point_rows(comparison)),
        note(
            f"Errors in cm against the {reference}, on {frames} of {sources}, by line and distance ahead of "
            "the front axle. Of 100 answers 95 are within p95."
        ),
    ]
    if worst:
        said = "The largest errors, one frame of each place."
        if reference == "map":
            said += " Where the answer lies on the tape and the magenta line beside it, the map is wrong."
        body += [section("Worst frames"), note(f"{said} {colours}"), gallery(worst)]
    if off:
        said = "Both markings can be seen here, and still the answer lies beside one."
        body += [section("Wrong in plain sight"), note(f"{said} {colours}"), gallery(off)]
    along = [
        plot(
            f"{Path(source.frames.name).name}: the largest error of each frame. Dotted: {LARGE_CM:g} cm, "
            "beyond which a lane is hard to follow.",
            plot_along,
            source,
        )
        for source in seen[:_SOURCES]
    ]
    body += [
        section("Along the drive") if any(along) else "",
        *along,
        section("More"),
        details(
            "By distance ahead",
            plot(
                f"Errors against the {reference}: half of them lie in the box, 90 % between the whiskers. "
                "Below: the share of the points that were answered.",
                plot_errors,
                *(comparison, True),
            ),
        ),
        details(
            "In bends, and how well it knows its own errors",
            plot(
                "Above: errors by how much the road bends. Below: how many errors lie within what was "
                "predicted; on the dashed line the predicted uncertainty is right, below it too small.",
                plot_breakdown,
                *(comparison, True),
            ),
        ),
        details("All tables, with the other detectors", *map(_text_table, lay_out(comparison))),
    ]
    return page_of(name, "", verdict_sentence(comparison, seen, where), body)


def point_rows(comparison: Comparison) -> list[Row]:
    """Errors of the first detector by line and distance, [cm]."""
    rows: list[Row] = [("cm", "median", "p95", "worst", "RMSE", "answered")]
    groups = comparison.tables[comparison.first].groups
    names = [f"{side} {row:.0f} cm" for side in SIDES for row in ROWS_CM]
    for shown, key in (("all points", "all"), *zip(names, POINT_NAMES, strict=True)):
        stats = groups[key]
        values = map(show_cm, (stats.median_cm, stats.p95_cm, stats.worst_cm, stats.rmse_cm))
        rows.append((shown, *values, show_share(stats.coverage)))
    return rows


def _pictures(seen: Sequence[SeenSource], answers_cm: Sequence[np.ndarray]) -> list[Picture]:
    """Frames with the largest of these errors; what is drawn is all that was answered."""
    pictures = []
    for found in find_worst([source.frames for source in seen], answers_cm, _PICTURES):
        source = seen[found.source]
        of = f" of {Path(source.frames.name).name}" if len(seen) > 1 else ""
        off_cm = np.abs(answers_cm[found.source][found.row] - source.frames.points_cm[found.row])
        side, row = divmod(int(np.nanargmax(off_cm)), len(ROWS_CM))
        where = f"{SIDES[side]} line {show_cm(found.error_cm)} cm off, {ROWS_CM[row]:.0f} cm ahead"
        line_cm = np.column_stack([source.frames.points_cm[found.row].reshape(len(SIDES), -1)[side], ROWS_CM])
        if not source.frames.camera.shows_ground(line_cm).any():
            where += " (out of view)"
        caption = f"frame {source.frames.frames[found.row]}{of}: {where}"
        image = draw_answer(source.frames, found.row, source.answers_cm[found.row], SMALL_PX)
        pictures.append(Picture(image, caption))
    return pictures


def plot_along(source: SeenSource) -> bytes | None:
    """Draw the largest error of each frame, [cm]; None without an answer, or without Matplotlib."""
    error_cm = np.abs(source.answers_cm - source.frames.points_cm)
    known = np.isfinite(error_cm).any(axis=1)
    figure = new_figure(PLOT_WIDTH_IN, 2.4, PLOT_DPI) if known.any() else None
    if figure is None:
        return None
    axes = figure.add_subplot()
    axes.plot(source.frames.frames[known], np.nanmax(error_cm[known], axis=1), ".", color="#2060c0", ms=3)
    axes.axhline(LARGE_CM, color="#c0392b", lw=1.2, ls=":")
    axes.grid(True, alpha=0.3)
    axes.set(ylim=(0.0, None), xlabel="frame", ylabel="largest error, cm")
    return png_bytes(figure)


def _text_table(shown: TextTable) -> str:
    return subsection(shown.title) + table([shown.header, *shown.lines], shown.texts) + note(shown.note)
