"""Layers that depend on all samples of a batch, for processes that have a part of it each.

PyTorch's own ``SyncBatchNorm`` runs on GPUs only, and its dropout knows nothing of other processes.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lanenet.learn.parallel import Processes

#: All but the channels.
_OVER = (0, 2, 3)


def share_layers(network: nn.Module, processes: Processes) -> None:
    """Replace the layers of a network by those that see the whole batch; weights and their names stay."""
    if processes.size == 1:
        return
    for parent in list(network.modules()):
        for name, layer in list(parent.named_children()):
            if type(layer) is nn.BatchNorm2d:
                setattr(parent, name, SharedBatchNorm(layer, processes))
            elif type(layer) is nn.Dropout:
                setattr(parent, name, SharedDropout(layer, processes))


class SharedBatchNorm(nn.BatchNorm2d):
    """Batch normalisation by mean and variance of the samples of all processes.

    Args:
        layer: Whose weights it takes over.
        processes: That share each batch.
    """

    def __init__(self, layer: nn.BatchNorm2d, processes: Processes) -> None:
        super().__init__(layer.num_features, layer.eps, layer.momentum)
        self.weight, self.bias = layer.weight, layer.bias
        for name, values in layer.named_buffers(recurse=False):
            setattr(self, name, values)
        self._processes = processes

    def forward(self, input: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Normalise; moves the running mean and variance in training."""
        if not self.training:
            return super().forward(input)
        count, mean, variance = self._moments(input.detach())
        with torch.no_grad():
            assert self.running_mean is not None and self.running_var is not None
            assert self.momentum is not None and self.num_batches_tracked is not None
            self.running_mean.lerp_(mean.to(self.running_mean), self.momentum)
            unbiased = variance * (count / max(count - 1.0, 1.0))
            self.running_var.lerp_(unbiased.to(self.running_var), self.momentum)
            self.num_batches_tracked += 1
        result: Tensor = _Normalise.apply(
            input,
            self.weight,
            self.bias,
            mean.to(input),
            variance.to(input),
            count,
            self.eps,
            self._processes,
        )
        return result

    def _moments(
        self, values: Float[Tensor, "n c h w"]
    ) -> tuple[float, Float[Tensor, "c"], Float[Tensor, "c"]]:
        """Number of values per channel over all processes, their mean and their variance."""
        own = values.new_zeros((3, self.num_features), dtype=torch.float64)
        if len(values):
            variance, mean = (part.double() for part in torch.var_mean(values, _OVER, correction=0))
            count = values.numel() // values.shape[1]
            own[0], own[1], own[2] = count, count * mean, count * (variance + mean * mean)
        count, total, squares = self._processes.sum(own)
        mean = total / count
        # In double precision, so that the difference keeps the digits of single precision.
        return float(count[0]), mean, (squares / count - mean * mean).clamp_(min=0.0)


class _Normalise(torch.autograd.Function):
    """(x - mean) / sigma, with the gradient through mean and sigma of all processes.

    Source:
        Ioffe and Szegedy 2015, "Batch normalization", section 3.
    """

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        weight: Tensor,
        bias: Tensor,
        mean: Tensor,
        variance: Tensor,
        count: float,
        eps: float,
        processes: Processes,
    ) -> Tensor:
        ctx.save_for_backward(x, weight, mean, torch.rsqrt(variance + eps))
        ctx.count, ctx.processes = count, processes
        return nn.functional.batch_norm(x, mean, variance, weight, bias, eps=eps)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = gradients
        x, weight, mean, inverse_sigma = ctx.saved_tensors
        centred = x - mean[:, None, None]
        # Those of the weights are summed with all others, later; those of the mean and the variance here.
        own = torch.stack([gradient.sum(_OVER), (gradient * centred).sum(_OVER)])
        total, dot = (ctx.processes.sum(own.double()) / ctx.count).to(x)
        slope = (dot * inverse_sigma * inverse_sigma)[:, None, None]
        of_x = (gradient - total[:, None, None] - centred * slope) * (inverse_sigma * weight)[:, None, None]
        return of_x, own[1] * inverse_sigma, own[0], *(None,) * 5


class SharedDropout(nn.Dropout):
    """Dropout that draws for the samples of all processes and applies its own part.

    All processes have the same state of torch's generator, so that on a CPU each sample has the draw that it
    has in a training by one process.

    Args:
        layer: Whose probability it takes over.
        processes: That share each batch.
    """

    def __init__(self, layer: nn.Dropout, processes: Processes) -> None:
        super().__init__(layer.p)
        self._processes = processes

    def forward(self, input: Float[Tensor, "n *_"]) -> Float[Tensor, "n *_"]:
        """Drop values in training."""
        if not self.training:
            return super().forward(input)
        first, count = self._processes.place(len(input))
        kept = input.new_empty((count, *input.shape[1:])).bernoulli_(1.0 - self.p).div_(1.0 - self.p)
        return input * kept[first : first + len(input)]
