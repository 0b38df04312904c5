"""Every detector by its name, and how one is built.

To add a detector, write a module that defines its ``KIND`` and import it below: one line. It then appears in
``detect``, ``val``, ``judge``, ``bench`` and ``drive``, with their help.
"""

# ruff: noqa: F401, I001 (these imports are the registry, in the order of tables and help)

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from lanenet.errors import CalibrationError, ConfigError
from lanenet.perception.estimate import DetectorInputs, DetectorKind, EdgeDetector
from lanenet.perception.estimate import Detector

from lanenet.perception.network.detector import KIND as NETWORK
from lanenet.perception.lane_filter import KIND as LANE_FILTER
from lanenet.perception.hough.detector import KIND as HOUGH
from lanenet.perception.painter.detector import KIND as PAINTER

#: The detectors that are imported above.
KINDS = {kind.name: kind for kind in tuple(globals().values()) if isinstance(kind, DetectorKind)}


def detector_names(where: Callable[[DetectorKind], bool] = lambda kind: True) -> list[str]:
    """Return the names of the detectors that meet a condition."""
    return [kind.name for kind in KINDS.values() if where(kind)]


def compared_names(where: Callable[[DetectorKind], bool] = lambda kind: True) -> list[str]:
    """Return the names of the detectors that meet a condition, each followed by its variants."""
    return [name for kind in KINDS.values() if where(kind) for name in (kind.name, *kind.variants)]


def usual_names(where: Callable[[DetectorKind], bool] = lambda kind: True) -> list[str]:
    """Return the same without the variants of networks, which are compared only where they are named."""
    return [name for name in compared_names(where) if name in KINDS or not kind_of(name).needs_model]


def listed(names: Sequence[str], word: str = "and") -> str:
    """Return names as prose lists them: ``a, b and c``."""
    *first, last = names
    return f"{', '.join(first)} {word} {last}" if first else last


def kind_of(name: str) -> DetectorKind:
    """Return the kind of a detector or of a variant.

    Raises:
        ConfigError: If there is no such detector.
    """
    for kind in KINDS.values():
        if name == kind.name or name in kind.variants:
            return kind
    raise ConfigError(f"detector {name!r}: expected one of {', '.join(compared_names())}")


def detector_for(name: str | None, model: Path | None) -> str:
    """Return the name of the detector that a person means who gave a name, a model, or both.

    Raises:
        ConfigError: If neither was given, or the detector of that name takes no model.
    """
    with_model = detector_names(lambda kind: kind.needs_model)
    if name is None and model is None:
        others = listed(detector_names(lambda kind: not kind.needs_model), "or")
        raise ConfigError(
            f"no detector was named: expected --model with a model or checkpoint folder for the "
            f"{with_model[0]}, as --model checkpoints/general, or --detector {others}"
        )
    if name is not None and model is not None and not kind_of(name).needs_model:
        raise ConfigError(
            f"detector {name}: takes no model (--model {model}); leave out --detector to use the model, or "
            "--model to use the detector"
        )
    return name or with_model[0]


def build_detector(name: str, inputs: DetectorInputs) -> Detector:
    """Build a detector or a variant.

    Raises:
        ConfigError: If something that the detector needs is missing or out of range, or it cannot use what
            is given.
        ModelMismatchError: If the model cannot be used with this camera.
        CalibrationError: If a camera is needed, sees no road, or the mask is of another size.
    """
    kind = kind_of(name)
    if inputs.mask is not None:
        refuse_mask(name)
    if inputs.camera is None and kind.needs_camera:
        raise CalibrationError(f"detector {name}: expected a camera (--camera camera.yaml)")
    if inputs.model is None and kind.needs_model:
        raise ConfigError(
            f"detector {name}: expected a model (--model MODEL, as --model checkpoints/general)"
        )
    return kind.build(_of_variant(name, inputs))


def build_on_edges(name: str, inputs: DetectorInputs) -> EdgeDetector:
    """Build a detector that takes edge points and needs no camera.

    Raises:
        ConfigError: If the detector needs frames, or a setting is missing or out of range.
    """
    build = kind_of(name).build_on_edges
    if build is None:
        raise ConfigError(f"detector {name}: needs frames, and cannot work on edge points")
    return build(_of_variant(name, inputs))


def refuse_mask(name: str) -> None:
    """Refuse a mask for a detector that cannot use one.

    Raises:
        ConfigError: If it looks at whole frames.
    """
    if not kind_of(name).takes_mask:
        others = listed(detector_names(lambda kind: kind.takes_mask))
        raise ConfigError(f"detector {name}: takes no mask (--mask); {others} do")


def _of_variant(name: str, inputs: DetectorInputs) -> DetectorInputs:
    settings = kind_of(name).variants.get(name)
    return inputs if settings is None else replace(inputs, config=settings)
