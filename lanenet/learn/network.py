"""The networks: a trunk, and a head that answers six points in cm, their spread and which lines are there.

The paper's network as a trunk: torchvision's AlexNet up to its last hidden layer.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from safetensors.torch import load_file
from torch import Tensor, nn
from torchvision.models import alexnet

from lanenet.errors import CheckpointError
from lanenet.geometry.lane import N_POINTS, PARABOLA_FROM_POINTS, ROWS_CM, SIDES
from lanenet.learn.config import NetworkSettings

#: Side of the picture that AlexNet takes, [px].
SIDE_PX = 224
#: Values of AlexNet's last hidden layer.
N_FEATURES = 4096

#: Mean and spread of the colours of the pictures that the published weights were trained on.
_MEAN, _SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class AlexNetTrunk(nn.Module):
    """AlexNet without its last fully connected layer, fed with rasters.

    A raster is stretched to 224 x 224 and stands in all three colours, as the published weights need it.

    Source:
        Kozlowski et al. 2024, section 2.4: the last four layers (dropout, classes, softmax and their output)
        are replaced. Krizhevsky 2014 in torchvision's version.
    """

    def __init__(self) -> None:
        super().__init__()
        whole = alexnet(weights=None)
        self.features = whole.features
        self.avgpool = whole.avgpool
        # Without its last layer, whose name in the published file is classifier.6.
        self.classifier = whole.classifier[:6]
        self.colour_mean: Tensor
        self.colour_spread: Tensor
        self.register_buffer("colour_mean", torch.tensor(_MEAN).reshape(1, 3, 1, 1))
        self.register_buffer("colour_spread", torch.tensor(_SPREAD).reshape(1, 3, 1, 1))

    def forward(self, raster: Float[Tensor, "n 1 r c"]) -> Float[Tensor, "n f"]:
        """Return the last hidden layer's values for rasters with values 0..1."""
        size = (SIDE_PX, SIDE_PX)
        stretched = nn.functional.interpolate(raster, size=size, mode="bilinear", align_corners=False)
        picture = (stretched - self.colour_mean) / self.colour_spread
        features: Tensor = self.classifier(torch.flatten(self.avgpool(self.features(picture)), 1))
        return features

    def load_pretrained(self, path: Path) -> None:
        """Read weights as torchvision publishes them, without their last layer.

        Args:
            path: State dict, as a PyTorch file or as safetensors.

        Raises:
            CheckpointError: If the file is missing, cannot be read or is not of AlexNet.
        """
        if not path.is_file():
            raise CheckpointError(f"{path}: no such file, expected weights of torchvision's AlexNet")
        try:
            if path.suffix == ".safetensors":
                state = load_file(path)
            else:
                state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # the unpickler raises whatever damaged bytes lead it to
            reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
            raise CheckpointError(f"{path}: cannot be read as weights ({reason})") from None
        own = {name: value for name, value in self.state_dict().items() if not name.startswith("colour_")}
        if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
            raise CheckpointError(f"{path}: expected a dict of tensors, found {type(state).__name__}")
        for name, value in own.items():
            found = state.get(name)
            if found is None or found.shape != value.shape:
                what = "nothing" if found is None else f"shape {tuple(found.shape)}"
                raise CheckpointError(
                    f"{path}: expected AlexNet's {name!r} of shape {tuple(value.shape)}, found {what}"
                )
        self.load_state_dict({name: state[name] for name in own}, strict=False)


#: Distance of the lane centre A that the paper steers at, [cm]; it is one of the label rows.
LOOKAHEAD_CM = ROWS_CM[1]
#: Widths of a lane that a network tells apart, [cm]: the middles of its bells, evenly spaced by ratio.
_WIDTHS_CM = (15.0, 20.0, 27.0, 36.0, 48.0, 64.0, 85.0, 114.0)
#: The predicted standard deviation stays within these, [cm], before it is calibrated.
SIGMA_RANGE_CM = (0.05, 50.0)

#: Width of a bell, in logarithms of the width: about the distance of two.
_BELL = 0.25
_LOG_LOW, _LOG_HIGH = (math.log(v) for v in SIGMA_RANGE_CM)


class LaneOutput(NamedTuple):
    """What a network answers.

    Attributes:
        points_cm: The six points, frame car, n x 6.
        sigma_cm: Standard deviation of each of them, n x 6.
        presence_logit: Per line the logarithm of the odds that it can be seen, n x 2.
        log_share: Per point the logarithm of the probability of each bin of x, n x 6 x b; None of a network
            without bins.
        bins_cm: Middles of the bins, evenly spaced.
    """

    points_cm: Tensor
    sigma_cm: Tensor
    presence_logit: Tensor
    log_share: Tensor | None = None
    bins_cm: Tensor | None = None


class LaneNet(nn.Module):
    """Bird's-eye raster in, six points in cm with their spread and the presence of two lines out.

    The compact networks are an AlexNet in kind (a wide first filter with a stride of four, then 3 x 3
    filters, then fully connected layers) with strided convolutions and batch normalisation, 1/600 of its
    size: a raster of edges has no texture to learn. The last feature map is not averaged over rows and
    columns, since the place of a line is the answer.

    A point is answered as a number, or, with bins, as the mean of a distribution of x: where one picture has
    two explanations, a distribution can learn both.

    Args:
        settings: Which network, and its size.
        rows: Rows of the raster.
        columns: Columns of the raster.

    Attributes:
        width_bias: What the width of the lane adds to the channels of each convolution but the first and to
            the hidden layer; None if the network is not told it.

    Source:
        Kozlowski et al. 2024, section 2.4: AlexNet with its last layers replaced by a regression layer.
        Bins: Li et al. 2020, "Generalized focal loss", section 3.2.
    """

    def __init__(self, settings: NetworkSettings, rows: int, columns: int) -> None:
        super().__init__()
        self.rows, self.columns = rows, columns
        n_outputs = N_POINTS * ((settings.bins or 1) + 1) + len(SIDES)
        self.trunk: nn.Module
        self.head: nn.Module
        self.width_bias: nn.ModuleList | None = None
        if settings.kind == "alexnet":
            self.trunk, self.head = AlexNetTrunk(), nn.Linear(N_FEATURES, n_outputs)
        else:
            channels, hidden = settings.size
            self.trunk, n_features = _compact_trunk(channels, rows, columns)
            self.head = nn.Sequential(
                nn.Linear(n_features, hidden), nn.ReLU(inplace=True), nn.Linear(hidden, n_outputs)
            )
            if settings.takes_width:
                told = [nn.Linear(len(_WIDTHS_CM), n, bias=False) for n in (*channels[1:], hidden)]
                self.width_bias = nn.ModuleList(told)
        # The layers predict (x - mean) / scale, so that all six outputs are of order one.
        self.mean_cm: Tensor
        self.scale_cm: Tensor
        self.bins_cm: Tensor | None
        self.register_buffer("bins_cm", torch.zeros(settings.bins) if settings.bins else None)
        # What the spread is multiplied with so that it is right on frames that the network has not seen.
        self.sigma_factor: Tensor
        self.register_buffer("mean_cm", torch.zeros(N_POINTS))
        self.register_buffer("scale_cm", torch.ones(N_POINTS))
        self.register_buffer("sigma_factor", torch.ones(N_POINTS))
        self.log_widths: Tensor
        self.register_buffer("log_widths", torch.log(torch.tensor(_WIDTHS_CM)), persistent=False)
        # Convolutions of few channels are up to twice as fast on a CPU with the channels side by side.
        self.to(memory_format=torch.channels_last)

    def forward(
        self, raster: Float[Tensor, "n 1 r c"], lane_cm: Float[Tensor, "w"] | None = None
    ) -> LaneOutput:
        """Find the lane in rasters with values 0..1.

        Args:
            raster: Bird's-eye rasters.
            lane_cm: Width of the lane of each, or of all; 0 where it is not known. None is not known for all.
        """
        if self.width_bias is None or lane_cm is None:
            outputs: Tensor = self.head(self.trunk(raster))
        else:
            outputs = self._of_width(raster, lane_cm)
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
        """Put the first bin at one end of where labels are and the last at the other, if there are bins."""
        if self.bins_cm is not None:
            self.bins_cm.copy_(torch.linspace(left_cm, right_cm, len(self.bins_cm)))

    def _of_width(
        self, raster: Float[Tensor, "n 1 r c"], lane_cm: Float[Tensor, "w"]
    ) -> Float[Tensor, "n k"]:
        """Pass through the layers, each with the bias that the width gives it."""
        assert self.width_bias is not None
        assert isinstance(self.trunk, nn.Sequential)
        assert isinstance(self.head, nn.Sequential)
        bells = torch.log(lane_cm.clamp(min=1.0)[:, None]) - self.log_widths
        code = torch.exp(-0.5 * (bells / _BELL) ** 2) * (lane_cm > 0.0)[:, None]
        x, biases = raster, [layer(code) for layer in self.width_bias]
        n_norms = 0
        for layer in self.trunk:
            x = layer(x)
            if isinstance(layer, nn.BatchNorm2d):
                if n_norms:
                    x = x + biases[n_norms - 1][:, :, None, None]
                n_norms += 1
        hidden = self.head[0](x) + biases[-1]
        for layer in self.head[1:]:
            hidden = layer(hidden)
        return hidden

    @torch.no_grad()
    def lower_presence(self, by: float) -> None:
        """Take this from the logarithm of the odds of both lines, for all rasters."""
        last = self.head[-1] if isinstance(self.head, nn.Sequential) else self.head
        assert isinstance(last, nn.Linear)
        last.bias[-len(SIDES) :] -= by

    @property
    def n_parameters(self) -> int:
        """Number of trainable values."""
        return sum(p.numel() for p in self.parameters())


class DeployedLaneNet(nn.Module):
    """What the ONNX file holds: bytes in; points, spread, presence, parabolas, centre and steering out."""

    def __init__(self, network: LaneNet) -> None:
        super().__init__()
        self.network = network
        self.parabola_from_points: Tensor
        matrix = torch.from_numpy(PARABOLA_FROM_POINTS.T.copy()).to(torch.float32)
        self.register_buffer("parabola_from_points", matrix)

    def forward(
        self, raster: UInt8[Tensor, "n 1 r c"], lane_cm: Float[Tensor, "w"] | None = None
    ) -> tuple[
        Float[Tensor, "n 6"],
        Float[Tensor, "n 6"],
        Float[Tensor, "n 2"],
        Float[Tensor, "n 2 3"],
        Float[Tensor, "n 1"],
        Float[Tensor, "n 1"],
    ]:
        """Find the lane in rasters.

        Args:
            raster: Bird's-eye rasters, 255 where there is an edge, 0 elsewhere.
            lane_cm: As in :meth:`LaneNet.forward`.

        Returns:
            The six points, [cm]; their standard deviations, [cm]; probability that the left and the right
            line can be seen; (a, b, c) of the left and right parabola; x of the lane centre at 15 cm, [cm];
            the steering target, [rad], positive left.

        Source:
            Steering: Kozlowski et al. 2024, eq. 3. The centre is ahead, so atan equals atan2 here.
        """
        output: LaneOutput = self.network(input_of_rasters(raster), lane_cm)
        lines = output.points_cm.reshape(-1, 2, len(ROWS_CM))
        middle_row = ROWS_CM.index(LOOKAHEAD_CM)
        centre = lines[:, :, middle_row].mean(dim=1, keepdim=True)
        steering = torch.atan(-centre / LOOKAHEAD_CM)
        presence = torch.sigmoid(output.presence_logit)
        return (
            output.points_cm,
            output.sigma_cm,
            presence,
            lines @ self.parabola_from_points,
            centre,
            steering,
        )


def input_of_rasters(rasters: UInt8[Tensor, "n 1 r c"]) -> Float[Tensor, "n 1 r c"]:
    """Return rasters of 0 and 255 as the network's input of 0 and 1."""
    return rasters.to(torch.float32) * (1.0 / 255.0)


def new_network(settings: NetworkSettings, rows: int, columns: int, seed: int) -> LaneNet:
    """Make a network with first weights drawn from ``seed``, without touching torch's global generator.

    Raises:
        CheckpointError: If pretrained weights are asked for and cannot be read.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = LaneNet(settings, rows, columns)
    if settings.weights is not None:
        assert isinstance(network.trunk, AlexNetTrunk)
        network.trunk.load_pretrained(settings.weights)
    return network


def _compact_trunk(channels: tuple[int, ...], rows: int, columns: int) -> tuple[nn.Module, int]:
    """Return the convolutions and the number of features that they leave."""
    layers: list[nn.Module] = []
    before, height, width = 1, rows, columns
    for i, after in enumerate(channels):
        kernel, stride = (7, 4) if i == 0 else (3, 2)
        layers += [
            nn.Conv2d(before, after, kernel, stride=stride, padding=kernel // 2, bias=False),
            nn.BatchNorm2d(after),
            nn.ReLU(inplace=True),
        ]
        before, height, width = after, -(-height // stride), -(-width // stride)
    return nn.Sequential(*layers, nn.Flatten()), before * height * width
