"""The paper's network as a trunk: torchvision's AlexNet up to its last hidden layer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor, nn

from lanenet.errors import CheckpointError
from lanenet.learn.trunks.compact import Trunk

#: Side of the image that AlexNet takes, [px].
SIDE_PX = 224
#: Mean and standard deviation of the colours of ImageNet, on which the published weights were trained.
_MEAN, _SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class AlexNetTrunk(Trunk):
    """AlexNet without its last fully connected layer, fed with rasters.

    A raster is scaled to 224 x 224 and copied to all three colours, as the published weights need it.

    Source:
        Kozlowski et al. 2024, section 2.4: the last four layers (dropout, classes, softmax and their output)
        are replaced. Krizhevsky 2014 in torchvision's version.
    """

    uses = frozenset({"weights"})
    head_learns_faster = True
    n_features = 4096

    def __init__(
        self, rows: int, columns: int, channels: None = None, hidden: None = None, planes: Literal[1] = 1
    ) -> None:
        super().__init__()
        # Here, since its import takes two seconds that no other network should wait for.
        from torchvision.models import alexnet

        whole = alexnet(weights=None)
        self.features = whole.features
        self.avgpool = whole.avgpool
        # Without its last layer, whose name in the published file is classifier.6.
        self.classifier = whole.classifier[:6]
        self.colour_mean: Tensor
        self.colour_spread: Tensor
        self.register_buffer("colour_mean", torch.tensor(_MEAN).reshape(1, 3, 1, 1))
        self.register_buffer("colour_spread", torch.tensor(_SPREAD).reshape(1, 3, 1, 1))

    def forward(
        self, raster: Float[Tensor, "n 1 r c"], biases: Sequence[Tensor] = ()
    ) -> Float[Tensor, "n f"]:
        """Return the values of the last hidden layer."""
        size = (SIDE_PX, SIDE_PX)
        scaled = nn.functional.interpolate(raster, size=size, mode="bilinear", align_corners=False)
        image = (scaled - self.colour_mean) / self.colour_spread
        features: Tensor = self.classifier(torch.flatten(self.avgpool(self.features(image)), 1))
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
        state: Any
        try:
            if path.suffix == ".safetensors":
                state = load_file(path)
            else:
                state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # the unpickler raises whatever damaged bytes lead it to
            # The first sentence: torch goes on with advice to trust the file.
            reason = str(error).splitlines()[0].split(". ")[0][:200] if str(error) else type(error).__name__
            raise CheckpointError(
                f"{path}: cannot be read as weights, expected a state dict ({reason})"
            ) from None
        if not isinstance(state, dict):
            raise CheckpointError(f"{path}: expected a dict of tensors, found {type(state).__name__}")
        for name, value in state.items():
            if not isinstance(value, Tensor):
                found = f"{type(value).__name__} under {name!r}"
                raise CheckpointError(f"{path}: expected a dict of tensors, found {found}")
        own = {name: value for name, value in self.state_dict().items() if not name.startswith("colour_")}
        for name, value in own.items():
            given = state.get(name)
            if given is None or given.shape != value.shape:
                found = "nothing" if given is None else f"shape {tuple(given.shape)}"
                raise CheckpointError(
                    f"{path}: expected AlexNet's {name!r} of shape {tuple(value.shape)}, found {found}"
                )
        self.load_state_dict({name: state[name] for name in own}, strict=False)
