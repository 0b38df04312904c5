"""Weights to start from: fine-tuning a network that has been trained before."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lanenet.errors import CheckpointError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.learn.config import LearnSettings
from lanenet.learn.dataset import hash_files
from lanenet.learn.export import WEIGHTS_NAME, read_network
from lanenet.learn.network import LaneNet, new_network
from lanenet.perception.birdseye import PerceptionSettings


def check_start(
    settings: LearnSettings, window: BirdseyeWindow, perceptions: Sequence[PerceptionSettings]
) -> None:
    """Refuse weights to begin with that the training would refuse, before its data is made.

    Args:
        settings: Of the training.
        window: Window of the rasters that the network will see.
        perceptions: How the edges of each drive will be found.

    Raises:
        CheckpointError: As :func:`load_start_weights`; or pretrained weights cannot be read.
    """
    network = new_network(settings.network, window.rows, window.columns, settings.seed)
    if settings.start_from is not None:
        for perception in perceptions:
            load_start_weights(network, settings.start_from, window, perception)


def load_start_weights(
    network: LaneNet, folder: Path, window: BirdseyeWindow, perception: PerceptionSettings
) -> None:
    """Take over the weights of a checkpoint, with the mean and the spread of the labels that they belong to.

    Args:
        network: Network to change.
        folder: Checkpoint folder.
        window: Window of the rasters that the network will see.
        perception: How their edges were found.

    Raises:
        CheckpointError: If the checkpoint cannot be read, is of another network or was made for another
            window or other edges.
    """
    start, meta = read_network(folder)
    if meta.window != window:
        raise CheckpointError(
            f"learn.start_from {folder}: was trained on the window {meta.window}, but the labels have "
            f"{window}; set data.window to the checkpoint's"
        )
    unlike = perception.unlike(meta.perception)
    if unlike:
        raise CheckpointError(
            f"learn.start_from {folder}: was trained on edges found in another way than those of the labels "
            f"({unlike}); set data.colour_weight to the checkpoint's"
        )
    weights = start.state_dict()
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    for name in sorted(shapes.keys() | weights.keys()):
        found = tuple(weights[name].shape) if name in weights else None
        if found != shapes.get(name):
            raise CheckpointError(
                f"learn.start_from {folder}: found weights {name!r} of shape {found}, expected "
                f"{shapes.get(name)}; set learn.network as in the checkpoint's config.yaml"
            )
    network.load_state_dict(weights)


def hash_of_start(folder: Path | None) -> str:
    """Return a hash of the weights that a run starts from; empty where it starts anew.

    Raises:
        CheckpointError: If there are none.
    """
    if folder is None:
        return ""
    path = folder / WEIGHTS_NAME
    if not path.is_file():
        raise CheckpointError(f"learn.start_from {folder}: no {WEIGHTS_NAME} in it, expected a checkpoint")
    return hash_files([path])
