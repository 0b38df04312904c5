"""Where the model of a checkpoint folder lies: whoever takes a model takes the folder as well."""

from __future__ import annotations

from pathlib import Path

from lanenet.errors import ModelMismatchError

#: The network as the car runs it.
MODEL_NAME = "model.onnx"
#: Says that a folder is a checkpoint.
MARKER_NAME = "checkpoint.yaml"
#: More folders than these are not listed in an error.
_MOST_NAMED = 8


def is_model(path: Path) -> bool:
    """Tell whether a path stands for a model: an ONNX file by its name, or a checkpoint folder."""
    return _is_checkpoint(path) or path.suffix.lower() == ".onnx"


def find_model(path: Path) -> Path:
    """Return the model file that a path stands for: the path itself, or the model of a checkpoint folder.

    Raises:
        ModelMismatchError: If there is no such file, or none in the folder; names the folders in it that have
            one.
    """
    found = path / MODEL_NAME if path.is_dir() else path
    if found.is_file():
        return found
    if _is_checkpoint(path):
        raise ModelMismatchError(f"{path}: no {MODEL_NAME} in it; make one with: lanenet export {path}")
    if path.is_dir():
        raise ModelMismatchError(f"{path}: expected a model: {without_model(path)}")
    raise ModelMismatchError(f"{path}: no such file, expected an ONNX model or a checkpoint folder")


def without_model(folder: Path) -> str:
    """Say that a folder is no checkpoint, and which of its own folders are."""
    there = sorted(child.name for child in folder.iterdir() if _is_checkpoint(child))
    more = f" and {len(there) - _MOST_NAMED} more" if len(there) > _MOST_NAMED else ""
    hint = f"; of its folders these do: {', '.join(there[:_MOST_NAMED])}{more}" if there else ""
    return f"the folder holds neither {MODEL_NAME} nor {MARKER_NAME}{hint}"


def _is_checkpoint(path: Path) -> bool:
    return any((path / name).is_file() for name in (MODEL_NAME, MARKER_NAME))
