"""Pictures of a map: from above, and its lines projected into frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from datagen.quality.measure import WrongSection
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.mapped_drive import MappedDrive, lines_at
from lanenet.errors import LanenetError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS, ROWS_CM
from lanenet.page import Picture
from lanenet.perception.draw import LEFT_BGR, MEMORY_BGR, TEXT_BGR, TRUTH_BGR, draw_estimate, draw_polyline
from lanenet.perception.estimate import LaneEstimate

#: What is withheld, and the points of labels, BGR.
_RED_BGR = (40, 40, 255)
#: Least width of an enlarged frame, [px]. Chosen: a phone shows it at half its size.
_TILE_WIDTH = 400
#: Frames in a row of a sheet, and frames of a kind on the report's page.
_COLUMNS, _PICTURES = 4, 8
#: Longer side of the picture of a map, [px], room around it and between its segments, [cm], and distance of
#: the scale from its edges, [px]. Chosen.
_SIZE_PX, _ROOM_CM, _CORNER_PX = 1600, 20.0, 20


def draw_map(
    path: Path, drive_map: DriveMap, clouds: list[Float[np.ndarray, "_ 2"]], starts: Bool[np.ndarray, "f"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Draw edge points (hue: time), driven path (white), lane lines (green left, magenta right) and a scale.

    Sections that the images contradict are red. Segments are drawn side by side: where they lie relative to
    each other is not known.

    Args:
        path: PNG to write.
        drive_map: The map.
        clouds: Edge points of each frame, frame map; those of the first segment come first.
        starts: Frames that do not continue the frame before them; no path is drawn between the two.

    Returns:
        The picture.
    """
    of_cloud = np.sort(drive_map.segment, kind="stable").tolist()
    strokes = []
    for segment, lines in drive_map.lines.items():
        for line in lines:
            at_cm = line.with_corners(np.arange(*line.span_cm, 2.0))
            points, withheld = line.points(at_cm), line.contradicted(at_cm)[:, None]
            colour = MEMORY_BGR if line.rank else LEFT_BGR if line.side == "left" else TRUTH_BGR
            strokes += [
                (segment, points, colour, 2),
                (segment, np.where(withheld, points, np.nan), _RED_BGR, 5),
            ]
    for driven in np.split(np.arange(len(starts)), np.flatnonzero(starts[1:]) + 1):
        strokes.append((int(drive_map.segment[driven[0]]), drive_map.poses[driven, :2], TEXT_BGR, 2))
    # A line of an adjacent lane may lie beyond all edge points that are drawn.
    known = [*zip(of_cloud, clouds, strict=True), *((segment, points) for segment, points, _, _ in strokes)]
    moved, low, high = _side_by_side(known)
    scale = _SIZE_PX / float((high - low).max())
    width, height = ((high - low) * scale).astype(int) + 1
    image = np.zeros((height, width, 3), np.uint8)

    def pixels(points: Float[np.ndarray, "m 2"]) -> np.ndarray:
        u, v = ((points - low) * scale).T
        return np.stack([u, height - 1 - v], axis=1)

    # Dark, so that the lines stand out.
    hues = np.linspace(0, 255, len(clouds)).astype(np.uint8)[:, None]
    colours = cv2.applyColorMap(hues, cv2.COLORMAP_RAINBOW)[:, 0] // 2
    for segment, cloud, colour in zip(of_cloud, clouds, colours, strict=True):
        u, v = pixels(cloud + moved[segment]).astype(np.int32).T
        image[v, u] = colour
    for segment, points, colour, thickness in strokes:
        draw_polyline(image, pixels(points + moved[segment]), colour, thickness)
    draw_metre(image, scale)
    write_png(path, image)
    return image


def _side_by_side(
    parts: list[tuple[int, Float[np.ndarray, "_ 2"]]],
) -> tuple[dict[int, Float[np.ndarray, "2"]], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Find how far each segment is moved to the right, so that none lies on another, and the ends of all."""
    moved: dict[int, Float[np.ndarray, "2"]] = {}
    ends: list[Float[np.ndarray, "2"]] = []
    for segment in sorted({number for number, _ in parts}):
        own = np.concatenate([points for number, points in parts if number == segment])
        low, high = np.nanmin(own, axis=0) - _ROOM_CM, np.nanmax(own, axis=0) + _ROOM_CM
        moved[segment] = np.array([ends[-1][0] - low[0] if ends else 0.0, 0.0])
        ends += [low + moved[segment], high + moved[segment]]
    return moved, np.min(ends, axis=0), np.max(ends, axis=0)


def draw_metre(image: UInt8[np.ndarray, "h w 3"], px_per_cm: float) -> None:
    """Draw a scale of one metre into the lower left corner."""
    y, end = image.shape[0] - _CORNER_PX, _CORNER_PX + int(100.0 * px_per_cm)
    cv2.line(image, (_CORNER_PX, y), (end, y), TEXT_BGR, 2)
    # In proportion, so that it can be read where the picture is shown small.
    size, at = max(0.5, 0.001 * max(image.shape)), (_CORNER_PX, y - _CORNER_PX // 2)
    cv2.putText(image, "1 m", at, cv2.FONT_HERSHEY_SIMPLEX, size, TEXT_BGR, 2, cv2.LINE_AA)


def draw_contact_sheet(path: Path, mapped: MappedDrive, chosen: Int[np.ndarray, "n"]) -> None:
    """Draw the chosen frames of a map with their projected lines (green left, magenta right) and points.

    What is withheld, since its labels are likely to be wrong, is red.
    """
    tiles = _drawn(mapped, chosen.tolist(), [f"{number}" for number in mapped.drive_map.frames[chosen]])
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _COLUMNS)
    rows = [np.hstack(tiles[i : i + _COLUMNS]) for i in range(0, len(tiles), _COLUMNS)]
    write_png(path, np.vstack(rows))


def _drawn(
    mapped: MappedDrive, chosen: Sequence[int], texts: Sequence[str]
) -> list[UInt8[np.ndarray, "h2 w2 3"]]:
    """Enlarge frames of a map, and draw their lines and a text; what is withheld of the lines is red."""
    drive_map, as_mapped, drawn = mapped.drive_map, mapped.drive_map.without_doubts(), []
    zoom = max(1, round(_TILE_WIDTH / drive_map.camera.width))
    for k, text in zip(chosen, texts, strict=True):
        image, camera = mapped.drive.image(int(mapped.rows[k])), drive_map.camera_at(k)
        big = draw_estimate(image, LaneEstimate(np.full(N_POINTS, np.nan)), scale=zoom, caption=text)

        def pixels(points_cm: Float[np.ndarray, "m 2"], camera: Camera = camera) -> np.ndarray:
            # Pixel centres are at integers; enlarging moves them by (zoom - 1) / 2.
            return camera.project_ground(points_cm) * zoom + 0.5 * (zoom - 1)

        every = lines_at(as_mapped, k)
        kept = lines_at(drive_map, k).without(drive_map.errors.withheld[k])
        for line, colour in (
            *((every.left_cm, _RED_BGR), (every.right_cm, _RED_BGR)),
            *((kept.left_cm, LEFT_BGR), (kept.right_cm, TRUTH_BGR)),
        ):
            shown = camera.shows_ground(line)[:, None]
            draw_polyline(big, pixels(np.where(shown, line, np.nan)), colour, 2)
        points = np.stack([kept.points_cm, np.tile(ROWS_CM, 2)], axis=1)
        for u, v in pixels(points[camera.shows_ground(points)]):
            cv2.circle(big, (round(u), round(v)), 5, _RED_BGR, 1, cv2.LINE_AA)
        drawn.append(big)
    return drawn


def write_png(path: Path, image: UInt8[np.ndarray, "h w *c"]) -> None:
    """Write an image as PNG.

    Raises:
        LanenetError: If it cannot be encoded.
    """
    done, data = cv2.imencode(".png", image)
    if not done:
        raise LanenetError(f"{path}: the picture could not be encoded")
    path.write_bytes(data.tobytes())


def doubtful_pictures(mapped: MappedDrive, points_cm: Float[np.ndarray, "n 6"]) -> list[Picture]:
    """Draw from each part of the drive the frame with the given label that is most likely off by 3 cm."""
    off_3 = np.where(np.isfinite(points_cm), mapped.drive_map.errors.off_3, -1.0).max(axis=1)
    parts = np.array_split(np.flatnonzero(off_3 >= 0.0), _PICTURES)
    chosen = [int(part[off_3[part].argmax()]) for part in parts if part.size]
    return _pictures(mapped, chosen, [f"{100.0 * off_3[k]:.1f} %" for k in chosen])


def withheld_pictures(mapped: MappedDrive, wrong: tuple[WrongSection, ...]) -> list[Picture]:
    """Draw frames that show the longest sections that are withheld, in red."""
    middle = [place.frames[len(place.frames) // 2] for place in wrong[:_PICTURES]]
    return _pictures(mapped, middle, [place.name for place in wrong[:_PICTURES]])


def _pictures(mapped: MappedDrive, chosen: Sequence[int], captions: Sequence[str]) -> list[Picture]:
    drawn = zip(_drawn(mapped, chosen, [""] * len(chosen)), chosen, captions, strict=True)
    return [Picture(image, f"frame {mapped.drive_map.frames[k]}: {text}") for image, k, text in drawn]
