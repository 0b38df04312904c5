"""A detector as the registry lists it: its name, how it is built, and what it needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from lanenet.config import Settings, SettingsT, check_settings, load_settings
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.perception.estimate import Detector, LaneEstimate


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
