"""Rerun (https://rerun.io): a file, its viewer on this machine, or one that waits elsewhere.

Lengths are in centimetres and frames those of this project, as everywhere in it. Rerun knows no fisheye lens:
lines are projected into the image here, not there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lanenet.data.files import require
from lanenet.errors import LanenetError
from lanenet.perception.draw import ARROW_BGR, Bgr
from lanenet.viewers.drawing import Artist, Drawing, map_from_front, strips_of
from lanenet.viewers.seen import Polyline
from lanenet.viewers.viewer import ViewerKind

#: Opens the viewer on this machine; and the address of one, as ``rerun+http://192.168.1.5:9876/proxy``.
_LIVE, _ADDRESS = "live", "rerun+http"
#: Drawn widths, [cm]. Chosen: half a tape, and less than that.
_LINE_CM, _POINT_CM = 0.8, 0.4
_MAP_RGB, _PATH_RGB, _EDGE_RGB = (200, 200, 200), (90, 140, 255), (120, 120, 120)
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
        self._blueprints = require("rerun.blueprint", "viewers")
        self._first_s: float | None = None
        self._shown: set[str] = set()

    def begin(self, artist: Artist) -> None:
        """Start the recording, with the map."""
        rr, scene = self._rr, artist.scene
        self._artist = artist
        self._stream = rr.RecordingStream("lanenet")
        layout = self._layout(scene.camera is not None)
        if self._target == _LIVE:
            self._connected(lambda: self._stream.spawn(default_blueprint=layout))
        elif self._target.startswith(_ADDRESS):
            self._connected(lambda: self._stream.connect_grpc(self._target, default_blueprint=layout))
        else:
            self._stream.save(self._target, default_blueprint=layout)
        self._stream.send_recording_name(scene.name)
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, line in scene.lines_map_cm.items():
            self._strips_3d(f"world/map/lines/{name}", strips_of(line), _MAP_RGB, static=True)
        if len(scene.path_map):
            self._strips_3d("world/map/path", [scene.path_map[:, :2]], _PATH_RGB, static=True)
        if len(scene.edges_map_cm):
            edges = rr.Points3D(_raised(scene.edges_map_cm), radii=_POINT_CM / 2, colors=_EDGE_RGB)
            self._log("world/map/edges", edges, static=True)

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
            self._log("world/car/edges", rr.Points3D(_raised(drawing.edges_cm), radii=_POINT_CM))
            edges_px = self._artist.birdseye_px(drawing.edges_cm)
            self._log("birdseye/edges", rr.Points2D(edges_px, radii=0.5, colors=_rgb(ARROW_BGR)))
        self._add_lanes(drawing)
        for name, value in drawing.values.items():
            is_angle = name.endswith(_ANGLE)
            shown = f"{name.removesuffix(_ANGLE)}_deg" if is_angle else name
            group = "angles" if is_angle else "values"
            self._log(f"plots/{group}/{shown}", rr.Scalars([np.rad2deg(value) if is_angle else value]))

    def close(self) -> None:
        """Write what waits."""
        self._stream.flush()
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
            self._strips_3d(f"world/car/{name}", strips, rgb)
            points = rr.Points3D(_raised(line.known_cm), radii=2 * _LINE_CM, colors=rgb)
            self._log(f"world/car/{name}/points", points)
            above = [self._artist.birdseye_px(strip) for strip in strips]
            self._log(f"birdseye/{name}", rr.LineStrips2D(above, colors=rgb, radii=0.7))
            in_image = [strip + 0.5 for strip in line.strips_px]
            self._log(f"camera/{name}", rr.LineStrips2D(in_image, colors=rgb, radii=0.7))

    def _move_car(self, pose: np.ndarray, wheelbase_cm: float) -> None:
        origin, turn_rad = map_from_front(pose, wheelbase_cm)
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        self._log("world/car", self._rr.Transform3D(translation=origin, mat3x3=turn))

    def _strips_3d(
        self, entity: str, strips: Sequence[Polyline], rgb: tuple[int, int, int], static: bool = False
    ) -> None:
        raised = [_raised(strip) for strip in strips]
        self._log(entity, self._rr.LineStrips3D(raised, colors=rgb, radii=_LINE_CM), static=static)

    def _log(self, entity: str, what: Any, static: bool = False) -> None:
        self._stream.log(entity, what, static=static)

    def _connected(self, connect: Any) -> None:
        try:
            connect()
        except Exception as error:
            raise LanenetError(f"--rerun {self._target}: no viewer can be reached ({error})") from None

    def _layout(self, with_road: bool) -> Any:
        """Which views there are and where."""
        rrb = self._blueprints
        camera = rrb.Spatial2DView(origin="camera", name="camera")
        plots = [
            rrb.TimeSeriesView(origin=f"plots/{group}", name=name)
            for group, name in (
                ("angles", "steering, positive left [deg]"),
                ("values", "confidence and match"),
            )
        ]
        above = rrb.Spatial2DView(origin="birdseye", name="bird's eye")
        world = rrb.Spatial3DView(origin="world", name="map and car [cm]")
        views = [rrb.Vertical(camera, above), world] if with_road else [camera]
        return rrb.Blueprint(
            rrb.Vertical(rrb.Horizontal(*views), rrb.Horizontal(*plots), row_shares=[3, 1]),
            rrb.TimePanel(timeline="frame"),
            collapse_panels=True,
        )


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
    addresses=(_LIVE, _ADDRESS),
)
