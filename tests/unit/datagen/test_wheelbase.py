"""The wheelbase that mapping and calibration work with: given, the camera's own, or nominal and said so."""

from __future__ import annotations

import inspect

import numpy as np
import pytest

from datagen.settings import MapSettings, with_wheelbase
from datagen.slam.camera.coarse import guessed_camera
from lanenet.cli.map import map_drive
from lanenet.config import dump_settings, load_settings

CAMERA = guessed_camera(160, 120, 80.0, 15.0, MapSettings().guess)

NOMINAL = (
    "the wheelbase is a nominal 17 cm; give the car's with --wheelbase or guess.wheelbase_cm if it is another"
)


def test_a_wheelbase_that_nobody_gave_is_nominal_and_said_so():
    settings, camera, notes = with_wheelbase(MapSettings(), None, None)
    assert settings == MapSettings() and camera is None
    assert notes == (NOMINAL,)


def test_settings_that_were_saved_in_full_do_not_make_a_nominal_wheelbase_known(tmp_path):
    path = tmp_path / "settings.yaml"
    path.write_text(dump_settings(MapSettings()), encoding="utf-8")
    saved = load_settings(MapSettings, path)
    assert "wheelbase_cm" in saved.guess.model_fields_set
    _, _, notes = with_wheelbase(saved, None, None)
    assert notes == (NOMINAL,)
    assert with_wheelbase(saved, None, 17.0)[2] == ()


def test_a_wheelbase_of_the_settings_or_the_camera_is_not_nominal():
    told = MapSettings.model_validate({"guess": {"wheelbase_cm": 26.0}})
    assert with_wheelbase(told, None, None) == (told, None, ())
    assert with_wheelbase(MapSettings(), CAMERA, None) == (MapSettings(), CAMERA, ())


@pytest.mark.parametrize("wheelbase_cm", [17.0, 26.0])
def test_a_given_wheelbase_goes_before_all_others(wheelbase_cm):
    settings, camera, notes = with_wheelbase(MapSettings(), CAMERA, wheelbase_cm)
    assert settings.guess.wheelbase_cm == wheelbase_cm and notes == ()
    assert camera is not None and camera.wheelbase_cm == wheelbase_cm
    # The lens stays where it is over the front axle.
    assert camera.mounting == CAMERA.mounting
    np.testing.assert_array_equal(camera.K, CAMERA.K)
    guessed, none, _ = with_wheelbase(MapSettings(), None, wheelbase_cm)
    assert none is None and guessed == settings


def test_map_can_be_told_the_wheelbase():
    assert "wheelbase" in inspect.signature(map_drive).parameters
