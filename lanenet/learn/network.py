"""The network: a trunk, and a head that answers six points in cm, their sigma and which lines are present."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from lanenet.geometry.lane import N_POINTS, PARABOLA_FROM_POINTS, ROWS_CM, SIDES
from lanenet.learn.config import NetworkSettings
from lanenet.learn.trunks import TRUNKS
from lanenet.perception.edges.raster import MIDDLE, STEPS

#: Distance of the lane centre A that the paper steers at, [cm]; it is one of the label rows.
LOOKAHEAD_CM = ROWS_CM[1]
#: The predicted sigma stays within these, [cm], before it is calibrated. Chosen: from below the best labels'
#: error to half the window.
SIGMA_RANGE_CM = (0.05, 50.0)
#: Centres of the eight Gaussians that encode the lane width, [cm]: from narrow model roads to wide ones, each
#: 4/3 of the one before; and their sigma in log width, about the distance of two neighbours, log(4/3).
_WIDTHS_CM = (15.0, 20.0, 27.0, 36.0, 48.0, 64.0, 85.0, 114.0)
WIDTH_SIGMA = 0.25
_LOG_LOW, _LOG_HIGH = (math.log(v) for v in SIGMA_RANGE_CM)


class LaneOutput(NamedTuple):
    """What a network answers.

    Attributes:
        points_cm: The six points, frame car, n x 6.
        sigma_cm: Predicted sigma of each, n x 6.
        presence_logit: Log odds that each line can be seen, n x 2.
        log_share: Log probability of each bin of x for each point, n x 6 x b; None without bins.
        bins_cm: Centres of the bins, evenly spaced.
    """

    points_cm: Tensor
    sigma_cm: Tensor
    presence_logit: Tensor
    log_share: Tensor | None = None
    bins_cm: Tensor | None = None


class LaneNet(nn.Module):
    """Bird's-eye raster in; six points in cm, their sigma and the presence of two lines out.

    A point is answered as a number or, with bins, as the mean of a distribution of x: where one image has two
    explanations, a distribution can learn both.

    Args:
        settings: Which network, and its size.
        rows: Rows of the raster.
        columns: Columns of the raster.

    Attributes:
        width_bias: What the lane width adds to the trunk's biased layers and to the hidden layer; None if the
            network is not given it.

    Source:
        Kozlowski et al. 2024, section 2.4: AlexNet with its last layers replaced by a regression layer.
        Bins: Li et al. 2020, "Generalized focal loss", section 3.2.
    """

    def __init__(self, settings: NetworkSettings, rows: int, columns: int) -> None:
        super().__init__()
        self.rows, self.columns, self.planes = rows, columns, settings.planes
        n_outputs = N_POINTS * ((settings.bins or 1) + 1) + len(SIDES)
        self.trunk = trunk = TRUNKS[settings.kind](
            rows, columns, settings.channels, settings.hidden, settings.planes
        )
        self.head: nn.Module
        self.width_bias: nn.ModuleList | None = None
        hidden = trunk.hidden_width
        if hidden is None:
            self.head = nn.Linear(trunk.n_features, n_outputs)
        else:
            self.head = nn.Sequential(
                nn.Linear(trunk.n_features, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, n_outputs)
            )
            if settings.takes_width:
                biased = (*trunk.biased_channels, hidden)
                self.width_bias = nn.ModuleList([nn.Linear(len(_WIDTHS_CM), n, bias=False) for n in biased])
        # The layers predict (x - mean) / scale, so that all six outputs are of order one.
        self.mean_cm: Tensor
        self.scale_cm: Tensor
        self.bins_cm: Tensor | None
        self.register_buffer("bins_cm", torch.zeros(settings.bins) if settings.bins else None)
        # Set after the training, so that sigma is right on frames that the network has not seen.
        self.sigma_factor: Tensor
        self.register_buffer("mean_cm", torch.zeros(N_POINTS))
        self.register_buffer("scale_cm", torch.ones(N_POINTS))
        self.register_buffer("sigma_factor", torch.ones(N_POINTS))
        self.log_widths: Tensor
        self.register_buffer("log_widths", torch.log(torch.tensor(_WIDTHS_CM)), persistent=False)
        # Convolutions of few channels are up to twice as fast on a CPU with the channels side by side.
        self.to(memory_format=torch.channels_last)

    def forward(
        self, raster: Float[Tensor, "n p r c"], lane_cm: Float[Tensor, "w"] | None = None
    ) -> LaneOutput:
        """Find the lane in rasters as :func:`input_of_rasters` returns them.

        Args:
            raster: Bird's-eye rasters with at least the network's planes.
            lane_cm: Lane width of each, or of all; 0 where it is not known. None: not known for any.
        """
        raster = raster[:, : self.planes]
        if self.width_bias is None or lane_cm is None:
            outputs: Tensor = self.head(self.trunk(raster))
        else:
            biases = self._width_biases(lane_cm)
            assert isinstance(self.head, nn.Sequential)
            first, *rest = self.head
            outputs = first(self.trunk(raster, biases[:-1])) + biases[-1]
            for layer in rest:
                outputs = layer(outputs)
        sizes = [outputs.shape[1] - N_POINTS - len(SIDES), N_POINTS, len(SIDES)]
        points, spread, presence = torch.split(outputs, sizes, dim=1)
        middle, half = 0.5 * (_LOG_LOW + _LOG_HIGH), 0.5 * (_LOG_HIGH - _LOG_LOW)
        # A soft limit: a hard one has no gradient beyond it.
        sigma = torch.exp(middle + half * torch.tanh(spread / half)) * self.sigma_factor
        if self.bins_cm is None:
            return LaneOutput(points * self.scale_cm + self.mean_cm, sigma, presence)
        log_share = torch.log_softmax(points.reshape(-1, N_POINTS, len(self.bins_cm)), dim=-1)
        means = (torch.exp(log_share) * self.bins_cm).sum(dim=-1)
        return LaneOutput(means, sigma, presence, log_share, self.bins_cm)

    @torch.no_grad()
    def spread_bins(self, left_cm: float, right_cm: float) -> None:
        """Spread the bins evenly between the ends of the window, if there are bins."""
        if self.bins_cm is not None:
            self.bins_cm.copy_(torch.linspace(left_cm, right_cm, len(self.bins_cm)))

    def _width_biases(self, lane_cm: Float[Tensor, "w"]) -> list[Tensor]:
        """Return what the lane width adds to each biased layer and to the hidden layer, w x channels."""
        assert self.width_bias is not None
        off = torch.log(lane_cm.clamp(min=1.0)[:, None]) - self.log_widths
        code = torch.exp(-0.5 * (off / WIDTH_SIGMA) ** 2) * (lane_cm > 0.0)[:, None]
        return [layer(code) for layer in self.width_bias]

    @torch.no_grad()
    def lower_presence(self, by: float) -> None:
        """Subtract this from the log odds of both lines, for all rasters."""
        last = self.head[-1] if isinstance(self.head, nn.Sequential) else self.head
        assert isinstance(last, nn.Linear)
        last.bias[-len(SIDES) :] -= by

    @property
    def n_parameters(self) -> int:
        """Number of trainable values."""
        return sum(p.numel() for p in self.parameters())


class DeployedLaneNet(nn.Module):
    """What the ONNX file holds: bytes in; points, sigma, presence, parabolas, centre and steering out.

    With the shares of places after them, where the network has them.
    """

    def __init__(self, network: LaneNet) -> None:
        super().__init__()
        self.network = network
        self.parabola_from_points: Tensor
        matrix = torch.from_numpy(PARABOLA_FROM_POINTS.T.copy()).to(torch.float32)
        self.register_buffer("parabola_from_points", matrix)

    def forward(
        self, raster: UInt8[Tensor, "n p r c"], lane_cm: Float[Tensor, "w"] | None = None
    ) -> tuple[Tensor, ...]:
        """Find the lane in rasters.

        Args:
            raster: Bird's-eye rasters with the network's planes.
            lane_cm: As in :meth:`LaneNet.forward`.

        Returns:
            The six points, [cm]; their sigmas, [cm]; probability that the left and the right line can be
            seen; (a, b, c) of the left and right parabola, n x 2 x 3; x of the lane centre at 15 cm, [cm];
            the steering target, [rad], positive left; the log probability of each place of each point,
            n x 6 x b, from a network with bins.

        Source:
            Steering: Kozlowski et al. 2024, eq. 3. The centre is ahead, so atan equals atan2 here.
        """
        output: LaneOutput = self.network(input_of_rasters(raster), lane_cm)
        lines = output.points_cm.reshape(-1, 2, len(ROWS_CM))
        middle_row = ROWS_CM.index(LOOKAHEAD_CM)
        centre = lines[:, :, middle_row].mean(dim=1, keepdim=True)
        steering = torch.atan(-centre / LOOKAHEAD_CM)
        presence = torch.sigmoid(output.presence_logit)
        parabolas = lines @ self.parabola_from_points
        answers = output.points_cm, output.sigma_cm, presence, parabolas, centre, steering
        return answers if output.log_share is None else (*answers, output.log_share)


def input_of_rasters(rasters: UInt8[Tensor, "n p r c"]) -> Float[Tensor, "n p r c"]:
    """Return rasters as the network's input: edges 0 or 1, directions and hues from -1 to 1."""
    values = rasters.to(torch.float32)
    edges = values[:, :1] * (1.0 / 255.0)
    if rasters.shape[1] == 1:
        return edges
    return torch.cat([edges, (values[:, 1:] - float(MIDDLE)) * (1.0 / STEPS)], dim=1)


def new_network(settings: NetworkSettings, rows: int, columns: int, seed: int) -> LaneNet:
    """Make a network with first weights drawn from ``seed``, without touching torch's global generator.

    Raises:
        CheckpointError: If pretrained weights are set and cannot be read.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = LaneNet(settings, rows, columns)
    if settings.weights is not None:
        network.trunk.load_pretrained(settings.weights)
    return network
