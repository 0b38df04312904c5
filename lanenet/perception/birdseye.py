"""Edge pixels moved to the road through a precomputed table: no image is warped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from pydantic import Field

from lanenet.config import Settings
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera
from lanenet.perception.edges import EdgePixels, EdgeSettings, find_edges


class RangeSettings(Settings):
    """Which part of the image counts as road.

    Attributes:
        far_cm: Points further ahead than this are dropped.
        side_cm: Points further to the side than this are dropped.
        max_cm_per_px: Points where one pixel spans more road than this are dropped.
        top_row: Rows above this are dropped whatever the camera says (0 keeps all below the horizon).
        bottom_rows: Rows at the bottom that show the car itself.
    """

    far_cm: float = Field(default=120.0, gt=0.0)
    side_cm: float = Field(default=100.0, gt=0.0)
    max_cm_per_px: float = Field(default=6.0, gt=0.0)
    top_row: int = Field(default=0, ge=0)
    bottom_rows: int = Field(default=0, ge=0)


class PerceptionSettings(Settings):
    """Everything that decides which edge points a frame gives; stored with labels and models."""

    edges: EdgeSettings = EdgeSettings()
    range: RangeSettings = RangeSettings()


@dataclass(frozen=True)
class RoadEdges:
    """Edge points on the road.

    Attributes:
        points_cm: Positions, frame car.
        normals: Unit vectors across the edge, towards the brighter side, frame car.
    """

    points_cm: Float[np.ndarray, "n 2"]
    normals: Float[np.ndarray, "n 2"]


class RoadTable:
    """For each pixel its point of the road and how that point moves with the pixel.

    This is the interpolation of Kozlowski et al. 2024 (section 2.1, the 131 x 4 matrix), with one node per
    pixel: a lookup is exact at pixel centres and linear between them.

    Attributes:
        keep: uint8 mask of the pixels that see the useful part of the road.
        points_cm: Road point of each pixel, [cm], frame car, height x width x 2; NaN off the road.
        jacobian: d(point)/d(pixel), [cm/px], height x width x 2 x 2 (row x, y; column u, v).
    """

    def __init__(self, camera: Camera, range_settings: RangeSettings) -> None:
        if range_settings.top_row + range_settings.bottom_rows >= camera.height:
            raise CalibrationError(
                f"range: top_row {range_settings.top_row} and bottom_rows {range_settings.bottom_rows} leave "
                f"nothing of an image of {camera.height} rows"
            )
        self.height, self.width = camera.height, camera.width
        v, u = np.mgrid[-1 : self.height + 1, -1 : self.width + 1].astype(np.float64)
        grid = camera.intersect_ground(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(*u.shape, 2)
        self.points_cm: Float[np.ndarray, "h w 2"] = grid[1:-1, 1:-1].copy()
        du = 0.5 * (grid[1:-1, 2:] - grid[1:-1, :-2])
        dv = 0.5 * (grid[2:, 1:-1] - grid[:-2, 1:-1])
        self.jacobian: Float[np.ndarray, "h w 2 2"] = np.stack([du, dv], axis=-1)
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
        self.keep: UInt8[np.ndarray, "h w"] = np.where(useful, 255, 0).astype(np.uint8)
        if not useful.any():
            raise CalibrationError("camera: no pixel sees the road in range; check pitch, height and range")

    def lift(self, edges: EdgePixels) -> RoadEdges:
        """Move edge pixels to the road.

        Args:
            edges: Edge points of a frame; those outside :attr:`keep` must have been dropped before.

        Returns:
            Their points and directions on the road, [cm], frame car.
        """
        nearest = np.rint(edges.uv_px).astype(np.intp)
        u = np.clip(nearest[:, 0], 0, self.width - 1)
        v = np.clip(nearest[:, 1], 0, self.height - 1)
        jacobian = self.jacobian[v, u]
        offset = edges.uv_px - np.stack([u, v], axis=1)
        points = self.points_cm[v, u] + np.einsum("nij,nj->ni", jacobian, offset)
        # A direction along the edge maps by the Jacobian; the normal is perpendicular to it, on the side to
        # which the image gradient leads.
        tangent = np.stack([-edges.normals[:, 1], edges.normals[:, 0]], axis=1)
        along = np.einsum("nij,nj->ni", jacobian, tangent)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        towards = np.einsum("nij,nj->ni", jacobian, edges.normals)
        across *= np.sign(np.sum(across * towards, axis=1, keepdims=True))
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        return RoadEdges(points, across)


class RoadEdgeExtractor:
    """Frame in, edge points on the road out; the one path for training and for driving."""

    def __init__(self, camera: Camera, settings: PerceptionSettings) -> None:
        self.camera = camera
        self.settings = settings
        self.table = RoadTable(camera, settings.range)

    def extract(self, frame_bgr: UInt8[np.ndarray, "h w *c"]) -> RoadEdges:
        """Find a frame's edges and move them to the road.

        Raises:
            CalibrationError: If the frame's size is not the camera's.
        """
        height, width = frame_bgr.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            raise CalibrationError(
                f"frame of {width}x{height} px, but the camera is calibrated for "
                f"{self.camera.width}x{self.camera.height}"
            )
        edges = self.table.lift(find_edges(frame_bgr, self.settings.edges, self.table.keep))
        good = np.isfinite(edges.points_cm).all(axis=1) & np.isfinite(edges.normals).all(axis=1)
        # The precision of the label files, so that a raster made from a file and one made on the car agree.
        return RoadEdges(edges.points_cm[good].astype(np.float32), edges.normals[good].astype(np.float32))
