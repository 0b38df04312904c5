"""From what was seen in a frame to what is drawn: once, for all viewers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import SIDES
from lanenet.perception.draw import LEFT_BGR, RIGHT_BGR, TRUTH_BGR, Bgr
from lanenet.perception.edges.road import RoadEdgeExtractor
from lanenet.viewers.seen import Lane, Polyline, Scene, Seen

#: Side of a bird's-eye pixel as a share of a cell of the network. Chosen: no detail of a small image is lost.
_FINER = 2
#: Chosen: indistinguishable by eye; a frame of 160 x 120 px takes 6 kB.
_JPEG_QUALITY = 90
#: Longest piece of a line whose ends are joined by a straight one in the image, [cm]. Chosen: bends of a
#: fisheye lens look smooth.
_PIECE_CM = 2.5
#: Nothing is drawn further outside the image, in image sizes. Chosen.
_MARGIN = 1.0


@dataclass(frozen=True, eq=False)
class DrawnLine:
    """One lane line of a frame.

    Attributes:
        name: Whose it is and its side: ``detected/left``.
        line_cm: On the road, frame car; empty where it is unknown.
        known_cm: Its known points in the label rows.
        strips_px: In the image, frame image.
        colour_bgr: As in annotated videos.
    """

    name: str
    line_cm: Polyline
    known_cm: Polyline
    strips_px: list[Polyline]
    colour_bgr: Bgr


@dataclass(frozen=True, eq=False)
class Drawing:
    """What is drawn of one frame.

    Attributes:
        seen: The frame.
        jpeg: Its image; None if it could not be read.
        birdseye_jpeg: The road in the window, seen from above; None without an image or a camera.
        edges_cm: Edge points, frame car.
        lines: Lane lines, with those that are unknown in this frame.
        values: The finite ones of :attr:`Seen.values`.
        camera: The camera in this frame; None without one.
    """

    seen: Seen
    jpeg: bytes | None
    birdseye_jpeg: bytes | None
    edges_cm: Polyline
    lines: list[DrawnLine]
    values: Mapping[str, float]
    camera: Camera | None


class Artist:
    """Draws the frames of a scene.

    Attributes:
        scene: What stays the same.
        window: The road that the bird's-eye image shows, with its pixels as cells.
    """

    def __init__(self, scene: Scene, window: BirdseyeWindow | None = None) -> None:
        """Prepare tables.

        Args:
            scene: What stays the same.
            window: The network's window; None takes the default.
        """
        self.scene = scene
        base = BirdseyeWindow() if window is None else window
        self.window = BirdseyeWindow(
            base.left_cm, base.near_cm, base.cell_cm / _FINER, base.rows * _FINER, base.columns * _FINER
        )
        self._extractor, self._from_px = None, None
        if scene.camera is not None:
            self._extractor = RoadEdgeExtractor(scene.camera, scene.perception)
            row, column = np.mgrid[0 : self.window.rows, 0 : self.window.columns].astype(np.float64)
            road = self.window.points(np.stack([row.ravel(), column.ravel()], axis=1))
            px = np.nan_to_num(scene.camera.project_ground(road), nan=-10.0)
            self._from_px = px.astype(np.float32).reshape(self.window.rows, self.window.columns, 2)

    def draw(self, seen: Seen) -> Drawing:
        """Draw one frame."""
        image = seen.image_bgr
        camera = self.scene.camera if seen.camera is None else seen.camera
        edges_cm, birdseye = np.empty((0, 2)), None
        if image is not None and self._extractor is not None and self._from_px is not None:
            edges_cm = self._extractor.extract(image).points_cm
            birdseye = _jpeg(cv2.remap(image, self._from_px, None, cv2.INTER_LINEAR))
        return Drawing(
            seen,
            None if image is None else _jpeg(image),
            birdseye,
            edges_cm,
            [line for name, lane in seen.lanes.items() for line in _lines(name, lane, camera)],
            {name: float(value) for name, value in seen.values.items() if np.isfinite(value)},
            camera,
        )

    def birdseye_px(self, points_cm: Polyline) -> Polyline:
        """Return places in the bird's-eye image, [px], whose origin is the corner of its first pixel."""
        return (self.window.cells(points_cm) + 0.5)[:, ::-1]


def strips_of(line: Polyline) -> list[Polyline]:
    """Split a polyline where it has NaN; pieces of one point are left out."""
    known = np.isfinite(line).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(np.int8)))
    return [line[start:end] for start, end in edges.reshape(-1, 2) if end - start > 1]


def _lines(name: str, lane: Lane, camera: Camera | None) -> list[DrawnLine]:
    colours = (TRUTH_BGR, TRUTH_BGR) if name == "reference" else (LEFT_BGR, RIGHT_BGR)
    drawn = []
    for side, (line_cm, colour) in enumerate(zip(lane.on_road_cm, colours, strict=True)):
        own_px = None if lane.lines_px is None else lane.lines_px[side]
        if own_px is not None:
            strips_px = strips_of(own_px)
        elif camera is not None:
            strips_px = [px for strip in strips_of(line_cm) for px in _in_image(strip, camera)]
        else:
            strips_px = []
        drawn.append(DrawnLine(f"{name}/{SIDES[side]}", line_cm, lane.known_cm(side), strips_px, colour))
    return drawn


def _in_image(strip_cm: Polyline, camera: Camera) -> list[Polyline]:
    """The parts of a line on the road that lie in the image or close to it."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(strip_cm, axis=0).T))])
    dense = np.linspace(0.0, along[-1], max(2, int(along[-1] / _PIECE_CM) + 2))
    line_cm = np.stack([np.interp(dense, along, strip_cm[:, axis]) for axis in (0, 1)], axis=1)
    px = camera.project_ground(line_cm)
    size = np.array([camera.width, camera.height])
    with np.errstate(invalid="ignore"):
        px[~((px > -_MARGIN * size) & (px < (1.0 + _MARGIN) * size)).all(axis=1)] = np.nan
    return strips_of(px)


def _jpeg(image: UInt8[np.ndarray, "h w *c"]) -> bytes:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return data.tobytes()


def map_from_front(pose: Float[np.ndarray, "3"], wheelbase_cm: float) -> tuple[Float[np.ndarray, "3"], float]:
    """Return where the car frame lies in the map: its origin, [cm], z = 0, and its turn about z, [rad].

    The car frame's x points to the right, so that it is turned by a quarter turn against the heading.
    """
    x, y, heading = (float(value) for value in pose)
    ahead = wheelbase_cm * np.array([np.cos(heading), np.sin(heading)])
    return np.array([x + ahead[0], y + ahead[1], 0.0]), heading - 0.5 * np.pi
