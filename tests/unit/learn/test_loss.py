import math

import numpy as np
import pytest
import torch

from lanenet.learn.config import LossSettings
from lanenet.learn.loss import lane_loss, sigma_factors
from lanenet.learn.network import LaneOutput

NAN = float("nan")
KINDS = ("student", "laplace", "gaussian")


def output(points, sigma=1.0, logit=0.0):
    points = torch.as_tensor(points, dtype=torch.float32).requires_grad_()
    return LaneOutput(
        points,
        torch.full_like(points, sigma).requires_grad_(),
        torch.full((len(points), 2), logit).requires_grad_(),
    )


def unknown(n):
    return torch.full((n, 6), NAN), torch.full((n, 2), NAN)


@pytest.mark.parametrize("kind", KINDS)
def test_masked_labels_give_neither_loss_nor_gradient(kind):
    labels, present = unknown(2)
    labels[0, 2], labels[1, 4] = 1.0, 10.0
    answer = output(np.zeros((2, 6)))
    lane_loss(answer, labels, present, LossSettings(kind=kind)).backward()
    known = torch.isfinite(labels)
    assert (answer.points_cm.grad[known] < 0.0).all() and (answer.points_cm.grad[~known] == 0.0).all()
    assert torch.isfinite(answer.sigma_cm.grad).all() and (answer.sigma_cm.grad[~known] == 0.0).all()
    assert answer.presence_logit.grad.count_nonzero() == 0


def binned(logits, bins_cm):
    logits = torch.as_tensor(logits, dtype=torch.float32).requires_grad_()
    log_share = torch.log_softmax(logits, dim=-1)
    points = (log_share.exp() * bins_cm).sum(dim=-1)
    presence = torch.zeros(len(logits), 2)
    return logits, LaneOutput(points, torch.ones_like(points), presence, log_share, bins_cm)


def test_a_label_between_two_bins_belongs_to_both():
    bins_cm = torch.linspace(-20.0, 20.0, 5)
    labels, present = unknown(1)
    labels[0, 1], labels[0, 3], labels[0, 4] = 2.5, -20.0, 20.0
    shares = torch.tensor([0.1, 0.2, 0.3, 0.15, 0.25])
    logits, answer = binned(shares.log().repeat(1, 6, 1), bins_cm)
    loss = lane_loss(answer, labels, present, LossSettings(distance=0.0))
    expected = -(0.75 * math.log(0.3) + 0.25 * math.log(0.15)) - math.log(0.1) - math.log(0.25)
    assert loss.item() == pytest.approx(expected / 3.0, rel=1e-5)
    loss.backward()
    known = torch.isfinite(labels)
    assert (logits.grad[known] != 0.0).any() and (logits.grad[~known] == 0.0).all()
    # The mean of these shares is 2.5 cm: distances of 0, 22.5 and 17.5 cm, the far ones less 1 cm.
    logits, answer = binned(shares.log().repeat(1, 6, 1), bins_cm)
    answer = answer._replace(sigma_cm=answer.sigma_cm.detach().requires_grad_())
    far = lane_loss(answer, labels, present, LossSettings(distance=0.5))
    doubt = [2.5 * math.log1p((1.1417 * error) ** 2 / 4.0) for error in (0.0, 22.5, 17.5)]
    assert far.item() - loss.item() == pytest.approx(0.5 * (21.5 + 16.5 + sum(doubt)) / 3.0, rel=1e-4)
    # The spread is learned from the errors without moving the points, so that their pull is the distance's.
    far.backward()
    points = torch.zeros(1, 6)
    points[0, 3], points[0, 4] = 1.0, -1.0
    pull = torch.softmax(logits.detach(), -1) * (bins_cm - 2.5) * points[..., None] * 0.5 / 3.0
    alone, plain = binned(shares.log().repeat(1, 6, 1), bins_cm)
    lane_loss(plain, labels, present, LossSettings(distance=0.0)).backward()
    torch.testing.assert_close(logits.grad, alone.grad + pull, atol=1e-5, rtol=1e-4)
    assert (answer.sigma_cm.grad[known] != 0.0).all() and (answer.sigma_cm.grad[~known] == 0.0).all()


def test_values():
    labels, present = unknown(1)
    labels[0, 0] = 3.0
    sigma = 2.0

    def loss(kind, evenness=0.0):
        settings = LossSettings(kind=kind, evenness=evenness)
        return float(lane_loss(output(np.zeros((1, 6)), sigma), labels, present, settings).detach())

    assert loss("gaussian") == pytest.approx(0.5 * 1.5**2 + math.log(2.0), rel=1e-5)
    # Laplace's scale holds 1 - 1/e of the errors, its one-sigma width 68.27 %.
    assert loss("laplace") == pytest.approx(1.5 * -math.log(1.0 - 0.6827) + math.log(2.0), rel=1e-5)
    assert loss("student") == pytest.approx(
        2.5 * math.log1p((1.5 * 1.1417) ** 2 / 4.0) + math.log(2.0), rel=1e-4
    )
    # The weight is the spread itself, without a gradient of its own.
    assert loss("gaussian", 1.0) == pytest.approx(2.0 * loss("gaussian"), rel=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_the_best_spread_holds_68_percent_of_the_errors(kind):
    # Errors of the distribution that the loss stands for, in units of the width that holds 68.27 % of them.
    rng = np.random.default_rng(0)
    draw = {
        "student": lambda n: rng.standard_t(4.0, n),
        "laplace": rng.laplace,
        "gaussian": rng.standard_normal,
    }
    errors = draw[kind](size=30_000) if kind == "laplace" else draw[kind](30_000)
    labels = torch.from_numpy((errors / np.quantile(np.abs(errors), 0.6827)).reshape(-1, 6)).float()
    present = torch.full((len(labels), 2), NAN)
    settings = LossSettings(kind=kind, evenness=0.0)
    sigmas = np.linspace(0.9, 1.1, 21)
    losses = [
        float(lane_loss(output(np.zeros((len(labels), 6)), s), labels, present, settings).detach())
        for s in sigmas
    ]
    assert sigmas[int(np.argmin(losses))] == pytest.approx(1.0, abs=0.03)


def test_outliers_pull_less_than_in_a_gaussian():
    labels, present = unknown(1)
    labels[0, 0], labels[0, 1] = 1.0, 50.0
    pull = {}
    for kind in KINDS:
        answer = output(np.zeros((1, 6)))
        lane_loss(answer, labels, present, LossSettings(kind=kind)).backward()
        pull[kind] = float(answer.points_cm.grad[0, 1] / answer.points_cm.grad[0, 0])
    assert pull["gaussian"] == pytest.approx(50.0, rel=1e-4)
    assert pull["laplace"] == pytest.approx(1.0, rel=1e-4) and pull["student"] < 1.0


def test_presence_counts_where_it_is_known():
    labels, present = unknown(2)
    present[0, 0], present[1, 1] = 1.0, 0.0
    settings = LossSettings(presence=0.5)
    answer = output(np.zeros((2, 6)), logit=math.log(3.0))
    # A probability of 3/4: -log(3/4) where the line is there, -log(1/4) where it is not.
    loss = lane_loss(answer, labels, present, settings)
    assert float(loss.detach()) == pytest.approx(0.5 * 0.5 * (-math.log(0.75) - math.log(0.25)), rel=1e-5)
    loss.backward()
    assert (
        answer.presence_logit.grad.count_nonzero() == 2 and torch.isfinite(answer.presence_logit.grad).all()
    )


def test_nothing_known_is_no_loss():
    answer = output(np.zeros((2, 6)))
    loss = lane_loss(answer, *unknown(2), LossSettings())
    loss.backward()
    assert float(loss.detach()) == 0.0 and answer.points_cm.grad.count_nonzero() == 0


def test_factors_bring_the_coverage_to_68_percent():
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.2, 3.0, (4000, 6))
    error = sigma * rng.standard_normal((4000, 6)) * np.tile([0.5, 1.0, 2.0], 2)
    error[rng.random(error.shape) < 0.2] = NAN
    factors = sigma_factors(error, sigma)
    np.testing.assert_allclose(factors, np.tile([0.5, 1.0, 2.0], 2), rtol=0.05)
    known = np.isfinite(error)
    assert (np.abs(error) <= factors * sigma)[known].mean() == pytest.approx(0.6827, abs=0.002)
    few = np.where(np.arange(4000)[:, None] < 20, error, NAN)
    np.testing.assert_array_equal(sigma_factors(few, sigma), np.ones(6))
