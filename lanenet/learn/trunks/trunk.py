"""What every trunk offers to the network around it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn


class Trunk(nn.Module, ABC):
    """The layers between the raster and the head.

    Made with (rows, columns, channels, hidden): the raster's size, and the settings of the same names.

    Attributes:
        uses: Which of ``channels``, ``hidden``, ``bins``, ``takes_width`` and ``weights`` of the network's
            settings it can be given.
        head_learns_faster: Whether ``learn.head_rate`` raises the learning rate of the head, as for a trunk
            with pretrained weights.
        n_features: Values per raster that it gives to the head.
        hidden_width: Width of the head's hidden layer; None for a head of one layer.
        biased_channels: Channels of each layer that takes a bias from the lane width; empty for none.
    """

    uses: ClassVar[frozenset[str]] = frozenset()
    head_learns_faster: ClassVar[bool] = False

    n_features: int
    hidden_width: int | None = None
    biased_channels: tuple[int, ...] = ()

    @abstractmethod
    def forward(
        self, raster: Float[Tensor, "n 1 r c"], biases: Sequence[Tensor] = ()
    ) -> Float[Tensor, "n f"]:
        """Return the features of rasters with values 0..1; ``biases`` has n x channels per biased layer."""

    def load_pretrained(self, path: Path) -> None:
        """Read pretrained weights; only for trunks that use ``weights``.

        Raises:
            CheckpointError: If the file cannot be read or is of another network.
        """
        raise NotImplementedError(f"{type(self).__name__} has no pretrained weights, found {path}")
