"""What a detector is: what it answers, how it is built, and the lane's width that it remembers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.config import Settings, SettingsT, check_settings, load_settings
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS, SIDES, lane_width_cm, parabolas_from_points, parallel_points
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.perception.lane_width import WidthBelief
from lanenet.perception.rolling_median import RollingMedian


@dataclass(frozen=True)
class LaneEstimate:
    """The lane as one frame shows it.

    Attributes:
        points_cm: Six points in the order of the label contract, frame car; NaN where unknown.
        sigma_cm: Standard deviation of each point; NaN where the detector does not know it.
        steering_rad: Steering target, positive left; NaN when there is none.
        confidence: 0 (nothing seen) to 1.
        radius_cm: Radius of curvature of the lane's centre line; infinite where straight, NaN where the
            detector does not know it.
        offset_cm: How far the car is to the right of the lane's centre line; NaN where the detector does not
            know it.
        presence: Probability that the left and the right line can be seen; NaN where the detector does not
            know it.
        own_lane: Probability that it is the lane to drive in, not the next one; NaN where the detector does
            not know it.
        reason: Why a point, or the whole frame, is not answered; empty where all are, or from a detector that
            does not say.
        lines_px: Left and right line in the image, the numbers of
            :data:`lanenet.perception.image_lane.LINE_PX_NAMES`; NaN for a missing line, None from a detector
            that does not work on lines of the image.
    """

    points_cm: Float[np.ndarray, "6"] = field(default_factory=lambda: np.full(N_POINTS, np.nan))
    sigma_cm: Float[np.ndarray, "6"] = field(default_factory=lambda: np.full(N_POINTS, np.nan))
    steering_rad: float = float("nan")
    confidence: float = 0.0
    radius_cm: float = float("nan")
    offset_cm: float = float("nan")
    presence: Float[np.ndarray, "2"] = field(default_factory=lambda: np.full(len(SIDES), np.nan))
    own_lane: float = float("nan")
    reason: str = ""
    lines_px: Float[np.ndarray, "2 8"] | None = None

    @property
    def mask(self) -> np.ndarray:
        """True where a point is known."""
        return np.isfinite(self.points_cm)

    @property
    def parabolas(self) -> Float[np.ndarray, "2 3"]:
        """(a, b, c) of the left and right line; NaN for a line that lacks a point."""
        return parabolas_from_points(self.points_cm)


@runtime_checkable
class Detector(Protocol):
    """A lane detector: frame in, estimate out; it may keep state from frame to frame."""

    def detect(self, frame_bgr: UInt8[np.ndarray, "h w 3"]) -> LaneEstimate:
        """Find the lane in one frame."""
        ...

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        ...


@runtime_checkable
class TakesMotion(Protocol):
    """A detector that follows the lane over what it cannot see, if it is told how the car moves."""

    def moved(self, travel_cm: float, turn_rad: float, wheelbase_cm: float) -> None:
        """Take the car's motion since the last frame, before the next one.

        Args:
            travel_cm: Distance of the rear axle, positive ahead.
            turn_rad: Change of heading, positive left.
            wheelbase_cm: Distance between the axles.
        """
        ...


@runtime_checkable
class EdgeDetector(Protocol):
    """A detector that works on edge points, so that label sets, which hold no frames, can be its input."""

    def estimate(
        self, points_cm: Float[np.ndarray, "n 2"], normals: Float[np.ndarray, "n 2"]
    ) -> LaneEstimate:
        """Find the lane in the edge points of one frame, [cm], frame car, and their unit normals."""
        ...

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        ...


@dataclass(frozen=True, eq=False)
class DetectorInputs:
    """What a detector may be built from; each kind uses what it needs.

    Attributes:
        camera: Camera of the frames.
        model: ONNX file or checkpoint folder.
        any_camera: Accept a model that was trained with another camera.
        lane_width_cm: Between the middles of the two lines; goes before the settings file's.
        drive_lane_width_cm: The source's lane width; counts where neither of those two is given.
        marking_cm: Thickness of the tape; goes before the settings file's.
        mask: Nonzero on the car itself.
        perception: How edge points are found in these frames; None takes the settings file's.
        config: Settings file (YAML) or its content; None takes the defaults.
    """

    camera: Camera | None = None
    model: Path | None = None
    any_camera: bool = False
    lane_width_cm: float | None = None
    drive_lane_width_cm: float | None = None
    marking_cm: float | None = None
    mask: UInt8[np.ndarray, "h w"] | None = None
    perception: PerceptionSettings | None = None
    config: Path | Mapping[str, Any] | None = None

    def settings(self, schema: type[SettingsT]) -> SettingsT:
        """Return ``config`` checked against a schema.

        Raises:
            ConfigError: If the file cannot be read, or a key or value is not the schema's.
        """
        if isinstance(self.config, Path):
            return load_settings(schema, self.config)
        return check_settings(schema, dict(self.config or {}), "detector")


@dataclass(frozen=True)
class DetectorKind:
    """A detector as :mod:`lanenet.perception.registry` lists it; its module defines it.

    Attributes:
        name: On the command line and in settings files.
        build: Builds it; called with a camera and a model where those are needed.
        settings: Schema of its settings file; None if it takes none.
        needs_camera: It cannot do without a camera.
        needs_model: It cannot do without a model.
        takes_lane_width: It uses the lane width.
        takes_marking: It uses the thickness of the tape.
        takes_mask: It can leave out the car itself.
        build_on_edges: Builds it for edge points without a camera; None if it looks at frames.
        variants: The same detector with other settings, by name; compared with the others in ``val``.
    """

    name: str
    build: Callable[[DetectorInputs], Detector]
    settings: type[Settings] | None = None
    needs_camera: bool = True
    needs_model: bool = False
    takes_lane_width: bool = False
    takes_marking: bool = False
    takes_mask: bool = False
    build_on_edges: Callable[[DetectorInputs], EdgeDetector] | None = None
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def on_label_sets(self) -> bool:
        """It can answer label sets, which hold edge points and no frames; a network sees their rasters."""
        return self.needs_model or self.build_on_edges is not None


#: Presence below which a line is missing, and above which it is certain. Chosen: more likely than not, and
#: nine in ten.
SEEN, SURE = 0.5, 0.9
#: Frames whose widths are compared with a given one. Chosen: 5 s at 20 frames/s.
_LENGTH = 100
#: Frames whose widths contradict a given one, and how far their median is off, as a share. Chosen: 2 s at 20
#: frames/s; a width wrong by 20 % was measured within 3 %, a right one within 8 % where the lane widens.
_CERTAIN, _WRONG = 40, 0.17
#: Least sigma of a width as a share of it. Chosen: 0.8 cm of a lane of 40 cm, laid by hand.
_WIDTH_SIGMA = 0.02
#: Common lanes: nine of ten lie between. Chosen: from Duckietown's to twice the width of the paper's lane.
COMMON_CM = (20.0, 80.0)
#: How far beyond its label rows a parabola is extrapolated; chosen: the distance of two rows.
_BEYOND_CM = 15.0


class LaneMemory:
    """The lane's width, given or found in the frames that show both lines.

    With a known width, one line determines the other. A network trained on lanes of many widths cannot infer
    it from one line, but from earlier frames.

    Attributes:
        given_cm: A known width, used instead of the one that is found; None without one.
        belief: What the frames say of the width.
    """

    def __init__(self, given_cm: float | None = None, common_cm: tuple[float, float] = COMMON_CM) -> None:
        """Start without a frame.

        Args:
            given_cm: A known width.
            common_cm: Widths between which nine lanes of ten lie.
        """
        self.given_cm = given_cm
        self.belief = WidthBelief(common_cm)
        self._widths_cm = RollingMedian(_LENGTH)

    @property
    def width_cm(self) -> float | None:
        """The lane's width; None while it is unknown."""
        return self.belief.width_cm if self.given_cm is None else self.given_cm

    @property
    def likely_cm(self) -> float:
        """The lane's width, or while it is unknown the mean of what is possible."""
        return self.belief.mean_cm if self.given_cm is None else self.given_cm

    @property
    def width_sigma(self) -> float:
        """Standard deviation of the width as a share of it."""
        return _WIDTH_SIGMA if self.given_cm is not None else max(self.belief.sigma, _WIDTH_SIGMA)

    @property
    def contradiction(self) -> str:
        """What the frames say against the given width; empty if they do not, or there is none."""
        if self.given_cm is None or len(self._widths_cm) < _CERTAIN:
            return ""
        seen_cm = self._widths_cm.median
        if abs(seen_cm / self.given_cm - 1.0) < _WRONG:
            return ""
        return (
            f"lane width {self.given_cm:g} cm: the lines that are seen lie {seen_cm:.0f} cm apart; measure "
            "the lane on a straight, between the middles of its two lines, or the camera file is of another "
            "car"
        )

    def learn(self, points_cm: Float[np.ndarray, "6"], presence: Float[np.ndarray, "2"]) -> None:
        """Learn the width of a frame in which both lines are certain; other frames are ignored.

        Args:
            points_cm: The six points, frame car; NaN where unknown.
            presence: Probability that each line can be seen; NaN from a detector that answers only the lines
                it sees.
        """
        left, right = presence.tolist()
        if left <= SURE or right <= SURE:
            return
        width_cm = lane_width_cm(points_cm)
        if not 0.0 < width_cm < math.inf:
            return
        if self.given_cm is None:
            self.belief.learn(width_cm)
        else:
            self._widths_cm.append(width_cm)

    def doubt(self) -> None:
        """Keep the width with little weight, as after a gap in a recording."""
        self._widths_cm.clear()
        self.belief.doubt()

    def reset(self) -> None:
        """Forget the frames; a given width stays."""
        self._widths_cm.clear()
        self.belief.forget()

    def complete(
        self,
        points_cm: Float[np.ndarray, "6"],
        sigma_cm: Float[np.ndarray, "6"],
        presence: Float[np.ndarray, "2"],
    ) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6"]]:
        """Rebuild the missing line of a frame with one.

        The rebuilt line is parallel to the visible one. It replaces the network's own guess only if its sigma
        is smaller, and if it needs no extrapolation far beyond the visible line's points. A missing line
        never replaces a visible one, whatever its sigma: a network has learned nothing of lines beside its
        window.

        Args:
            points_cm: The six points, frame car.
            sigma_cm: Their standard deviations.
            presence: Probability that each line can be seen.

        Returns:
            Points and standard deviations, changed for the missing line only.
        """
        width_cm = self.width_cm
        left, right = presence.tolist()
        if width_cm is None or (left < SEEN) == (right < SEEN):
            return points_cm, sigma_cm
        missing = 0 if left < SEEN else 1
        # The right line, 1, lies to the right of the left one, 0.
        side = 1.0 if missing == 1 else -1.0
        lines, sigmas = points_cm.reshape(2, 3).copy(), sigma_cm.reshape(2, 3).copy()
        rebuilt = parallel_points(lines[1 - missing], side * width_cm, _BEYOND_CM)
        rebuilt_sigma = np.hypot(sigmas[1 - missing], self.width_sigma * width_cm)
        if np.isfinite(rebuilt).all() and rebuilt_sigma.mean() < sigmas[missing].mean():
            lines[missing], sigmas[missing] = rebuilt, rebuilt_sigma
        return lines.reshape(6), sigmas.reshape(6)
