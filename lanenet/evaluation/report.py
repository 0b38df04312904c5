"""The files of a report: tables, plots of errors by row and bend, coverage of sigma, and the worst frames."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.data.maps.mapped_drive import LabelledFrames
from lanenet.errors import LabelFormatError
from lanenet.evaluation.comparison import Comparison, SeenSource
from lanenet.evaluation.errors import GROUPS, RELIABILITY_SHARES
from lanenet.evaluation.tables import as_markdown
from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.page import PLOT_DPI, PLOT_WIDTH_IN, jpeg_bytes
from lanenet.perception.draw import LEFT_BGR, RIGHT_BGR, TRUTH_BGR, draw_estimate
from lanenet.perception.estimate import LaneEstimate

#: Smaller errors are drawn as this, [cm]: on a logarithmic axis the simulator's rounding would only stretch
#: it.
_LEAST_CM = 0.01
#: Of the sheet of worst frames: width of a frame, frames side by side, height of the legend.
_TILE_WIDTH_PX, _COLUMNS, _LEGEND_PX = 400, 4, 24
#: Neighbours look alike: of frames this close only the worst is shown. Chosen.
_APART_FRAMES = 15
#: Frames at most with an answer off a marking in plain sight. Chosen: as many as a person looks at.
_OFF_FRAMES = 20


def report_files(comparison: Comparison, seen: Sequence[SeenSource]) -> dict[str, str | bytes]:
    """Return the files of a report, by the ending of the name.

    Args:
        comparison: The figures.
        seen: The first detector's points on each source with frames.

    Returns:
        ``.md``, and where they can be made ``.png`` (errors by row), ``-breakdown.png`` (errors by bend, and
        coverage of sigma), ``-worst.jpg`` (the frames with the first detector's largest errors) and
        ``-plain.jpg`` (the same of the frames in which it is off a marking in plain sight).
    """
    frames, answers_cm = [source.frames for source in seen], [source.answers_cm for source in seen]
    worst = find_worst(frames, answers_cm)
    off = find_worst(frames, [source.off_cm for source in seen], _OFF_FRAMES)
    files = {
        ".md": as_markdown(comparison),
        ".png": plot_errors(comparison),
        "-breakdown.png": plot_breakdown(comparison),
        "-worst.jpg": jpeg_bytes(draw_worst(frames, answers_cm, worst)) if worst else None,
        "-plain.jpg": jpeg_bytes(draw_worst(frames, answers_cm, off)) if off else None,
    }
    return {ending: content for ending, content in files.items() if content is not None}


def new_figure(width_in: float, height_in: float, dpi: int = 100) -> Any | None:
    """Return an empty figure; None where Matplotlib is not installed.

    Made without pyplot, which picks a window system and keeps global state.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return None
    figure = Figure(figsize=(width_in, height_in), dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


def png_bytes(figure: Any) -> bytes:
    """Return a figure as a PNG, cropped to what is drawn."""
    png = io.BytesIO()
    figure.savefig(png, format="png", bbox_inches="tight")
    return png.getvalue()


def plot_errors(comparison: Comparison, on_page: bool = False) -> bytes | None:
    """Draw a box per detector and row: quartiles and median of the error, whiskers at 5 and 95 %.

    Below each box stands the share of the labelled points that were answered.

    Args:
        comparison: The figures.
        on_page: For a page that fits a phone, and has a caption in place of the title.

    Returns:
        A PNG, or None where Matplotlib is not installed.
    """
    figure = new_figure(PLOT_WIDTH_IN, 4.0, PLOT_DPI) if on_page else new_figure(9.0, 5.0)
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
                share,
                (x, 0.01),
                xycoords=("data", "axes fraction"),
                ha="center",
                fontsize=5 if on_page else 8,
                color=f"C{i}",
            )
    axes.set(yscale="log", xlim=(-0.5, len(ROWS_CM) - 0.5), ylabel="error, cm")
    axes.set_xticks(range(len(ROWS_CM)), [f"y = {row:.0f} cm" for row in ROWS_CM])
    if not on_page:
        title = "Quartiles, whiskers at 5 and 95 %; below: points answered"
        axes.set_title(f"Against the {comparison.reference}. {title}", fontsize=10)
    axes.grid(True, axis="y", which="major", alpha=0.3)
    # Room for the shares below the boxes.
    low, high = axes.get_ylim()
    axes.set_ylim(low * (low / high) ** 0.08, high)
    handles = [Patch(facecolor=f"C{i}", label=name) for i, name in enumerate(names)]
    # Below the axes, where no box is covered.
    size, columns = (7, 3) if on_page else (9, len(names))
    axes.legend(
        handles=handles, fontsize=size, ncols=columns, loc="upper center", bbox_to_anchor=(0.5, -0.07)
    )
    return png_bytes(figure)


def _row_errors(errors_cm: Float[np.ndarray, "n 6"], row: int) -> Float[np.ndarray, "_"]:
    """The answered errors of both lines on a row."""
    found = errors_cm[:, [side * len(ROWS_CM) + row for side in range(len(SIDES))]].ravel()
    return np.maximum(found[np.isfinite(found)], _LEAST_CM)


def plot_breakdown(comparison: Comparison, on_page: bool = False) -> bytes | None:
    """Draw the RMSE by curvature of the lane, and the reliability diagram of the sigmas.

    Args:
        comparison: The figures.
        on_page: As for :func:`plot_errors`.

    Returns:
        A PNG, or None where Matplotlib is not installed.
    """
    figure = new_figure(PLOT_WIDTH_IN, 7.0, PLOT_DPI) if on_page else new_figure(10.0, 4.5)
    if figure is None:
        return None
    bend, coverage = figure.subplots(*((2, 1) if on_page else (1, 2)))
    figure.subplots_adjust(hspace=0.35)
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
    coverage.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linestyle="--", label="calibrated")
    for i, name in enumerate(names):
        own = comparison.breakdown.sigma.get(name)
        if own is not None:
            coverage.plot(RELIABILITY_SHARES, own.reliability, marker="o", color=f"C{i}", label=name)
    labels = {
        "xlabel": "share of the errors that the interval should hold",
        "ylabel": "share that lies in it",
    }
    coverage.set(**labels, xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    coverage.set_title("Above the line: sigma too large; below: too small", fontsize=10)
    coverage.grid(True, alpha=0.3)
    coverage.legend(fontsize=8)
    return png_bytes(figure)


@dataclass(frozen=True)
class WorstFrame:
    """A frame and its error.

    Attributes:
        source: Position of its source.
        row: Position of the frame in its source.
        error_cm: Largest error of its answered points.
    """

    source: int
    row: int
    error_cm: float


def find_worst(
    sources: Sequence[LabelledFrames], answers_cm: Sequence[Float[np.ndarray, "_ 6"]], count: int = 12
) -> list[WorstFrame]:
    """Return the frames with the largest errors, the worst first, without close neighbours.

    Args:
        sources: Frames and labels.
        answers_cm: A detector's six points for each frame of each source; NaN where it has no answer.
        count: Frames at most.
    """
    candidates = []
    for k, (source, answer) in enumerate(zip(sources, answers_cm, strict=True)):
        if answer.shape != source.points_cm.shape:
            raise LabelFormatError(
                f"{source.name}: answers of shape {answer.shape}, expected {source.points_cm.shape}"
            )
        error = np.nan_to_num(np.abs(answer - source.points_cm), nan=-1.0).max(axis=1)
        candidates += [WorstFrame(k, int(i), float(error[i])) for i in np.flatnonzero(error >= 0.0)]
    candidates.sort(key=lambda frame: -frame.error_cm)
    chosen: list[WorstFrame] = []
    for frame in candidates:
        near = (f for f in chosen if f.source == frame.source and abs(f.row - frame.row) < _APART_FRAMES)
        if len(chosen) < count and not any(near):
            chosen.append(frame)
    return chosen


def draw_worst(
    sources: Sequence[LabelledFrames],
    answers_cm: Sequence[Float[np.ndarray, "_ 6"]],
    worst: Sequence[WorstFrame],
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw frames side by side, with a legend of the colours below.

    The labels are magenta, the answer is green (left) and orange (right).

    Args:
        sources: As for :func:`find_worst`.
        answers_cm: As for :func:`find_worst`.
        worst: At least one frame.

    Raises:
        DriveFormatError: If a frame cannot be read.
    """
    tiles: list[UInt8[np.ndarray, "h w 3"]] = []
    for item in worst:
        source = sources[item.source]
        text = f"{Path(source.name).name} {source.frames[item.row]}: {item.error_cm:.1f} cm"
        image = draw_answer(source, item.row, answers_cm[item.source][item.row], text=text)
        if tiles and image.shape != tiles[0].shape:
            # Cameras of different sources may differ in size.
            height, width = tiles[0].shape[:2]
            image = np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
        tiles.append(image)
    columns = min(_COLUMNS, len(tiles))
    while len(tiles) % columns:
        tiles.append(np.zeros_like(tiles[0]))
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    return np.vstack([*rows, _legend(rows[0].shape[1])])


def draw_answer(
    source: LabelledFrames,
    row: int,
    answer_cm: Float[np.ndarray, "6"],
    width_px: int = _TILE_WIDTH_PX,
    text: str = "",
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a frame, enlarged to about this width, with its labels, an answer to it, and a text in the corner.

    Raises:
        DriveFormatError: If the frame cannot be read.
    """
    return draw_estimate(
        source.image(row),
        LaneEstimate(points_cm=answer_cm),
        source.camera,
        max(1, round(width_px / source.camera.width)),
        text,
        truth_cm=source.points_cm[row],
    )


def _legend(width_px: int) -> UInt8[np.ndarray, "h w 3"]:
    strip = np.zeros((_LEGEND_PX, width_px, 3), dtype=np.uint8)
    x = y = _LEGEND_PX // 3
    for text, colour in (("labels", TRUTH_BGR), ("answer: left", LEFT_BGR), ("right", RIGHT_BGR)):
        font, size = cv2.FONT_HERSHEY_SIMPLEX, _LEGEND_PX / 50.0
        cv2.putText(strip, text, (x, _LEGEND_PX - y), font, size, colour, 1, cv2.LINE_AA)
        x += cv2.getTextSize(text, font, size, 1)[0][0] + _LEGEND_PX // 2
    return strip
