"""From a finished run to the folder that people use: ``checkpoints/<name>/``."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import yaml

from lanenet.data.files import atomic_folder, write_json, write_text
from lanenet.errors import CheckpointError
from lanenet.learn.export import CHECKPOINT_FORMAT
from lanenet.learn.run_state import METRICS_NAME, STATE_NAME
from lanenet.perception.checkpoint import MARKER_NAME


def publish(
    run_folder: Path,
    out: Path,
    name: str,
    files: Mapping[str, str | bytes],
    results: Mapping[str, object] | None = None,
) -> None:
    """Copy a finished run, without the state of its optimiser, and what was measured on it.

    An earlier checkpoint of the name is replaced as a whole, once the new one is complete.

    Args:
        run_folder: Folder of a finished training run.
        out: Checkpoint folder to write.
        name: Of the checkpoint.
        files: More files by name: config, results, camera.
        results: Figures for ``results.json``.

    Raises:
        CheckpointError: If the run is not finished.
    """
    if not (run_folder / METRICS_NAME).is_file():
        raise CheckpointError(f"{run_folder}: no {METRICS_NAME} in it, the run is not finished")
    with atomic_folder(out, "checkpoint") as folder:
        for path in sorted(run_folder.iterdir()):
            if path.is_file() and path.name != STATE_NAME:
                shutil.copyfile(path, folder / path.name)
        for file_name, content in files.items():
            if isinstance(content, str):
                write_text(folder / file_name, content)
            else:
                (folder / file_name).write_bytes(content)
        if results is not None:
            write_json(folder / "results.json", results)
        marker = {"format": CHECKPOINT_FORMAT, "name": name}
        write_text(folder / MARKER_NAME, yaml.safe_dump(marker, sort_keys=False))
