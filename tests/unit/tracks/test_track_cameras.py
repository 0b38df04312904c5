"""Cameras of several drives: whether they agree, and how far apart they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_map import CAMERA

from datagen.tracks.cameras import DriveCamera, difference, same_lens

#: As a drive of two laps leaves them.
SIGMA = {
    "focal": 0.012,
    "cx": 0.6,
    "cy": 0.9,
    "k1": 0.005,
    "pitch": 0.01,
    "roll": 0.004,
    "yaw": 0.008,
    "lever": 0.06,
}


def found(camera=CAMERA, sigma=SIGMA) -> DriveCamera:
    return DriveCamera("drive", camera, sigma)


def test_cameras_within_their_sigmas_agree_and_one_that_was_knocked_does_not():
    near = CAMERA.with_mounting(pitch_down_rad=0.262, yaw_rad=0.005)
    assert difference(found(), found(near)).agree
    knocked = difference(found(), found(CAMERA.with_mounting(pitch_down_rad=0.25 + 0.06)))
    assert not knocked.agree
    assert knocked.worst == "pitch"
    assert knocked.sigmas["pitch"] == pytest.approx(0.06 / np.hypot(0.01, np.hypot(0.01, 0.001)), rel=1e-3)
    assert "pitch" in knocked.text


def test_differences_are_said_in_pixels_and_centimetres():
    # A principal point that is 2 px further to the right moves the whole image by 2 px.
    K = CAMERA.K.copy()
    K[0, 2] += 2.0
    off = difference(found(), found(replace(CAMERA, K=K)))
    assert off.image_px == pytest.approx(2.0, abs=1e-6)
    assert 0.2 < off.ground_cm < 5.0
    assert difference(found(), found()).ground_cm == pytest.approx(0.0, abs=1e-9)


def test_given_cameras_have_to_be_equal_but_for_the_last_digits():
    assert difference(found(sigma={}), found(sigma={})).agree
    assert not difference(found(sigma={}), found(CAMERA.with_mounting(pitch_down_rad=0.26), {})).agree


def test_images_of_another_size_are_of_another_camera():
    assert not same_lens([found(), found(replace(CAMERA, width=320))])
    assert same_lens([found(), found()])
