"""Residuals: distance in pixels between the projected borders of the lane lines and the edges of a frame.

On a textured floor there is always some edge close by. So an edge counts only if it brightens towards the
marking, as the border does; on a map of dark markings, if it darkens towards it. Two coverages put the
residuals into perspective: the share of the border in view that met an edge, and the same share for a line
shifted off its marking.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numba import njit

from datagen.slam.odometry.scans import edges_of_drive
from datagen.slam.stripes import true_borders
from datagen.slam.view import mapping_range
from lanenet.data.maps.frame_lines import FrameLines
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import SIDES
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RoadTable

#: Image width to which pixels are converted so that drives can be compared: that of Donkeycar images.
REFERENCE_WIDTH = 160.0
#: Width of road, [cm], that a pixel of such an image shows so far ahead, [cm], at least: one that sees it
#: more finely, through a long lens or from nearby, is judged by the same lengths, not by smaller ones.
#: Measured: 315 simulated cameras and three real ones show 0.43 cm and more; that of `blue_tape` 0.14 cm.
_FINEST_CM, _FINEST_AHEAD_CM = 0.45, 45.0
#: Largest distance of an edge from its border, in pixels of such an image. Chosen: eight times the residuals
#: of good maps.
GATE_PX = 4.0
#: Least cosine between the gradients of edge and border. Chosen: 37 degrees, for blur and noise.
_MIN_AGREEMENT = 0.8
#: Distance of the samples along a border. Chosen: finer than a pixel at the far end of the bands.
_STEP_CM = 1.0
#: Limits of the distance bands ahead of the front axle: the label rows and beyond.
BANDS_CM = (0.0, 15.0, 30.0, 45.0, 90.0)


def reference_scale(camera: Camera) -> float:
    """Reference pixels per pixel of the image: those of an image 160 px wide that shows the road as usual."""
    m = camera.mounting
    # A place that it sees, wherever it is.
    ahead_cm = max(_FINEST_AHEAD_CM, m.ahead_of_front_axle_cm + m.height_cm)
    left, right = camera.project_ground(np.array([[-0.5, ahead_cm], [0.5, ahead_cm]]))
    px_per_cm = float(np.hypot(*(right - left)))
    return min(REFERENCE_WIDTH / camera.width, 1.0 / (_FINEST_CM * px_per_cm))


class BorderSamples(NamedTuple):
    """Places on the borders of the lines that are in view of a frame, with the residuals there.

    Attributes:
        right: Whether the sample belongs to the right line.
        ahead_cm: Distance ahead of the front axle.
        residual_px: Distance across the border to the edge, positive towards the marking's middle, in pixels
            of the image; NaN if no edge of this direction lies within the gate.
    """

    right: Bool[np.ndarray, "m"]
    ahead_cm: Float[np.ndarray, "m"]
    residual_px: Float[np.ndarray, "m"]

    @property
    def found(self) -> Bool[np.ndarray, "m"]:
        """Whether the sample met an edge."""
        return np.isfinite(self.residual_px)

    def select(self, rows: Bool[np.ndarray, "m"]) -> BorderSamples:
        """Return some of the samples."""
        return BorderSamples(*(column[rows] for column in self))


def join_samples(parts: list[BorderSamples]) -> BorderSamples:
    """Concatenate the samples of several frames."""
    none = BorderSamples(np.zeros(0, dtype=bool), np.zeros(0), np.zeros(0))
    return BorderSamples(*(np.concatenate(column) for column in zip(none, *parts, strict=True)))


def border_samples(
    edges: EdgePixels,
    lines: FrameLines,
    tape_cm: float,
    camera: Camera,
    keep: UInt8[np.ndarray, "h w"],
    aside_cm: float = 0.0,
) -> BorderSamples:
    """Measure the distance of a frame's edges from the borders that its lines predict.

    Args:
        edges: Edge pixels of the frame.
        lines: Its lane, frame car.
        tape_cm: Width of a marking that has no measured width.
        camera: Camera with the tilt of the frame.
        keep: Nonzero where the image shows road.
        aside_cm: Shift both lines to the right by this, off their markings.
    """
    parts = []
    for i, line in enumerate((lines.left_cm, lines.right_cm)):
        at, across, marking_cm = _along(line, lines.markings_cm(i, tape_cm))
        at = at + aside_cm * across
        for border in (-0.5, 0.5):
            # ``across`` points to the right; the left border lies on its negative side.
            place = at + border * marking_cm[:, None] * across
            uv, gradient = _in_image(place, -np.sign(border) * across, camera)
            seen = in_view(uv, gradient, keep)
            gate_px = GATE_PX / reference_scale(camera)
            residual = _nearest(edges.uv_px, edges.normals, uv[seen], gradient[seen], gate_px)
            parts.append(BorderSamples(np.full(int(seen.sum()), SIDES[i] == "right"), at[seen, 1], residual))
    return join_samples(parts)


def _along(
    line_cm: Float[np.ndarray, "k 2"], widths_cm: Float[np.ndarray, "k"]
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"], Float[np.ndarray, "m"]]:
    """Sample a polyline evenly within the bands; return points, unit vectors to its right, and widths."""
    step = np.diff(line_cm, axis=0)
    length = np.linalg.norm(step, axis=1)
    good = np.isfinite(length) & (length > 1e-9)
    start, length = line_cm[:-1][good], length[good]
    ahead = step[good] / length[:, None]
    # The spacing continues from one segment to the next, so that short segments get their share of samples.
    ends = np.cumsum(length)
    s = np.arange(0.0, length.sum(), _STEP_CM)
    k = np.minimum(np.searchsorted(ends, s, side="right"), len(ends) - 1)
    past = s - (ends - length)[k]
    at = start[k] + past[:, None] * ahead[k]
    width, change = widths_cm[:-1][good], np.diff(widths_cm)[good] / length
    right = np.stack([ahead[k, 1], -ahead[k, 0]], axis=1)
    inside = (at[:, 1] >= BANDS_CM[0]) & (at[:, 1] < BANDS_CM[-1])
    return at[inside], right[inside], (width[k] + past * change[k])[inside]


def _in_image(
    place_cm: Float[np.ndarray, "m 2"], towards: Float[np.ndarray, "m 2"], camera: Camera
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
    """Project a border and its unit normal, which points into the marking, into the image."""
    along = np.stack([-towards[:, 1], towards[:, 0]], axis=1)
    uv, ahead, inwards = (
        camera.project_ground(points)
        for points in (place_cm, place_cm + 0.1 * along, place_cm + 0.1 * towards)
    )
    tangent = ahead - uv
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    normal *= np.where(np.sum(normal * (inwards - uv), axis=1) < 0.0, -1.0, 1.0)[:, None]
    return uv, normal


def in_view(
    uv: Float[np.ndarray, "m 2"], gradient: Float[np.ndarray, "m 2"], keep: UInt8[np.ndarray, "h w"]
) -> Bool[np.ndarray, "m"]:
    """Return which points lie in the image where it shows road; those with NaN in either argument do not."""
    finite = np.isfinite(uv).all(axis=1) & np.isfinite(gradient).all(axis=1)
    nearest = np.rint(np.where(finite[:, None], uv, -1.0)).clip(-1, 1e6).astype(np.intp)
    height, width = keep.shape
    inside = finite & (nearest >= 0).all(axis=1) & (nearest[:, 0] < width) & (nearest[:, 1] < height)
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
            if edge_normal[j, 0] * gx + edge_normal[j, 1] * gy >= _MIN_AGREEMENT:
                found[i], best = across, abs(across)
    return found


@dataclass(frozen=True)
class ResidualFigures:
    """Summary of some residuals.

    Attributes:
        samples: Number of places in view.
        coverage: Share of them that met an edge.
        robust_sd_px: 1.4826 times the median of the absolute residuals; includes a common offset.
        p95_px: 95th percentile of the absolute residuals.
        median_px: Median residual, positive towards the markings' middle.
    """

    samples: int
    coverage: float
    robust_sd_px: float
    p95_px: float
    median_px: float

    def as_dict(self, scale: float) -> dict[str, float | int]:
        """Return the figures in pixels of the image and in reference pixels, see :func:`reference_scale`."""
        return {
            **vars(self),
            **{
                f"{name}_at_160": vars(self)[name] * scale for name in ("robust_sd_px", "p95_px", "median_px")
            },
        }


def summarise(samples: BorderSamples) -> ResidualFigures:
    """Summarise samples; NaN where there are none."""
    found = samples.residual_px[samples.found]
    if not found.size:
        share = 0.0 if len(samples.residual_px) else float("nan")
        return ResidualFigures(len(samples.residual_px), share, *([float("nan")] * 3))
    size = np.abs(found)
    return ResidualFigures(
        len(samples.residual_px),
        found.size / len(samples.residual_px),
        1.4826 * float(np.median(size)),
        float(np.percentile(size, 95.0)),
        float(np.median(found)),
    )


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
