"""The network as a detector: an ONNX file, the edges that confirm it, and one frame after the other."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.config import Settings
from lanenet.errors import ModelMismatchError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import (
    ROWS_CM,
    lane_width_cm,
    parabola_through,
    proportional_angle_rad,
)
from lanenet.perception.edges.raster import fill_raster, new_raster
from lanenet.perception.edges.road import RoadEdgeExtractor, RoadEdges
from lanenet.perception.estimate import SURE, DetectorInputs, DetectorKind, LaneEstimate, LaneMemory
from lanenet.perception.network.lane.filter import NOTHING_SEEN, LaneFilter
from lanenet.perception.network.lane.looks import Keep
from lanenet.perception.network.lane.network_answer import NetworkAnswer
from lanenet.perception.network.lane.settings import BorderWeight
from lanenet.perception.network.lane.view import LinesInView
from lanenet.perception.network.model_file import (
    INPUT_NAME,
    LOG_SHARE_NAME,
    WIDTH_NAME,
    ModelMeta,
    open_model,
)

log = logging.getLogger(__name__)

#: What the network is asked for, beside the probabilities of places, which not every model has.
_ANSWERS = ("points_cm", "sigma_cm", "presence")
#: Places of the one mode that stands for a model without their probabilities. Chosen: as networks have.
_PLACES = 64

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
#: Widths of the same lane, as shares of the known one: it widens in bends and where it joins another. Chosen.
_NARROW, _WIDE = 0.8, 1.25
#: Sigma of the width by which one line tells the centre, as a share of it. Chosen: 2 cm of a lane of 40 cm.
_ONE_LINE = 0.05
#: Length along the road, [cm], from which a line is seen on its edges, as for the lane filter; below it what
#: the network says of it counts by half.
_SEEN_CM = BorderWeight().seen_cm
#: Why a frame is not answered that is all edges.
_CROWDED = "the frame is all edges"
#: Label row at which the car aims, 15 cm ahead.
_AIM = 1


class NetworkDetector:
    """Frame in, lane out: the network's lines, fitted to their markings and followed from frame to frame.

    Attributes:
        meta: What the model says about itself.
        memory: The lane's width; rebuilds the missing line of a frame with one.
        problems: Warnings about the inputs, a line each; that the lane has another width than was given comes
            while frames are seen, and is logged.
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
        keeps: bool = True,
        keep: Keep | None = None,
    ) -> None:
        """Open a model for a camera.

        Args:
            model_path: ONNX file or checkpoint folder.
            camera: The car's camera. Edges are found as the model's training images had them.
            any_camera: Accept a camera that the model was not trained with. Bird's-eye rasters of two
                calibrated cameras look alike, but not where one of them sees more.
            threads: Threads of onnxruntime.
            mask: Nonzero on the car itself: edges there are left out, beside what the model's own settings
                leave out.
            lane_width_cm: The lane's width if it is known; a network with an input for it gets it. None takes
                it from the frames that show both lines. A line that a frame lacks is rebuilt with it.
            keeps: Keep the lane, its width and its markings from frame to frame; else each is the first one.
            keep: Side of the road on which cars drive; with it the estimates say whether this is their lane.

        Raises:
            CalibrationError: If the mask's size is not the camera's.
            ModelMismatchError: If the file is not a model of this format, or was made for another camera.
        """
        self._session, self.meta = open_model(model_path, threads, frames=1)
        if not any_camera:
            _check_camera(self.meta, camera, model_path)
        widths_cm = [] if lane_width_cm is None else [lane_width_cm]
        self.problems = self.meta.untrained_widths(widths_cm, str(model_path))
        self._told, self._keeps = False, keeps
        self.memory = LaneMemory(lane_width_cm, self.meta.widths_cm)
        self._extractor = RoadEdgeExtractor(camera, self.meta.perception, mask)
        self._filter = LaneFilter(self.memory, LinesInView(camera, self._extractor.table.keep), keep)
        self._raster = new_raster(self.meta.window, self.meta.planes)
        self._feed: dict[str, np.ndarray] = {INPUT_NAME: self._raster[None]}
        places = {o.name: o.shape[-1] for o in self._session.get_outputs()}.get(LOG_SHARE_NAME)
        self._answers = _ANSWERS if places is None else (*_ANSWERS, LOG_SHARE_NAME)
        ends_cm = self.meta.window.left_cm, self.meta.window.right_cm
        self._places_cm: Float[np.ndarray, "b"] = np.linspace(*ends_cm, places or _PLACES)

    def detect(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> LaneEstimate:
        """Find the lane in one frame.

        Returns:
            The six points with their standard deviations, NaN where unknown; an empty estimate of confidence
            0 if no edge lies in the window, or if the frame is all edges.

        Raises:
            CalibrationError: If the frame's size is not the camera's.
        """
        return self.detect_edges(self._extractor.extract(frame_bgr))

    def detect_edges(self, edges: RoadEdges) -> LaneEstimate:
        """Find the lane in the edge points of one frame, as label sets hold them; as :meth:`detect`."""
        if not self._keeps:
            self.memory.reset()
            self._filter.reset()
        if self._extractor.is_crowded(len(edges.points_cm), _MAX_EDGE_SHARE):
            self._filter.lose()
            return LaneEstimate(reason=_CROWDED)
        if not np.count_nonzero(fill_raster(self.meta.window, edges, self._raster)[0]):
            self._filter.lose()
            return LaneEstimate(reason=NOTHING_SEEN)
        answer = self._run()
        lane = self._filter.follow(answer, edges)
        if not self._told and (contradiction := self.memory.contradiction):
            self._told = True
            self.problems.append(contradiction)
            log.warning(contradiction)
        # Plain numbers: for two of them arrays cost more than they save.
        both = zip(answer.presence.tolist(), lane.seen_cm.tolist(), strict=True)
        confirmed = np.array(
            [min(max(p, SURE), p + 0.5) if seen >= _SEEN_CM else 0.5 * p for p, seen in both]
        )
        return self._estimate(lane.points_cm, lane.sigma_cm, answer.presence, confirmed, lane.reason)

    def __call__(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> LaneEstimate:
        """Find the lane in one frame, as :meth:`detect`."""
        return self.detect(frame_bgr)

    def detect_raster(self, raster: UInt8[np.ndarray, "p r c"]) -> LaneEstimate:
        """Find the lane in a bird's-eye raster with all planes: the network alone, with the lane's width."""
        self._raster[:] = raster[: len(self._raster)]
        if not np.count_nonzero(self._raster[0]):
            return LaneEstimate()
        points_cm, sigma_cm, presence, *_ = self._run()
        points_cm, sigma_cm = self.memory.complete(points_cm, sigma_cm, presence)
        self.memory.learn(points_cm, presence)
        return self._estimate(points_cm, sigma_cm, presence, presence)

    def _run(self) -> NetworkAnswer:
        """Run the network on the raster, with the lane's width as soon as it is known."""
        if self.meta.takes_width:
            self._feed[WIDTH_NAME] = np.array([self.memory.width_cm or 0.0], np.float32)
        found = self._session.run(self._answers, self._feed)
        points_cm, sigma_cm, presence, *shares = (np.asarray(values[0], np.float64) for values in found)
        if shares:
            return NetworkAnswer(points_cm, sigma_cm, presence, shares[0], self._places_cm)
        return NetworkAnswer.of_one_mode(points_cm, sigma_cm, presence, self._places_cm)

    def _estimate(
        self,
        points_cm: Float[np.ndarray, "6"],
        sigma_cm: Float[np.ndarray, "6"],
        presence: Float[np.ndarray, "2"],
        confirmed: Float[np.ndarray, "2"],
        reason: str = "",
    ) -> LaneEstimate:
        """Return the answer; ``confirmed`` is the presence that the confidence counts."""
        width_cm = self.memory.width_cm
        aim_cm = _centre_cm(points_cm, width_cm)
        return LaneEstimate(
            points_cm=points_cm,
            sigma_cm=sigma_cm,
            steering_rad=math.nan if math.isnan(aim_cm) else proportional_angle_rad(aim_cm, ROWS_CM[_AIM]),
            confidence=confidence(points_cm, sigma_cm, confirmed, self.meta.widths_cm, width_cm),
            presence=presence,
            own_lane=self._filter.looks.own_lane,
            reason=reason,
        )

    def moved(self, travel_cm: float, turn_rad: float, wheelbase_cm: float) -> None:
        """Take the car's motion since the last frame; as :class:`lanenet.perception.estimate.TakesMotion`."""
        self._filter.moved(travel_cm, turn_rad, wheelbase_cm)

    def reset(self) -> None:
        """Forget the lane and its markings; its width stays likely, since most roads stay the same."""
        self.memory.doubt()
        self._filter.reset()


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
    return float(camera.shows_ground(window.points(np.stack([row.ravel(), column.ravel()], axis=1))).mean())


def _centre_cm(points_cm: Float[np.ndarray, "6"], width_cm: float | None) -> float:
    """Return the lane's centre at y = 15 cm, by one line if the other is unknown; NaN without any."""
    left, right = points_cm.tolist()[_AIM :: len(ROWS_CM)]
    if width_cm is not None:
        left, right = (
            right - width_cm if math.isnan(left) else left,
            left + width_cm if math.isnan(right) else right,
        )
    return 0.5 * (left + right)


def confidence(
    points_cm: Float[np.ndarray, "6"],
    sigma_cm: Float[np.ndarray, "6"],
    presence: Float[np.ndarray, "2"],
    width_range_cm: tuple[float, float],
    known_width_cm: float | None = None,
) -> float:
    """Rate an answer by the presence of its lines, the sigma of its centre, its width, and its bend.

    The product of four factors from 0 to 1, with W the lane's width if it is known, else that of the answer
    within the widths of the training:

    - the probability that at least one line is seen, ``1 - (1 - p_left) (1 - p_right)``;
    - ``1 / (1 + (s / (0.1 W))^2)`` with s the standard deviation of the lane's centre at y = 15 cm: half the
      root of the sum of the squares of both lines', or, of one line and W, that of the line and 0.05 W;
    - ``exp(-0.5 (d / (0.15 W'))^2)`` with d how far the width of the answer, across the lane, lies outside
      0.8 to 1.25 W, or the widths of the training, and W' the nearest of these; 1 within them;
    - ``1 - 0.5 (1 - p) min(1, W / R)`` with p the presence of the line that is seen less, and R the radius of
      the bend: one line in a bend tells little of the other.

    Args:
        points_cm: The six points, frame car; NaN where unknown.
        sigma_cm: Their standard deviations.
        presence: Probability that each line can be seen.
        width_range_cm: The narrowest and the widest lane that the network was trained on.
        known_width_cm: The lane's width, given or remembered; None while unknown.

    Returns:
        0 to 1; 0 if no line is known 15 cm ahead, or one and no width, if the right line does not lie to the
        right of the left one, or if a point is infinite, its sigma is none, or a presence is no probability.

    Source:
        Own choice; values in ``tests/unit/perception/test_confidence.py``.
    """
    points, sigmas, (left, right) = points_cm.tolist(), sigma_cm.tolist(), presence.tolist()
    # Written so that NaN fails as well.
    if not (0.0 <= left <= 1.0 and 0.0 <= right <= 1.0):
        return 0.0
    both = zip(points, sigmas, strict=True)
    if [x for x, s in both if not (math.isnan(x) or (math.isfinite(x) and 0.0 <= s < math.inf))]:
        return 0.0
    low, high = width_range_cm
    if known_width_cm is not None:
        low, high = _NARROW * known_width_cm, _WIDE * known_width_cm
    known = [not math.isnan(x) for x in points[_AIM :: len(ROWS_CM)]]
    if all(known):
        across_cm = lane_width_cm(points_cm)
        if math.isnan(across_cm):
            across_cm = points[_AIM + len(ROWS_CM)] - points[_AIM]
        if not across_cm > 0.0:
            return 0.0
        nearest_cm = min(max(across_cm, low), high)
        off = (across_cm - nearest_cm) / (_WIDTH_TOLERANCE * nearest_cm)
        unit_cm = known_width_cm or nearest_cm
        centre_cm = 0.5 * math.hypot(sigmas[_AIM], sigmas[_AIM + len(ROWS_CM)])
    elif any(known) and known_width_cm is not None:
        off, unit_cm = 0.0, known_width_cm
        side = known.index(True)
        centre_cm = math.hypot(sigmas[_AIM + side * len(ROWS_CM)], _ONE_LINE * unit_cm)
    else:
        return 0.0
    least = min(p if there else 0.0 for p, there in zip((left, right), known, strict=True))
    bend = 0.0
    for line in (points[: len(ROWS_CM)], points[len(ROWS_CM) :]):
        if not any(map(math.isnan, line)):
            a, b, _ = parabola_through(*line)
            bend = max(bend, abs(2.0 * a) / math.hypot(1.0, 2.0 * a * ROWS_CM[_AIM] + b) ** 3)
    seen = 1.0 - (1.0 - left) * (1.0 - right)
    sure = 1.0 / (1.0 + (centre_cm / (_CENTRE_TOLERANCE * unit_cm)) ** 2)
    alone = 1.0 - 0.5 * (1.0 - least) * min(1.0, unit_cm * bend)
    return seen * sure * math.exp(-0.5 * off * off) * alone


class NetworkDetectorSettings(Settings):
    """What a network is told beside its model.

    Attributes:
        memory: The lane, its width and its markings are kept from frame to frame; without it each frame is
            answered as the first one.
        keep: Side of the road on which cars drive, ``right`` or ``left``; None where there are no sides, or
            nobody knows. It decides nothing but ``own_lane`` of the estimates.
    """

    memory: bool = True
    keep: Keep | None = None


def _build(inputs: DetectorInputs) -> NetworkDetector:
    assert inputs.camera is not None and inputs.model is not None
    width_cm = inputs.drive_lane_width_cm if inputs.lane_width_cm is None else inputs.lane_width_cm
    settings = inputs.settings(NetworkDetectorSettings)
    return NetworkDetector(
        inputs.model,
        inputs.camera,
        any_camera=inputs.any_camera,
        mask=inputs.mask,
        lane_width_cm=width_cm,
        keeps=settings.memory,
        keep=settings.keep,
    )


KIND = DetectorKind(
    "network",
    _build,
    settings=NetworkDetectorSettings,
    needs_model=True,
    takes_lane_width=True,
    takes_mask=True,
    variants={"network-single": {"memory": False}},
)
