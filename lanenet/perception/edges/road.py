"""Edge pixels moved to the road through a precomputed table; no image is warped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from lanenet.config import Settings, flat_settings
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges import compiled
from lanenet.perception.edges.canny import (
    EdgeSettings,
    check_frame,
    check_size,
    find_edges,
    sample_pixels,
    search_of,
)
from lanenet.perception.edges.markings_only import PixelScale
from lanenet.perception.edges.pixels import EdgePixels

#: Rows beyond the useful ones that blur, slopes and the search for maxima look at.
_MARGIN_PX = 4
#: Colour weight of the edges that networks see. Maps see each line in many frames, so that colour would only
#: add the edges of coloured things beside the road. Chosen: below 1, since images store colour at half the
#: resolution of brightness.
COLOUR_WEIGHT = 0.75


class RangeSettings(Settings):
    """Which part of the image counts as road.

    Attributes:
        far_cm: Points further ahead than this are dropped. Chosen: about six heights of a camera at 20 cm. On
            three real drives a line seen only beyond 3.5 heights was already unreliable.
        side_cm: Points further to the side than this are dropped. Chosen: a two-lane road of 40 cm lanes,
            seen from either lane.
        max_cm_per_px: Points where one pixel spans more road than this are dropped. Chosen: above the
            thickness of common tape (2 to 5 cm), whose two borders then merge.
        top_row: Rows above this are dropped whatever the camera says (0 keeps all below the horizon).
        bottom_rows: Rows at the bottom that show the car itself.
    """

    far_cm: float = Field(default=120.0, gt=0.0)
    side_cm: float = Field(default=100.0, gt=0.0)
    max_cm_per_px: float = Field(default=6.0, gt=0.0)
    top_row: int = Field(default=0, ge=0)
    bottom_rows: int = Field(default=0, ge=0)


class PerceptionSettings(Settings):
    """All settings that decide which edge points a frame has; stored with labels and models."""

    edges: EdgeSettings = EdgeSettings()
    range: RangeSettings = RangeSettings()

    def with_colours(self, weight: float = COLOUR_WEIGHT) -> PerceptionSettings:
        """Return the same with edges by colour as well, as networks see them; maps use gray alone."""
        return self.model_copy(update={"edges": self.edges.model_copy(update={"colour_weight": weight})})

    def of_all_rows(self) -> PerceptionSettings:
        """Return the same without the rows that one car leaves out, to compare the settings of two cars."""
        rows = {"top_row": 0, "bottom_rows": 0}
        return self.model_copy(update={"range": self.range.model_copy(update=rows)})

    def unlike(self, other: PerceptionSettings) -> str:
        """Describe the settings that differ from ``other``'s; the rows left out are ignored."""
        own, others = (flat_settings(each.of_all_rows()) for each in (self, other))
        return ", ".join(f"{key} {own[key]}, not {others[key]}" for key in own if own[key] != others[key])


@dataclass(frozen=True)
class RoadEdges:
    """Edge points on the road.

    Attributes:
        points_cm: Positions, frame car.
        normals: Unit vectors across the edge, towards the brighter side, frame car.
        hues: As :attr:`EdgePixels.hues`.
    """

    points_cm: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]
    hues: Float[np.ndarray, "n 2"] | None = None

    def rows(self) -> Float[np.ndarray, "n 6"]:
        """Return x, y, normal x, normal y, yellow, red of each point, as label sets hold them."""
        hues = np.zeros_like(self.points_cm) if self.hues is None else self.hues
        return np.concatenate([self.points_cm, self.normals, hues], axis=1).astype(np.float32)

    @staticmethod
    def of_rows(rows: Float[np.ndarray, "n 6"]) -> RoadEdges:
        """Return the points of :meth:`rows`."""
        return RoadEdges(rows[:, :2], rows[:, 2:4], rows[:, 4:])


class RoadTable:
    """The road point of each pixel, and its derivative by the pixel.

    This is the interpolation of Kozlowski et al. 2024 (section 2.1, the 131 x 4 matrix), with one node per
    pixel: a lookup is exact at pixel centres and linear between them.

    Attributes:
        keep: uint8 mask of the pixels that see the useful part of the road.
        useful_pixels: Number of them.
        rows: Rows of the image that hold them, and a few above and below, which filters look at.
        sample: Pixels from which :func:`lanenet.perception.edges.canny.find_edges` measures the contrast.
        scale: Road that a pixel spans sideways.
        points_cm: Road point of each pixel, [cm], frame car, height x width x 2; NaN off the road.
    """

    def __init__(
        self, camera: Camera, range_settings: RangeSettings, mask: UInt8[np.ndarray, "h w"] | None = None
    ) -> None:
        if range_settings.top_row + range_settings.bottom_rows >= camera.height:
            raise CalibrationError(
                f"range: top_row {range_settings.top_row} and bottom_rows {range_settings.bottom_rows} leave "
                f"nothing of an image of {camera.height} rows"
            )
        self.height, self.width = camera.height, camera.width
        v, u = np.mgrid[-1 : self.height + 1, -1 : self.width + 1].astype(np.float64)
        grid = camera.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(*u.shape, 2)
        du = 0.5 * (grid[1:-1, 2:] - grid[1:-1, :-2])
        dv = 0.5 * (grid[2:, 1:-1] - grid[:-2, 1:-1])
        self._last_px = np.array([self.width - 1.0, self.height - 1.0])
        # A pixel's six numbers lie side by side: one memory access per lookup.
        self._rows = np.concatenate([grid[1:-1, 1:-1], du, dv], axis=-1).reshape(-1, 6)
        self.points_cm: Float[np.ndarray, "h w 2"] = self._rows.reshape(self.height, self.width, 6)[..., :2]
        x, y = self.points_cm[..., 0], self.points_cm[..., 1]
        with np.errstate(invalid="ignore"):
            coarse = np.maximum(np.linalg.norm(du, axis=-1), np.linalg.norm(dv, axis=-1))
            useful = (
                (y <= range_settings.far_cm)
                & (np.abs(x) <= range_settings.side_cm)
                & (coarse <= range_settings.max_cm_per_px)
            )
        useful[: range_settings.top_row] = False
        useful[self.height - range_settings.bottom_rows :] = False
        if mask is not None:
            if mask.shape != useful.shape:
                raise CalibrationError(
                    f"mask of {mask.shape[1]}x{mask.shape[0]} px, but the camera is calibrated for "
                    f"{camera.width}x{camera.height}"
                )
            useful &= mask == 0
        self.keep: UInt8[np.ndarray, "h w"] = np.where(useful, 255, 0).astype(np.uint8)
        self.useful_pixels = int(np.count_nonzero(useful))
        self.sample = sample_pixels(self.keep)
        if not useful.any():
            raise CalibrationError("camera: no pixel sees the road in range; check pitch, height and range")
        seen_rows = np.flatnonzero(useful.any(axis=1))
        self.rows = slice(max(0, int(seen_rows[0]) - _MARGIN_PX), int(seen_rows[-1]) + 1 + _MARGIN_PX)
        self._keep_rows = np.ascontiguousarray(self.keep[self.rows])
        self._sample_rows = sample_pixels(self._keep_rows)
        across = np.linalg.norm(du, axis=-1)
        # A row without a useful pixel has no median.
        per_row, seen = np.full(self.height, np.nan), useful.any(axis=1)
        per_row[seen] = np.nanmedian(np.where(useful[seen], across[seen], np.nan), axis=1)
        self.scale = PixelScale(across, per_row)

    def find(self, frame_bgr: UInt8[np.ndarray, "h w *c"], settings: EdgeSettings) -> EdgePixels:
        """Find the edges of the road in a frame of the camera's size, without a look at the other rows."""
        if settings.method == "colour":
            return find_edges(frame_bgr, settings, self.keep, self.scale, self.sample)
        found = find_edges(frame_bgr[self.rows], settings, self._keep_rows, None, self._sample_rows)
        found.uv_px[:, 1] += self.rows.start
        return found

    def extract(self, frame_bgr: UInt8[np.ndarray, "h w *c"], search: compiled.Search) -> RoadEdges:
        """Do :meth:`find` and :meth:`lift_single` in one go, by the compiled loops."""
        rows = self.rows.start, self.height
        return RoadEdges(
            *compiled.extract(
                frame_bgr[self.rows], self._keep_rows, self._sample_rows, search, self._rows, rows
            )
        )

    def lift(self, edges: EdgePixels) -> RoadEdges:
        """Move edge pixels to the road.

        Args:
            edges: Edge points of a frame; those outside :attr:`keep` must have been dropped before.

        Returns:
            Their points and directions on the road, [cm], frame car.
        """
        if compiled.is_here():
            return RoadEdges(*compiled.lift(edges, self._rows, (self.height, self.width), single=False))
        points, rows = self._look_up(edges)
        _, _, x_u, y_u, x_v, y_v = rows
        normal_u, normal_v = edges.normals.T
        # A tangent maps by the Jacobian and a normal by its cofactors, times the sign of the determinant.
        across = np.empty_like(points)
        np.subtract(y_v * normal_u, y_u * normal_v, out=across[0])
        np.subtract(x_u * normal_v, x_v * normal_u, out=across[1])
        across *= np.sign(x_u * y_v - x_v * y_u)
        across *= 1.0 / np.maximum(np.sqrt(across[0] * across[0] + across[1] * across[1]), 1e-12)
        return RoadEdges(np.ascontiguousarray(points.T), np.ascontiguousarray(across.T), edges.hues)

    def lift_single(self, edges: EdgePixels) -> RoadEdges:
        """Return :meth:`lift` in the precision of label files, without points that are not finite.

        So a raster from a file equals one made on the car.
        """
        if compiled.is_here():
            return RoadEdges(*compiled.lift(edges, self._rows, (self.height, self.width), single=True))
        road = self.lift(edges)
        points, normals = road.points_cm.astype(np.float32), road.normals.astype(np.float32)
        hues = None if road.hues is None else road.hues.astype(np.float32)
        good = np.isfinite(points[:, 0] + points[:, 1] + normals[:, 0] + normals[:, 1])
        if good.all():
            return RoadEdges(points, normals, hues)
        return RoadEdges(points[good], normals[good], None if hues is None else hues[good])

    def lift_points(self, edges: EdgePixels) -> Float[np.ndarray, "n 2"]:
        """Return the points of :meth:`lift` alone."""
        return np.ascontiguousarray(self._look_up(edges)[0].T)

    def _look_up(self, edges: EdgePixels) -> tuple[Float[np.ndarray, "2 n"], Float[np.ndarray, "6 n"]]:
        """Return x and y of each edge point, and the six numbers of the pixel that it lies in."""
        nearest = np.rint(edges.uv_px)
        np.maximum(nearest, 0.0, out=nearest)
        np.minimum(nearest, self._last_px, out=nearest)
        at = (nearest[:, 1] * self.width + nearest[:, 0]).astype(np.intp)
        rows = np.ascontiguousarray(self._rows.take(at, axis=0).T)
        off_u, off_v = (edges.uv_px - nearest).T
        return rows[:2] + (rows[2:4] * off_u + rows[4:] * off_v), rows


class RoadEdgeExtractor:
    """Frame in, edge points on the road out; training and driving use the same path.

    Attributes:
        camera: Camera of the frames.
        settings: Detector and range.
        table: Its road table; a mask given to the extractor (nonzero on the car itself, as from
            :func:`lanenet.perception.edges.static.static_mask`) is taken out of the table's ``keep``.
    """

    def __init__(
        self,
        camera: Camera,
        settings: PerceptionSettings,
        mask: UInt8[np.ndarray, "h w"] | None = None,
    ) -> None:
        self.camera = camera
        self.settings = settings
        self.table = RoadTable(camera, settings.range, mask)
        loops_suffice = settings.edges.method != "colour" and compiled.finds_in(
            self.table.keep[self.table.rows]
        )
        self._search = search_of(settings.edges) if loops_suffice else None

    def is_crowded(self, n_edges: int, max_share: float) -> bool:
        """Tell whether so many edges are more than this share of the pixels that see the road.

        A frame of noise has an edge everywhere, and any lane can be found in it.
        """
        return n_edges > max_share * self.table.useful_pixels

    def extract(self, frame_bgr: UInt8[np.ndarray, "h w *c"]) -> RoadEdges:
        """Find a frame's edges and move them to the road.

        Raises:
            CalibrationError: If the frame's size is not the camera's.
            DriveFormatError: If the array is no image.
        """
        check_size(check_frame(frame_bgr), self.camera)
        if self._search is not None and compiled.is_here():
            return self.table.extract(frame_bgr, self._search)
        return self.table.lift_single(self.table.find(frame_bgr, self.settings.edges))
