"""Frames against the geometry that they were drawn from, and effects against the truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_roads import floor_pixels, line_xy, mirror_track, move_track

from datagen.world.car.camera import CameraSettings
from datagen.world.render.appearance import Appearance, random_appearance
from datagen.world.render.compiled import edge_share, painted_share
from datagen.world.render.floor import locate
from datagen.world.render.ground import PixelGround
from datagen.world.render.light import mirror_lamps
from datagen.world.render.renderer import Renderer
from datagen.world.render.scene import build_scene
from datagen.world.road.build import random_track
from datagen.world.road.track import Track
from datagen.world.road.track_settings import MarkingSettings, TrackSettings
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import car_from_map

CAMERA = CameraSettings().build(26.0)
GROUND = PixelGround.of(CAMERA)
FLOOR, PAINT = 70.0, 235.0
ROAD = TrackSettings(length_cm=700.0, left=MarkingSettings(), interruptions_per_m=0.0)
EFFECTS = {
    "texture_level": 8.0,
    "joint_u_cm": 30.0,
    "line_wear": 0.6,
    "lamps_per_m": 3.0,
    "clutter_per_m": 5.0,
    "wall_level": 30.0,
    "exposure": 0.8,
    "white_balance": (0.9, 1.0, 1.1),
    "vignetting": 0.4,
    "blur_px": 1.0,
    "noise_level": 4.0,
    "jpeg_quality": 60,
}


def _road(seed: int) -> Track:
    return random_track(ROAD, np.random.default_rng(seed))


def _renderer(track: Track, **look: object) -> Renderer:
    return Renderer(CAMERA, track, Appearance(**look), np.random.default_rng(7), GROUND)


def _pose(track: Track, s_cm: float, offset_cm: float = 0.0, turn_rad: float = 0.0) -> np.ndarray:
    xy, heading = track.point(s_cm, offset_cm)
    return np.array([*xy, heading + turn_rad])


def _crossings(curve_px: np.ndarray, axis: int, cut: int) -> np.ndarray:
    """Where a projected curve crosses pixel row (axis 1) or column (axis 0) ``cut``."""
    with np.errstate(invalid="ignore"):
        d = curve_px[:, axis] - cut
        k = np.flatnonzero(d[:-1] * d[1:] <= 0.0)
    t = d[k] / (d[k] - d[k + 1])
    return curve_px[k, 1 - axis] * (1.0 - t) + curve_px[k + 1, 1 - axis] * t


def _centroid_errors(camera: Camera, track: Track, image: np.ndarray, pose: np.ndarray, sign: float):
    """Painted centroid minus the projected middle, and minus the middle of the projected borders, [px]."""
    share = (image[..., 0].astype(float) - FLOOR) / (PAINT - FLOOR)
    normal = np.stack([-np.sin(track.heading_rad), np.cos(track.heading_rad)], axis=1)
    offset_lines = [
        car_from_map(track.xy_cm + offset * normal, pose, camera.wheelbase_cm)
        for offset in (sign * 20.0, sign * 20.0 + 1.0, sign * 20.0 - 1.0)
    ]
    near = np.hypot(*offset_lines[0].T) < 120.0
    middle, outer, inner = (camera.project_ground(line[near]) for line in offset_lines)
    tangent = np.gradient(middle, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = outer - inner
    width = np.abs(across[:, 0] * tangent[:, 1] - across[:, 1] * tangent[:, 0])
    to_middle, to_borders = [], []
    for k in np.flatnonzero(width[:-1] >= 2.0):
        axis = 1 if abs(tangent[k, 1]) >= abs(tangent[k, 0]) else 0
        low, high = sorted((middle[k, axis], middle[k + 1, axis]))
        for cut in range(int(np.ceil(low)), int(np.floor(high)) + 1):
            if not 0 <= cut < share.shape[1 - axis]:
                continue
            profile = share[cut] if axis == 1 else share[:, cut]
            expected = _crossings(middle[k : k + 2], axis, cut)
            if not expected.size or not 14 < expected[0] < len(profile) - 15:
                continue
            window = np.arange(round(expected[0]) - 12, round(expected[0]) + 13)
            values = profile[window]
            borders = [_crossings(line, axis, cut) for line in (outer, inner)]
            if values[0] > 0.0 or values[-1] > 0.0 or not all(b.size == 1 for b in borders):
                continue
            centroid = values @ window / values.sum()
            to_middle.append(centroid - expected[0])
            to_borders.append(centroid - 0.5 * (borders[0][0] + borders[1][0]))
    return to_middle, to_borders


def test_painted_lines_lie_where_the_camera_model_puts_them():
    to_middle, to_borders = [], []
    for seed in range(3):
        track = _road(seed)
        renderer = _renderer(track)
        for s, offset, turn in ((60.0, 0.0, 0.0), (200.0, 5.0, 0.2), (330.0, -5.0, -0.2)):
            pose = _pose(track, s, offset, turn)
            for sign in (1.0, -1.0):
                a, b = _centroid_errors(CAMERA, track, renderer.render(pose), pose, sign)
                to_middle += a
                to_borders += b
    assert len(to_middle) > 1000
    assert np.median(np.abs(to_middle)) <= 0.1
    assert np.max(np.abs(to_middle)) <= 0.3
    # The rest of that error is perspective: the middle of the borders is met much closer.
    assert np.median(np.abs(to_borders)) <= 0.01
    assert np.max(np.abs(to_borders)) <= 0.06
    assert abs(np.mean(to_borders)) <= 0.003


def test_pinhole_and_tilted_cameras_are_met_too():
    rig = CameraSettings(
        model="pinhole", width=160, height=120, field_of_view_rad=1.9, distortion=(-0.05, 0.0, 0.0, 0.0),
        height_cm=14.0, pitch_down_rad=0.4, roll_rad=0.05, yaw_rad=-0.04, right_of_centre_cm=1.5,
    )  # fmt: skip
    camera, track = rig.build(20.0), _road(1)
    renderer = Renderer(camera, track, Appearance(), np.random.default_rng(0))
    errors: list[float] = []
    for s in (60.0, 150.0, 260.0, 350.0):
        pose = _pose(track, s)
        for sign in (1.0, -1.0):
            errors += _centroid_errors(camera, track, renderer.render(pose), pose, sign)[1]
    assert len(errors) > 50
    assert np.max(np.abs(errors)) <= 0.08


def test_fisheye_spans_the_stated_field_of_view():
    half = np.deg2rad(85.0)
    edge = CAMERA.project_rays(np.array([[np.sin(half), 0.0, np.cos(half)]]))[0]
    np.testing.assert_allclose(edge, [159.5 + 160.0, 119.5], atol=1e-9)
    assert CAMERA.K[0, 0] == pytest.approx(107.8, abs=0.1)
    with pytest.raises(ConfigError, match="field_of_view_rad"):
        CameraSettings(model="pinhole", field_of_view_rad=3.2).build(26.0)


@given(d=st.floats(-3.0, 3.0), a=st.floats(0.01, 2.0), b=st.floats(0.01, 2.0))
def test_edge_share_is_the_area_behind_an_edge(d, a, b):
    # The distance over the pixel is d + a u + b v with u, v in +-0.5: count a fine grid.
    u = (np.arange(100) + 0.5) / 100.0 - 0.5
    counted = np.mean(d + a * u[:, None] + b * u[None, :] > 0.0)
    assert edge_share(d, (a, b, 0.0)) == pytest.approx(counted, abs=0.012)
    assert edge_share(d, (a, b, 0.0)) == edge_share(d, (-b, a, 0.0))
    assert edge_share(d, (a, b, 0.0)) + edge_share(-d, (a, b, 0.0)) == pytest.approx(1.0)


def test_dashes_are_painted_with_their_length():
    stretches = np.array([[10.0, 30.0], [50.0, 70.0], [90.0, 110.0]])
    s = np.arange(0.0, 120.0, 0.25)
    share = np.array([painted_share(x, (0.8, 0.3, 0.0), stretches, 0, 3) for x in s])
    assert share.sum() * 0.25 == pytest.approx(60.0, abs=1e-6)
    assert share[s == 20.0] == 1.0 and share[s == 40.0] == 0.0 and share[s == 50.0] == pytest.approx(0.5)


def test_dashes_and_interruptions_appear_where_the_track_has_them():
    road = TrackSettings(
        length_cm=700.0,
        left=MarkingSettings(kind="dashed", dash_cm=12.0, gap_cm=9.0),
        interruptions_per_m=0.5,
        max_interruption_cm=20.0,
    )
    checked = {True: 0, False: 0}
    for seed in range(4):
        track = random_track(road, np.random.default_rng(seed))
        pose = _pose(track, 150.0)
        image = _renderer(track).render(pose)
        for side, marking in zip(("left", "right"), track.markings, strict=True):
            line = car_from_map(line_xy(track, side)[150:240], pose, 26.0)
            ends = marking.painted_cm.ravel()
            for s, (u, v) in zip(track.s_cm[150:240], CAMERA.project_ground(line), strict=True):
                # Half a centimetre is more than a pixel here; ends of the paint are left out by 1.5 cm.
                near_end = np.min(np.abs(ends - s)) < 1.5
                if near_end or not (2 < u < 317 and 130 < v < 237):
                    continue
                painted = bool(((marking.painted_cm[:, 0] < s) & (s < marking.painted_cm[:, 1])).any())
                assert (image[round(v), round(u)].max() > 150) == painted, (seed, side, s)
                checked[painted] += 1
    assert checked[True] > 60 and checked[False] > 25


def test_moving_the_world_moves_nothing_in_the_image():
    track = _road(2)
    pose = _pose(track, 150.0, 3.0)
    moved = move_track(track, np.array([120.0, -40.0, 1.3]))
    c, s = np.cos(1.3), np.sin(1.3)
    there = np.array([c * pose[0] - s * pose[1] + 120.0, s * pose[0] + c * pose[1] - 40.0, pose[2] + 1.3])
    a, b = _renderer(track).render(pose).astype(int), _renderer(moved).render(there).astype(int)
    assert np.abs(a - b)[floor_pixels(GROUND)].max() <= 1


def test_mirrored_road_gives_the_mirrored_image():
    track = _road(0)
    pose = _pose(track, 150.0, 3.0, 0.1)
    image = _renderer(track).render(pose)
    mirrored = _renderer(mirror_track(track)).render(pose * [1.0, -1.0, -1.0])
    floor = floor_pixels(GROUND) & floor_pixels(GROUND)[:, ::-1]
    assert np.abs(image.astype(int) - mirrored[:, ::-1].astype(int))[floor].max() <= 1
    assert (image[floor] > 150).any()


def test_loop_is_painted_without_a_seam():
    road = ROAD.model_copy(update={"closed": True, "length_cm": 900.0})
    track = random_track(road, np.random.default_rng(0))
    for s in (845.0, 850.3, 856.7):
        pose = _pose(track, s)
        image = _renderer(track).render(pose)
        # The seam lies some 20 cm ahead of the front axle: paint is full on both sides and across.
        ahead = (np.arange(-15, 15) + len(track.s_cm)) % len(track.s_cm)
        for side in ("left", "right"):
            line = CAMERA.project_ground(car_from_map(line_xy(track, side)[ahead], pose, 26.0))
            seen = np.rint(line).astype(int)
            assert ((seen > 0) & (seen < [319, 239])).all()
            assert min(image[v, u].min() for u, v in seen) == PAINT


def test_place_along_the_road_agrees_with_the_track():
    rng = np.random.default_rng(0)
    for closed in (False, True):
        road = ROAD.model_copy(update={"closed": closed, "length_cm": 900.0})
        track = random_track(road, np.random.default_rng(1))
        renderer = _renderer(track)
        for s, offset in zip(rng.uniform(2.0, 898.0, 200), rng.uniform(-25.0, 25.0, 200), strict=True):
            xy, heading = track.point(s, offset)
            guess = (int(s / track.step_cm) + int(rng.integers(-3, 4))) % len(track.s_cm)
            found = locate(xy[0], xy[1], renderer._road.nodes, closed, guess)
            near = (found[0] - s + 450.0) % 900.0 - 450.0 if closed else found[0] - s
            assert abs(near) < 0.01
            assert found[1] == pytest.approx(offset, abs=0.005)
            np.testing.assert_allclose(found[2:4], [np.cos(heading), np.sin(heading)], atol=2e-4)


def test_lines_keep_their_place_under_every_effect():
    """The painted middle, found by correlation with the clean frame, stays within half a pixel."""
    track = _road(1)
    pose = _pose(track, 150.0)
    clean = _renderer(track).render(pose)
    full = _renderer(track, **{**EFFECTS, "clutter_per_m": 0.0, "lamps_per_m": 0.0}).render(pose)
    lower = slice(110, 240)
    shift, _ = cv2.phaseCorrelate(clean[lower, :, 0].astype(np.float64), full[lower, :, 0].astype(np.float64))
    assert np.hypot(*shift) < 0.5


@pytest.mark.parametrize("effect", sorted(EFFECTS))
def test_each_effect_shows(effect):
    track = _road(1)
    pose = _pose(track, 150.0)
    changed = _renderer(track, **{effect: EFFECTS[effect]}).render(pose).astype(int)
    assert np.abs(changed - _renderer(track).render(pose)).max() > 2


def test_switching_one_effect_off_leaves_the_others():
    track = _road(1)
    pose = _pose(track, 150.0)
    names = ("clutter_per_m", "texture_level")
    both = _renderer(track, **{n: EFFECTS[n] for n in names}).render(pose).astype(int)
    one = _renderer(track, clutter_per_m=EFFECTS["clutter_per_m"]).render(pose).astype(int)
    things = np.abs(one - _renderer(track).render(pose)).max(axis=2) > 60
    assert things.sum() > 100
    # Where clutter covers the floor whole, the texture under it changes nothing.
    core = cv2.erode(things.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    assert core.any()
    assert np.abs(both - one)[core].max() <= 1


def test_noise_depends_on_the_frame_and_not_on_the_order():
    track = _road(0)
    first, second = _renderer(track, noise_level=5.0), _renderer(track, noise_level=5.0)
    pose = _pose(track, 100.0)
    ninth = first.render(pose, 9)
    second.render(pose, 3)
    np.testing.assert_array_equal(second.render(pose, 9), ninth)
    assert (first.render(pose, 10) != ninth).mean() > 0.5
    flat = ninth[230:, 150:170].astype(float)
    assert flat.std() == pytest.approx(5.0, rel=0.2)


def test_lamps_wander_as_a_mirror_would_have_it():
    track = _road(0)
    lamps = build_scene(track, Appearance(lamps_per_m=2.0), np.random.default_rng(7)).lamps
    pose = _pose(track, 200.0)
    # Equal angles: the ray through the spot, mirrored in the floor, meets the lamp.
    eye = np.array([*(pose[:2] + 24.0 * np.array([np.cos(pose[2]), np.sin(pose[2])])), 20.0])
    spots = mirror_lamps(lamps, eye, 120.0, 250.0)
    for spot in spots:
        ray = np.array([*spot[:2], 0.0]) - eye
        ray[2] = -ray[2]
        heights = lamps[:, 2] / ray[2]
        met = spot[:2] + heights[:, None] * ray[:2]
        assert np.min(np.linalg.norm(met - lamps[:, :2], axis=1)) < 1e-6
    assert len(spots) > 0


def test_random_looks_differ_keep_contrast_and_respect_fixed_values():
    looks = [random_appearance(Appearance(), np.random.default_rng(seed)) for seed in range(60)]
    gray = [float(np.mean(look.floor_bgr)) for look in looks]
    assert min(gray) < 60.0 and max(gray) > 130.0
    for look, floor in zip(looks, gray, strict=True):
        assert PAINT * look.line_brightness - floor > 35.0
    fixed = random_appearance(Appearance(noise_level=0.0, blur_px=0.0), np.random.default_rng(5))
    free = random_appearance(Appearance(), np.random.default_rng(5))
    assert (fixed.noise_level, fixed.blur_px) == (0.0, 0.0)
    assert fixed.model_copy(update={"noise_level": free.noise_level, "blur_px": free.blur_px}) == free
