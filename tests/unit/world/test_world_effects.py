"""Each effect alone: off, it leaves no trace; on, it does what it says; and frames come in any order."""

from __future__ import annotations

import copy
from itertools import pairwise

import numpy as np
import pytest
from synthetic_roads import drive_frames, floor_pixels

from datagen.world.car.camera import CameraSettings
from datagen.world.render.appearance import Appearance, random_appearance
from datagen.world.render.compiled import FAR, NOT_FLOOR, TILE
from datagen.world.render.floor import ROW_INDICES, ROW_NUMBERS, SHADE, place_row, shade_row
from datagen.world.render.ground import TEXTURE_SIDE, Nearby, PixelGround, row_poses, shake_rotation
from datagen.world.render.renderer import Renderer
from datagen.world.render.sensor import Steps, Wander
from datagen.world.render.textures import PATTERN_BGR, floor_pattern, level_starts, pack_levels
from datagen.world.road.build import random_track
from datagen.world.road.track import Track
from datagen.world.road.track_settings import MarkingSettings, TrackSettings
from datagen.world.world import SimulationSettings

CAMERA = CameraSettings().build(26.0)
GROUND = PixelGround.of(CAMERA)
ROAD = TrackSettings(length_cm=700.0, left=MarkingSettings(), interruptions_per_m=0.0)
TRACK = random_track(ROAD, np.random.default_rng(1))
MOVING = (80.0, 0.9)
EFFECTS = {
    "verge_bgr": {"verge_bgr": (150.0, 120.0, 40.0)},
    "objects": {"objects_per_m": 2.0},
    "objects_on_road": {"objects_per_m": 4.0, "objects_on_road": 1.0},
    "shadows": {"shadows_per_m": 2.0},
    "exposure_drift": {"exposure_drift": 0.3},
    "exposure_step": {"exposure_step": 0.3},
    "white_balance_drift": {"white_balance_drift": 0.2},
    "white_balance_step": {"white_balance_step": 0.2},
    "exposure_s": {"exposure_s": 0.02},
    "readout_s": {"readout_s": 0.03},
    "shake_pitch_rad": {"shake_pitch_rad": 0.02},
    "shake_roll_rad": {"shake_roll_rad": 0.02},
} | {f"floor_{kind}": {"floor": kind, "texture_level": 8.0} for kind in PATTERN_BGR}
ALL = Appearance(
    floor="wood", texture_level=8.0, line_wear=0.5, lamps_per_m=1.0, clutter_per_m=3.0, wall_level=30.0,
    vignetting=0.3, blur_px=0.8, noise_level=4.0, jpeg_quality=80, verge_bgr=(150.0, 120.0, 40.0),
    objects_per_m=2.0, shadows_per_m=1.0, exposure_drift=0.2, exposure_step=0.2, white_balance_drift=0.1,
    white_balance_step=0.1, exposure_s=0.02, readout_s=0.03, shake_pitch_rad=0.01, shake_roll_rad=0.01,
)  # fmt: skip


def _renderer(track: Track = TRACK, camera=CAMERA, **look: object) -> Renderer:
    ground = GROUND if camera is CAMERA else None
    return Renderer(camera, track, Appearance(**look), np.random.default_rng(7), ground)


def _pose(s_cm: float = 150.0, offset_cm: float = 0.0) -> np.ndarray:
    xy, heading = TRACK.point(s_cm, offset_cm)
    return np.array([*xy, heading])


def _with_boxes(boxes: list[list[float]]) -> Track:
    track = copy.copy(TRACK)
    object.__setattr__(track, "boxes", np.array(boxes, dtype=np.float64).reshape(-1, 9))
    return track


PLAIN = _renderer().render(_pose(), 3)


@pytest.mark.parametrize("effect", sorted(EFFECTS))
def test_each_effect_shows_and_repeats(effect):
    look = EFFECTS[effect]
    shown = _renderer(**look).render(_pose(), 3, *MOVING)
    assert np.abs(shown.astype(int) - _renderer().render(_pose(), 3, *MOVING)).max() > 4
    np.testing.assert_array_equal(_renderer(**look).render(_pose(), 3, *MOVING), shown)


@pytest.mark.parametrize(
    "look",
    [
        {"exposure_s": 0.1, "readout_s": 0.1},  # the car stands
        {"shadows_per_m": 3.0, "shadow_depth": 0.0},
        {"floor": "grass"},  # without a level
        {"objects_on_road": 1.0, "drift_frames": 5.0},  # nothing to place, nothing that drifts
        {"verge_bgr": (70.0, 70.0, 70.0)},  # the floor's own colour
    ],
)
def test_what_has_no_effect_leaves_every_byte(look):
    np.testing.assert_array_equal(_renderer(**look).render(_pose(), 3), PLAIN)


def test_no_effect_changes_the_truth():
    settings = SimulationSettings(frames=3, random_look=False, camera=CameraSettings(width=64, height=48))
    plain = list(drive_frames(settings))
    frames = list(drive_frames(settings.model_copy(update={"look": ALL})))
    for a, b in zip(plain, frames, strict=True):
        np.testing.assert_array_equal(a.pose, b.pose)
        np.testing.assert_array_equal(a.points_cm, b.points_cm)
        assert np.abs(a.image_bgr.astype(int) - b.image_bgr).max() > 50


def test_frames_are_the_same_in_any_order():
    poses = [_pose(60.0 + 5.0 * i) for i in range(6)]
    one = Renderer(CAMERA, TRACK, ALL, np.random.default_rng(5), GROUND)
    other = Renderer(CAMERA, TRACK, ALL, np.random.default_rng(5))
    forward = [one.render(pose, i, *MOVING) for i, pose in enumerate(poses)]
    for i in (4, 0, 5, 2):
        np.testing.assert_array_equal(other.render(poses[i], i, *MOVING), forward[i])
    assert np.abs(one.render(poses[2], 100, *MOVING).astype(int) - forward[2]).max() > 10


def test_motion_widens_an_edge_by_the_way_of_the_exposure():
    xy, heading = TRACK.point(200.0)
    c, s = np.cos(heading), np.sin(heading)
    track = _with_boxes([[*xy, c, s, 10.0, 60.0, 235.0, 235.0, 235.0]])  # 20 cm along the road, all across
    rig = CameraSettings(model="pinhole", field_of_view_rad=0.9, pitch_down_rad=1.45, height_cm=20.0)
    camera = rig.build(26.0)
    pose = np.array([*(xy - np.array([c, s]) * (26.0 - 2.0 + 10.0 + 2.0)), heading])
    column = 160
    spread = []
    for exposure_s in (0.0, 0.02):
        image = _renderer(track, camera, exposure_s=exposure_s).render(pose, 0, 100.0)
        edge = np.abs(np.diff(image[:, column, 0].astype(float)))
        edge[np.abs(np.arange(len(edge)) - np.argmax(edge)) > 40] = 0.0
        rows = np.arange(len(edge))
        mean = rows @ edge / edge.sum()
        spread.append((rows - mean) ** 2 @ edge / edge.sum())
    # 2 cm, in pixels there; an even distribution of that width has a variance of a twelfth of its square.
    at = camera.project_ground(np.array([[0.0, 0.0], [0.0, 2.0]]) + [0.0, camera.intersect_ground(
        np.array([[160.0, 0.0 + mean]])
    )[0, 1] - 1.0])  # fmt: skip
    moved_px = np.linalg.norm(at[1] - at[0])
    assert moved_px > 10.0
    assert np.sqrt(12.0 * (spread[1] - spread[0])) == pytest.approx(moved_px, rel=0.05)


def test_each_row_shows_the_road_as_it_was_when_the_row_was_read():
    pose, speed, yaw_rate, readout_s = _pose(), 120.0, 1.5, 0.05
    skewed = _renderer(readout_s=readout_s, texture_level=8.0, wall_level=0.0).render(
        pose, 0, speed, yaw_rate
    )
    plain = _renderer(readout_s=0.0, texture_level=8.0)
    for row in (130, 180, 235):
        x, y, c, s = row_poses(240, pose[2], speed, yaw_rate, readout_s)[row]
        then = plain.render(np.array([pose[0] + x, pose[1] + y, np.arctan2(s, c)]), 0)
        difference = np.abs(skewed[row].astype(int) - then[row])[floor_pixels(GROUND)[row]]
        assert difference.max() <= 2 and difference.mean() < 0.1
        assert np.abs(skewed[row].astype(int) - plain.render(pose, 0)[row]).max() > 20 or row == 119


def test_rows_in_the_middle_belong_to_the_pose():
    rows = row_poses(3, 0.4, 50.0, 1.0, 0.02)
    np.testing.assert_allclose(rows[1], [0.0, 0.0, np.cos(0.4), np.sin(0.4)])
    np.testing.assert_allclose(np.linalg.norm(rows[2, :2]), 50.0 * 0.01, rtol=1e-4)
    np.testing.assert_allclose(np.arctan2(rows[2, 3], rows[2, 2]), 0.41)


@pytest.mark.parametrize(("pitch", "roll"), [(0.03, 0.0), (-0.02, 0.0), (0.0, 0.04)])
def test_shake_is_a_turned_camera(pitch, roll, monkeypatch):
    # About a level camera's own axes the car's pitch and roll are the mounting's.
    camera = CameraSettings(pitch_down_rad=0.0 if roll else 0.4).build(26.0)
    mounting = camera.mounting
    turned = camera.with_mounting(pitch_down_rad=mounting.pitch_down_rad + pitch, roll_rad=roll)
    monkeypatch.setattr(Renderer, "_shake_at", lambda *_: np.array([pitch, roll]))
    shaken = _renderer(camera=camera, joint_u_cm=20.0, joint_v_cm=20.0).render(_pose(), 0)
    monkeypatch.setattr(Renderer, "_shake_at", lambda *_: np.zeros(2))
    expected = _renderer(camera=turned, joint_u_cm=20.0, joint_v_cm=20.0).render(_pose(), 0)
    floor = floor_pixels(PixelGround.of(turned))
    assert floor.sum() > 20000
    assert np.abs(shaken.astype(int) - expected)[floor].max() <= 2
    np.testing.assert_allclose(
        shake_rotation(pitch, roll) @ shake_rotation(pitch, roll).T, np.eye(3), atol=1e-12
    )


def test_boxes_of_the_track_are_painted_where_they_lie():
    xy, heading = TRACK.point(230.0)
    box = [*xy, np.cos(heading), np.sin(heading), 3.0, 15.0, 235.0, 235.0, 235.0]
    image = _renderer(_with_boxes([box])).render(_pose(), 3).astype(int)
    changed = np.abs(image - PLAIN).max(axis=2) > 60
    points = CAMERA.intersect_ground(np.argwhere(changed)[:, ::-1].astype(float))
    pose = _pose()
    ahead, right = points[:, 1] + 26.0, points[:, 0]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = pose[0] + ahead * c + right * s - xy[0], pose[1] + ahead * s - right * c - xy[1]
    assert changed.sum() > 50
    assert np.abs(dx * box[2] + dy * box[3]).max() < 4.5
    assert np.abs(dy * box[2] - dx * box[3]).max() < 16.0


def test_verge_begins_at_the_outermost_lines():
    image = _renderer(verge_bgr=(200.0, 20.0, 20.0)).render(_pose(), 3)
    pixels = np.argwhere(floor_pixels(GROUND))[::7]
    points = CAMERA.intersect_ground(pixels[:, ::-1].astype(float)) + [0.0, 26.0]
    pose = _pose()
    c, s = np.cos(pose[2]), np.sin(pose[2])
    checked = {True: 0, False: 0}
    for (v, u), (right, ahead) in zip(pixels, points, strict=True):
        if np.hypot(right, ahead) > 120.0:
            continue
        _, offset = TRACK.nearest(pose[:2] + [ahead * c + right * s, ahead * s - right * c])
        if abs(abs(offset) - 20.0) > 3.0:
            beyond = abs(offset) > 20.0
            assert (image[v, u, 0] > 150) == beyond
            checked[beyond] += 1
    assert min(checked.values()) > 300


def test_shadows_only_darken_and_take_no_more_than_their_share():
    look = {"shadows_per_m": 3.0, "shadow_depth": 0.5, "floor_bgr": (160.0,) * 3}
    shaded = _renderer(**look).render(_pose(), 3).astype(int)
    plain = _renderer(floor_bgr=(160.0,) * 3).render(_pose(), 3).astype(int)
    assert (shaded <= plain).all() and (shaded >= 0.5 * plain - 1).all()
    moved = _renderer(**look).render(_pose(), 60).astype(int)
    assert (np.abs(moved - shaded).max(axis=2) > 10).sum() > 300


def test_exposure_and_white_balance_leave_green_to_the_exposure():
    look = {"white_balance_drift": 0.2, "white_balance_step": 0.1}
    renderer = _renderer(**look)
    for frame in (0, 40, 400):
        image = renderer.render(_pose(), frame)
        np.testing.assert_array_equal(image[..., 1], PLAIN[..., 1])
    stepping = _renderer(exposure_step=0.3, drift_frames=10.0)
    levels = {int(stepping.render(_pose(), frame)[235, 160, 1]) for frame in range(60)}
    assert 4 <= len(levels) <= 7  # constant in between


def test_variation_has_unit_variance_and_needs_no_order():
    frames = range(0, 40000, 7)
    wander = Wander(3, 10.0, 100.0, np.random.default_rng(0))
    values = np.array([wander.at(frame) for frame in frames])
    np.testing.assert_allclose(values.std(axis=0), 1.0, atol=0.1)
    assert np.abs(wander.at(50) - wander.at(51)).max() < 1.5
    steps = Steps(2, 20.0, np.random.default_rng(0))
    values = np.array([steps.at(frame) for frame in frames])
    np.testing.assert_allclose(values.std(axis=0), 1.0, atol=0.1)
    np.testing.assert_array_equal(values[5], Steps(2, 20.0, np.random.default_rng(0)).at(35))


@pytest.mark.parametrize("kind", sorted(PATTERN_BGR))
def test_patterns_have_unit_variance_and_repeat_without_a_seam(kind):
    pattern = floor_pattern(kind, 0.6, 1.0, np.random.default_rng(3))
    assert pattern.shape == (512, 512)
    assert abs(pattern.mean()) < 0.05 and pattern.std() == pytest.approx(1.0, abs=0.08)
    # Neighbours across the seam differ no more than neighbours anywhere, but for a joint that lies there.
    seam = np.median(np.abs(pattern[:, 0] - pattern[:, -1]))
    inside = np.median(np.abs(np.diff(pattern, axis=1)), axis=0)
    assert seam <= 1.5 * inside.max() + 0.05
    packed, starts = pack_levels(pattern), level_starts()
    assert len(packed) == starts[-1]
    spread = [packed[a:b].std() for a, b in pairwise(starts)]
    assert all(fine > coarse for fine, coarse in pairwise(spread))


def test_nearby_misses_nothing_in_sight_at_any_length():
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.uniform(-9000.0, 9000.0, (5000, 2)), np.arange(5000.0)])
    reach = rng.uniform(0.0, 40.0, 5000)
    nearby = Nearby(rows, reach, 250.0)
    for x, y in rng.uniform(-9000.0, 9000.0, (150, 2)):
        found, reaches = nearby.at(x, y)
        seen = np.hypot(rows[:, 0] - x, rows[:, 1] - y) < 250.0 + reach
        assert set(rows[seen, 2]) <= set(found[:, 2])
        assert len(found) == len(reaches) < 60
        assert (np.diff(found[:, 2]) > 0).all()
    assert len(nearby._cells) <= 64


def test_dark_paint_gets_a_light_floor():
    black, white = (25.0, 25.0, 25.0), (235.0, 235.0, 235.0)
    for seed in range(40):
        free = random_appearance(Appearance(), np.random.default_rng(seed))
        only_black = random_appearance(Appearance(), np.random.default_rng(seed), (black,))
        both = random_appearance(Appearance(), np.random.default_rng(seed), (black, white))
        assert np.mean(only_black.floor_bgr) - 25.0 >= 55.0
        assert np.mean(both.floor_bgr) - 25.0 >= 55.0 and 235.0 - np.mean(both.floor_bgr) >= 55.0
        # Paint has a say in how light the floor is and how dull the paint, and in nothing else.
        paint = {"line_brightness": free.line_brightness}
        assert only_black.model_copy(update={"floor_bgr": free.floor_bgr, **paint}) == free
        only_white = random_appearance(Appearance(), np.random.default_rng(seed), (white,))
        assert only_white.model_copy(update=paint) == free


@pytest.mark.parametrize("width", [50, 96])
def test_any_width_is_drawn_to_its_last_column(width):
    camera = CameraSettings(width=width, height=37).build(26.0)
    image = _renderer(camera=camera, texture_level=5.0).render(_pose(), 0)
    assert image.shape == (37, width, 3)
    assert image[30:, -1].min() > 30


@pytest.mark.parametrize("motion_cm", [0.0, 0.4, 1.2, 4.0, 20.0])
def test_a_row_of_pixels_takes_the_same_pattern_as_each_of_them_alone(motion_cm):
    rng = np.random.default_rng(3)
    starts, cj, sj = level_starts(), np.cos(0.7), np.sin(0.7)
    texture = pack_levels(rng.standard_normal((TEXTURE_SIDE, TEXTURE_SIDE)))
    row, index = np.zeros(ROW_NUMBERS), np.zeros(ROW_INDICES, np.int64)
    for fits in (0, 2, 5, FAR + 1):
        numbers = rng.uniform(-300.0, 300.0, 8 * TILE).astype(np.float32)
        numbers[6 * TILE :] = motion_cm
        alike, mixed = np.full(TILE, fits, np.uint8), np.full(TILE, fits, np.uint8)
        mixed[-1] = NOT_FLOOR
        shades = []
        for seen in (alike, mixed):  # the quick way for neighbours of one level, and one by one
            place_row(seen, numbers, 2000.0, -700.0, cj, sj, row, index)
            shade_row(seen, numbers, texture, starts, 7.0, cj, sj, row, index)
            shades.append(row[SHADE : SHADE + TILE - 1].copy())
        np.testing.assert_array_equal(shades[0], shades[1])
        assert np.abs(shades[0]).max() > 0.01
