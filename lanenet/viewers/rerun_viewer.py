"""Rerun (https://rerun.io): a file, its viewer on this machine, or one that waits elsewhere.

Lengths are in centimetres and frames those of this project, as everywhere in it. Rerun knows no fisheye lens:
lines are projected into the image here, not there.
"""

from __future__ import annotations

import os
import socket
import sysconfig
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from lanenet.data.files import require
from lanenet.errors import LanenetError
from lanenet.geometry.camera import Camera
from lanenet.perception.draw import ARROW_BGR, Bgr
from lanenet.reading import first_line
from lanenet.viewers.drawing import Artist, Drawing, map_from_front, strips_of
from lanenet.viewers.seen import Polyline
from lanenet.viewers.viewer import ViewerKind

#: Opens the viewer on this machine; and the address of one, as ``rerun+http://192.168.1.5:9876/proxy``.
_LIVE, _ADDRESS = "live", "rerun+http"
#: Rerun's own port; and how long the other machine may take to answer, chosen: a slow wireless network.
_PORT, _PATIENCE_S = 9876, 3.0
#: Drawn half widths, negative for points of the screen: lines are seen at any distance. Chosen.
_LINE, _THICK_LINE, _DOT, _POINT = -1.0, -1.5, -0.6, -3.0
#: Half width of the arrow that stands for the car, from its rear to its front axle, [cm]. Chosen.
_CAR_CM = 1.5
#: Seen on a dark background and on a light one.
_MAP_RGB, _PATH_RGB, _EDGE_RGB, _CAR_RGB = (0, 160, 150), (90, 140, 255), (130, 130, 130), (230, 60, 60)
#: Angles are plotted in degrees, since people read them.
_ANGLE = "_rad"


class RerunViewer:
    """Writes what is drawn as entities of a Rerun recording."""

    def __init__(self, target: str) -> None:
        """Remember where to show it.

        Args:
            target: ``live``, an address, or a file to write.

        Raises:
            MissingExtraError: If rerun-sdk is not installed.
        """
        self._rr, self._target = require("rerun", "viewers"), target
        self._is_live = target.startswith((_LIVE, _ADDRESS))
        self._blueprints = require("rerun.blueprint", "viewers")
        self._first_s: float | None = None
        self._shown: set[str] = set()

    def begin(self, artist: Artist) -> None:
        """Start the recording, with the map."""
        rr, scene = self._rr, artist.scene
        self._artist = artist
        self._stream = rr.RecordingStream("lanenet")
        layout = self._layout(scene.camera)
        if self._is_live:
            self._connect(layout)
        else:
            self._stream.save(self._target, default_blueprint=layout)
        self._stream.send_recording_name(scene.name)
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, line in scene.lines_map_cm.items():
            self._strips_3d(f"world/map/lines/{name}", strips_of(line), _MAP_RGB, static=True)
        if len(scene.path_map):
            self._strips_3d("world/map/path", [scene.path_map[:, :2]], _PATH_RGB, static=True)
        if len(scene.edges_map_cm):
            edges = rr.Points3D(_raised(scene.edges_map_cm), radii=_DOT, colors=_EDGE_RGB)
            self._log("world/map/edges", edges, static=True)
        if scene.camera is not None:
            rear = [0.0, -scene.camera.wheelbase_cm, 0.0]
            arrow = rr.Arrows3D(origins=[rear], vectors=[np.negative(rear)], radii=_CAR_CM, colors=_CAR_RGB)
            self._log("world/car/axles", arrow, static=True)

    def add(self, drawing: Drawing) -> None:
        """Show a frame; what it lacks is taken away."""
        rr, seen, stream = self._rr, drawing.seen, self._stream
        stream.set_time("frame", sequence=seen.frame)
        if np.isfinite(seen.t_s):
            self._first_s = seen.t_s if self._first_s is None else self._first_s
            stream.set_time("time", duration=seen.t_s - self._first_s)
        for entity, jpeg in (("camera/image", drawing.jpeg), ("birdseye/image", drawing.birdseye_jpeg)):
            if jpeg is None:
                self._log(entity, rr.Clear(recursive=False))
            else:
                self._log(entity, rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        if drawing.camera is not None:
            if seen.pose is not None:
                self._move_car(seen.pose, drawing.camera.wheelbase_cm)
            elif len(self._artist.scene.path_map):
                # A frame that the map does not have is nowhere.
                self._log("world/car", rr.Transform3D(scale=0.0))
            self._log(
                "world/car/edges", rr.Points3D(_raised(drawing.edges_cm), radii=_DOT, colors=_rgb(ARROW_BGR))
            )
            edges_px = self._artist.birdseye_px(drawing.edges_cm)
            self._log("birdseye/edges", rr.Points2D(edges_px, radii=_DOT, colors=_rgb(ARROW_BGR)))
        self._add_lanes(drawing)
        if seen.reason:
            self._log("unanswered", rr.TextLog(seen.reason))
        for name, value in drawing.values.items():
            is_angle = name.endswith(_ANGLE)
            shown = f"{name.removesuffix(_ANGLE)}_deg" if is_angle else name
            group = "angles" if is_angle else "values"
            self._log(f"plots/{group}/{shown}", rr.Scalars([np.rad2deg(value) if is_angle else value]))

    def close(self) -> None:
        """Write what waits.

        Raises:
            OSError: If a file could not be written to its end; the SDK itself only logs that.
        """
        try:
            if not self._is_live:
                self._stream.flush()
        except RuntimeError as error:
            # Without disconnecting, which would wait for the writer that has given up.
            raise OSError(first_line(error)) from None
        self._stream.disconnect()

    def _add_lanes(self, drawing: Drawing) -> None:
        """Show the lanes of a frame, and take away those that only the frame before it had."""
        rr, before = self._rr, self._shown
        self._shown = {line.name for line in drawing.lines}
        for gone in before - self._shown:
            for root in ("world/car", "birdseye", "camera"):
                self._log(f"{root}/{gone}", rr.Clear(recursive=True))
        for line in drawing.lines:
            name, rgb, strips = line.name, _rgb(line.colour_bgr), strips_of(line.line_cm)
            self._strips_3d(f"world/car/{name}", strips, rgb, radius=_THICK_LINE)
            points = rr.Points3D(_raised(line.known_cm), radii=_POINT, colors=rgb)
            self._log(f"world/car/{name}/points", points)
            above = [self._artist.birdseye_px(strip) for strip in strips]
            self._log(f"birdseye/{name}", rr.LineStrips2D(above, colors=rgb, radii=_THICK_LINE))
            in_image = [strip + 0.5 for strip in line.strips_px]
            self._log(f"camera/{name}", rr.LineStrips2D(in_image, colors=rgb, radii=_THICK_LINE))

    def _move_car(self, pose: np.ndarray, wheelbase_cm: float) -> None:
        origin, turn_rad = map_from_front(pose, wheelbase_cm)
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._log("world/car", self._rr.Transform3D(translation=origin, mat3x3=turn))

    def _strips_3d(
        self,
        entity: str,
        strips: Sequence[Polyline],
        rgb: tuple[int, int, int],
        static: bool = False,
        radius: float = _LINE,
    ) -> None:
        raised = [_raised(strip) for strip in strips]
        self._log(entity, self._rr.LineStrips3D(raised, colors=rgb, radii=radius), static=static)

    def _log(self, entity: str, what: Any, static: bool = False) -> None:
        self._stream.log(entity, what, static=static)

    def _connect(self, layout: Any) -> None:
        """Open the viewer here, or reach the one at the address.

        Raises:
            LanenetError: If that fails; the SDK alone would wait for a viewer without an end.
        """
        try:
            if self._target == _LIVE:
                # The viewer comes with the SDK, also where its environment is not activated.
                os.environ["PATH"] = os.pathsep.join([os.environ["PATH"], sysconfig.get_path("scripts")])
                self._stream.spawn(default_blueprint=layout)
            else:
                address = urlsplit(self._target)
                place = (address.hostname or "", address.port or _PORT)
                socket.create_connection(place, timeout=_PATIENCE_S).close()
                self._stream.connect_grpc(self._target, default_blueprint=layout)
        except (OSError, ValueError, RuntimeError) as error:
            raise LanenetError(
                f"--rerun {self._target}: no viewer can be reached ({first_line(error)}); --rerun FILE.rrd "
                "writes a file for later"
            ) from None

    def _layout(self, camera: Camera | None) -> Any:
        """Which views there are and where."""
        rrb = self._blueprints
        plots = [
            rrb.TimeSeriesView(origin=f"plots/{group}", name=name)
            for group, name in (("angles", "steering, positive left [deg]"), ("values", "values"))
        ]
        if camera is None:
            image = rrb.Spatial2DView(origin="camera", name="camera")
            return rrb.Blueprint(rrb.Vertical(image, *plots), collapse_panels=True)
        window = self._artist.window
        flat = [
            rrb.Spatial2DView(
                origin=origin,
                name=name,
                visual_bounds=rrb.VisualBounds2D(x_range=[0, width], y_range=[0, height]),
            )
            for origin, name, width, height in (
                ("camera", "camera", camera.width, camera.height),
                ("birdseye", "bird's eye", window.columns, window.rows),
            )
        ]
        world = rrb.Spatial3DView(origin="world", name="map and car [cm]")
        views = rrb.Horizontal(rrb.Vertical(*flat), world)
        layout = rrb.Vertical(views, rrb.Horizontal(*plots), row_shares=[3, 1])
        return rrb.Blueprint(layout, collapse_panels=True)


def _raised(points_cm: Polyline) -> np.ndarray:
    """Points of the road in space."""
    return np.column_stack([points_cm, np.zeros(len(points_cm))])


def _rgb(bgr: Bgr) -> tuple[int, int, int]:
    return bgr[2], bgr[1], bgr[0]


KIND = ViewerKind(
    "rerun",
    RerunViewer,
    check=lambda: require("rerun", "viewers"),
    ending=".rrd",
    help=f"Show what is seen in Rerun: a file to write, '{_LIVE}' for a viewer that opens here, or the "
    "address of one that runs.",
    to_look="rerun {file}",
    addresses=(_LIVE, _ADDRESS),
)
