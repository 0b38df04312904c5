"""Distance in pixels between the projected borders of the lane lines and the edges that a frame shows.

The nearest edge is an optimist: where the floor is full of edges there is always one close by. So an edge
only counts if it brightens towards the marking as the border does, and two shares stand beside the distances:
how much of the border in view met an edge at all, and how much of a line moved aside, off the marking, did.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numba import njit
from pydantic import Field

from lanenet.config import Settings
from lanenet.data.maps.frame_lines import FrameLines
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import SIDES
from lanenet.perception.edges.canny import EdgePixels

#: Image width to which pixels are converted where drives are compared.
REFERENCE_WIDTH = 160.0


class ResidualSettings(Settings):
    """How the borders of the lines are compared with edges; pixels are those of an image 160 px wide.

    Attributes:
        gate_px: An edge further than this from the border is not the border's.
        min_agreement: Cosine between the gradients of edge and border at least.
        step_cm: Distance of the samples along a border.
        bands_cm: Limits of the distance bands, ahead of the front axle.
    """

    gate_px: float = Field(default=4.0, gt=0.0)
    min_agreement: float = Field(default=0.8, gt=0.0, lt=1.0)
    step_cm: float = Field(default=1.0, gt=0.0)
    bands_cm: tuple[float, ...] = (0.0, 15.0, 30.0, 45.0, 90.0)


@dataclass(frozen=True)
class BorderSamples:
    """Places on the borders of the lines that a frame can see, and what it shows there.

    Attributes:
        right: Whether the sample belongs to the right line.
        ahead_cm: Distance ahead of the front axle.
        residual_px: Signed distance across the border to the edge, towards the marking's middle positive,
            in pixels of the image; NaN where no edge of this direction lies within the gate.
    """

    right: Bool[np.ndarray, "m"]
    ahead_cm: Float[np.ndarray, "m"]
    residual_px: Float[np.ndarray, "m"]

    @property
    def found(self) -> Bool[np.ndarray, "m"]:
        """Whether the sample met an edge."""
        return np.isfinite(self.residual_px)

    def part(self, rows: Bool[np.ndarray, "m"]) -> BorderSamples:
        """Return some of the samples."""
        return BorderSamples(self.right[rows], self.ahead_cm[rows], self.residual_px[rows])


def join_samples(parts: list[BorderSamples]) -> BorderSamples:
    """Put the samples of several frames together."""
    return BorderSamples(
        np.concatenate([np.zeros(0, dtype=bool), *(part.right for part in parts)]),
        np.concatenate([np.zeros(0), *(part.ahead_cm for part in parts)]),
        np.concatenate([np.zeros(0), *(part.residual_px for part in parts)]),
    )


def border_samples(
    edges: EdgePixels,
    lines: FrameLines,
    tape_cm: float,
    camera: Camera,
    keep: UInt8[np.ndarray, "h w"],
    settings: ResidualSettings,
    aside_cm: float = 0.0,
) -> BorderSamples:
    """Measure how far the edges of a frame lie from where its lines say that markings have their borders.

    Args:
        edges: Edge pixels of the frame.
        lines: Its lane, frame car.
        tape_cm: Width of a marking whose own one is not known.
        camera: Camera of the frame, with the tilt that it had in it.
        keep: Nonzero where the image shows road.
        settings: Gate and sampling.
        aside_cm: Move both lines to the right by this, to where no marking is.
    """
    parts = []
    for i, line in enumerate((lines.left_cm, lines.right_cm)):
        at, across = _along(line, settings)
        at = at + aside_cm * across
        marking_cm = lines.marking_cm(i, tape_cm)
        for border in (-0.5, 0.5):
            # ``across`` points to the right, so that the left border lies against it.
            place = at + border * marking_cm * across
            uv, gradient = _in_image(place, -np.sign(border) * across, camera)
            seen = _in_view(uv, gradient, keep)
            residual = _nearest(edges, uv[seen], gradient[seen], camera.width / REFERENCE_WIDTH, settings)
            parts.append(BorderSamples(np.full(int(seen.sum()), SIDES[i] == "right"), at[seen, 1], residual))
    return join_samples(parts)


def _along(
    line_cm: Float[np.ndarray, "k 2"], settings: ResidualSettings
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
    """Sample a polyline evenly within the bands; with unit vectors across it, to the right."""
    step = np.diff(line_cm, axis=0)
    length = np.linalg.norm(step, axis=1)
    good = np.isfinite(length) & (length > 1e-9)
    places, across = [np.empty((0, 2))], [np.empty((0, 2))]
    # A length that spacing does not divide carries on in the next piece, or short pieces would get no sample.
    offset = 0.0
    for k in np.flatnonzero(good):
        s = np.arange(offset, length[k], settings.step_cm)
        offset = (s[-1] + settings.step_cm if s.size else offset) - length[k]
        direction = step[k] / length[k]
        places.append(line_cm[k] + s[:, None] * direction)
        across.append(np.tile([direction[1], -direction[0]], (len(s), 1)))
    at, right = np.concatenate(places), np.concatenate(across)
    inside = (at[:, 1] >= settings.bands_cm[0]) & (at[:, 1] < settings.bands_cm[-1])
    return at[inside], right[inside]


def _in_image(
    place_cm: Float[np.ndarray, "m 2"], towards: Float[np.ndarray, "m 2"], camera: Camera
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
    """Project a border and its unit normal, towards the marking, into the image."""
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


def _in_view(
    uv: Float[np.ndarray, "m 2"], gradient: Float[np.ndarray, "m 2"], keep: UInt8[np.ndarray, "h w"]
) -> Bool[np.ndarray, "m"]:
    finite = np.isfinite(uv).all(axis=1) & np.isfinite(gradient).all(axis=1)
    nearest = np.rint(np.where(finite[:, None], uv, -1.0)).clip(-1, 1e6).astype(np.intp)
    height, width = keep.shape
    inside = finite & (nearest >= 0).all(axis=1) & (nearest[:, 0] < width) & (nearest[:, 1] < height)
    inside[inside] = keep[nearest[inside, 1], nearest[inside, 0]] > 0
    return inside


def _nearest(
    edges: EdgePixels,
    uv: Float[np.ndarray, "m 2"],
    gradient: Float[np.ndarray, "m 2"],
    scale: float,
    settings: ResidualSettings,
) -> Float[np.ndarray, "m"]:
    """Signed distance along the gradient to the edge that lies closest across the border; NaN without one."""
    found = np.full(len(uv), np.nan)
    _meet(edges.uv_px, edges.normals, uv, gradient, settings.min_agreement, settings.gate_px * scale, found)
    return found


@njit(cache=True)
@no_type_check
def _meet(edge_uv, edge_normal, uv, gradient, least, gate, found):
    for i in range(uv.shape[0]):
        best = gate
        gx, gy = gradient[i, 0], gradient[i, 1]
        for j in range(edge_uv.shape[0]):
            dx, dy = edge_uv[j, 0] - uv[i, 0], edge_uv[j, 1] - uv[i, 1]
            across = dx * gx + dy * gy
            # Edges are about a pixel apart along their line, whatever the size of the image.
            if abs(across) > best or abs(dx * gy - dy * gx) > 0.75:
                continue
            if edge_normal[j, 0] * gx + edge_normal[j, 1] * gy >= least:
                found[i], best = across, abs(across)


@dataclass(frozen=True)
class ResidualFigures:
    """Residuals of one part of the road.

    Attributes:
        samples: Places in view.
        coverage: Share of them that met an edge.
        robust_sd_px: 1.4826 times the median of the absolute residuals; an offset counts too.
        p95_px: 95th percentile of the absolute residuals.
        median_px: Median residual, towards the markings' middle positive.
    """

    samples: int
    coverage: float
    robust_sd_px: float
    p95_px: float
    median_px: float

    def as_dict(self, width: int) -> dict[str, float | int]:
        """Figures in pixels of the image, and of one 160 px wide beside them."""
        scale = REFERENCE_WIDTH / width
        return {
            **vars(self),
            "robust_sd_px_at_160": self.robust_sd_px * scale,
            "p95_px_at_160": self.p95_px * scale,
            "median_px_at_160": self.median_px * scale,
        }


def summarise(samples: BorderSamples) -> ResidualFigures:
    """Figures of some samples; NaN where there are none."""
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
