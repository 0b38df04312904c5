"""The moving picture of the README: a recorded drive with the lane that the network sees, beside the map.

    python contrib/pictures.py runs/pictures/donkey_circuit docs/images/drive.webp --frames 700:859

It shows photos of the drive: their owner has to allow it, and is named beside the picture. Needs Pillow,
which comes with lanenet[viz].
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import lanenet
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.mapped_drive import open_mapped_drive
from lanenet.geometry.frames import map_from_car
from lanenet.perception.draw import FAR_CM, LEFT_BGR, RIGHT_BGR, draw_estimate
from lanenet.perception.estimate import LaneEstimate

#: Enlargement of the camera's image, and the share of it that is cut off at the top, above the road. Chosen
#: for images of 160 x 120 px, on a page of GitHub.
SCALE, CUT = 3, 0.2
#: Frames that the network is shown before the first that is drawn: it remembers the lane. Chosen: 2 s.
BEFORE = 40
#: Free border of the map, and half of the length and width of the car that is drawn on it, [cm]. Chosen.
BORDER_CM, CAR_CM = 20.0, (20.0, 9.0)
#: BGR.
PAPER, LANE, OTHER, PATH, CAR = (250, 250, 250), (60, 60, 60), (190, 190, 190), (230, 200, 160), (60, 40, 200)


class MapView:
    """A map from above, as high as the camera's image beside it.

    Attributes:
        size: Width and height of the picture, [px].
    """

    def __init__(self, drive_map: DriveMap, high_px: int) -> None:
        lines = [line for of_segment in drive_map.lines.values() for line in of_segment]
        curves = [line.points(np.linspace(*line.span_cm, 2000)) for line in lines]
        path_cm = drive_map.poses[:, :2]
        everything = np.concatenate([path_cm, *curves])
        self._low_cm = np.nanmin(everything, axis=0) - BORDER_CM
        extent_cm = np.nanmax(everything, axis=0) + BORDER_CM - self._low_cm
        self._px_per_cm = high_px / extent_cm[1]
        self.size = round(extent_cm[0] * self._px_per_cm), high_px
        self._wheelbase_cm = drive_map.camera.wheelbase_cm
        self._background = np.full((high_px, self.size[0], 3), PAPER, np.uint8)
        self._line(self._background, path_cm, PATH, 1)
        for line, curve in sorted(zip(lines, curves, strict=True), key=lambda pair: -pair[0].rank):
            self._line(self._background, curve, OTHER if line.rank else LANE, 1 if line.rank else 2)

    def _pixels(self, points_cm: np.ndarray) -> np.ndarray:
        return (points_cm - self._low_cm) * (self._px_per_cm, -self._px_per_cm) + (0.0, self.size[1])

    def _line(
        self, picture: np.ndarray, points_cm: np.ndarray, colour: tuple[int, int, int], thickness: int
    ) -> None:
        known = np.isfinite(points_cm).all(axis=1)
        for part in np.split(np.arange(len(points_cm)), np.flatnonzero(np.diff(known)) + 1):
            if len(part) and known[part[0]]:
                at_px = np.rint(self._pixels(points_cm[part])).astype(np.int32)
                cv2.polylines(picture, [at_px], False, colour, thickness, cv2.LINE_AA)

    def draw(self, pose: np.ndarray, answer: LaneEstimate) -> np.ndarray:
        """Draw the car at a rear-axle pose, and the lines that the network sees from there."""
        picture = self._background.copy()
        y_cm = np.linspace(0.0, FAR_CM, 41)
        for parabola, colour in zip(answer.parabolas, (LEFT_BGR, RIGHT_BGR), strict=True):
            seen_cm = np.stack([np.polyval(parabola, y_cm), y_cm], axis=1)
            self._line(picture, map_from_car(seen_cm, pose, self._wheelbase_cm), colour, 4)
        long_cm, wide_cm = CAR_CM
        corners_cm = np.array(
            [[-wide_cm, -long_cm], [wide_cm, -long_cm], [wide_cm, 0.0], [0.0, 8.0], [-wide_cm, 0.0]]
        )
        outline_px = np.rint(self._pixels(map_from_car(corners_cm, pose, self._wheelbase_cm))).astype(
            np.int32
        )
        cv2.fillPoly(picture, [outline_px], CAR, cv2.LINE_AA)
        return picture


def main() -> None:
    """Draw the frames and write the picture."""
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("map", type=Path)
    words.add_argument("out", type=Path)
    words.add_argument("--frames", default="0:159", help="FIRST:LAST; every second one is drawn")
    words.add_argument("--model", default="checkpoints/general")
    given = words.parse_args()
    first, last = map(int, given.frames.split(":"))
    mapped = open_mapped_drive(given.map)
    drive_map = mapped.drive_map
    network = lanenet.load(given.model, camera=drive_map.camera, lane_width_cm=drive_map.meta.lane_cm)
    view, pictures = None, []
    for k, number in enumerate(drive_map.frames):
        if not first - BEFORE <= number <= last:
            continue
        frame = mapped.drive.image(int(mapped.rows[k]))
        answer = network(frame)
        if number < first or (number - first) % 2:
            continue
        left = draw_estimate(frame, answer, drive_map.camera, SCALE)
        left = left[round(CUT * left.shape[0]) :]
        view = view or MapView(drive_map, left.shape[0])
        picture = np.hstack([left, view.draw(drive_map.poses[k], answer)])
        pictures.append(Image.fromarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)))
    step_ms = round(2000.0 * float(np.median(np.diff(drive_map.t_s))))
    given.out.parent.mkdir(parents=True, exist_ok=True)
    pictures[0].save(
        given.out, save_all=True, append_images=pictures[1:], duration=step_ms, loop=0, quality=55, method=6
    )
    print(f"wrote {given.out}: {len(pictures)} frames, {given.out.stat().st_size / 1e6:.2f} MB")  # noqa: T201


if __name__ == "__main__":
    main()
