"""The moving picture of the README: a recorded drive as the network sees it, its answer, and the map.

    python contrib/pictures.py runs/pictures/donkey_circuit docs/images/drive.webp --frames 700:859

Of the frames only edge points are shown, unless --photos is given: recorded drives often belong to others,
who do not want their photos in every project. Needs Pillow, which comes with lanenet[viz].
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import lanenet
from lanenet.data.maps.frame_lines import FrameLines
from lanenet.data.maps.mapped_drive import lines_at, open_mapped_drive
from lanenet.perception.draw import FAR_CM, LEFT_BGR, RIGHT_BGR, draw_estimate
from lanenet.perception.edges.road import RoadEdgeExtractor, RoadEdges
from lanenet.perception.estimate import LaneEstimate

#: Enlargement of the camera's image, and the share of it that is cut off at the top, above the road. Chosen
#: for images of 160 x 120 px, on a page of GitHub.
SCALE, CUT = 4, 0.4
#: Scale of the view from above, [px/cm], its width, and what it shows behind the front axle, [cm]. Chosen.
PX_PER_CM, WIDE_CM, BEHIND_CM = 2.6, 110.0, 12.0
#: Frames that the network is shown before the first that is drawn: it remembers the lane. Chosen: 2 s.
BEFORE = 40
#: BGR.
DARK, GRID, PALE, YELLOW, MAP = (28, 24, 20), (48, 44, 40), (190, 190, 190), (60, 220, 250), (160, 70, 160)


def draw_points(picture: np.ndarray, at_px: np.ndarray, edges: RoadEdges) -> None:
    """Draw edge points in gray, those of yellow markings in yellow."""
    hues = np.zeros_like(edges.points_cm) if edges.hues is None else edges.hues
    inside = (at_px >= 0.0).all(axis=1) & (at_px < (picture.shape[1] - 1, picture.shape[0] - 1)).all(axis=1)
    for (x, y), yellow in zip(
        np.rint(at_px[inside]).astype(int), np.clip(hues[inside, 0], 0.0, 1.0), strict=True
    ):
        picture[y : y + 2, x : x + 2] = (1.0 - yellow) * np.array(PALE) + yellow * np.array(YELLOW)


def from_above(edges: RoadEdges, answer: LaneEstimate, lane: FrameLines, high_px: int) -> np.ndarray:
    """Draw edge points, the map's lines and the answer on the road plane, with a grid of 10 cm."""
    size_px = np.array([round(WIDE_CM * PX_PER_CM), high_px])
    picture = np.full((size_px[1], size_px[0], 3), DARK, np.uint8)

    def pixels(points_cm: np.ndarray) -> np.ndarray:
        return (points_cm * (1.0, -1.0) + (0.5 * WIDE_CM, -BEHIND_CM)) * PX_PER_CM + (0.0, high_px)

    def line(points_cm: np.ndarray, colour: tuple[int, int, int], thickness: int) -> None:
        known = points_cm[np.isfinite(points_cm).all(axis=1)]
        cv2.polylines(
            picture, [np.rint(pixels(known)).astype(np.int32)], False, colour, thickness, cv2.LINE_AA
        )

    for cm in np.arange(-200.0, 200.0, 10.0):
        line(np.array([[cm, -200.0], [cm, 200.0]]), GRID, 1)
        line(np.array([[-200.0, cm], [200.0, cm]]), GRID, 1)
    for mapped_cm in (lane.left_cm, lane.right_cm):
        line(mapped_cm, MAP, 2)
    draw_points(picture, pixels(edges.points_cm), edges)
    y_cm = np.linspace(0.0, FAR_CM, 41)
    for parabola, colour in zip(answer.parabolas, (LEFT_BGR, RIGHT_BGR), strict=True):
        line(np.stack([np.polyval(parabola, y_cm), y_cm], axis=1), colour, 3)
    # The car's front axle.
    line(np.array([[-7.0, 0.0], [7.0, 0.0]]), PALE, 4)
    return picture


def main() -> None:
    """Draw the frames and write the picture."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("map", type=Path)
    words.add_argument("out", type=Path)
    words.add_argument("--frames", default="0:159", help="FIRST:LAST; every second one is drawn")
    words.add_argument("--model", default="checkpoints/general")
    words.add_argument("--photos", action="store_true", help="draw on the frames themselves")
    given = words.parse_args()
    first, last = map(int, given.frames.split(":"))
    mapped = open_mapped_drive(given.map)
    camera, lane_cm = mapped.drive_map.camera, mapped.drive_map.meta.lane_cm
    network = lanenet.load(given.model, camera=camera, lane_width_cm=lane_cm)
    edges = RoadEdgeExtractor(camera, network.meta.perception)
    pictures = []
    for k, number in enumerate(mapped.drive_map.frames):
        if not first - BEFORE <= number <= last:
            continue
        frame = mapped.drive.image(int(mapped.rows[k]))
        answer = network(frame)
        if number < first or (number - first) % 2:
            continue
        found = edges.extract(frame)
        shown = frame if given.photos else np.full_like(frame, DARK)
        left = draw_estimate(shown, answer, camera, SCALE)
        if not given.photos:
            draw_points(left, (camera.project_ground(found.points_cm) + 0.5) * SCALE, found)
        left = left[round(CUT * left.shape[0]) :]
        right = from_above(found, answer, lines_at(mapped.drive_map, k), left.shape[0])
        picture = np.hstack([left, np.full((left.shape[0], 6, 3), 255, np.uint8), right])
        pictures.append(Image.fromarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)))
    step_ms = round(2000.0 * float(np.median(np.diff(mapped.drive_map.t_s))))
    given.out.parent.mkdir(parents=True, exist_ok=True)
    pictures[0].save(
        given.out, save_all=True, append_images=pictures[1:], duration=step_ms, loop=0, quality=60, method=6
    )
    print(f"wrote {given.out}: {len(pictures)} frames, {given.out.stat().st_size / 1e6:.2f} MB")  # noqa: T201


if __name__ == "__main__":
    main()
