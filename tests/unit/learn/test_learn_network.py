import numpy as np
import pytest
import torch

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import parabolas_from_points
from lanenet.geometry.steering import proportional_angle_rad
from lanenet.learn.config import NetworkSettings
from lanenet.learn.network import DeployedLaneNet, LaneNet, input_of_rasters, new_network

torch.set_num_threads(1)


def test_default_network_is_compact():
    window = BirdseyeWindow()
    network = LaneNet(NetworkSettings(), window.rows, window.columns)
    assert network(torch.zeros(3, 1, window.rows, window.columns)).shape == (3, 6)
    assert network.n_parameters <= 150_000


@pytest.mark.parametrize("shape", [(96, 128), (33, 47), (1, 1)])
def test_any_window_fits(shape):
    network = LaneNet(NetworkSettings(channels=(2, 3), hidden=4), *shape).eval()
    assert network(torch.zeros(1, 1, *shape)).shape == (1, 6)


def test_first_weights_follow_from_the_seed_and_leave_the_global_generator_alone():
    before = torch.random.get_rng_state()
    a, b, c = (new_network(NetworkSettings(), 24, 32, seed) for seed in (3, 3, 4))
    assert torch.equal(before, torch.random.get_rng_state())
    first = [next(n.parameters()) for n in (a, b, c)]
    assert torch.equal(first[0], first[1])
    assert not torch.equal(first[0], first[2])


def test_buffers_scale_the_output():
    network = LaneNet(NetworkSettings(), 24, 32).eval()
    raster = torch.ones(1, 1, 24, 32)
    plain = network(raster)
    network.mean_cm.fill_(7.0)
    network.scale_cm.fill_(2.0)
    torch.testing.assert_close(network(raster), 2.0 * plain + 7.0)


def test_deployed_outputs_follow_from_the_points():
    network = new_network(NetworkSettings(), 24, 32, 0).eval()
    network.mean_cm.copy_(torch.tensor([-20.0, -19.0, -17.0, 20.0, 22.0, 25.0]))
    rng = np.random.default_rng(0)
    raster = torch.from_numpy(np.where(rng.random((5, 1, 24, 32)) < 0.1, 255, 0).astype(np.uint8))
    with torch.inference_mode():
        points, parabolas, centre, steering = (v.numpy() for v in DeployedLaneNet(network)(raster))
        np.testing.assert_allclose(points, network(input_of_rasters(raster)).numpy(), atol=1e-5)
    np.testing.assert_allclose(parabolas, parabolas_from_points(points), atol=1e-4)
    np.testing.assert_allclose(centre[:, 0], (points[:, 1] + points[:, 4]) / 2.0, atol=1e-5)
    expected = [proportional_angle_rad(float(c), 15.0) for c in centre[:, 0]]
    np.testing.assert_allclose(steering[:, 0], expected, atol=1e-6)
    # The lane lies to the right here (centre 1.5 cm), and right is negative.
    assert (centre > 0).all() and (steering < 0).all()
