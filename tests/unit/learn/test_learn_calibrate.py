import numpy as np
import pytest
import torch
from synthetic_labels import WINDOW, make_label_set

from lanenet.learn.config import NetworkSettings
from lanenet.learn.network import new_network
from lanenet.learn.predict import answer_rasters, calibrate_presence, calibrate_sigma, predict
from lanenet.samples.dataset import LaneSamples
from lanenet.samples.settings import AugmentSettings

SAMPLES = LaneSamples([make_label_set(400, 3)], ["set"])


def network_that_says(odds):
    """Of random weights, but for the mean of what it says of the lines."""
    network = new_network(NetworkSettings(kind="nano", bins=0), WINDOW.rows, WINDOW.columns, seed=0).eval()
    batch = SAMPLES.plain_batch(np.arange(len(SAMPLES)))
    found = answer_rasters(network, batch.rasters, batch.lane_cm).presence_logit.mean(dim=0)
    with torch.no_grad():
        network.head[-1].bias[-2:] += odds - found
    return network


def absent_found(network):
    gone = AugmentSettings.only(missing_line=0.8, missing_both=0.2)
    rasters, _, present, lane_cm = SAMPLES.augmented_batch(np.arange(len(SAMPLES)), gone, seed=8, epoch=0)
    assert (present == 0.0).any(axis=1).all()
    said = answer_rasters(network, rasters, lane_cm).presence_logit.numpy() >= 0.0
    return 1.0 - said[present == 0.0].mean()


def test_lines_that_are_taken_out_are_called_absent_afterwards():
    network = network_that_says(0.8)
    before, points = absent_found(network), predict(network, SAMPLES).points_cm
    calibrate_presence(network, SAMPLES)
    assert before < 0.5 and absent_found(network) == pytest.approx(0.96, abs=0.015)
    # Nothing else is touched.
    np.testing.assert_array_equal(predict(network, SAMPLES).points_cm, points)


@pytest.mark.parametrize(("odds", "shift"), [(-4.0, 0.0), (5.0, 2.0)])
def test_presence_is_lowered_where_needed_and_by_no_more_than_two(odds, shift):
    network = network_that_says(odds)
    before = network.head[-1].bias.detach().clone()
    calibrate_presence(network, SAMPLES)
    after = network.head[-1].bias.detach()
    np.testing.assert_allclose((before - after).numpy()[-2:], shift, atol=1e-6)
    np.testing.assert_array_equal(before[:-2], after[:-2])


def test_the_spread_holds_68_percent_afterwards():
    network = network_that_says(0.0)
    calibrate_sigma(network, SAMPLES)
    answers = predict(network, SAMPLES)
    within = np.abs(answers.points_cm - answers.truth_cm) <= answers.sigma_cm
    for row in range(3):
        assert within[:, [row, row + 3]].mean() == pytest.approx(0.683, abs=0.02)
