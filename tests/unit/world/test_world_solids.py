"""Things above the floor: against rays that are marched step by step, and where they may stand."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from datagen.world.car.camera import CameraSettings
from datagen.world.render.appearance import Appearance
from datagen.world.render.ground import Nearby
from datagen.world.render.renderer import Renderer
from datagen.world.render.scene import place_objects
from datagen.world.render.solids import BOX, CONE, CYLINDER, SOLID_COLUMNS
from datagen.world.road.build import random_track
from datagen.world.road.track_settings import TrackSettings
from lanenet.geometry.camera import Camera

TRACK = random_track(TrackSettings(length_cm=900.0), np.random.default_rng(2))
POSE = np.array([*TRACK.point(200.0)[0], TRACK.point(200.0)[1]])
STILL = [0.0, 0.0, 1.0, 0.0]
RED = (20.0, 20.0, 200.0)
FISHEYE = CameraSettings(width=160, height=120).build(26.0)


def _solid(ahead, right, half_a, half_b, bottom, top, shape, turn=0.3):
    """A solid beside the car, from its rear axle."""
    c, s = np.cos(POSE[2]), np.sin(POSE[2])
    at = POSE[:2] + [ahead * c + right * s, ahead * s - right * c]
    direction = [np.cos(POSE[2] + turn), np.sin(POSE[2] + turn)]
    return [*at, *direction, half_a, half_b, bottom, top, shape, *RED, *RED, 0.0, 0.0, *STILL]


def _render(camera: Camera, solids: list[list[float]], pose=POSE, motion=(0.0, 0.0), **look) -> np.ndarray:
    renderer = Renderer(camera, TRACK, Appearance(**look), np.random.default_rng(0))
    rows = np.array(solids).reshape(-1, SOLID_COLUMNS + 4)
    renderer._solids = Nearby(rows, np.full(len(rows), 100.0), 450.0)
    return renderer.render(pose, 0, *motion)


def _marched(camera: Camera, solid: list[float]) -> np.ndarray:
    """Mask of the pixels whose ray comes into the solid before it meets the floor."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    rays = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=1)) @ camera.mounting.camera_from_car
    right, ahead, height = camera.mounting.position_car_cm + [0.0, camera.wheelbase_cm, 0.0]
    c, s = np.cos(POSE[2]), np.sin(POSE[2])
    eye = np.array([POSE[0] + ahead * c + right * s, POSE[1] + ahead * s - right * c, height])
    ray = np.stack([rays[:, 1] * c + rays[:, 0] * s, rays[:, 1] * s - rays[:, 0] * c, rays[:, 2]], axis=1)
    hit = np.zeros(len(ray), bool)
    for t in np.arange(0.5, 160.0, 0.2):
        p = eye + t * ray
        dx, dy = p[:, 0] - solid[0], p[:, 1] - solid[1]
        inside = (p[:, 2] >= max(solid[6], 0.0)) & (p[:, 2] <= solid[7])
        if solid[8] == BOX:
            inside &= np.abs(dx * solid[2] + dy * solid[3]) <= solid[4]
            inside &= np.abs(dy * solid[2] - dx * solid[3]) <= solid[5]
        else:
            share = (solid[7] - p[:, 2]) / (solid[7] - solid[6]) if solid[8] == CONE else 1.0
            inside &= np.hypot(dx, dy) <= solid[4] * share
        hit |= inside
    return hit.reshape(camera.height, camera.width)


SOLIDS = {
    "low box, seen from above": (70.0, -12.0, 9.0, 6.0, 0.0, 8.0, BOX),
    "tall box": (75.0, 15.0, 8.0, 14.0, 0.0, 45.0, BOX),
    "wall beside the car": (40.0, 35.0, 60.0, 2.0, 0.0, 30.0, BOX, 0.05),
    "cabin that floats": (65.0, -5.0, 9.0, 7.0, 9.0, 15.0, BOX),
    "sign above the eye": (80.0, 0.0, 4.0, 20.0, 30.0, 45.0, BOX),
    "leg": (60.0, 10.0, 6.0, 6.0, 0.0, 90.0, CYLINDER),
    "bottle": (60.0, -10.0, 5.0, 5.0, 0.0, 12.0, CYLINDER),
    "cone": (62.0, 8.0, 7.0, 7.0, 0.0, 25.0, CONE),
    "low cone": (60.0, -3.0, 6.0, 6.0, 0.0, 10.0, CONE),
    "behind the car": (-40.0, 30.0, 10.0, 10.0, 0.0, 40.0, BOX),
}
LENSES = {
    "fisheye": FISHEYE,
    "wide": CameraSettings(width=160, height=120, field_of_view_rad=np.deg2rad(190.0), roll_rad=0.1).build(
        26.0
    ),
    "pinhole": CameraSettings(
        model="pinhole", width=120, height=90, field_of_view_rad=1.6, yaw_rad=0.2, right_of_centre_cm=3.0
    ).build(26.0),
}


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("name", SOLIDS)
def test_a_solid_covers_exactly_the_pixels_whose_rays_meet_it(name, lens):
    camera, solid = LENSES[lens], _solid(*SOLIDS[name])
    covered = _marched(camera, solid)
    empty, image = _render(camera, []).astype(int), _render(camera, [solid]).astype(int)
    change = np.abs(image - empty).max(axis=2)
    cross = np.ones((3, 3), np.uint8)
    core = cv2.erode(covered.astype(np.uint8), cross, borderValue=1).astype(bool)
    around, further = (cv2.dilate(covered.astype(np.uint8), cross, iterations=n).astype(bool) for n in (1, 2))
    assert covered.sum() > 10 or name == "behind the car"
    # Nothing shines through: red, whatever was there.
    assert (image[core][:, 2] > 100).all() and (image[core][:, 0] < 60).all()
    # Nothing else changes, in front of it or beside it, but for a trace of its corners.
    assert change[~around].max() <= 20 and (change[~around] > 0).sum() <= 2
    assert not change[~further].any()


def test_the_nearer_of_two_hides_the_other_whatever_their_order():
    far, near = _solid(90.0, 0.0, 10.0, 10.0, 0.0, 40.0, BOX), _solid(60.0, 0.0, 4.0, 4.0, 0.0, 15.0, BOX)
    far[9:15] = [200.0, 20.0, 20.0] * 2
    one, two = _render(FISHEYE, [far, near]), _render(FISHEYE, [near, far])
    np.testing.assert_array_equal(one, two)
    mask = cv2.erode(_marched(FISHEYE, near).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert mask.sum() > 20 and (one[mask][:, 2] > 100).all()
    # A long wall whose middle is near does not hide what stands before its far end.
    wall = _solid(60.0, 60.0, 120.0, 2.0, 0.0, 40.0, BOX, 0.0)
    post = _solid(150.0, 50.0, 5.0, 5.0, 0.0, 30.0, CYLINDER)
    wall[9:15] = [200.0, 20.0, 20.0] * 2
    image = _render(FISHEYE, [wall, post])
    mask = cv2.erode(_marched(FISHEYE, post).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert mask.any() and (image[mask][:, 2] > 100).all()


def test_motion_and_readout_move_a_solid_as_they_move_the_car():
    solid = _solid(60.0, 10.0, 5.0, 5.0, 0.0, 60.0, CYLINDER)
    blurred = _render(FISHEYE, [solid], motion=(0.0, 2.0), exposure_s=0.05)
    row = 30  # above the floor, where only the leg and the wall are
    red = (blurred[row, :, 2].astype(int) - blurred[row, :, 0]) > 15
    sharp = _render(FISHEYE, [solid])
    red_sharp = (sharp[row, :, 2].astype(int) - sharp[row, :, 0]) > 15
    turned_px = 0.1 * FISHEYE.K[0, 0]
    assert red.sum() - red_sharp.sum() == pytest.approx(turned_px, abs=2.5)
    # The top rows are read first: turning left, the leg is still further left there... seen from then.
    skewed = _render(FISHEYE, [solid], motion=(0.0, 2.0), readout_s=0.1)
    when = 2.0 * 0.1 * (row / 119.0 - 0.5)
    then = _render(FISHEYE, [solid], pose=POSE + [0.0, 0.0, when])
    assert np.abs(skewed[row].astype(int) - then[row]).max() <= 40
    assert np.abs(skewed[row].astype(int) - sharp[row]).max() > 60


@pytest.mark.parametrize("shape", [BOX, CYLINDER, CONE])
def test_an_eye_inside_a_solid_or_above_it_does_no_harm(shape):
    for half in (3.0, 30.0):
        inside = _solid(24.0, 0.0, half, half, 0.0, 40.0, shape)
        above = _solid(24.0, 0.0, half, half, 0.0, 10.0, shape)
        touching = _solid(24.0, half, half, half, 0.0, 40.0, shape, 0.0)
        image = _render(
            FISHEYE, [inside, above, touching], motion=(100.0, 2.0), readout_s=0.05, exposure_s=0.02
        )
        assert image.shape == (120, 160, 3)


@pytest.mark.parametrize("pitch_rad", [-1.2, -0.6, 1.4])
def test_a_camera_that_looks_at_the_sky_or_at_its_feet_is_drawn(pitch_rad):
    camera = CameraSettings(
        width=50, height=37, field_of_view_rad=np.deg2rad(120.0), pitch_down_rad=pitch_rad
    ).build(26.0)
    look = Appearance(
        texture_level=5.0, clutter_per_m=3.0, objects_per_m=8.0, objects_on_road=0.5, shadows_per_m=3.0,
        lamps_per_m=3.0, shake_pitch_rad=0.2, shake_roll_rad=0.2, exposure_s=0.1, readout_s=0.1,
    )  # fmt: skip
    renderer = Renderer(camera, TRACK, look, np.random.default_rng(1))
    for frame in range(4):
        image = renderer.render(POSE, frame, 300.0, 6.0)
        assert image.shape == (37, 50, 3) and image.max() > 30


@pytest.mark.parametrize("closed", [False, True])
def test_objects_leave_the_middle_of_the_lane_free_and_shadows_follow(closed):
    settings = TrackSettings(closed=closed, length_cm=1500.0)
    kinds = set()
    for seed in range(4):
        track = random_track(settings, np.random.default_rng(seed))
        look = Appearance(objects_per_m=4.0, objects_on_road=0.3)
        rngs = np.random.default_rng(seed).spawn(2)
        objects = place_objects(track, look, *rngs)
        assert len(objects.shadows) == len(objects.solids) > 30
        partly = 0
        for row in objects.solids:
            kinds.add(float(row[8]))
            along = np.linspace(-row[4], row[4], 9)[:, None] * row[2:4]
            gap = (row[:2] + along)[:, None] - track.xy_cm[None]
            clear = np.hypot(gap[..., 0], gap[..., 1]).min() - row[5]
            assert clear > 0.25 * track.lane_width_cm - 1.0
            partly += clear < 0.5 * track.lane_width_cm
        assert partly > 0
        # Without things on the road, none comes over its lines.
        beside = place_objects(
            track, look.model_copy(update={"objects_on_road": 0.0}), *np.random.default_rng(seed).spawn(2)
        )
        for row in beside.solids:
            gap = row[:2] - track.xy_cm
            assert np.hypot(gap[:, 0], gap[:, 1]).min() - min(row[4], row[5]) > 0.5 * track.lane_width_cm
    assert kinds == {BOX, CYLINDER, CONE}
