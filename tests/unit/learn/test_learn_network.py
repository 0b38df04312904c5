import numpy as np
import pytest
import torch
from synthetic_labels import make_label_set

from lanenet.errors import CheckpointError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.lane import parabolas_from_points, proportional_angle_rad
from lanenet.learn.config import NetworkSettings
from lanenet.learn.network import SIGMA_RANGE_CM, DeployedLaneNet, LaneNet, input_of_rasters, new_network
from lanenet.samples.dataset import LaneSamples

torch.set_num_threads(1)

ALEXNET = NetworkSettings(kind="alexnet")


@pytest.fixture(scope="module")
def alexnet():
    return new_network(ALEXNET, 24, 32, 0).eval()


def test_the_family_grows_and_stays_compact():
    window = BirdseyeWindow()
    networks = [
        LaneNet(NetworkSettings(kind=k), window.rows, window.columns) for k in ("nano", "small", "base")
    ]
    sizes = [network.n_parameters for network in networks]
    assert sizes == sorted(sizes) and sizes[0] < 50_000 < sizes[1] <= 150_000 < sizes[2]
    output = networks[1](torch.zeros(3, 5, window.rows, window.columns))
    assert [tuple(value.shape) for value in output[:3]] == [(3, 6), (3, 6), (3, 2)]


def test_channels_and_hidden_go_before_the_kind():
    nano = LaneNet(NetworkSettings(kind="nano", channels=(4, 8)), 24, 32)
    assert nano.trunk.hidden_width == LaneNet(NetworkSettings(kind="nano"), 24, 32).trunk.hidden_width == 32
    assert nano.trunk.biased_channels == (8,)
    a = LaneNet(NetworkSettings(kind="nano", channels=(4, 8), hidden=16), 24, 32)
    b = LaneNet(NetworkSettings(kind="base", channels=(4, 8), hidden=16), 24, 32)
    assert a.n_parameters == b.n_parameters


@pytest.mark.parametrize("shape", [(96, 128), (33, 47), (1, 1)])
def test_any_window_fits(shape):
    network = LaneNet(NetworkSettings(channels=(2, 3), hidden=4), *shape).eval()
    assert network(torch.zeros(1, 5, *shape)).points_cm.shape == (1, 6)


def test_alexnet_is_the_papers_and_300_times_as_large(alexnet):
    # 61,100,840 values of AlexNet, without the 4096 x 1000 + 1000 of its last layer, with one of 14 outputs.
    assert alexnet.n_parameters == 61_100_840 - 4_097_000 + 4096 * 14 + 14
    window = BirdseyeWindow()
    small = LaneNet(NetworkSettings(), window.rows, window.columns)
    assert alexnet.n_parameters >= 300 * small.n_parameters
    raster = torch.zeros(1, 1, 24, 32)
    raster[0, 0, :, 8] = 1.0
    with torch.inference_mode():
        marked, empty = alexnet(raster).points_cm, alexnet(0.0 * raster).points_cm
    assert not torch.equal(marked, empty)


def test_pretrained_weights_are_taken_up_but_for_the_last_layer(alexnet, tmp_path):
    from torchvision.models import alexnet as torchvision_alexnet

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        published = torchvision_alexnet(weights=None).state_dict()
    path = tmp_path / "alexnet.pth"
    torch.save(published, path)
    network = new_network(NetworkSettings(kind="alexnet", weights=path), 24, 32, 0)
    own = network.trunk.state_dict()
    assert torch.equal(own["features.0.weight"], published["features.0.weight"])
    assert torch.equal(own["classifier.4.bias"], published["classifier.4.bias"])
    assert torch.equal(network.head.weight, alexnet.head.weight)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"rubbish", "cannot be read as weights"),
        ({}, r"expected AlexNet's 'features\.0\.weight' of shape \(64, 3, 11, 11\), found nothing"),
        ({"features.0.weight": torch.zeros(2)}, r"found shape \(2,\)"),
        ([1], "expected a dict of tensors, found list"),
        ({"state_dict": {}}, "expected a dict of tensors, found dict under 'state_dict'"),
        (torch.nn.Linear(1, 1), r"expected a state dict \(Weights only load failed\)"),
    ],
)
def test_faulty_pretrained_weights_are_refused(alexnet, tmp_path, content, message):
    path = tmp_path / "w.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(CheckpointError, match=message) as caught:
        alexnet.trunk.load_pretrained(path)
    assert str(path) in str(caught.value)


def test_first_weights_follow_from_the_seed_and_leave_the_global_generator_alone():
    before = torch.random.get_rng_state()
    a, b, c = (new_network(NetworkSettings(), 24, 32, seed) for seed in (3, 3, 4))
    assert torch.equal(before, torch.random.get_rng_state())
    first = [next(n.parameters()) for n in (a, b, c)]
    assert torch.equal(first[0], first[1])
    assert not torch.equal(first[0], first[2])


def test_buffers_scale_the_output():
    network = LaneNet(NetworkSettings(bins=0), 24, 32).eval()
    raster = torch.ones(1, 5, 24, 32)
    plain = network(raster)
    network.mean_cm.fill_(7.0)
    network.scale_cm.fill_(2.0)
    network.sigma_factor.fill_(3.0)
    torch.testing.assert_close(network(raster).points_cm, 2.0 * plain.points_cm + 7.0)
    torch.testing.assert_close(network(raster).sigma_cm, 3.0 * plain.sigma_cm)


def test_a_network_sees_its_planes_and_no_others():
    batch = LaneSamples([make_label_set(3, 3)], ["a"]).plain_batch(np.arange(3))
    rasters = torch.from_numpy(batch.rasters)
    turned = rasters.clone()
    turned[:, 1] = 2 * 128 - turned[:, 1]
    assert not torch.equal(turned, rasters)
    for planes in (1, 5):
        settings = NetworkSettings(channels=(4, 8), hidden=8, bins=0, planes=planes)
        network = new_network(settings, *rasters.shape[2:], 0).eval()
        with torch.inference_mode():
            own, all_of_them, other = (
                network(input_of_rasters(seen)).points_cm for seen in (rasters[:, :planes], rasters, turned)
            )
        torch.testing.assert_close(own, all_of_them)
        assert torch.allclose(all_of_them, other) == (planes == 1)


def test_rasters_become_numbers_from_minus_one_to_one():
    raster = torch.tensor([[0, 255], [1, 255], [128, 128], [64, 192], [2, 254]], dtype=torch.uint8)
    expected = torch.tensor([[0, 127], [-127, 127], [0, 0], [-64, 64], [-126, 126]]) / 127.0
    torch.testing.assert_close(input_of_rasters(raster.reshape(1, 5, 1, 2))[0, :, 0], expected)


def test_points_of_bins_are_the_means_of_their_distributions():
    network = LaneNet(NetworkSettings(channels=(2,), hidden=4, bins=9), 24, 32).eval()
    network.spread_bins(-40.0, 40.0)
    last = network.head[-1]
    torch.nn.init.zeros_(last.weight)
    torch.nn.init.constant_(last.bias, -50.0)
    logits = last.bias.data[:54].view(6, 9)
    logits[0, 3] = 0.0  # at -10 cm
    logits[1, 3] = logits[1, 8] = 0.0  # at -10 and 40 cm alike
    logits[2] = 0.0  # anywhere
    last.bias.data[54:60] = 0.3
    last.bias.data[60:] = 2.0
    answer = network(torch.zeros(1, 5, 24, 32))
    torch.testing.assert_close(answer.points_cm[0, :3], torch.tensor([-10.0, 15.0, 0.0]), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(answer.sigma_cm[0], answer.sigma_cm[0, :1].repeat(6))
    assert SIGMA_RANGE_CM[0] < answer.sigma_cm[0, 0] < SIGMA_RANGE_CM[1]
    torch.testing.assert_close(answer.presence_logit, torch.full((1, 2), 2.0))
    assert LaneNet(NetworkSettings(takes_width=True), 96, 128).n_parameters <= 150_000


@pytest.mark.parametrize(("bias", "limit"), [(-1e3, SIGMA_RANGE_CM[0]), (1e3, SIGMA_RANGE_CM[1])])
def test_the_spread_stays_within_its_range(bias, limit):
    network = LaneNet(NetworkSettings(channels=(2,), hidden=4, bins=0), 24, 32).eval()
    network.head[-1].bias.data[6:12] = bias
    sigma = network(torch.zeros(1, 5, 24, 32)).sigma_cm
    torch.testing.assert_close(sigma, torch.full((1, 6), limit))


def test_deployed_outputs_follow_from_the_points():
    network = new_network(NetworkSettings(bins=0), 24, 32, 0).eval()
    network.mean_cm.copy_(torch.tensor([-20.0, -19.0, -17.0, 20.0, 22.0, 25.0]))
    rng = np.random.default_rng(0)
    raster = torch.from_numpy(np.where(rng.random((5, 5, 24, 32)) < 0.1, 255, 0).astype(np.uint8))
    with torch.inference_mode():
        deployed = (v.numpy() for v in DeployedLaneNet(network)(raster))
        points, sigma, presence, parabolas, centre, steering = deployed
        plain = network(input_of_rasters(raster))
    np.testing.assert_allclose(points, plain.points_cm.numpy(), atol=1e-5)
    np.testing.assert_allclose(sigma, plain.sigma_cm.numpy(), atol=1e-5)
    np.testing.assert_allclose(presence, 1.0 / (1.0 + np.exp(-plain.presence_logit.numpy())), atol=1e-6)
    np.testing.assert_allclose(parabolas, parabolas_from_points(points), atol=1e-4)
    np.testing.assert_allclose(centre[:, 0], (points[:, 1] + points[:, 4]) / 2.0, atol=1e-5)
    expected = [proportional_angle_rad(float(c), 15.0) for c in centre[:, 0]]
    np.testing.assert_allclose(steering[:, 0], expected, atol=1e-6)
    # The lane lies to the right here (centre 1.5 cm), and right is negative.
    assert (centre > 0).all() and (steering < 0).all()


def test_the_width_of_the_lane_is_an_input_of_its_own_and_may_be_unknown():
    network = new_network(
        NetworkSettings(channels=(4, 8), hidden=8, bins=0, takes_width=True), 24, 32, 0
    ).eval()
    raster = torch.rand(3, 5, 24, 32)
    with torch.inference_mode():
        unknown, zero = network(raster), network(raster, torch.zeros(1))
        narrow, mixed = (
            network(raster, torch.full((3,), 25.0)),
            network(raster, torch.tensor([25.0, 0.0, 50.0])),
        )
    assert torch.equal(unknown.points_cm, zero.points_cm)
    assert not torch.allclose(narrow.points_cm, unknown.points_cm)
    torch.testing.assert_close(mixed.points_cm[0], narrow.points_cm[0])
    torch.testing.assert_close(mixed.points_cm[1], unknown.points_cm[1])
    # Widths that differ by a tenth are told apart, all over the range, and it ends softly.
    widths = torch.arange(10.0, 150.0, 1.0)
    with torch.inference_mode():
        hidden = torch.stack([network(raster[:1], w.reshape(1)).points_cm[0] for w in widths])
    assert torch.isfinite(hidden).all()
    assert (hidden[1:] - hidden[:-1]).norm(dim=1)[5:100].min() > 0.0
    plain = new_network(NetworkSettings(channels=(4, 8), hidden=8, bins=0), 24, 32, 0).eval()
    with torch.inference_mode():
        assert torch.equal(plain(raster).points_cm, plain(raster, torch.full((3,), 25.0)).points_cm)
    with pytest.raises(ValueError, match="takes_width: alexnet"):
        NetworkSettings(kind="alexnet", takes_width=True)
    with pytest.raises(ValueError, match="bins: alexnet"):
        NetworkSettings(kind="alexnet", bins=32)
