"""A map of two segments that was never driven."""

from __future__ import annotations

import numpy as np

from lanenet.data.maps.folder import FORMAT, DriveMap, MapMeta
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.line import LaneLine, Side
from lanenet.geometry.camera import Camera, Mounting

N = 30
CAMERA = Camera(
    "fisheye",
    160,
    120,
    np.array([[80.0, 0.0, 79.5], [0.0, 80.0, 59.5], [0.0, 0.0, 1.0]]),
    np.array([-0.03, 0.0, 0.0, 0.0]),
    Mounting(15.0, pitch_down_rad=0.25, ahead_of_front_axle_cm=-3.5),
    17.0,
)


def lane_line(side: Side, y_cm: float, residual_cm: float = 0.12) -> LaneLine:
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, 200.0, 11), np.full(3, 200.0)])
    rng = np.random.default_rng(0)
    coefficients = np.column_stack([np.linspace(0.0, 200.0, 13), y_cm + rng.normal(size=13)])
    supported = np.array([[0.0, 80.0], [120.0, 200.0]])
    return LaneLine(side, knots, coefficients, supported, residual_cm)


def small_map() -> DriveMap:
    rng = np.random.default_rng(1)
    poses = np.column_stack([rng.uniform(-300.0, 300.0, (N, 2)), np.linspace(0.0, 14.0, N)])
    match = rng.uniform(0.2, 0.9, N)
    match[0] = match[20] = np.nan
    never_seen = LaneLine(
        "right",
        lane_line("right", -18.0).knots_cm,
        lane_line("right", -18.0).coefficients_cm,
        np.empty((0, 2)),
        np.nan,
    )
    return DriveMap(
        meta=MapMeta(
            format=FORMAT,
            drive="drives/circuit",
            lane_width_cm=36.0,
            mapped_lane_cm=36.4,
            tape_cm=2.1,
            scale_from="lane width",
            laps=1,
        ),
        camera=CAMERA,
        frames=np.arange(100, 100 + N),
        t_s=0.05 * np.arange(N),
        poses=poses,
        lap=np.repeat([0, 1], N // 2),
        segment=np.repeat([0, 1], [20, 10]),
        s_cm=np.concatenate([np.linspace(0.0, 90.0, 20), np.linspace(0.0, 40.0, 10)]),
        match=match,
        lines={
            0: [lane_line("left", 18.0), lane_line("right", -18.0)],
            1: [lane_line("left", 18.0), never_seen],
        },
        tilt_rad=rng.normal(0.0, 0.01, (N, 2)),
        held_out=np.arange(N) % 10 == 3,
        errors=LabelErrors.withholding(np.repeat(np.arange(N)[:, None] // 4 == [2, 3], 3, axis=1)),
    )
