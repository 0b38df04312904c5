"""Lines of the truth against the painted lines of clean frames, through all kinds of lenses."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.world.car.camera import CameraSettings
from datagen.world.render.appearance import Appearance
from datagen.world.render.renderer import Renderer
from datagen.world.road.build import random_track
from datagen.world.road.track import Track
from datagen.world.road.track_settings import MarkingSettings, TrackSettings
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import car_from_map

FLOOR, PAINT = 70.0, 235.0
REACH_PX = 14  # to either side of a line that a profile covers
LEAST_WIDTH_PX = 1.5  # of a line's marking, to be measured


def _rig(rng: np.random.Generator) -> CameraSettings:
    """A lens and mounting as cars of this scale have them: fisheye of 120 to 190 degrees, or pinhole."""
    fisheye = rng.random() < 0.7
    field = rng.uniform(120.0, 190.0) if fisheye else rng.uniform(60.0, 110.0)
    return CameraSettings(
        model="fisheye" if fisheye else "pinhole",
        field_of_view_rad=float(np.deg2rad(field)),
        distortion=(rng.uniform(-0.04, 0.03), 0.0, 0.0, 0.0)
        if fisheye
        else (rng.uniform(-0.1, 0.02), 0, 0, 0),
        height_cm=rng.uniform(10.0, 28.0),
        pitch_down_rad=rng.uniform(0.15, 0.7),
        roll_rad=rng.uniform(-0.08, 0.08),
        yaw_rad=rng.uniform(-0.15, 0.15),
        ahead_of_front_axle_cm=rng.uniform(-12.0, 6.0),
        right_of_centre_cm=rng.uniform(-4.0, 4.0),
    )


def _road(rng: np.random.Generator) -> Track:
    marking = MarkingSettings()
    return random_track(
        TrackSettings(
            length_cm=700.0,
            lane_width_cm=rng.uniform(25.0, 60.0),
            line_width_cm=rng.uniform(1.5, 5.0),
            left=marking,
            right=marking,
            interruptions_per_m=0.0,
        ),
        rng,
    )


def _crossings(curve_px: np.ndarray, axis: int, cut: int) -> np.ndarray:
    """Where a projected curve crosses pixel row (axis 1) or column (axis 0) ``cut``."""
    with np.errstate(invalid="ignore"):
        d = curve_px[:, axis] - cut
        k = np.flatnonzero((d[:-1] <= 0.0) != (d[1:] <= 0.0))
    t = d[k] / (d[k] - d[k + 1])
    return curve_px[k, 1 - axis] * (1.0 - t) + curve_px[k + 1, 1 - axis] * t


def _step(profile: np.ndarray, near: float, rising: bool) -> float:
    """Sub-pixel place of a step from 0 to 1 (or back) near a place: where a sharp step would lie."""
    low, high = round(near) - 3, round(near) + 3
    inside = profile[low : high + 1].sum()
    return high + 0.5 - inside if rising else low - 0.5 + inside


def line_errors(camera: Camera, track: Track, seed: int, stops: tuple[float, ...]) -> np.ndarray:
    """Middle of the painted marking minus the middle of its projected borders, across the line, [px].

    The borders are the line of the truth moved by half the marking's width to either side, on the road: the
    image of a line's middle is not the middle of its image, by up to two pixels in a wide marking nearby.
    """
    renderer = Renderer(camera, track, Appearance(floor_bgr=(FLOOR,) * 3), np.random.default_rng(seed))
    normal = np.stack([-np.sin(track.heading_rad), np.cos(track.heading_rad)], axis=1)
    errors: list[float] = []
    for s_cm in stops:
        xy, heading = track.point(s_cm, 3.0 * np.sin(s_cm))
        pose = np.array([*xy, heading + 0.15 * np.cos(s_cm)])
        share = (renderer.render(pose)[..., 0].astype(float) - FLOOR) / (PAINT - FLOOR)
        for marking in track.markings:
            half = 0.5 * marking.width_cm
            lines = [
                car_from_map(track.xy_cm + offset * normal, pose, camera.wheelbase_cm)
                for offset in (marking.offset_cm, marking.offset_cm + half, marking.offset_cm - half)
            ]
            near = (np.hypot(*lines[0].T) < 110.0) & (lines[0][:, 1] > -camera.wheelbase_cm)
            middle, *borders = (camera.project_ground(line[near]) for line in lines)
            errors += _profile_errors(share, middle, borders)
    return np.array(errors)


def _profile_errors(share: np.ndarray, middle: np.ndarray, borders: list[np.ndarray]) -> list[float]:
    """Errors along the rows or columns that cut the line, whichever cut it more squarely."""
    errors = []
    for k in range(len(middle) - 1):
        along = middle[k + 1] - middle[k]
        if not np.isfinite(along).all() or not np.any(along):
            continue
        axis = 1 if abs(along[1]) >= abs(along[0]) else 0
        squarely = abs(along[axis]) / np.hypot(*along)
        low, high = sorted((middle[k, axis], middle[k + 1, axis]))
        for cut in range(int(np.ceil(low)), int(np.floor(high)) + 1):
            if not 3 <= cut < share.shape[1 - axis] - 3:
                continue
            profile = share[cut] if axis == 1 else share[:, cut]
            # Only borders beside this place: a road may come back across the same row.
            around = slice(max(k - 25, 0), k + 26)
            at = [_crossings(border[around], axis, cut) for border in borders]
            if not all(a.size == 1 for a in at):
                continue
            (a, b) = sorted(float(x[0]) for x in at)
            if not np.isfinite(a + b):
                continue
            if (b - a) * squarely < LEAST_WIDTH_PX or b - a > 60.0:
                continue
            left, right = round(a) - REACH_PX, round(b) + REACH_PX
            if left < 0 or right >= len(profile):
                continue
            if profile[left : round(a) - 4].max() > 0.0 or profile[round(b) + 5 : right + 1].max() > 0.0:
                continue  # another line beside this one
            if b - a > 8.0:  # wide enough to find each border by itself
                found = 0.5 * (_step(profile, a, rising=True) + _step(profile, b, rising=False))
            else:
                window = np.arange(left, right + 1)
                found = float(profile[window] @ window / profile[window].sum())
            errors.append((found - 0.5 * (a + b)) * squarely)
    return errors


def _check(seeds: range, least: int) -> None:
    for seed in seeds:
        rng = np.random.default_rng(seed)
        rig, track = _rig(rng), _road(rng)
        errors = np.abs(line_errors(rig.build(rng.uniform(16.0, 30.0)), track, seed, (90.0, 210.0, 330.0)))
        assert len(errors) > least, (seed, rig)
        assert np.median(errors) <= 0.1, (seed, rig)
        assert np.max(errors) <= 0.3, (seed, rig)


def test_painted_lines_meet_the_truth_through_three_lenses():
    _check(range(3), 100)


@pytest.mark.slow
def test_painted_lines_meet_the_truth_through_twenty_lenses():
    _check(range(20), 100)
