"""The network as a detector: an ONNX file, the edges that confirm it, and one frame after the other."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.errors import ModelMismatchError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM, lane_width_cm, proportional_angle_rad
from lanenet.perception.edges.raster import fill_raster, new_raster
from lanenet.perception.edges.road import RoadEdgeExtractor
from lanenet.perception.estimate import DetectorInputs, DetectorKind, LaneEstimate, LaneMemory
from lanenet.perception.network.model_file import INPUT_NAME, WIDTH_NAME, ModelMeta, open_model
from lanenet.perception.network.tracker import LaneTracker

#: A frame with more edges than this share of its road pixels is noise. Chosen: above the lane filter's 0.1,
#: since a network copes with more clutter.
_MAX_EDGE_SHARE = 0.15
#: Least share of the window's far half that a camera has to see for a model trained for any camera. Chosen.
_LEAST_SHARE_SEEN = 1.0 / 3.0

#: Sigma of lane widths beyond the known ones, as a share of the width. Chosen: 6 cm of a lane of 40 cm.
_WIDTH_TOLERANCE = 0.15
#: Sigma of the lane's centre that halves the confidence, as a share of the width. Chosen: 4 cm of 40 cm, well
#: above a good network's RMSE and well below half a car's width.
_CENTRE_TOLERANCE = 0.1


class NetworkDetector:
    """Frame in, lane out: the network's lines, fitted to their markings and followed from frame to frame.

    Attributes:
        meta: What the model says about itself.
        memory: The lane's width; rebuilds the missing line of a frame with one.
        problems: Warnings about the inputs, a line each.
    """

    def __init__(
        self,
        model_path: Path,
        camera: Camera,
        *,
        any_camera: bool = False,
        threads: int = 1,
        mask: UInt8[np.ndarray, "h w"] | None = None,
        lane_width_cm: float | None = None,
    ) -> None:
        """Open a model for a camera.

        Args:
            model_path: ONNX file or checkpoint folder.
            camera: The car's camera. Edges are found as the model's training images had them.
            any_camera: Accept a camera that the model was not trained with. Bird's-eye rasters of two
                calibrated cameras look alike, but not where one of them sees more.
            threads: Threads of the computation.
            mask: Nonzero on the car itself: edges there are left out, beside what the model's own settings
                leave out.
            lane_width_cm: The lane's width if it is known; a network with an input for it gets it. None takes
                it from the frames that show both lines. A line that a frame lacks is rebuilt with it.

        Raises:
            CalibrationError: If the mask's size is not the camera's.
            ModelMismatchError: If the file is not a model of this format, or was made for another camera.
        """
        self._session, self.meta = open_model(model_path, threads, frames=1)
        if not any_camera:
            _check_camera(self.meta, camera, model_path)
        widths_cm = [] if lane_width_cm is None else [lane_width_cm]
        self.problems = self.meta.untrained_widths(widths_cm, str(model_path))
        self.memory = LaneMemory(lane_width_cm)
        self._tracker = LaneTracker(self.memory)
        self._extractor = RoadEdgeExtractor(camera, self.meta.perception, mask)
        self._raster = new_raster(self.meta.window, self.meta.planes)
        self._feed: dict[str, np.ndarray] = {INPUT_NAME: self._raster[None]}
        if self.meta.takes_width and lane_width_cm is not None:
            self._feed[WIDTH_NAME] = np.array([lane_width_cm], np.float32)

    def detect(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> LaneEstimate:
        """Find the lane in one frame.

        Returns:
            All six points with their standard deviations; an empty estimate of confidence 0 if no edge lies
            in the window, or if the frame is all edges.

        Raises:
            CalibrationError: If the frame's size is not the camera's.
        """
        edges = self._extractor.extract(frame_bgr)
        if self._extractor.is_crowded(len(edges.points_cm), _MAX_EDGE_SHARE):
            return LaneEstimate()
        raster = fill_raster(self.meta.window, edges, self._raster)
        if not np.count_nonzero(raster[0]):
            return LaneEstimate()
        points_cm, sigma_cm, presence = self._run()
        points_cm, sigma_cm, _ = self._tracker.follow(points_cm, sigma_cm, presence, edges)
        return self._estimate(points_cm, sigma_cm, presence)

    def detect_raster(self, raster: UInt8[np.ndarray, "p r c"]) -> LaneEstimate:
        """Find the lane in a bird's-eye raster with all planes: the network alone, with the lane's width."""
        self._raster[:] = raster[: len(self._raster)]
        if not np.count_nonzero(self._raster[0]):
            return LaneEstimate()
        points_cm, sigma_cm, presence = self._run()
        points_cm, sigma_cm = self.memory.complete(points_cm, sigma_cm, presence)
        return self._estimate(points_cm, sigma_cm, presence)

    def _run(self) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"], Float[np.ndarray, "2"]]:
        """Run the network on the raster."""
        found = self._session.run(("points_cm", "sigma_cm", "presence"), self._feed)
        points_cm, sigma_cm, presence = (np.asarray(values[0], np.float64) for values in found)
        return points_cm, sigma_cm, presence

    def _estimate(
        self,
        points_cm: Float[np.ndarray, "6"],
        sigma_cm: Float[np.ndarray, "6"],
        presence: Float[np.ndarray, "2"],
    ) -> LaneEstimate:
        row = 1
        centre_cm = 0.5 * (float(points_cm[row]) + float(points_cm[row + len(ROWS_CM)]))
        return LaneEstimate(
            points_cm=points_cm,
            sigma_cm=sigma_cm,
            steering_rad=proportional_angle_rad(centre_cm, ROWS_CM[row]),
            confidence=confidence(points_cm, sigma_cm, presence, self.meta.widths_cm),
            presence=presence,
        )

    def reset(self) -> None:
        """Forget what earlier frames showed: the lane, its width, and its markings."""
        self.memory.reset()
        self._tracker.reset()


def _check_camera(meta: ModelMeta, camera: Camera, model_path: Path) -> None:
    """Refuse a camera that a model was not trained for.

    Raises:
        ModelMismatchError: Naming both cameras, or how much of the window this one sees.
    """
    if meta.any_camera:
        share = _share_seen(meta.window, camera)
        if share < _LEAST_SHARE_SEEN:
            raise ModelMismatchError(
                f"{model_path}: made for any camera that sees its window, {meta.window}; this one sees "
                f"{share:.0%} of the window's far half, expected at least {_LEAST_SHARE_SEEN:.0%}"
            )
        return
    this = f"this camera, {camera.model} {camera.width}x{camera.height},"
    meta.check_trained_with(camera.hash, this, str(model_path))


def _share_seen(window: BirdseyeWindow, camera: Camera) -> float:
    """Return the share of the far half of a window that lies in a camera's image."""
    row, column = np.mgrid[0 : window.rows / 2 : 16j, 0 : window.columns - 1 : 32j]
    pixels = camera.project_ground(window.points(np.stack([row.ravel(), column.ravel()], axis=1)))
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= -0.5) & (pixels < (camera.width - 0.5, camera.height - 0.5))).all(axis=1)
    return float(inside.mean())


def confidence(
    points_cm: Float[np.ndarray, "6"],
    sigma_cm: Float[np.ndarray, "6"],
    presence: Float[np.ndarray, "2"],
    width_range_cm: tuple[float, float],
) -> float:
    """Rate an answer by the presence of its lines, the sigma of its centre and its width.

    The product of three factors from 0 to 1:

    - the probability that at least one line is seen, ``1 - (1 - p_left) (1 - p_right)``;
    - ``1 / (1 + (s / (0.1 W))^2)`` with s the standard deviation of the lane's centre at y = 15 cm, half the
      root of the sum of the squares of both lines', and W the middle of the known widths;
    - ``exp(-0.5 (d / (0.15 W'))^2)`` with d how far the width of the answer, across the lane, lies outside
      the known widths, and W' the nearest of these; 1 within them.

    Args:
        points_cm: The six points, frame car.
        sigma_cm: Their standard deviations.
        presence: Probability that each line can be seen.
        width_range_cm: The narrowest and the widest lane that the network was trained on.

    Returns:
        0 to 1; 0 if the right line does not lie to the right of the left one, or if anything is not a finite
        number, a sigma is negative, or a presence is no probability.

    Source:
        Own choice; values in ``tests/unit/perception/test_confidence.py``.
    """
    width_cm, sigmas, (left, right) = lane_width_cm(points_cm), sigma_cm.tolist(), presence.tolist()
    # Written so that NaN fails as well.
    if not (0.0 < width_cm < math.inf and min(sigmas) >= 0.0 and sum(sigmas) < math.inf):
        return 0.0
    if not (0.0 <= left <= 1.0 and 0.0 <= right <= 1.0):
        return 0.0
    low, high = width_range_cm
    seen = 1.0 - (1.0 - left) * (1.0 - right)
    centre_cm = 0.5 * math.hypot(sigmas[1], sigmas[4])
    sure = 1.0 / (1.0 + (centre_cm / (_CENTRE_TOLERANCE * 0.5 * (low + high))) ** 2)
    nearest_cm = min(max(width_cm, low), high)
    off = (width_cm - nearest_cm) / (_WIDTH_TOLERANCE * nearest_cm)
    return seen * sure * math.exp(-0.5 * off * off)


def _build(inputs: DetectorInputs) -> NetworkDetector:
    assert inputs.camera is not None and inputs.model is not None
    width_cm = inputs.drive_lane_width_cm if inputs.lane_width_cm is None else inputs.lane_width_cm
    return NetworkDetector(
        inputs.model, inputs.camera, any_camera=inputs.any_camera, mask=inputs.mask, lane_width_cm=width_cm
    )


KIND = DetectorKind("network", _build, needs_model=True, takes_lane_width=True, takes_mask=True)
