"""The bird's-eye window: which patch of road the network sees, and its grid of cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from pydantic import Field

from lanenet.config import Settings


@dataclass(frozen=True)
class BirdseyeWindow:
    """A rectangle of road ahead of the car, cut into square cells.

    Row 0 is the far edge and column 0 the left edge, so that the raster looks like the road from above.

    Attributes:
        left_cm: x of the left edge, frame car.
        near_cm: y of the near edge, frame car.
        cell_cm: Side of a cell.
        rows: Cells along y.
        columns: Cells along x.
    """

    left_cm: float = -48.0
    near_cm: float = 0.0
    cell_cm: float = 0.75
    rows: int = 96
    columns: int = 128

    @property
    def right_cm(self) -> float:
        """x of the right edge, [cm], frame car."""
        return self.left_cm + self.columns * self.cell_cm

    @property
    def far_cm(self) -> float:
        """y of the far edge, [cm], frame car."""
        return self.near_cm + self.rows * self.cell_cm

    def cells(self, points_car_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return fractional (row, column) of each point; the centre of cell (0, 0) is (0, 0)."""
        column = (points_car_cm[:, 0] - self.left_cm) / self.cell_cm - 0.5
        row = (self.far_cm - points_car_cm[:, 1]) / self.cell_cm - 0.5
        return np.stack([row, column], axis=1)

    def points(self, cells: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Return the road point of each fractional (row, column), [cm], frame car."""
        x = self.left_cm + (cells[:, 1] + 0.5) * self.cell_cm
        y = self.far_cm - (cells[:, 0] + 0.5) * self.cell_cm
        return np.stack([x, y], axis=1)

    def labelled(self, points_cm: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 6"]:
        """Return labels with NaN where a point lies beside the window.

        A line that leaves the window sideways before it reaches a row has no place in the raster there, and
        a network that guesses it would be judged by where the map ends.
        """
        with np.errstate(invalid="ignore"):
            inside = (points_cm >= self.left_cm) & (points_cm <= self.right_cm)
        return np.where(inside, points_cm, np.nan)

    def rasterise(
        self, points_car_cm: Float[np.ndarray, "n 2"], out: UInt8[np.ndarray, "r c"] | None = None
    ) -> UInt8[np.ndarray, "r c"]:
        """Mark the cells that hold at least one point: 255 there, 0 elsewhere.

        Args:
            points_car_cm: Edge points, [cm], frame car; NaN and points outside the window are ignored.
            out: Image to fill in place, so that the drive loop allocates nothing.

        Returns:
            The raster, ``rows`` x ``columns``.
        """
        raster = np.zeros((self.rows, self.columns), np.uint8) if out is None else out
        raster[...] = 0
        row, column, _ = self.places(points_car_cm)
        raster[row, column] = 255
        return raster

    def places(
        self, points_car_cm: Float[np.ndarray, "n 2"]
    ) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"], Bool[np.ndarray, "n"]]:
        """Return row and column of the cell of each point inside the window, and which points those are."""
        x = (points_car_cm[:, 0] - self.left_cm) / self.cell_cm
        y = (self.far_cm - points_car_cm[:, 1]) / self.cell_cm
        with np.errstate(invalid="ignore"):
            inside = (x >= 0.0) & (x < self.columns) & (y >= 0.0) & (y < self.rows)
        return y[inside].astype(np.intp), x[inside].astype(np.intp), inside


#: Window of the networks for any camera, as ``checkpoints/general``: it shows lanes of up to 128 cm.
GENERAL_WINDOW = BirdseyeWindow(left_cm=-64.0, cell_cm=1.0)


class WindowFile(Settings):
    """A window in a file; see :class:`BirdseyeWindow`.

    Bounds are chosen: ten metres, and sixteen times the cells of the default along each side.
    """

    left_cm: float = Field(ge=-1000.0, le=1000.0)
    near_cm: float = Field(ge=-1000.0, le=1000.0)
    cell_cm: float = Field(gt=0.0, le=100.0)
    rows: int = Field(gt=0, le=2048)
    columns: int = Field(gt=0, le=2048)

    def window(self) -> BirdseyeWindow:
        """Return the window that the file describes."""
        return BirdseyeWindow(**self.model_dump())
