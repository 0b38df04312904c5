"""Models and label sets by name on the Hugging Face Hub.

``hf:owner/name`` is a model, ``hf:datasets/owner/name`` a label set; both stand where a path of one may.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import yaml

from lanenet.data.files import require
from lanenet.errors import ConfigError, LanenetError
from lanenet.reading import first_line

Kind = Literal["model", "dataset"]

PREFIX = "hf:"
#: As the Hub's own addresses: hf://datasets/owner/name.
_DATASETS = "datasets/"
_NAME = re.compile(r"[\w.-]+/[\w.-]+", re.ASCII)
#: What is pulled: of a model what runs it, of a data set the label set in it. Nothing of it is a program.
_PULLED: dict[Kind, tuple[str, ...]] = {
    "model": (
        "model.onnx",
        "camera.yaml",
        "checkpoint.yaml",
        "config.yaml",
        "metrics.json",
        "weights.safetensors",
        "*.md",
    ),
    "dataset": ("labels.parquet",),
}


def pulled(path: str | Path) -> Path:
    """Return a path as it is, or what a name on the Hub stands for, downloaded if it is not there yet.

    Args:
        path: A path, ``hf:owner/name`` for the checkpoint folder of a model, or ``hf:datasets/owner/name``
            for the label set (.parquet) that ``lanenet export --format huggingface`` put into a data set.

    Raises:
        ConfigError: If it begins with ``hf:``, but is no such name.
        LanenetError: If it is not on the Hub, or the Hub cannot be reached.
        MissingExtraError: If huggingface_hub is not installed.
    """
    text = str(path)
    if not text.startswith(PREFIX):
        return Path(path)
    kind: Kind = "dataset" if text.startswith(PREFIX + _DATASETS) else "model"
    name = check_name(text.removeprefix(PREFIX).removeprefix(_DATASETS if kind == "dataset" else ""))
    with _asking(name):
        api = require("huggingface_hub", "hub").HfApi()
        folder = Path(api.snapshot_download(repo_id=name, repo_type=kind, allow_patterns=list(_PULLED[kind])))
    found = folder / _PULLED[kind][0]
    if not found.is_file():
        raise LanenetError(f"{text}: holds no {found.name}, expected a {kind} that lanenet pushed")
    return folder if kind == "model" else found


def check_name(name: str) -> str:
    """Return a name on the Hub.

    Raises:
        ConfigError: If it is not ``owner/name``.
    """
    if not _NAME.fullmatch(name):
        raise ConfigError(f"{name!r}: expected a name on the Hugging Face Hub, as in owner/name")
    return name


def push(
    folder: Path, name: str, kind: Kind, card: Mapping[str, Any] | None = None, public: bool = False
) -> str:
    """Put the files of a folder on the Hub, in one commit.

    Args:
        folder: A checkpoint, or an export for Hugging Face.
        name: ``owner/name``; made if it is not there, else its files of the same names are replaced (the Hub
            keeps the earlier versions).
        kind: What it is on the Hub.
        card: Head of the card of a model, whose text is ``MODEL_CARD.md``; None if ``README.md`` is there.
        public: Whether others may see what is made new.

    Returns:
        Its address.

    Raises:
        LanenetError: If the Hub refuses, or cannot be reached.
        MissingExtraError: If huggingface_hub is not installed.
    """
    hub = require("huggingface_hub", "hub")
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    operations = [
        hub.CommitOperationAdd(path_in_repo=path.relative_to(folder).as_posix(), path_or_fileobj=str(path))
        for path in files
    ]
    if card is not None:
        text = (folder / "MODEL_CARD.md").read_text(encoding="utf-8")
        readme = f"---\n{yaml.safe_dump(dict(card), sort_keys=False)}---\n\n{text}".encode()
        operations.append(hub.CommitOperationAdd(path_in_repo="README.md", path_or_fileobj=readme))
    with _asking(check_name(name)):
        api = hub.HfApi()
        address = api.create_repo(repo_id=name, repo_type=kind, private=not public, exist_ok=True)
        api.create_commit(
            repo_id=name, repo_type=kind, operations=operations, commit_message="lanenet export --push"
        )
    return str(address)


@contextmanager
def _asking(name: str) -> Iterator[None]:
    """Turn what the Hub's library raises into one error."""
    try:
        yield
    except LanenetError:
        raise
    except Exception as error:  # HTTP, connection, validation and a missing token, each of another family
        raise LanenetError(
            f"{name}: the Hugging Face Hub answers: {first_line(error)}; to log in: hf auth login"
        ) from error
