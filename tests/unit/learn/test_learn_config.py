import pytest
from pydantic import ValidationError

from lanenet.config import check_settings
from lanenet.errors import ConfigError
from lanenet.learn.config import LearnSettings, NetworkSettings


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


def test_alexnet_has_its_own_size_and_the_others_no_pretrained_weights():
    with pytest.raises(ConfigError, match="alexnet has a size of its own"):
        check_settings(LearnSettings, {"network": {"kind": "alexnet", "hidden": 8}}, "x.yaml")
    with pytest.raises(ConfigError, match="weights are for alexnet"):
        check_settings(LearnSettings, {"network": {"weights": "w.pth"}}, "x.yaml")


def test_misspelt_nested_key_is_named():
    with pytest.raises(ConfigError, match=r"augment\.miror.*mirror"):
        check_settings(LearnSettings, {"augment": {"miror": 0.5}}, "x.yaml")
