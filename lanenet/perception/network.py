"""The network as a detector: an ONNX file, its description and one frame after the other."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from jaxtyping import Float, UInt8

from lanenet.config import check_settings
from lanenet.errors import ConfigError, ModelMismatchError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS, PARABOLA_FROM_POINTS, POINT_NAMES, ROWS_CM
from lanenet.perception.birdseye import PerceptionSettings, RoadEdgeExtractor
from lanenet.perception.estimate import LaneEstimate

FORMAT = "lanenet-model/1"
INPUT_NAME = "raster"
OUTPUT_NAMES = ("points_cm", "parabolas", "centre_cm", "steering_rad")

_UNITS = {"points_cm": "cm", "parabolas": "1/cm, 1, cm", "centre_cm": "cm", "steering_rad": "rad"}
_SIGNS = {"x": "positive right", "y": "positive ahead", "steering_rad": "positive left"}

#: Edge points in the window from which on the number of points no longer limits the confidence.
_ENOUGH_POINTS = 120
#: A frame with more edges than this share of its road pixels is noise.
_MAX_EDGE_SHARE = 0.15
#: Standard deviation of the lane width that the confidence expects, as a share of the width.
_WIDTH_TOLERANCE = 0.15


@dataclass(frozen=True)
class ModelMeta:
    """What a model file says about itself.

    Attributes:
        window: Bird's-eye window of its rasters.
        camera_hashes: Of the cameras whose frames it was trained on.
        wheelbase_cm: Of the car that it was trained on.
        lane_width_cm: Mean lane width of its training data, between the middles of the markings.
        training_hash: Hash of the contents of its training files.
        rmse_cm: Error of each point on validation frames; NaN where it was not measured.
        reference: What the errors were measured against: ``truth``, ``map`` or ``map and truth``.
        perception: How the edge points of its rasters were found.
    """

    window: BirdseyeWindow
    camera_hashes: tuple[str, ...]
    wheelbase_cm: float
    lane_width_cm: float
    training_hash: str
    rmse_cm: tuple[float, ...]
    reference: str
    perception: PerceptionSettings = field(default_factory=PerceptionSettings)

    def to_properties(self) -> dict[str, str]:
        """Return the description as the text properties of an ONNX file."""
        errors = [None if math.isnan(v) else v for v in self.rmse_cm]
        return {
            "format": FORMAT,
            "rows_cm": json.dumps(ROWS_CM),
            "points": json.dumps(POINT_NAMES),
            "units": json.dumps(_UNITS),
            "signs": json.dumps(_SIGNS),
            "window": json.dumps(asdict(self.window)),
            "camera_hashes": json.dumps(self.camera_hashes),
            "wheelbase_cm": json.dumps(self.wheelbase_cm),
            "lane_width_cm": json.dumps(self.lane_width_cm),
            "training_hash": self.training_hash,
            "rmse_cm": json.dumps(errors),
            "reference": self.reference,
            "perception": self.perception.model_dump_json(),
        }

    @staticmethod
    def from_properties(properties: Mapping[str, str], where: str) -> ModelMeta:
        """Read the description back.

        Args:
            properties: Text properties of an ONNX file.
            where: Names the file in the error.

        Raises:
            ModelMismatchError: If the format is unknown, a property is missing or unreadable, or the six
                outputs mean something else.
        """
        found = properties.get("format")
        if found != FORMAT:
            what = f"format {found!r}" if found else "no format"
            raise ModelMismatchError(f"{where}: {what}, expected {FORMAT!r}; export the model again")

        def value(key: str) -> Any:
            try:
                return json.loads(properties[key])
            except KeyError:
                raise ModelMismatchError(f"{where}: property {key!r} is missing") from None
            except ValueError:
                raise ModelMismatchError(f"{where}: property {key!r} is not JSON") from None

        for key, expected in (("rows_cm", list(ROWS_CM)), ("points", list(POINT_NAMES)), ("signs", _SIGNS)):
            if value(key) != expected:
                raise ModelMismatchError(f"{where}: {key} {value(key)}, expected {expected}")
        try:
            meta = ModelMeta(
                window=BirdseyeWindow(**value("window")),
                camera_hashes=tuple(str(v) for v in value("camera_hashes")),
                wheelbase_cm=float(value("wheelbase_cm")),
                lane_width_cm=float(value("lane_width_cm")),
                training_hash=str(properties.get("training_hash", "")),
                rmse_cm=tuple(math.nan if v is None else float(v) for v in value("rmse_cm")),
                reference=str(properties.get("reference", "")),
                perception=check_settings(PerceptionSettings, value("perception"), "perception"),
            )
        except (TypeError, ValueError, ConfigError) as error:
            raise ModelMismatchError(f"{where}: unreadable description ({error})") from None
        if len(meta.rmse_cm) != N_POINTS:
            raise ModelMismatchError(f"{where}: rmse_cm has {len(meta.rmse_cm)} values, expected {N_POINTS}")
        return meta


def open_model(path: Path, threads: int = 1) -> tuple[onnxruntime.InferenceSession, ModelMeta]:
    """Open a model file and check that it is what its description says.

    Args:
        path: ONNX file that :mod:`lanenet.learn` exported.
        threads: Threads of the computation.

    Raises:
        ModelMismatchError: If the file is missing, is not an ONNX file, or its description is of another
            format or does not fit its own inputs and outputs.
    """
    if not path.is_file():
        raise ModelMismatchError(f"{path}: no such file, expected an ONNX model")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has no common base class of its own
        reason = str(error).splitlines()[0][:200]
        raise ModelMismatchError(f"{path}: cannot be opened as an ONNX model ({reason})") from None
    meta = ModelMeta.from_properties(session.get_modelmeta().custom_metadata_map, str(path))
    inputs = {i.name: (i.type, list(i.shape[1:])) for i in session.get_inputs()}
    expected = {INPUT_NAME: ("tensor(uint8)", [1, meta.window.rows, meta.window.columns])}
    if inputs != expected:
        raise ModelMismatchError(f"{path}: inputs {inputs} do not fit its window, expected {expected}")
    outputs = [o.name for o in session.get_outputs()]
    if not set(OUTPUT_NAMES) <= set(outputs):
        raise ModelMismatchError(f"{path}: outputs {outputs}, expected {list(OUTPUT_NAMES)}")
    return session, meta


def read_model_meta(path: Path) -> ModelMeta:
    """Return what a model file says about itself.

    Raises:
        ModelMismatchError: As :func:`open_model`.
    """
    return open_model(path)[1]


class NetworkDetector:
    """Frame in, lane out, by the network; keeps nothing from frame to frame.

    Attributes:
        meta: What the model says about itself.
    """

    def __init__(
        self,
        model_path: Path,
        camera: Camera,
        *,
        any_camera: bool = False,
        window: BirdseyeWindow | None = None,
        threads: int = 1,
        mask: UInt8[np.ndarray, "h w"] | None = None,
    ) -> None:
        """Open a model for a camera.

        Args:
            model_path: ONNX file.
            camera: The car's camera. Edges are found as the model's training images had them.
            any_camera: Accept a camera that the model was not trained with. Bird's-eye rasters of two
                calibrated cameras look alike, but not where one of them sees more.
            window: The bird's-eye window that the caller counts on; None takes the model's.
            threads: Threads of the computation.
            mask: Nonzero on the car itself: edges there are left out, beside what the model's own settings
                leave out.

        Raises:
            CalibrationError: If the mask's size is not the camera's.
            ModelMismatchError: If the file is not a model of this format, or was made for another window or
                camera; the message says which.
        """
        self._session, self.meta = open_model(model_path, threads)
        if window is not None and window != self.meta.window:
            raise ModelMismatchError(
                f"{model_path}: made for the window {self.meta.window}, but {window} is in use"
            )
        camera_hash = camera.hash
        if not any_camera and camera_hash not in self.meta.camera_hashes:
            raise ModelMismatchError(
                f"{model_path}: trained with camera {', '.join(self.meta.camera_hashes) or 'unknown'}, but "
                f"this camera is {camera_hash}; train with this camera, or allow any camera if both are "
                "calibrated and see about the same road"
            )
        self._extractor = RoadEdgeExtractor(camera, self.meta.perception, mask)
        shape = (1, 1, self.meta.window.rows, self.meta.window.columns)
        self._raster: UInt8[np.ndarray, "1 1 r c"] = np.zeros(shape, np.uint8)
        self._sigma_cm: Float[np.ndarray, "6"] = np.array(self.meta.rmse_cm)

    def detect(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> LaneEstimate:
        """Find the lane in one frame.

        Returns:
            All six points, with the model's validation errors as their standard deviations; an empty
            estimate of confidence 0 if no edge lies in the window, or if the frame is all edges.

        Raises:
            CalibrationError: If the frame's size is not the camera's.
        """
        edges = self._extractor.extract(frame_bgr)
        if self._extractor.is_crowded(edges, _MAX_EDGE_SHARE):
            return LaneEstimate()
        return self.detect_raster(self.meta.window.rasterise(edges.points_cm, out=self._raster[0, 0]))

    def detect_raster(self, raster: UInt8[np.ndarray, "r c"]) -> LaneEstimate:
        """Find the lane in a bird's-eye raster of 0 and 255."""
        n_cells = int(np.count_nonzero(raster))
        if n_cells == 0:
            return LaneEstimate()
        if raster.base is not self._raster and raster is not self._raster:
            self._raster[0, 0] = raster
        points, steering = self._session.run(("points_cm", "steering_rad"), {INPUT_NAME: self._raster})
        points_cm = np.asarray(points[0], np.float64)
        return LaneEstimate(
            points_cm=points_cm,
            sigma_cm=self._sigma_cm.copy(),
            steering_rad=float(steering[0, 0]),
            confidence=confidence(points_cm, n_cells, self.meta.lane_width_cm),
        )

    def reset(self) -> None:
        """Do nothing: there is no state."""


def confidence(points_cm: Float[np.ndarray, "6"], n_cells: int, lane_width_cm: float) -> float:
    """Judge an answer by how much was seen and by whether it is a lane of the known width.

    ``min(1, n / 120) * exp(-0.5 * ((w - W) / (0.15 W))^2)`` with n the marked cells of the raster, W the lane
    width of the training data and w the width of the answer at y = 15 cm, measured across the lane: the gap
    along x divided by sqrt(1 + slope^2), with the mean slope dx/dy of the two parabolas there.

    Args:
        points_cm: The six points, frame car.
        n_cells: Cells of the raster that hold an edge.
        lane_width_cm: W.

    Returns:
        0 to 1; 0 if the right line does not lie to the right of the left one.

    Source:
        Own choice; values in ``tests/unit/perception/test_network.py``.
    """
    lines = points_cm.reshape(2, len(ROWS_CM))
    row = 1
    gap = float(lines[1, row] - lines[0, row])
    if not gap > 0.0:
        return 0.0
    a, b, _ = PARABOLA_FROM_POINTS @ lines.mean(axis=0)
    slope = 2.0 * a * ROWS_CM[row] + b
    width = gap / math.sqrt(1.0 + slope * slope)
    off = (width - lane_width_cm) / (_WIDTH_TOLERANCE * lane_width_cm)
    return min(1.0, n_cells / _ENOUGH_POINTS) * math.exp(-0.5 * off * off)
