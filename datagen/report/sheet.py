"""Contact sheet of held-out frames: the best, those in the middle, and the worst."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from datagen.labels.mapped_drive import MappedDrive, lines_at
from datagen.pictures import draw_lines
from datagen.report.quality import MapQuality
from datagen.report.residuals import REFERENCE_WIDTH

_TILES = 8
_TILE_WIDTH, _TITLE_HEIGHT, _COLUMNS = 320, 22, 4


@dataclass(frozen=True, eq=False)
class Sheet:
    """One row of the contact sheet: its title and its picture."""

    title: str
    picture: UInt8[np.ndarray, "h w 3"]


def contact_sheets(mapped: MappedDrive, quality: MapQuality) -> list[Sheet]:
    """Draw best, median and worst held-out frames, each with its lines and its median residual.

    A frame in which no residual was found counts as worst: there the map expects a line that is not seen.
    """
    medians = quality.frame_median_px
    order = np.argsort(np.nan_to_num(medians, nan=np.inf), kind="stable")
    if not order.size:
        return []
    count = min(_TILES, max(1, len(order) // 3))
    middle = (len(order) - count) // 2
    picks = {
        "best": order[:count],
        "median": order[middle : middle + count],
        "worst": order[::-1][:count],
    }
    return [Sheet(name, _sheet(mapped, quality, medians, rows)) for name, rows in picks.items()]


def _sheet(
    mapped: MappedDrive, quality: MapQuality, medians: np.ndarray, picks: np.ndarray
) -> UInt8[np.ndarray, "h w 3"]:
    drive_map, scale = mapped.drive_map, REFERENCE_WIDTH / mapped.drive.width
    tiles = []
    for i in picks:
        k = int(quality.held_out[i])
        known = np.isfinite(medians[i])
        text = f"frame {drive_map.frames[k]}: " + (
            f"{medians[i] * scale:.2f} px" if known else "nothing found"
        )
        image = mapped.drive.image(int(mapped.rows[k]))
        tile = draw_lines(image, lines_at(drive_map, k), drive_map.camera_at(k), "")
        height = round(tile.shape[0] * _TILE_WIDTH / tile.shape[1])
        title = np.full((_TITLE_HEIGHT, _TILE_WIDTH, 3), 255, np.uint8)
        cv2.putText(title, text, (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        tiles.append(
            np.vstack([title, cv2.resize(tile, (_TILE_WIDTH, height), interpolation=cv2.INTER_AREA)])
        )
    while len(tiles) % _COLUMNS:
        tiles.append(np.full_like(tiles[0], 255))
    rows = [np.hstack(tiles[i : i + _COLUMNS]) for i in range(0, len(tiles), _COLUMNS)]
    return np.asarray(np.vstack(rows), dtype=np.uint8)
