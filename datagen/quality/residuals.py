"""Residuals: distance in pixels between the projected borders of the lane lines and the edges of a frame.

Of a map its held-out frames are measured, which have no say in the lines. Their edges still find their own
poses, without which they could not be compared: what all poses share is not seen.

On a textured floor there is always some edge close by. So an edge counts only if it brightens towards the
marking, as the border does; on a map of dark markings, if it darkens towards it. A line shifted off its
marking shows how many edges are met by chance.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numba import njit

from datagen.slam.odometry.scans import edges_of_drive
from datagen.slam.stripes import true_borders
from datagen.slam.view import mapping_range
from lanenet.data.maps.frame_lines import FrameLines
from lanenet.data.maps.mapped_drive import MappedDrive, lines_at
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RoadTable

#: Image width to which pixels are converted so that drives can be compared: that of Donkeycar images.
_REFERENCE_WIDTH = 160.0
#: Width of road, [cm], that a pixel of such an image shows at the far end of what counts, at least: one that
#: sees it more finely, through a long lens or from nearby, is judged by the same lengths, not smaller ones.
#: Measured: 315 simulated cameras and three real ones show 0.43 cm and more; that of `blue_tape` 0.14 cm.
_FINEST_CM = 0.45
#: Distance ahead of the front axle up to which a frame is compared. Chosen: one row beyond the labels.
REACH_CM = 45.0
#: Largest distance of an edge from its border, in pixels of such an image. Chosen: eight times the residuals
#: of good maps.
_GATE_PX = 4.0
#: Least cosine between line and border: a smooth line on the kink of a tape differs by up to 45 degrees.
COSINE = 0.64


class Residuals(NamedTuple):
    """Distances across the borders in view to the nearest edge, as :func:`border_residuals` gives them.

    Attributes:
        left: Of the left lines.
        right: Of the right lines.
        chance: Of left lines that were shifted into the middle of the lane, where no marking is.
    """

    left: Float[np.ndarray, "_"]
    right: Float[np.ndarray, "_"]
    chance: Float[np.ndarray, "_"]


def coverage(residual_px: Float[np.ndarray, "m"]) -> float:
    """Share of the places that met an edge; NaN without places."""
    return float(np.isfinite(residual_px).mean()) if residual_px.size else float("nan")


def robust_sd(residual_px: Float[np.ndarray, "m"]) -> float:
    """1.4826 times the median of the absolute residuals, a common offset included; NaN without any."""
    size = np.abs(residual_px[np.isfinite(residual_px)])
    return 1.4826 * float(np.median(size)) if size.size else float("nan")


def held_out_residuals(mapped: MappedDrive) -> Residuals:
    """Compare a map's lines with its held-out frames, without what is withheld of the lines."""
    drive_map, parts = mapped.drive_map, [Residuals(*[np.zeros(0)] * 3)]
    tape_cm, aside_cm = drive_map.meta.tape_cm, 0.5 * drive_map.meta.mapped_lane_cm
    for k, edges, keep in frame_edges(mapped, np.flatnonzero(drive_map.held_out)):
        lines = lines_at(drive_map, k).without(drive_map.errors.doubted[k])
        seen = edges, lines, tape_cm, drive_map.camera_at(k), keep
        parts.append(Residuals(*border_residuals(*seen), border_residuals(*seen, aside_cm)[0]))
    return Residuals(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def border_residuals(
    edges: EdgePixels,
    lines: FrameLines,
    tape_cm: float,
    camera: Camera,
    keep: UInt8[np.ndarray, "h w"],
    aside_cm: float = 0.0,
) -> tuple[Float[np.ndarray, "l"], Float[np.ndarray, "r"]]:
    """Measure the distance of a frame's edges from the borders that its lines predict.

    Args:
        edges: Edge pixels of the frame.
        lines: Its lane, frame car.
        tape_cm: Width of a marking that has no measured width.
        camera: Camera with the tilt of the frame.
        keep: Nonzero where the image shows road.
        aside_cm: Shift both lines to the right by this, off their markings.

    Returns:
        Of each place in view on the borders of the left, the right line: distance across the border to the
        edge, positive towards the marking's middle, in pixels of an image 160 px wide; NaN if no edge of this
        direction lies within the gate.
    """
    scale, found = reference_scale(camera), []
    for side, line in enumerate((lines.left_cm, lines.right_cm)):
        step = np.diff(line, axis=0)
        step /= np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9)
        right = np.stack([step[:, 1], -step[:, 0]], axis=1)
        middle = 0.5 * (line[1:] + line[:-1]) + aside_cm * right
        near = (middle[:, 1] >= 0.0) & (middle[:, 1] < REACH_CM)
        parts = []
        # The left border brightens to the right, the right one to the left; in the image as on the road.
        for sign in (1.0, -1.0):
            place = middle - 0.5 * sign * lines.markings_cm(side, tape_cm)[1:, None] * right
            uv = camera.project_ground(place)
            along = camera.project_ground(place + 0.1 * step) - uv
            along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
            gradient = sign * np.stack([-along[:, 1], along[:, 0]], axis=1)
            seen = near & in_view(uv, gradient, keep)
            met = _nearest(edges.uv_px, edges.normals, uv[seen], gradient[seen], _GATE_PX / scale)
            parts.append(scale * met)
        found.append(np.concatenate(parts))
    return found[0], found[1]


def reference_scale(camera: Camera) -> float:
    """Reference pixels per pixel of the image: those of an image 160 px wide that shows the road as usual."""
    m = camera.mounting
    # A place that it sees, wherever it is.
    ahead_cm = max(REACH_CM, m.ahead_of_front_axle_cm + m.height_cm)
    left, right = camera.project_ground(np.array([[-0.5, ahead_cm], [0.5, ahead_cm]]))
    px_per_cm = float(np.hypot(*(right - left)))
    return min(_REFERENCE_WIDTH / camera.width, 1.0 / (_FINEST_CM * px_per_cm))


def in_view(
    uv: Float[np.ndarray, "m 2"], gradient: Float[np.ndarray, "m 2"], keep: UInt8[np.ndarray, "h w"]
) -> Bool[np.ndarray, "m"]:
    """Return which points lie in the image where it shows road; those with NaN in either argument do not."""
    finite = np.isfinite(uv).all(axis=1) & np.isfinite(gradient).all(axis=1)
    nearest = np.rint(np.where(finite[:, None], uv, -1.0)).clip(-1, 1e6).astype(np.intp)
    inside = np.asarray(((nearest >= 0) & (nearest < keep.shape[::-1])).all(axis=1))
    inside[inside] = keep[nearest[inside, 1], nearest[inside, 0]] > 0
    return inside


@njit(cache=True)
@no_type_check
def _nearest(edge_uv, edge_normal, uv, gradient, gate_px):
    """Signed distance along the gradient to the closest edge across the border; NaN without one."""
    found = np.full(len(uv), np.nan)
    for i in range(uv.shape[0]):
        best = gate_px
        gx, gy = gradient[i, 0], gradient[i, 1]
        for j in range(edge_uv.shape[0]):
            dx, dy = edge_uv[j, 0] - uv[i, 0], edge_uv[j, 1] - uv[i, 1]
            across = dx * gx + dy * gy
            # Edge pixels of a line are about one pixel apart, at any image size.
            if abs(across) > best or abs(dx * gy - dy * gx) > 0.75:
                continue
            if edge_normal[j, 0] * gx + edge_normal[j, 1] * gy >= COSINE:
                found[i], best = across, abs(across)
    return found


def frame_edges(
    mapped: MappedDrive, rows: Int[np.ndarray, "m"]
) -> Iterator[tuple[int, EdgePixels, UInt8[np.ndarray, "h w"]]]:
    """Yield frames of a map with their edges, normals into the markings, and the mask of road pixels.

    Borders of narrow lines are put where they are, as they were for the map.
    """
    camera, perception = mapped.drive_map.camera, mapped.perception
    dark = mapped.drive_map.meta.markings == "dark"
    table = RoadTable(camera, mapping_range(camera.mounting, perception.range))
    if not len(rows):
        return
    found = edges_of_drive(mapped.drive.subset(mapped.rows[rows]), perception.edges, table)
    for k, edges in zip(rows.tolist(), true_borders(found, table), strict=True):
        yield k, edges.towards_dark() if dark else edges, table.keep
