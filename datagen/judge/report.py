"""What a contest leaves: tables by kind of road and entrant, and top views with the driven paths."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from datagen.judge.run import RunResult, Trajectory
from datagen.judge.settings import JudgeSettings
from datagen.world.road.track import Track
from datagen.world.road.track_picture import FIXED_BITS, box_corners_cm, paint_track, painted_bounds_cm
from lanenet.data.files import write_json, write_text
from lanenet.data.tables import write_csv
from lanenet.errors import counted

FORMAT = "lanenet-judge/1"

#: Header, measure, decimals, factor; each shown as mean/worst over the runs.
_MEASURES: tuple[tuple[str, str, int, float], ...] = (
    ("departures", "departures", 1, 1.0),
    ("put back", "put_backs", 1, 1.0),
    ("offset, cm", "mean_offset_cm", 2, 1.0),
    ("furthest, cm", "worst_offset_cm", 1, 1.0),
    ("steer, rad/s", "steering_rms_rad_s", 2, 1.0),
    ("no answer, %", "unanswered", 1, 100.0),
    ("time, s", "time_s", 0, 1.0),
)
_COUNTS = ("completed", "clean")
#: In addition, where cars start across their lane.
_BACK = "back in lane"
_BACK_MEASURE = ("back after, s", "back_after_s", 1, 1.0)

_SIDE_PX = 1100  # of the longer side of the road
_MARGIN_CM = 50.0
_BESIDE_PAINT_CM = 3.0
_ROW_PX = 26
_GROUND_BGR, _ROAD_BGR, _TEXT_BGR = (225, 228, 225), (120, 120, 120), (30, 30, 30)
#: BGR by place among the entrants; more of them start over.
COLOURS_BGR: tuple[tuple[int, int, int], ...] = (
    (40, 40, 40),
    (230, 140, 20),
    (30, 160, 40),
    (20, 110, 245),
    (200, 40, 200),
    (40, 40, 220),
    (200, 190, 0),
)


#: From the map to the image, in OpenCV's fixed point.
_Fixed = Callable[[Float[np.ndarray, "n 2"]], np.ndarray]


def summarise(results: Sequence[RunResult]) -> list[dict[str, Any]]:
    """Return a row per kind of road and entrant, in the order in which they first occur.

    Returns:
        ``kind``, ``entrant``, ``runs``, ``completed``, ``clean`` (completed without a departure), ``back``
        (in the lane after a start across it), ``laps_mean``, and ``*_mean`` and ``*_worst`` of the measures
        of :class:`RunResult`.
    """
    groups: dict[tuple[str, str], list[RunResult]] = {}
    for result in results:
        groups.setdefault((result.kind, result.entrant), []).append(result)
    rows = []
    for (kind, entrant), runs in groups.items():
        row: dict[str, Any] = {
            "kind": kind,
            "entrant": entrant,
            "runs": len(runs),
            "completed": sum(run.completed for run in runs),
            "clean": sum(run.completed and run.departures == 0 for run in runs),
            "back": sum(run.back for run in runs),
            "laps_mean": float(np.mean([run.laps for run in runs])),
        }
        for _, name, _, _ in (*_MEASURES, _BACK_MEASURE):
            values = [float(getattr(run, name)) for run in runs]
            row |= {f"{name}_mean": float(np.mean(values)), f"{name}_worst": max(values)}
        rows.append(row)
    return rows


def tables(results: Sequence[RunResult]) -> dict[str, list[list[str]]]:
    """Return a table per kind of road, as text: a row per entrant, under the headers of its first row."""
    counts, measures = list(_COUNTS), list(_MEASURES)
    headers = ["", *_COUNTS]
    if any(result.across_deg for result in results):
        counts, headers = [*counts, "back"], [*headers, _BACK]
        measures = [_BACK_MEASURE, *measures]
    headers += [header for header, *_ in measures]
    found: dict[str, list[list[str]]] = {}
    for row in summarise(results):
        cells = [row["entrant"], *(f"{row[count]}/{row['runs']}" for count in counts)]
        for _, measure, decimals, factor in measures:
            values = (row[f"{measure}_mean"] * factor, row[f"{measure}_worst"] * factor)
            cells.append("/".join(f"{value:.{decimals}f}" for value in values))
        found.setdefault(row["kind"], [headers]).append(cells)
    return found


def table_title(settings: JudgeSettings, kind: str) -> str:
    """Return a line that says what was driven."""
    far = counted(settings.laps, "lap")
    if settings.distance_cm is not None:
        far += f", at most {settings.distance_cm:g} cm,"
    if settings.start_across_deg:
        far = f"started {settings.start_across_deg:g} degrees across, {far}"
    roads = counted(settings.counts.get(kind, settings.count), "road")
    return (
        f"{kind}: {roads}, {far} at {settings.speed_cm_s:g} cm/s, "
        f"{settings.simulation.rate_hz:g} frames/s, {settings.pilot.law}, seed {settings.seed}; "
        "mean/worst over the runs"
    )


def write_report(out: Path, settings: JudgeSettings, results: Sequence[RunResult]) -> list[Path]:
    """Write ``results.json``, ``results.md`` and ``runs.csv`` (a row per run); returns their paths."""
    paths = [out / "results.json", out / "results.md", out / "runs.csv"]
    data = {
        "format": FORMAT,
        "settings": settings.model_dump(mode="json"),
        "summary": summarise(results),
        "runs": [asdict(result) for result in results],
    }
    write_json(paths[0], data)
    lines = []
    for kind, (headers, *rows) in tables(results).items():
        lines += [f"# {table_title(settings, kind)}", "", "| " + " | ".join(headers) + " |"]
        lines.append("|---|" + "---:|" * (len(headers) - 1))
        lines += [*("| " + " | ".join(row) + " |" for row in rows), ""]
    write_text(paths[1], "\n".join(lines))
    names = [field.name for field in fields(RunResult)]
    write_csv(paths[2], {name: [getattr(result, name) for result in results] for name in names})
    return paths


def draw_top_view(
    track: Track, runs: Sequence[tuple[RunResult, Trajectory]], title: str
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a road and the runs on it, as :func:`draw_runs` does, below a line for each run.

    Args:
        track: The road.
        runs: Results and trajectories, in the order of their colours.
        title: For the top left corner.
    """
    road = draw_runs(track, runs)
    header = np.full((_ROW_PX * (len(runs) + 1) + 12, max(760, road.shape[1]), 3), _GROUND_BGR, np.uint8)
    _write(header, title, 0, _TEXT_BGR)
    for index, (result, _) in enumerate(runs):
        _write(header, f"{result.entrant}: {run_text(result)}", index + 1, colour_of(index))
    beside = np.full((len(road), header.shape[1] - road.shape[1], 3), _GROUND_BGR, np.uint8)
    return np.vstack([header, np.hstack([road, beside])])


def run_text(result: RunResult) -> str:
    """Say how a run went."""
    text = (
        f"{result.laps:.2f} laps, {counted(result.departures, 'departure')}, {result.put_backs} put back, "
        f"offset {result.mean_offset_cm:.2f} cm mean, {result.worst_offset_cm:.1f} cm worst"
    )
    if result.across_deg:
        text += f", back after {result.back_after_s:.1f} s" if result.back else ", not back"
    return text


def colour_of(index: int) -> tuple[int, int, int]:
    """Return the colour of an entrant's path, BGR."""
    return COLOURS_BGR[index % len(COLOURS_BGR)]


def draw_runs(track: Track, runs: Sequence[tuple[RunResult, Trajectory]]) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a road and the runs on it.

    A filled dot marks where a departure begins, a cross where the car was put back.

    Args:
        track: The road.
        runs: Results and trajectories, in the order of their colours.
    """
    # Markings reach beyond the driven lane where the road has another one.
    half_cm = 0.5 * track.lane_width_cm
    sides_cm = [-half_cm, half_cm, *(marking.offset_cm for marking in track.markings)]
    low_cm, high_cm = painted_bounds_cm(track, _MARGIN_CM)
    size_cm = high_cm - low_cm
    scale = _SIDE_PX / float(size_cm.max())
    width, height = np.rint(size_cm * scale).astype(int).tolist()
    image = np.full((height, width, 3), _GROUND_BGR, np.uint8)

    def fixed(xy_cm: Float[np.ndarray, "n 2"]) -> np.ndarray:
        """Points in OpenCV's fixed point; y of the map is up."""
        px = (xy_cm - [low_cm[0], high_cm[1]]) * [scale, -scale]
        return np.rint(px * (1 << FIXED_BITS)).astype(np.int32)

    road_px = max(1, round(scale * (max(sides_cm) - min(sides_cm) + 6.0)))
    middle_cm = track.beside(np.arange(len(track.s_cm)), 0.5 * (max(sides_cm) + min(sides_cm)))
    points = fixed(middle_cm)
    cv2.polylines(image, [points], track.closed, _ROAD_BGR, road_px, cv2.LINE_AA, FIXED_BITS)
    _pave_furniture(image, track, fixed, scale)
    paint_track(image, track, fixed)
    for index, (_, trajectory) in enumerate(runs):
        # Later ones are thinner, so that equal paths below stay visible.
        thickness = min(2 + len(runs) - 1 - index, 7)
        _draw_run(image, trajectory, colour_of(index), thickness, fixed)
    _draw_start(image, track, max(sides_cm) + 18.0, fixed)
    return image


def _pave_furniture(image: UInt8[np.ndarray, "h w 3"], track: Track, fixed: _Fixed, px_per_cm: float) -> None:
    """Draw the ground of bays and side roads, since white paint needs something darker below it."""
    paved = np.zeros(image.shape[:2], np.uint8)
    for box in track.boxes:
        cv2.fillPoly(paved, [fixed(box_corners_cm(box, _BESIDE_PAINT_CM))], 255, cv2.LINE_8, FIXED_BITS)
    # What lies between the lines of a side road and the road itself is road as well.
    side_px = 1 + round(2.0 * track.half_width_cm * px_per_cm)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side_px, side_px))
    paved = cv2.morphologyEx(paved, cv2.MORPH_CLOSE, disc)
    road = (image == _ROAD_BGR).all(axis=2).astype(np.uint8) * 255
    joined = cv2.morphologyEx(paved | road, cv2.MORPH_CLOSE, disc)
    image[(joined & cv2.dilate(paved, disc)) > 0] = _ROAD_BGR


def _draw_run(
    image: UInt8[np.ndarray, "h w 3"],
    trajectory: Trajectory,
    colour: tuple[int, int, int],
    thickness: int,
    fixed: _Fixed,
) -> None:
    points = fixed(trajectory.xy_cm)
    for section in np.split(points, np.flatnonzero(trajectory.put_back) + 1):
        if len(section):
            cv2.polylines(image, [section], False, colour, thickness, cv2.LINE_AA, FIXED_BITS)
    begins = np.flatnonzero(trajectory.over & ~np.concatenate([[False], trajectory.over[:-1]]))
    for x, y in points[begins].tolist():
        cv2.circle(image, (x, y), 5 << FIXED_BITS, colour, -1, cv2.LINE_AA, FIXED_BITS)
        cv2.circle(image, (x, y), 5 << FIXED_BITS, (255, 255, 255), 1, cv2.LINE_AA, FIXED_BITS)
    for x, y in (points[trajectory.put_back] >> FIXED_BITS).tolist():
        cv2.drawMarker(image, (x, y), colour, cv2.MARKER_TILTED_CROSS, 14, 3)


def _draw_start(image: UInt8[np.ndarray, "h w 3"], track: Track, offset_cm: float, fixed: _Fixed) -> None:
    """An arrow beside the start, in the direction of travel."""
    heading = float(track.heading_rad[0])
    ahead, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    tail_cm = track.xy_cm[0] + offset_cm * left
    tail, tip = (fixed(np.stack([tail_cm, tail_cm + 40.0 * ahead])) >> FIXED_BITS).tolist()
    cv2.arrowedLine(image, tail, tip, _TEXT_BGR, 2, cv2.LINE_AA, tipLength=0.35)


def _write(image: UInt8[np.ndarray, "h w 3"], text: str, row: int, colour: tuple[int, int, int]) -> None:
    place = (12, _ROW_PX * (row + 1))
    cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, colour, 2 if row else 1, cv2.LINE_AA)
