"""Who drives in a simulation: the scripted driver, or a detector built by its name."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from lanenet.cli.shared import console
from lanenet.errors import ConfigError
from lanenet.perception.estimate import DetectorInputs
from lanenet.perception.network.model_file import find_model
from lanenet.perception.registry import KINDS, build_detector, kind_of

if TYPE_CHECKING:
    from datagen.judge.run import Entrant
    from datagen.world.simulate import BuildPilot
    from lanenet.geometry.camera import Camera
    from lanenet.perception.estimate import Detector

#: Drives as the network unless ``--model`` names another.
SHIPPED_MODEL = Path("checkpoints/small")


@dataclass(frozen=True)
class NamedDetector:
    """Builds a detector by its name, in any process.

    Attributes:
        name: One of :mod:`lanenet.perception.registry`.
        model: ONNX file, for the network.
        config: YAML with its settings.
        any_camera: Accept a model that was trained with another camera.
    """

    name: str
    model: Path | None = None
    config: Path | None = None
    any_camera: bool = False

    def __call__(self, camera: Camera, lane_width_cm: float, marking_cm: float | None) -> Detector:
        """Build it for a camera and a lane."""
        inputs = DetectorInputs(
            camera=camera,
            model=self.model,
            any_camera=self.any_camera,
            lane_width_cm=lane_width_cm,
            marking_cm=marking_cm,
            config=self.config,
        )
        return build_detector(self.name, inputs)

    @property
    def identity(self) -> str:
        """Hash of the files it depends on."""
        files = [path for path in (self.model, self.config) if path is not None]
        return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:16]


def pilot_builder(text: str, model: Path | None, lane_width_cm: float) -> BuildPilot:
    """Return a function that builds the driver of a simulated world in closed loop.

    Args:
        text: A detector's name, as in judge's ``--detectors``.
        model: Model or checkpoint folder of the network; None takes the shipped one, and says so.
        lane_width_cm: Lane width of the road; prints a warning if the network was trained on other widths.

    Raises:
        LanenetError: If there is no such detector or file.
    """
    from datagen.judge.run import build_pilot
    from datagen.world.car.pilot import PilotSettings

    entrant = named_entrant(text, model, "--detector", any_camera=False)
    warn_of_widths([entrant], [lane_width_cm])
    return lambda world: build_pilot(world, entrant, PilotSettings())


def named_entrant(text: str, model: Path | None, option: str, any_camera: bool) -> Entrant:
    """Return the entrant that a text names.

    Args:
        text: ``truth``, ``true-points``, or a detector's name; ``NAME=SETTINGS.yaml`` if it takes settings.
        model: Model or checkpoint folder of the network; None takes the shipped one, and says so.
        option: The option that holds the text, for error messages.
        any_camera: Accept a model that was trained with another camera.

    Raises:
        LanenetError: If there is no such detector or file.
    """
    from datagen.judge.run import TRUE_POINTS, TRUTH, Entrant

    name, equals, file = text.partition("=")
    if name in (TRUTH, TRUE_POINTS) and not equals:
        return Entrant(name)
    if name not in KINDS:
        raise ConfigError(f"{option} {text!r}: expected {', '.join((TRUTH, TRUE_POINTS, *KINDS))}")
    if equals and not Path(file).is_file():
        raise ConfigError(f"{option} {text!r}: {file}: no such file")
    detector = NamedDetector(
        name,
        _network_model(model) if kind_of(name).needs_model else None,
        Path(file).resolve() if equals else None,
        any_camera,
    )
    return Entrant(f"{name}-{Path(file).stem}" if equals else name, detector, detector.identity)


def _network_model(given: Path | None) -> Path:
    """Return the network's file; the shipped one if none is given."""
    if given is None:
        if not SHIPPED_MODEL.exists():
            raise ConfigError(f"detector network: expected a model (--model), {SHIPPED_MODEL} is not there")
        typer.echo(f"network: {SHIPPED_MODEL}; --model names another one")
    return find_model(SHIPPED_MODEL if given is None else given).resolve()


def warn_of_widths(entrants: list[Entrant], lane_widths_cm: list[float]) -> None:
    """Print a warning for each network that was not trained on these lane widths."""
    from lanenet.perception.network.model_file import read_model_meta

    for entrant in entrants:
        if isinstance(entrant.build, NamedDetector) and entrant.build.model is not None:
            model = entrant.build.model
            console.show_problems(read_model_meta(model).untrained_widths(lane_widths_cm, str(model)))
