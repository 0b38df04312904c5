"""The network: a small convolutional trunk and a regression of six points in cm."""

from __future__ import annotations

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from lanenet.geometry.lane import N_POINTS, PARABOLA_FROM_POINTS, ROWS_CM
from lanenet.learn.config import NetworkSettings

#: Distance of the lane centre A that the paper steers at, [cm]; it is one of the label rows.
LOOKAHEAD_CM = ROWS_CM[1]


class LaneNet(nn.Module):
    """Bird's-eye raster in, six points in cm out.

    An AlexNet in kind (wide first filter, then 3 x 3 filters, then fully connected layers) with strided
    convolutions and batch normalisation, 1/500 of its size: a raster of edges has no texture to learn.

    Args:
        settings: Size of the network.
        rows: Rows of the raster.
        columns: Columns of the raster.

    Source:
        Kozlowski et al. 2024, section 2.4: AlexNet with its last layers replaced by a regression layer.
    """

    def __init__(self, settings: NetworkSettings, rows: int, columns: int) -> None:
        super().__init__()
        self.rows, self.columns = rows, columns
        layers: list[nn.Module] = []
        before, height, width = 1, rows, columns
        for i, channels in enumerate(settings.channels):
            kernel = 5 if i == 0 else 3
            layers += [
                nn.Conv2d(before, channels, kernel, stride=2, padding=kernel // 2, bias=False),
                nn.BatchNorm2d(channels),
                nn.ReLU(inplace=True),
            ]
            before, height, width = channels, (height + 1) // 2, (width + 1) // 2
        self.trunk = nn.Sequential(*layers)
        self.head = nn.Sequential(
            nn.Flatten(),
            nn.Linear(before * height * width, settings.hidden),
            nn.ReLU(inplace=True),
            nn.Linear(settings.hidden, N_POINTS),
        )
        # The layers predict (x - mean) / scale, so that all six outputs are of order one.
        self.mean_cm: Tensor
        self.scale_cm: Tensor
        self.register_buffer("mean_cm", torch.zeros(N_POINTS))
        self.register_buffer("scale_cm", torch.ones(N_POINTS))

    def forward(self, raster: Float[Tensor, "n 1 r c"]) -> Float[Tensor, "n 6"]:
        """Return the six points, [cm], frame car, of rasters with values 0..1."""
        scaled: Tensor = self.head(self.trunk(raster))
        return scaled * self.scale_cm + self.mean_cm

    @property
    def n_parameters(self) -> int:
        """Number of trainable values."""
        return sum(p.numel() for p in self.parameters())


class DeployedLaneNet(nn.Module):
    """What the ONNX file holds: bytes in, points, parabolas, lane centre and steering target out."""

    def __init__(self, network: LaneNet) -> None:
        super().__init__()
        self.network = network
        self.parabola_from_points: Tensor
        matrix = torch.from_numpy(PARABOLA_FROM_POINTS.T.copy()).to(torch.float32)
        self.register_buffer("parabola_from_points", matrix)

    def forward(
        self, raster: UInt8[Tensor, "n 1 r c"]
    ) -> tuple[Float[Tensor, "n 6"], Float[Tensor, "n 2 3"], Float[Tensor, "n 1"], Float[Tensor, "n 1"]]:
        """Find the lane in rasters.

        Args:
            raster: Bird's-eye rasters, 255 where there is an edge, 0 elsewhere.

        Returns:
            The six points, [cm]; (a, b, c) of the left and right parabola; x of the lane centre at 15 cm,
            [cm]; the steering target, [rad], positive left.

        Source:
            Steering: Kozlowski et al. 2024, eq. 3. The centre is ahead, so atan equals atan2 here.
        """
        points: Tensor = self.network(raster.to(torch.float32) * (1.0 / 255.0))
        lines = points.reshape(-1, 2, len(ROWS_CM))
        middle_row = ROWS_CM.index(LOOKAHEAD_CM)
        centre = lines[:, :, middle_row].mean(dim=1, keepdim=True)
        steering = torch.atan(-centre / LOOKAHEAD_CM)
        return points, lines @ self.parabola_from_points, centre, steering


def input_of_rasters(rasters: UInt8[Tensor, "n 1 r c"]) -> Float[Tensor, "n 1 r c"]:
    """Return rasters of 0 and 255 as the network's input of 0 and 1."""
    return rasters.to(torch.float32) * (1.0 / 255.0)


def new_network(settings: NetworkSettings, rows: int, columns: int, seed: int) -> LaneNet:
    """Make a network with first weights drawn from ``seed``, without touching torch's global generator."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return LaneNet(settings, rows, columns)
