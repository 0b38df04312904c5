"""Specks, prints, glints, stains and cracks: where they lie, and that they leave the lines alone."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.world.car.camera import CameraSettings
from datagen.world.render.appearance import Appearance, random_appearance
from datagen.world.render.ground import PixelGround
from datagen.world.render.renderer import Renderer
from datagen.world.render.scene import build_scene, glints, prints, specks
from datagen.world.render.textures import cracks, stains
from datagen.world.road.build import random_track
from datagen.world.road.track_settings import TrackSettings

TRACK = random_track(TrackSettings(length_cm=900.0), np.random.default_rng(2))
CAMERA = CameraSettings(width=160, height=120).build(26.0)
GROUND = PixelGround.of(CAMERA)
POSES = [np.array([*TRACK.point(s)[0], TRACK.point(s)[1]]) for s in (150.0, 300.0, 450.0, 600.0)]


def _frames(**look: object) -> np.ndarray:
    renderer = Renderer(CAMERA, TRACK, Appearance(**look), np.random.default_rng(4), GROUND)
    return np.stack([renderer.render(pose, i) for i, pose in enumerate(POSES)])


@pytest.mark.parametrize(
    ("off", "on"),
    [
        ({}, {"specks_per_m": 20.0}),
        ({}, {"prints_per_m": 8.0}),
        ({}, {"glints_per_m": 10.0}),
        ({"texture_level": 3.0}, {"texture_level": 3.0, "stain_level": -30.0}),
        ({"texture_level": 3.0}, {"texture_level": 3.0, "crack_level": 60.0}),
        (
            {"floor": "wood", "texture_level": 3.0},
            {"floor": "wood", "texture_level": 3.0, "crack_level": 60.0},
        ),
        ({"lamps_per_m": 6.0}, {"lamps_per_m": 6.0, "lamp_size": 0.4}),
    ],
)
def test_each_mark_shows_and_repeats(off, on):
    shown = _frames(**on)
    assert np.abs(shown.astype(int) - _frames(**off)).max() > 10
    np.testing.assert_array_equal(_frames(**on), shown)


def test_one_part_of_the_scene_does_not_move_another():
    look = Appearance(texture_level=4.0, lamps_per_m=2.0, clutter_per_m=3.0, objects_per_m=2.0)
    marks = {"specks_per_m": 9.0, "prints_per_m": 3.0, "glints_per_m": 4.0, "stain_level": 20.0}
    plain = build_scene(TRACK, look, np.random.default_rng(1))
    more = build_scene(TRACK, look.model_copy(update=marks), np.random.default_rng(1))
    np.testing.assert_array_equal(more.lamps[: len(plain.lamps)], plain.lamps)
    np.testing.assert_array_equal(more.room, plain.room)
    np.testing.assert_array_equal(more.wear, plain.wear)
    np.testing.assert_array_equal(more.objects.solids, plain.objects.solids)
    assert len(more.clutter) > len(plain.clutter) and len(more.lamps) > len(plain.lamps)
    rows = {tuple(row) for row in more.clutter.tolist()}
    assert rows.issuperset(map(tuple, plain.clutter.tolist()))


def test_prints_keep_clear_of_all_lines():
    boxes = prints(TRACK, 20.0, np.random.default_rng(5))
    assert len(boxes) > 50
    outermost = max(abs(m.offset_cm) + 0.5 * m.width_cm for m in TRACK.markings)
    for x, y, c, s, half_a, half_b in boxes[:, :6].tolist():
        for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0)):
            corner = np.array([x + a * half_a * c - b * half_b * s, y + a * half_a * s + b * half_b * c])
            gap = corner - TRACK.xy_cm
            assert np.hypot(gap[:, 0], gap[:, 1]).min() > outermost + 2.0


def test_specks_are_small_and_differ_from_the_floor():
    found = specks(TRACK, 50.0, (70.0, 70.0, 70.0), np.random.default_rng(6))
    assert 300 < len(found) < 600
    assert found[:, 4:6].max() <= 1.6 and found[:, 4:6].min() >= 0.2
    assert np.abs(found[:, 6:].mean(axis=1) - 70.0).min() > 12.0


def test_glints_are_lower_than_lamps_and_small():
    found = glints(TRACK, 5.0, np.random.default_rng(7))
    assert len(found) > 25
    assert found[:, 2].min() >= 25.0 and found[:, 2].max() <= 200.0
    assert found[:, 3].max() <= 0.036


def test_patterns_of_stains_and_cracks_are_shares():
    for seed in range(3):
        spots, lines = stains(np.random.default_rng(seed)), cracks(np.random.default_rng(seed))
        for pattern in (spots, lines):
            assert pattern.min() >= 0.0 and pattern.max() <= 1.0
        assert 0.01 < spots.mean() < 0.3 and 0.0005 < lines.mean() < 0.05


def test_random_looks_draw_marks_on_some_drives_only():
    looks = [random_appearance(Appearance(), np.random.default_rng(seed)) for seed in range(200)]
    for name in ("specks_per_m", "stain_level", "crack_level", "prints_per_m", "glints_per_m"):
        share = np.mean([getattr(look, name) != 0.0 for look in looks])
        assert 0.15 < share < 0.65, name
    assert all(look.texture_level > 0.0 for look in looks)


def test_dull_paint_still_stands_out_from_the_floor():
    white, black = (230.0, 230.0, 230.0), (30.0, 30.0, 30.0)
    dull = 0
    for seed in range(200):
        look = random_appearance(Appearance(), np.random.default_rng(seed), (white,))
        paint = 230.0 * look.line_brightness
        assert paint >= min(look.floor_bgr[1] + 45.0, 230.0 * 0.85) - 1e-6
        dull += look.line_brightness < 0.85
        dark = random_appearance(Appearance(), np.random.default_rng(seed), (black,))
        assert dark.line_brightness >= 0.85
    assert 40 < dull < 110
