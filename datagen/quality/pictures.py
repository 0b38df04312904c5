"""Pictures of a map: from above, and its lines projected into frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from datagen.quality.measure import MapQuality, WrongSection
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.frame_lines import FrameLines
from lanenet.data.maps.mapped_drive import MappedDrive, lines_at
from lanenet.data.segments import true_runs
from lanenet.errors import LanenetError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM
from lanenet.page import Picture
from lanenet.perception.draw import outlined_text

#: Colours, BGR.
_LEFT, _RIGHT, _ADJACENT, _POINT = (80, 220, 80), (220, 80, 220), (200, 200, 80), (60, 60, 255)
_WITHHELD = (40, 40, 255)
#: Least width of an enlarged frame, [px]. Chosen: a phone shows it at half its size.
_TILE_WIDTH = 400
#: Frames in a row of a sheet, and frames of a kind on the report's page.
_COLUMNS, _PICTURES = 4, 8
#: Distance between segments on the picture of a map, relative to their size. Chosen.
_BETWEEN = 0.08


def draw_map(
    path: Path,
    drive_map: DriveMap,
    clouds: list[Float[np.ndarray, "_ 2"]],
    starts: Bool[np.ndarray, "f"],
    size_px: int = 1600,
) -> None:
    """Draw edge points (hue: time), driven path (white), lane lines (green left, magenta right) and a scale.

    Sections that the images contradict are red. Segments are drawn side by side: where they lie relative to
    each other is not known.

    Args:
        path: PNG to write.
        drive_map: The map.
        clouds: Edge points of each frame, frame map; those of the first segment come first.
        starts: Frames that do not continue the frame before them; no path is drawn between the two.
        size_px: Longer side of the picture.
    """
    lanes = []
    for segment, lines in drive_map.lines.items():
        s = drive_map.s_cm[drive_map.segment == segment]
        for line in lines:
            end = s.max() + 60.0 if line.period_cm is None else s.min() + line.period_cm + 2.0
            colour = _ADJACENT if line.rank else _LEFT if line.side == "left" else _RIGHT
            at_cm = line.with_corners(np.arange(s.min(), end, 2.0))
            points, withheld = line.points(at_cm), line.contradicted(at_cm)
            lanes.append((segment, points, colour, 3))
            lanes.append((segment, np.where(withheld[:, None], points, np.nan), _WITHHELD, 7))
    of_cloud = np.sort(drive_map.segment, kind="stable")
    # A line of an adjacent lane may lie beyond all edge points that are drawn.
    known = [(segment, points[np.isfinite(points[:, 0])]) for segment, points, _, _ in lanes]
    known += [*zip(of_cloud.tolist(), clouds, strict=True)]
    known += [*zip(drive_map.segment.tolist(), drive_map.poses[:, None, :2], strict=True)]
    moved = _side_by_side(known)
    clouds = [cloud + moved[segment] for segment, cloud in zip(of_cloud.tolist(), clouds, strict=True)]
    driven_cm = drive_map.poses[:, :2] + np.array([moved[segment] for segment in drive_map.segment.tolist()])
    xy = np.concatenate([points + moved[segment] for segment, points in known])
    low, high = xy.min(axis=0) - 20.0, xy.max(axis=0) + 20.0
    scale = size_px / float((high - low).max())
    width, height = ((high - low) * scale).astype(int) + 1
    image = np.full((height, width, 3), 24, np.uint8)

    def pixels(points: Float[np.ndarray, "m 2"]) -> np.ndarray:
        p = (points - low) * scale
        return np.stack([p[:, 0], height - 1 - p[:, 1]], axis=1).astype(np.int32)

    # Pale and dark, so that the lines stand out.
    hues = np.full((1, len(clouds), 3), 140, np.uint8)
    hues[0, :, 0] = np.linspace(0, 150, len(clouds))
    hues = np.asarray(cv2.cvtColor(hues, cv2.COLOR_HSV2BGR))
    for cloud, colour in zip(clouds, hues[0], strict=True):
        at = pixels(cloud)
        image[at[:, 1], at[:, 0]] = colour
    for segment, points, colour, thickness in lanes:
        _polyline(image, pixels, points + moved[segment], colour, thickness)
    for driven in np.split(driven_cm, np.flatnonzero(starts[1:]) + 1):
        _polyline(image, pixels, driven, (255, 255, 255), 2)
    draw_metre(image, scale)
    write_png(path, image)


def _side_by_side(
    parts: list[tuple[int, Float[np.ndarray, "_ 2"]]],
) -> dict[int, Float[np.ndarray, "2"]]:
    """Find how far each segment is moved to the right, so that none lies on another; the first one stays."""
    moved: dict[int, Float[np.ndarray, "2"]] = {}
    free_cm: float | None = None
    for segment in sorted({number for number, _ in parts}):
        own = np.concatenate([points for number, points in parts if number == segment])
        low, high = own.min(axis=0), own.max(axis=0)
        moved[segment] = np.zeros(2) if free_cm is None else np.array([free_cm - low[0], 0.0])
        free_cm = float(high[0] + moved[segment][0] + max(20.0, _BETWEEN * (high - low).max()))
    return moved


def draw_metre(image: UInt8[np.ndarray, "h w 3"], px_per_cm: float) -> None:
    """Draw a scale of one metre into the lower left corner."""
    y, end = image.shape[0] - 20, 20 + int(100.0 * px_per_cm)
    cv2.line(image, (20, y), (end, y), (255, 255, 255), 2)
    # In proportion, so that it can be read where the picture is shown small.
    size = max(0.5, 0.001 * max(image.shape))
    cv2.putText(image, "1 m", (20, y - 8), cv2.FONT_HERSHEY_SIMPLEX, size, (255, 255, 255), 2, cv2.LINE_AA)


def _polyline(  # type: ignore[no-untyped-def]
    image: UInt8[np.ndarray, "h w 3"], pixels, points: Float[np.ndarray, "m 2"], colour, thickness: int
) -> None:
    for run in true_runs(np.isfinite(points[:, 0])):
        if len(run) > 1:
            at = pixels(points[run]).astype(np.int32)
            cv2.polylines(image, [at], False, colour, thickness, cv2.LINE_AA)


def draw_contact_sheet(path: Path, mapped: MappedDrive, chosen: Int[np.ndarray, "n"]) -> None:
    """Draw the chosen frames of a map with their projected lines (green left, magenta right) and points.

    What is withheld, since its labels are likely to be wrong, is red.
    """
    drive_map, tiles = mapped.drive_map, []
    for k in map(int, chosen):
        lines, wrong = lines_at(drive_map, k), drive_map.errors.withheld[k]
        text = f"{drive_map.frames[k]}"
        kept, withheld = lines.without(wrong), lines.without(~wrong)
        tiles.append(draw_lines(_frame(mapped, k), kept, drive_map.camera, text, withheld))
    write_png(path, _tiled(tiles))


def draw_lines(
    image: UInt8[np.ndarray, "h w 3"],
    lines: FrameLines,
    camera: Camera,
    text: str,
    withheld: FrameLines | None = None,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Enlarge a frame and draw its lane with a text in the corner; what is withheld of it is red."""
    zoom = max(1, round(_TILE_WIDTH / camera.width))
    big = cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)

    def pixels(points_cm: Float[np.ndarray, "m 2"]) -> np.ndarray:
        # Pixel centres are at integers; enlarging moves them by (zoom - 1) / 2.
        return camera.project_ground(points_cm) * zoom + 0.5 * (zoom - 1)

    drawn = [] if withheld is None else [(withheld.left_cm, _WITHHELD), (withheld.right_cm, _WITHHELD)]
    for line, colour in [*drawn, (lines.left_cm, _LEFT), (lines.right_cm, _RIGHT)]:
        at = pixels(line)
        # A fisheye projects points far behind the bumper, too; these are not drawn.
        inside = (
            np.isfinite(at).all(axis=1) & (np.abs(at) < 4 * big.shape[1]).all(axis=1) & (line[:, 1] > -5.0)
        )
        _polyline(big, np.rint, np.where(inside[:, None], at, np.nan), colour, 2)
    rows = np.tile(ROWS_CM, 2)
    for u, v in pixels(np.stack([lines.points_cm, rows], axis=1)):
        if np.isfinite(u) and np.isfinite(v) and abs(u) < 9999 and abs(v) < 9999:
            cv2.circle(big, (round(u), round(v)), 5, _POINT, 1, cv2.LINE_AA)
    outlined_text(big, text, (6, 18), 0.55, (0, 0, 0), (255, 255, 255))
    return np.asarray(big)


def write_png(path: Path, image: UInt8[np.ndarray, "h w *c"]) -> None:
    """Write an image as PNG.

    Raises:
        LanenetError: If it cannot be encoded.
    """
    done, data = cv2.imencode(".png", image)
    if not done:
        raise LanenetError(f"{path}: the picture could not be encoded")
    path.write_bytes(data.tobytes())


def held_out_pictures(mapped: MappedDrive, quality: MapQuality) -> dict[str, list[Picture]]:
    """Draw the best, median and worst held-out frames, with their lines and median residuals.

    A frame without residuals counts as worst: the map expects a line there that is not seen.
    """
    medians = quality.frame_median_px
    order = np.argsort(np.nan_to_num(medians, nan=np.inf), kind="stable")
    if not order.size:
        return {}
    count = min(_PICTURES, max(1, len(order) // 3))
    middle = (len(order) - count) // 2
    picks = {
        "worst": order[::-1][:count],
        "median": order[middle : middle + count],
        "best": order[:count],
    }
    return {title: _held_out(mapped, quality, rows) for title, rows in picks.items()}


def _held_out(mapped: MappedDrive, quality: MapQuality, picks: np.ndarray) -> list[Picture]:
    drive_map = mapped.drive_map
    pictures = []
    for i in picks:
        k, median_px = int(quality.held_out[i]), quality.frame_median_px[i]
        found = f"{median_px * quality.scale:.2f} px" if np.isfinite(median_px) else "nothing found"
        drawn = draw_lines(_frame(mapped, k), lines_at(drive_map, k), drive_map.camera_at(k), "")
        pictures.append(Picture(drawn, f"frame {drive_map.frames[k]}: {found}"))
    return pictures


def withheld_pictures(mapped: MappedDrive, wrong: tuple[WrongSection, ...]) -> list[Picture]:
    """Draw frames that show the longest sections that are withheld, in red."""
    drive_map = mapped.drive_map
    as_mapped = drive_map.without_doubts()
    pictures = []
    for place in wrong[:_PICTURES]:
        k = place.frames[len(place.frames) // 2]
        drawn = draw_lines(
            _frame(mapped, k), lines_at(drive_map, k), drive_map.camera_at(k), "", lines_at(as_mapped, k)
        )
        pictures.append(Picture(drawn, f"frame {drive_map.frames[k]}: {place.name}"))
    return pictures


def _frame(mapped: MappedDrive, k: int) -> UInt8[np.ndarray, "h w *c"]:
    return mapped.drive.image(int(mapped.rows[k]))


def _tiled(tiles: list[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Lay out pictures of one size in rows."""
    tiles = [*tiles, *[np.zeros_like(tiles[0])] * (-len(tiles) % _COLUMNS)]
    rows = [np.hstack(tiles[i : i + _COLUMNS]) for i in range(0, len(tiles), _COLUMNS)]
    return np.asarray(np.vstack(rows), dtype=np.uint8)
