import pytest
import yaml
from pydantic import ValidationError

from lanenet.config import check_settings, dump_settings
from lanenet.errors import ConfigError
from lanenet.learn.config import LearnSettings, NetworkSettings
from lanenet.samples.settings import AugmentSettings


def test_hash_ignores_what_does_not_decide_the_result():
    assert (
        LearnSettings(threads=2, checkpoint_every=3, device="cpu", tensorboard=True).hash
        == LearnSettings().hash
    )
    assert LearnSettings(seed=1).hash != LearnSettings().hash
    assert LearnSettings.model_validate({"augment": {"mirror": 0.1}}).hash != LearnSettings().hash


@pytest.mark.parametrize("channels", [(), (0,), (8,) * 7])
def test_impossible_networks_are_refused(channels):
    with pytest.raises(ValidationError):
        NetworkSettings(channels=channels)


def test_a_single_bin_is_refused():
    with pytest.raises(ConfigError, match=r"network\.bins.*at least 2"):
        check_settings(LearnSettings, {"network": {"bins": 1}}, "x.yaml")
    assert NetworkSettings(bins=2).bins == 2


def test_alexnet_has_its_own_size_and_the_others_no_pretrained_weights():
    with pytest.raises(ConfigError, match="hidden: alexnet"):
        check_settings(LearnSettings, {"network": {"kind": "alexnet", "hidden": 8}}, "x.yaml")
    with pytest.raises(ConfigError, match="weights: small"):
        check_settings(LearnSettings, {"network": {"weights": "w.pth"}}, "x.yaml")


def test_an_unknown_network_is_named_with_those_that_there_are():
    with pytest.raises(ConfigError, match=r"network\.kind.*'smal'.*nano, small, base, alexnet"):
        check_settings(LearnSettings, {"network": {"kind": "smal"}}, "x.yaml")


def test_misspelt_nested_key_is_named():
    with pytest.raises(ConfigError, match=r"augment\.miror.*mirror"):
        check_settings(LearnSettings, {"augment": {"miror": 0.5}}, "x.yaml")


def test_a_preset_is_changed_by_the_keys_beside_it_and_written_out_as_values():
    data = {"augment": {"preset": "own_road", "objects": 3, "shift_cm": 1.0}}
    settings = check_settings(LearnSettings, data, "x.yaml")
    found, own = settings.augment, AugmentSettings.model_validate({"preset": "own_road"})
    assert (found.objects, found.shift_cm) == (3, 1.0) and (own.objects, own.shift_cm) == (0, 8.0)
    assert found.mirror == own.mirror == 0.0 and found.clutter_points == own.clutter_points == 10
    # What it does not name is as without it.
    assert own.jitter_cm == AugmentSettings().jitter_cm
    written = yaml.safe_load(dump_settings(settings))
    assert "preset" not in written["augment"] and written["augment"]["pitch_rad"] == 0.005
    again = check_settings(LearnSettings, written, "run.yaml")
    assert again == settings and again.hash == settings.hash
    assert data == {"augment": {"preset": "own_road", "objects": 3, "shift_cm": 1.0}}


def test_the_preset_none_changes_nothing():
    found = AugmentSettings.model_validate({"preset": "none", "mirror": 0.5}).model_dump(exclude={"draw"})
    assert {name for name, value in found.items() if value} == {"mirror"}


@pytest.mark.parametrize("name", ["own_raod", None, ["own_road"]])
def test_an_unknown_preset_is_named_with_those_that_there_are(name):
    with pytest.raises(
        ConfigError, match=r"x\.yaml: key 'augment': .*no preset .*expected one of own_road, none"
    ):
        check_settings(LearnSettings, {"augment": {"preset": name}}, "x.yaml")


def test_a_preset_is_checked_with_what_stands_beside_it():
    with pytest.raises(ConfigError, match="sum to at most 1"):
        check_settings(LearnSettings, {"augment": {"preset": "own_road", "missing_both": 0.96}}, "x.yaml")
