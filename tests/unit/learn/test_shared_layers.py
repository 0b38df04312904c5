"""Layers and losses of a batch that several processes share, as they are in one."""

import pytest
import torch
from torch import nn

from lanenet.learn.config import LossSettings, NetworkSettings
from lanenet.learn.loss import count_known, lane_loss
from lanenet.learn.network import LaneNet, LaneOutput
from lanenet.learn.parallel import ALONE, Processes
from lanenet.learn.shared_layers import SharedBatchNorm, SharedDropout, share_layers


@pytest.fixture
def drawn():
    generator = torch.Generator().manual_seed(0)
    return lambda *shape: torch.randn(shape, generator=generator)


def test_batch_normalisation_is_that_of_torch(drawn):
    plain = nn.BatchNorm2d(5)
    nn.init.normal_(plain.weight), nn.init.normal_(plain.bias)
    shared = SharedBatchNorm(nn.BatchNorm2d(5), ALONE)
    shared.load_state_dict(plain.state_dict())
    # Far from zero, where sums of squares lose digits.
    values, slope = 3.0 * drawn(7, 5, 6, 4) + 40.0, drawn(7, 5, 6, 4)
    found = []
    for layer in (plain, shared):
        x = values.clone().requires_grad_()
        y = layer(x)
        (y * slope).sum().backward()
        found.append([y, x.grad, layer.weight.grad, layer.bias.grad, *layer.buffers()])
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=2e-5, atol=2e-5)
    torch.testing.assert_close(shared.eval()(values), plain.eval()(values), rtol=1e-4, atol=1e-4)


def test_the_gradient_of_batch_normalisation_is_the_slope_of_its_values(drawn):
    layer = SharedBatchNorm(nn.BatchNorm2d(2).double(), ALONE).double()
    assert torch.autograd.gradcheck(layer, drawn(3, 2, 2, 2).double().requires_grad_())


def test_a_process_without_samples_goes_along():
    layer = SharedBatchNorm(nn.BatchNorm2d(2), ALONE)
    layer._moments = lambda values: (4.0, torch.zeros(2).double(), torch.ones(2).double())  # of the others
    x = torch.empty((0, 2, 3, 3), requires_grad=True)
    layer(x).sum().backward()
    assert x.grad is not None and x.grad.shape == x.shape and not layer.weight.grad.any()


def test_dropout_draws_as_torch_does(drawn):
    values, found = drawn(6, 11), []
    for layer in (nn.Dropout(0.3), SharedDropout(nn.Dropout(0.3), ALONE)):
        torch.manual_seed(3)
        found.append(layer(values))
    assert torch.equal(*found) and (found[0] == 0.0).any()


def test_a_part_of_a_batch_has_its_part_of_the_draws(drawn, monkeypatch):
    values = drawn(6, 11)
    torch.manual_seed(3)
    whole = nn.Dropout(0.3)(values)
    monkeypatch.setattr(Processes, "place", lambda self, count: (4, 6))
    torch.manual_seed(3)
    assert torch.equal(SharedDropout(nn.Dropout(0.3), Processes(1, 2))(values[4:]), whole[4:])


def test_weights_and_their_names_stay():
    network = LaneNet(NetworkSettings(channels=(4, 8), hidden=8), 24, 32)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    share_layers(network, ALONE)
    assert not any(isinstance(layer, SharedBatchNorm) for layer in network.modules())
    share_layers(network, Processes(0, 2))
    assert sum(isinstance(layer, SharedBatchNorm) for layer in network.modules()) == 2
    assert list(before) == list(network.state_dict())
    assert all(torch.equal(value, network.state_dict()[name]) for name, value in before.items())


@pytest.mark.parametrize("bins", [0, 6])
def test_the_losses_of_the_parts_add_up_to_that_of_the_batch(drawn, bins):
    size = 9
    shares = torch.log_softmax(drawn(size, 6, bins), -1) if bins else None
    output = (drawn(size, 6), drawn(size, 6).exp(), drawn(size, 2), shares)
    places = torch.linspace(-5.0, 5.0, bins) if bins else None
    labels, present = drawn(size, 6), (drawn(size, 2) > 0.0).float()
    labels[labels > 0.9], present[1:3] = torch.nan, torch.nan

    def loss(rows, counts=None):
        own = LaneOutput(*(part if part is None else part[rows] for part in output), places)
        return lane_loss(own, labels[rows], present[rows], LossSettings(), counts)

    parts = (slice(0, 2), slice(2, 9), slice(9, 9))
    counts = count_known(labels, present)
    assert counts.points < 6 * size and counts.lines == 14
    together = sum(loss(rows, counts) for rows in parts)
    torch.testing.assert_close(together, loss(slice(None)))
