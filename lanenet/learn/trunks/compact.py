"""What every trunk offers to the network around it, and our own: strided convolutions in three sizes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn


class Trunk(nn.Module, ABC):
    """The layers between the raster and the head.

    Made with (rows, columns, channels, hidden, planes): the raster's size, and the settings of those names.

    Attributes:
        uses: Which of ``channels``, ``hidden``, ``bins``, ``planes``, ``takes_width`` and ``weights`` of the
            network's settings it can be given.
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
        self, raster: Float[Tensor, "n p r c"], biases: Sequence[Tensor] = ()
    ) -> Float[Tensor, "n f"]:
        """Return the features of rasters; ``biases`` has n x channels per biased layer."""

    def load_pretrained(self, path: Path) -> None:
        """Read pretrained weights; only for trunks that use ``weights``.

        Raises:
            CheckpointError: If the file cannot be read or is of another network.
        """
        raise NotImplementedError(f"{type(self).__name__} has no pretrained weights, found {path}")


class SmallTrunk(Trunk):
    """A small relative of AlexNet: a wide first filter with a stride of four, then 3 x 3 filters.

    Strided convolutions and batch normalisation, at 1/600 of AlexNet's size: a raster of edges has no texture
    to learn. The last feature map is not averaged over rows and columns, since the answer is a place.

    Attributes:
        default_channels: Output channels of the convolutions. The first divides rows and columns by four,
            each other one by two.
        default_hidden: Width of the hidden layer before the outputs. Both were chosen by ``lanenet sweep``.
    """

    uses = frozenset({"channels", "hidden", "bins", "planes", "takes_width"})
    default_channels: ClassVar[tuple[int, ...]] = (16, 32, 48, 64, 80)
    default_hidden: ClassVar[int] = 64

    def __init__(
        self,
        rows: int,
        columns: int,
        channels: tuple[int, ...] | None = None,
        hidden: int | None = None,
        planes: int = 1,
    ) -> None:
        super().__init__()
        channels = channels or self.default_channels
        layers: list[nn.Module] = []
        before, height, width = planes, rows, columns
        for i, after in enumerate(channels):
            kernel, stride = (7, 4) if i == 0 else (3, 2)
            layers += [
                nn.Conv2d(before, after, kernel, stride=stride, padding=kernel // 2, bias=False),
                nn.BatchNorm2d(after),
                nn.ReLU(inplace=True),
            ]
            before, height, width = after, -(-height // stride), -(-width // stride)
        # Under their numbers, as the weights of a checkpoint are named.
        for i, layer in enumerate([*layers, nn.Flatten()]):
            self.add_module(str(i), layer)
        self.n_features = before * height * width
        self.hidden_width = hidden or self.default_hidden
        self.biased_channels = channels[1:]

    def forward(
        self, raster: Float[Tensor, "n p r c"], biases: Sequence[Tensor] = ()
    ) -> Float[Tensor, "n f"]:
        """Return the features; a bias is added after the normalisation of each convolution but the first."""
        x, norms = raster, 0
        for layer in self.children():
            x = layer(x)
            if isinstance(layer, nn.BatchNorm2d):
                if biases and norms:
                    x = x + biases[norms - 1][:, :, None, None]
                norms += 1
        return x


class NanoTrunk(SmallTrunk):
    """Half the channels of ``small``."""

    default_channels = (8, 16, 24, 32, 40)
    default_hidden = 32


class BaseTrunk(SmallTrunk):
    """One and a half times the channels of ``small``."""

    default_channels = (24, 48, 72, 96, 120)
    default_hidden = 96
