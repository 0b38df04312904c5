"""Which file a path to a model stands for, and what is said where there is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from lanenet.errors import ModelMismatchError
from lanenet.perception.network.model_file import find_model, is_model, without_model


def make_checkpoint(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True)
    for name in names:
        (folder / name).write_bytes(b"")
    return folder


def test_a_file_stands_for_itself_and_a_folder_for_its_model(tmp_path: Path) -> None:
    folder = make_checkpoint(tmp_path / "small", "model.onnx", "checkpoint.yaml", "model-int8.onnx")
    assert find_model(folder) == folder / "model.onnx"
    assert find_model(folder / "model-int8.onnx") == folder / "model-int8.onnx"


def test_what_is_no_model_is_refused_by_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(ModelMismatchError, match=r"gone: no such file, expected an ONNX model or a checkp"):
        find_model(tmp_path / "gone")
    # Trained, but the export is missing.
    begun = make_checkpoint(tmp_path / "begun", "checkpoint.yaml")
    with pytest.raises(ModelMismatchError, match=rf"no model\.onnx in it; .* lanenet export {begun}"):
        find_model(begun)


def test_a_folder_of_checkpoints_names_them(tmp_path: Path) -> None:
    parent = tmp_path / "checkpoints"
    assert without_model(tmp_path) == "the folder holds neither model.onnx nor checkpoint.yaml"
    make_checkpoint(parent / "small", "model.onnx")
    make_checkpoint(parent / "general", "checkpoint.yaml")
    make_checkpoint(parent / "notes", "README.md")
    with pytest.raises(ModelMismatchError, match=r"neither .*; of its folders these do: general, small$"):
        find_model(parent)
    for k in range(9):
        make_checkpoint(parent / f"run{k}", "model.onnx")
    assert without_model(parent).endswith(": general, run0, run1, run2, run3, run4, run5, run6 and 3 more")


def test_a_model_is_told_from_a_source(tmp_path: Path) -> None:
    # A name is enough: that the file is not there is said later, by its name.
    assert is_model(tmp_path / "gone.onnx") and is_model(make_checkpoint(tmp_path / "c", "checkpoint.yaml"))
    assert not is_model(tmp_path) and not is_model(tmp_path / "labels.parquet")
