"""What detectors answer: on frames, on the edge points of label sets, and networks on rasters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from lanenet.data.label_set import LabelSet
from lanenet.data.maps.mapped_drive import LabelledFrames
from lanenet.errors import ConfigError, ModelMismatchError
from lanenet.evaluation.detect import run_detectors
from lanenet.evaluation.plain_sight import in_plain_sight
from lanenet.geometry.lane import N_POINTS, SIDES
from lanenet.perception.edges.road import PerceptionSettings, RoadEdgeExtractor, RoadEdges
from lanenet.perception.estimate import Detector, DetectorInputs, EdgeDetector, LaneEstimate
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.network.model_file import INPUT_NAME, WIDTH_NAME, open_model
from lanenet.perception.registry import build_detector, build_on_edges, compared_names, kind_of
from lanenet.processes import run_jobs

#: Called with (source, frames done, frames).
Progress = Callable[[str, int, int], None]

#: Fewer frames are answered sooner than a process starts. Chosen: some 10 s of work.
_WORTH_PROCESSES = 600
#: Rasters that a network is given at a time; bounds the memory.
_CHUNK = 64


@dataclass(frozen=True)
class Answers:
    """What detectors say about the frames of a source, by their names.

    Attributes:
        points_cm: Six points per frame, frame car; NaN where a detector has no answer.
        sigma_cm: Sigma of each point; a detector that predicts none is left out or has NaN.
        presence: Probability that the left and the right line can be seen; likewise.
        confidence: Of each frame; empty for label sets.
        steering_rad: Steering target of each frame, positive left; empty for label sets.
        brightness: Mean grey level of each frame, 0 to 255; None for label sets.
        plain: Frames with both markings in plain sight; None for label sets.
    """

    points_cm: dict[str, Float[np.ndarray, "n 6"]]
    sigma_cm: dict[str, Float[np.ndarray, "n 6"]] = field(default_factory=dict)
    presence: dict[str, Float[np.ndarray, "n 2"]] = field(default_factory=dict)
    confidence: dict[str, Float[np.ndarray, "n"]] = field(default_factory=dict)
    steering_rad: dict[str, Float[np.ndarray, "n"]] = field(default_factory=dict)
    brightness: Float[np.ndarray, "n"] | None = None
    plain: Bool[np.ndarray, "n"] | None = None


def answer_frames(
    frames: LabelledFrames,
    detectors: Mapping[str, Detector],
    progress: Callable[[int, int], None] | None = None,
) -> Answers:
    """Collect what detectors say about every frame.

    Args:
        frames: The source.
        detectors: By name.
        progress: Called with (frames done, frames).

    Raises:
        LanenetError: As :func:`run_detectors`.
    """
    n = len(frames)
    brightness, plain = np.empty(n), np.zeros(n, bool)
    extractor = RoadEdgeExtractor(frames.camera, frames.perception)
    answers = Answers(
        {name: np.full((n, N_POINTS), np.nan) for name in detectors},
        {name: np.full((n, N_POINTS), np.nan) for name in detectors},
        {name: np.full((n, len(SIDES)), np.nan) for name in detectors},
        {name: np.full(n, np.nan) for name in detectors},
        {name: np.full(n, np.nan) for name in detectors},
        brightness,
        plain,
    )
    for seen in run_detectors(frames, detectors, frames.motion):
        i, image = seen.index, seen.image
        assert image is not None
        # Every fourth pixel is enough for a mean.
        brightness[i] = image[::4, ::4].mean()
        if np.isfinite(frames.points_cm[i]).all():
            road = extractor.extract(image)
            plain[i] = in_plain_sight(road.points_cm, road.normals, frames.points_cm[i])
        for name, found in seen.estimates.items():
            answers.points_cm[name][i] = found.points_cm
            answers.sigma_cm[name][i] = found.sigma_cm
            answers.presence[name][i] = found.presence
            answers.confidence[name][i] = found.confidence
            answers.steering_rad[name][i] = found.steering_rad
        if progress is not None:
            progress(i + 1, n)
    return answers


def choose_names(text: str) -> tuple[str, ...]:
    """Read a list of detectors, as in ``network,painter``; returned in the order of the tables.

    Raises:
        ConfigError: If a name is unknown, or there is none.
    """
    known = compared_names()
    wanted = [part.strip() for part in text.split(",") if part.strip()]
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        found = repr(unknown[0]) if unknown else "no detector"
        raise ConfigError(f"--detectors {text!r}: found {found}, known: {', '.join(known)}")
    return tuple(name for name in known if name in wanted)


@dataclass(frozen=True)
class Compared:
    """Which detectors are compared, and what they are built from.

    Attributes:
        names: Detectors of the registry.
        models: ONNX files by name: ``network``, and more networks under other names.
        marking_cm: Thickness of the tape for the lane filter; None takes the source's, or the default.
        any_camera: Accept a model that was trained with another camera than that of the frames or labels.
    """

    names: Sequence[str]
    models: Mapping[str, Path] = field(default_factory=dict)
    marking_cm: float | None = None
    any_camera: bool = False

    @property
    def in_order(self) -> list[str]:
        """All names, in the order of the tables; other networks follow the first one."""
        more = [name for name in self.models if name != "network"]
        network = [name for name in self.names if name == "network"]
        return [*network, *more, *(name for name in self.names if name != "network")]

    def build(self, frames: LabelledFrames) -> dict[str, Detector]:
        """Build the detectors for the camera, the lane and the markings of a source.

        Raises:
            ConfigError: If something that a detector needs is missing or out of range.
            ModelMismatchError: If a model cannot be used with this camera.
            CalibrationError: If the camera sees no road.
        """
        # Besides the rows that a model leaves out, those in which this car sees itself.
        hidden = hidden_rows(frames) if frames.perception.range.bottom_rows else None
        detectors = {}
        for name in self.in_order:
            kind = "network" if name in self.models else name
            detectors[name] = build_detector(
                kind,
                DetectorInputs(
                    camera=frames.camera,
                    # A variant of the network has its model.
                    model=self.models.get(name, self.models.get(kind_of(kind).name)),
                    any_camera=self.any_camera,
                    # The network gets the same lane width as the lane filter, as on the car.
                    lane_width_cm=frames.lane_width_cm,
                    marking_cm=frames.marking_cm if self.marking_cm is None else self.marking_cm,
                    perception=frames.perception,
                    mask=hidden if kind_of(kind).takes_mask else None,
                ),
            )
        return detectors

    def answer(self, frames: LabelledFrames, progress: Progress | None = None) -> Answers:
        """Run the detectors over a source."""
        report = None if progress is None else partial(progress, Path(frames.name).name)
        return answer_frames(frames, self.build(frames), report)

    def answer_each(
        self, sources: Sequence[LabelledFrames], workers: int, progress: Progress | None
    ) -> list[Answers]:
        """Run the detectors over sources, in several processes where that is faster.

        Args:
            sources: Labelled frames.
            workers: Processes at a time.
            progress: As for one source; of several processes called with ("sources", sources done, sources).
        """
        if workers == 1 or len(sources) == 1 or sum(map(len, sources)) < _WORTH_PROCESSES:
            return [self.answer(source, progress) for source in sources]
        report = None if progress is None else partial(progress, "sources")
        return run_jobs(self.answer, [(source.name, source) for source in sources], workers, report)

    def answer_labels(self, labels: LabelSet, source: Path) -> Answers:
        """Run detectors on a label set's edge points.

        Of a label set without its camera networks answer each raster alone: the lane is not followed from
        frame to frame, nor are its lines fitted to the edge points.

        Raises:
            ConfigError: If a detector needs frames.
            ModelMismatchError: If a model does not fit the label set, which lies at ``source``.
        """
        meta, answers, n = labels.meta, Answers({}), len(labels)
        for name in self.in_order:
            kind = kind_of("network" if name in self.models else name)
            path = self.models.get(name, self.models.get(kind.name))
            if path is None:
                marking_cm = meta.marking_cm if self.marking_cm is None else self.marking_cm
                inputs = DetectorInputs(lane_width_cm=meta.lane_width_cm, marking_cm=marking_cm)
                answers.points_cm[name] = answer_edges(labels, build_on_edges(name, inputs))
                continue
            model = RasterModel(path)
            if not self.any_camera:
                model.meta.check_trained_with(meta.camera_hash, f"the camera of {source}", str(path))
            if meta.camera is None:
                found = model.answer_labels(labels)
                answers.points_cm[name], answers.sigma_cm[name] = found.points_cm, found.sigma_cm
                answers.presence[name] = found.presence
                continue
            model.check_edges(meta.perception)
            inputs = DetectorInputs(
                camera=meta.camera, model=path, any_camera=self.any_camera, lane_width_cm=meta.lane_width_cm
            )
            detector = build_detector(kind.name if name in self.models else name, inputs)
            assert isinstance(detector, NetworkDetector)
            estimates = answer_each_edges(labels, detector, detector.detect_edges)
            answers.points_cm[name] = np.array([e.points_cm for e in estimates]).reshape(n, N_POINTS)
            answers.sigma_cm[name] = np.array([e.sigma_cm for e in estimates]).reshape(n, N_POINTS)
            answers.presence[name] = np.array([e.presence for e in estimates]).reshape(n, len(SIDES))
        return answers


def hidden_rows(frames: LabelledFrames) -> UInt8[np.ndarray, "h w"]:
    """Return a mask of the rows in which a source's car sees itself."""
    mask = np.zeros((frames.camera.height, frames.camera.width), np.uint8)
    mask[frames.camera.height - frames.perception.range.bottom_rows :] = 255
    return mask


def answer_edges(label_set: LabelSet, detector: EdgeDetector) -> Float[np.ndarray, "n 6"]:
    """Run a detector of edge points over a label set.

    Args:
        label_set: Frames with their edge points and the directions of these.
        detector: Built for the label set's lane.

    Returns:
        Six points per frame, [cm], frame car; NaN where the detector has no answer.
    """

    def of(edges: RoadEdges) -> LaneEstimate:
        points, normals = (np.asarray(values, np.float64) for values in (edges.points_cm, edges.normals))
        return detector.estimate(points, normals)

    estimates = answer_each_edges(label_set, detector, of)
    return np.array([estimate.points_cm for estimate in estimates]).reshape(len(label_set), N_POINTS)


def answer_each_edges(
    label_set: LabelSet, detector: Detector | EdgeDetector, of: Callable[[RoadEdges], LaneEstimate]
) -> list[LaneEstimate]:
    """Return what a detector says of each frame's edge points.

    The detector is reset wherever a frame does not follow the one before it.

    Args:
        label_set: Frames with their edge points.
        detector: The detector.
        of: Its answer to the edge points of one frame.
    """
    estimates = []
    for i, edges in enumerate(label_set.edges):
        follows = (
            i > 0
            and label_set.drive[i] == label_set.drive[i - 1]
            and label_set.frame[i] == label_set.frame[i - 1] + 1
        )
        if not follows:
            detector.reset()
        estimates.append(of(RoadEdges.of_rows(edges)))
    return estimates


@dataclass(frozen=True)
class RasterAnswers:
    """What a network says about rasters.

    Attributes:
        points_cm: Six points each, frame car; NaN for an empty raster.
        sigma_cm: Their sigmas; NaN where the model predicts none.
        presence: Probability that the left and the right line can be seen; NaN likewise.
    """

    points_cm: Float[np.ndarray, "n 6"]
    sigma_cm: Float[np.ndarray, "n 6"]
    presence: Float[np.ndarray, "n 2"]


class RasterModel:
    """A model file that is run on rasters, as label sets hold them.

    The camera is not compared: a label set's edges are already on the road.

    Attributes:
        path: The file.
        meta: Its description.
    """

    def __init__(self, path: Path, threads: int = 1) -> None:
        """Open a file.

        Raises:
            ModelMismatchError: If it cannot be used.
        """
        self.path = path
        self._session, self.meta = open_model(path, threads)

    def check_edges(self, perception: PerceptionSettings) -> None:
        """Refuse edges that were found with other settings.

        Raises:
            ModelMismatchError: Naming both.
        """
        unlike = perception.unlike(self.meta.perception)
        if unlike:
            raise ModelMismatchError(
                f"{self.path}: made for edges with other settings than those of the label set ({unlike}); "
                "give the map or the drive itself, or label it with another --colour-weight"
            )

    def answer(
        self, rasters: UInt8[np.ndarray, "n p r c"], lane_cm: Float[np.ndarray, "n"] | None = None
    ) -> RasterAnswers:
        """Run the model on rasters.

        Args:
            rasters: Bird's-eye rasters with all planes, see :mod:`lanenet.perception.edges.raster`.
            lane_cm: Lane width of each, for a model that takes it; None: not known.
        """
        n = len(rasters)
        columns = {"points_cm": N_POINTS, "sigma_cm": N_POINTS, "presence": len(SIDES)}
        values = {name: np.full((n, width), np.nan) for name, width in columns.items()}
        for start in range(0, n, _CHUNK):
            part = rasters[start : start + _CHUNK]
            feed = {INPUT_NAME: np.ascontiguousarray(part[:, : self.meta.planes])}
            if self.meta.takes_width and lane_cm is not None:
                feed[WIDTH_NAME] = lane_cm[start : start + _CHUNK].astype(np.float32)
            # As on the car: an empty raster gets no points.
            marked = np.asarray(part[:, 0].any(axis=(1, 2)))[:, None]
            for name, answer in zip(values, self._session.run(list(values), feed), strict=True):
                values[name][start : start + _CHUNK] = np.where(marked, answer, np.nan)
        # An empty raster shows no line; that is an answer.
        values["presence"][~rasters[:, 0].any(axis=(1, 2))] = 0.0
        return RasterAnswers(**values)

    def answer_labels(self, labels: LabelSet) -> RasterAnswers:
        """Run the model on the frames of a label set, in its own window; their lane width is known.

        Raises:
            ModelMismatchError: If it is for edges that were found with other settings.
        """
        self.check_edges(labels.meta.perception)
        labels = labels.in_window(self.meta.window)
        rasters = [labels.raster(i)[: self.meta.planes] for i in range(len(labels.points_cm))]
        shape = (-1, self.meta.planes, self.meta.window.rows, self.meta.window.columns)
        lane_cm = np.full(len(rasters), labels.meta.lane_width_cm)
        return self.answer(np.array(rasters, np.uint8).reshape(shape), lane_cm)
