"""Labels where tape turns in corners, against the truth; no corners where the road bends."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datagen.pipeline import MapRequest, MapSettings, map_drive
from datagen.world.road.track import SIDES, read_track
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.drives import read_truth
from lanenet.data.maps.folder import read_map
from lanenet.data.maps.mapped_drive import read_map_frames
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.frames import map_from_car
from lanenet.geometry.lane import POINT_NAMES, ROWS_CM

#: Labels count within this distance of a corner, at the rows of 15 and 30 cm.
NEAR_CM = 40.0
MAX_RMSE_CM = 0.5
#: Straights between corners, and their turns, positive left: a loop.
COURSES = {
    40.0: ([84.9, 190.4, 118.1, 132.5, 98.0, 96.3, 150.0, 84.8], [60, 30, 90, 60, -30, 60, 90]),
    50.0: ([110.0, 150.0, 152.7, 220.0, 130.0, 100.0, 120.0, 186.6], [60, 30, 90, 60, -30, 60, 90]),
}
CAMERA = {
    "width": 160, "height": 120, "field_of_view_rad": math.radians(130.0), "height_cm": 18.0,
    "pitch_down_rad": math.radians(18.0),
}  # fmt: skip


def _straight(length_cm: float) -> dict[str, Any]:
    return {"straight": {"length_cm": length_cm}}


def _turn(kind: str, angle_deg: float, **more: float) -> dict[str, Any]:
    direction = "left" if angle_deg > 0.0 else "right"
    return {kind: {"angle_deg": abs(angle_deg), "direction": direction, **more}}


def _map(folder: Path, pieces: list[dict[str, Any]], lane_cm: float, length_cm: float) -> Path:
    """Simulate 2.1 laps and map them with the true camera."""
    track = {"closed": True, "lane_width_cm": lane_cm, "interruptions_per_m": 0.0, "pieces": pieces}
    settings = {
        "seed": 1, "rate_hz": 20.0, "frames": int(2.1 * length_cm / 3.5), "camera": CAMERA,
        "track": track | {"left": {"kind": "solid"}},
        "car": {"wheelbase_cm": 18.0, "max_steering_rad": 0.6},
        "driver": {"speed_cm_s": 70.0, "wander_cm": 0.1 * lane_cm},
    }  # fmt: skip
    drive = simulate_drive(SimulationSettings.model_validate(settings), folder / "drive")
    map_drive(MapRequest(drive, lane_cm), MapSettings(), folder / "map", pictures=False)
    return drive


@pytest.mark.slow
@pytest.mark.parametrize("lane_cm", COURSES)
def test_labels_beside_corners_are_right(tmp_path, lane_cm):
    lengths_cm, turns_deg = COURSES[lane_cm]
    pieces = [_straight(lengths_cm[0])]
    for turn, length_cm in zip(turns_deg, lengths_cm[1:], strict=True):
        pieces += [_turn("kink", turn), _straight(length_cm)]
    drive = _map(tmp_path, pieces, lane_cm, sum(lengths_cm))
    found, truth = read_map_frames(tmp_path / "map"), read_truth(drive)
    assert truth is not None
    points = np.stack([truth[name] for name in POINT_NAMES], axis=1)[found.frames]
    poses = np.stack([truth[name] for name in ("x_cm", "y_cm", "heading_rad")], axis=1)[found.frames]
    track = read_track(drive / "track.json")
    errors: dict[int, list[float]] = {30: [], 60: [], 90: []}
    wanted = dict.fromkeys(errors, 0)
    for k, pose in enumerate(poses):
        shown = BirdseyeWindow().labelled(points[k])
        for j in np.flatnonzero(np.isfinite(shown)).tolist():
            side, row_cm = SIDES[j // 3], ROWS_CM[j % 3]
            at_cm = map_from_car(np.array([[points[k, j], row_cm]]), pose, found.camera.wheelbase_cm)[0]
            angle_deg = _corner_near(track, at_cm, track.line_offset_cm(side))
            if row_cm > 0.0 and angle_deg is not None:
                wanted[angle_deg] += 1
                errors[angle_deg].append(found.points_cm[k, j] - points[k, j])
    for angle_deg, off_cm in errors.items():
        assert np.sqrt(np.nanmean(np.square(off_cm))) <= MAX_RMSE_CM, angle_deg
        assert np.isfinite(off_cm).sum() >= 0.65 * wanted[angle_deg], angle_deg


def _corner_near(track: Any, at_cm: np.ndarray, offset_cm: float) -> int | None:
    """Angle of the corner of a line that a point is near to, [deg]; None without one."""
    for i in np.flatnonzero(track.kinks_rad):
        half, ahead = 0.5 * float(track.kinks_rad[i]), float(track.heading_rad[i])
        corner = track.xy_cm[i] + 0.5 * track.step_cm * np.array([math.cos(ahead), math.sin(ahead)])
        left = np.array([-math.sin(ahead + half), math.cos(ahead + half)])
        if np.hypot(*(corner + offset_cm / math.cos(half) * left - at_cm)) < NEAR_CM:
            return round(abs(math.degrees(2.0 * half)))
    return None


@pytest.mark.slow
def test_tight_bends_get_no_corners(tmp_path):
    side_cm, radius_cm = (110.0, 150.0), 55.0
    pieces: list[dict[str, Any]] = []
    for length_cm in 2 * side_cm:
        pieces += [_straight(length_cm), _turn("arc", 90.0, radius_cm=radius_cm)]
    _map(tmp_path, pieces, 40.0, 2.0 * sum(side_cm) + 2.0 * math.pi * radius_cm)
    assert not any(len(line.kinks_cm) for line in read_map(tmp_path / "map").lines[0])
