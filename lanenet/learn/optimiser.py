"""How the weights move: AdamW, its learning rate, and the running mean of the weights."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lanenet.learn.config import LearnSettings
from lanenet.learn.network import LaneNet

_FACTOR = "rate_factor"


def new_optimizer(network: LaneNet, settings: LearnSettings) -> torch.optim.Optimizer:
    """Return AdamW over a network's weights; biases and norms do not decay.

    AlexNet's new layer learns ``head_rate`` times as fast as the rest, as in the paper.
    """
    head_factor = settings.head_rate if settings.network.kind == "alexnet" else 1.0
    groups = []
    # All children, so that no part of a network is left as it was drawn.
    for part in network.children():
        factor = head_factor if part is network.head else 1.0
        for decays in (True, False):
            chosen = [p for p in part.parameters() if (p.ndim > 1) == decays]
            decay = settings.weight_decay if decays else 0.0
            if chosen:
                groups.append({"params": chosen, "weight_decay": decay, _FACTOR: factor})
    return torch.optim.AdamW(groups, lr=settings.learning_rate, fused=True)


def learning_rate_at(step: int, total: int, settings: LearnSettings) -> float:
    """Return the learning rate of a step (from 0): a straight rise, then a cosine down to zero."""
    rise = settings.warmup * total
    if step < rise:
        return settings.learning_rate * (step + 1) / (rise + 1)
    share = (step - rise) / max(total - rise, 1.0)
    return settings.learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))


def set_learning_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate; a group of parameters may have a multiple of it."""
    for group in optimizer.param_groups:
        group["lr"] = rate * group[_FACTOR]


class RunningMean:
    """Keeps a copy of a network at the running mean of its weights.

    Attributes:
        network: The copy.
    """

    def __init__(self, network: LaneNet, source: LaneNet, decay: float) -> None:
        """Take over a copy.

        Args:
            network: Made like ``source``; gets its weights.
            source: The network that is trained.
            decay: Share of the mean that a step leaves.
        """
        network.load_state_dict(source.state_dict())
        self.network, self._decay = network, decay
        pairs = [(mean, source.state_dict()[name]) for name, mean in network.state_dict().items()]
        self._means: list[Tensor] = [mean for mean, _ in pairs if mean.is_floating_point()]
        self._values: list[Tensor] = [value for _, value in pairs if value.is_floating_point()]
        self._counts = [(mean, value) for mean, value in pairs if not mean.is_floating_point()]

    @torch.no_grad()
    def update(self, step: int) -> None:
        """Move the mean towards the weights after a step, counted from 1."""
        # Short at first, so that the first epochs are not judged by their random beginning.
        decay = min(self._decay, (1.0 + step) / (10.0 + step))
        torch._foreach_lerp_(self._means, self._values, 1.0 - decay)
        for mean, value in self._counts:
            mean.copy_(value)
