"""The picture of joined maps: each drive's edges in a colour of their own, and places that were laid anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from datagen.assemble import AssembledMap
from datagen.quality.pictures import draw_metre, write_png
from datagen.tracks.relaid import RelaidPlace
from lanenet.data.maps.folder import DriveMap
from lanenet.perception.draw import draw_polyline

#: Colours of the drives' edges and paths, in turn, of the lines, and of places laid anew, BGR. Chosen: told
#: apart by people who see no red or no green.
_DRIVES = ((230, 160, 70), (60, 160, 240), (180, 120, 220), (110, 200, 200), (150, 150, 150))
_LINE, _RELAID = (245, 245, 245), (60, 60, 255)
#: Longer side of the picture, [px].
_SIZE_PX = 1600


def draw_joined(
    path: Path, members: Sequence[tuple[str, AssembledMap, DriveMap]], places: Sequence[RelaidPlace]
) -> None:
    """Draw joined maps from above.

    Args:
        path: PNG to write.
        members: Name of each drive, its map in parts and as it is written.
        places: Where lines were laid anew, common map frame.
    """
    clouds = [np.concatenate([np.empty((0, 2)), *assembled.near_points]) for _, assembled, _ in members]
    lines = [line.points(np.arange(*line.span_cm, 1.0)) for line in members[0][2].lines[0]]
    every = np.concatenate([*clouds, *(line[np.isfinite(line[:, 0])] for line in lines)])
    low, high = every.min(axis=0) - 20.0, every.max(axis=0) + 20.0
    scale = _SIZE_PX / float((high - low).max())
    width, height = ((high - low) * scale).astype(int) + 1
    image = np.full((height, width, 3), 24, np.uint8)

    def pixels(points: Float[np.ndarray, "m 2"]) -> np.ndarray:
        at = (points - low) * scale
        return np.stack([at[:, 0], height - 1 - at[:, 1]], axis=1)

    for number, cloud in enumerate(clouds):
        at = pixels(cloud).astype(np.int32)
        image[at[:, 1], at[:, 0]] = 0.55 * np.array(_DRIVES[number % len(_DRIVES)])
    for number, (name, _, drive_map) in enumerate(members):
        colour = _DRIVES[number % len(_DRIVES)]
        draw_polyline(image, pixels(drive_map.poses[:, :2]), colour, 1)
        cv2.putText(
            image, name, (20, 34 + 30 * number), cv2.FONT_HERSHEY_SIMPLEX, 0.9, colour, 2, cv2.LINE_AA
        )
    for line in lines:
        draw_polyline(image, pixels(line), _LINE, 2)
    for place in places:
        draw_polyline(image, pixels(place.points_cm), _RELAID, 4)
        x, y = pixels(np.array([place.at_cm]))[0].astype(np.int32).tolist()
        text = "gone" if place.apart_cm is None else f"{place.apart_cm:.1f} cm"
        cv2.putText(image, text, (x + 12, y), cv2.FONT_HERSHEY_SIMPLEX, 0.8, _RELAID, 2, cv2.LINE_AA)
    draw_metre(image, scale)
    write_png(path, image)
