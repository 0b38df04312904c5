"""The map's table of edges and its figures name frames as the drive does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from datagen.lanes.find import MappedSegment
from datagen.lanes.trace import TracedLane
from datagen.quality.figures import map_edges
from datagen.slam.adjustment.adjust import BundleResult
from datagen.slam.camera.coarse import guessed_camera
from datagen.slam.filter.dp_slam import Trajectory
from datagen.slam.odometry.scans import pack_scans
from datagen.slam.segment import SolvedSegment
from datagen.slam.settings import GuessSettings
from lanenet.geometry.frames import car_from_map
from lanenet.perception.edges.road import RoadEdges

CAMERA = guessed_camera(160, 120, 90.0, 15.0, GuessSettings())
#: The drive's own numbers of its frames that count: the car stood in 2 to 4, and 8 is missing.
NUMBERS = np.array([0, 1, 5, 6, 7, 9, 10])


def segment(rows: list[int], seed: int) -> MappedSegment:
    """A segment whose frame at row r shows r + 1 edge points."""
    rng = np.random.default_rng(seed)
    n = len(rows)
    poses = rng.normal(0.0, 1.0, (n, 3))
    roads = []
    for row in rows:
        angle = rng.uniform(0.0, 2.0 * np.pi, row + 1)
        roads.append(
            RoadEdges(rng.normal(0.0, 9.0, (row + 1, 2)), np.stack([np.cos(angle), np.sin(angle)], 1))
        )
    zeros = np.zeros(n)
    solved = SolvedSegment(
        rows=np.array(rows),
        camera=CAMERA,
        scans=pack_scans(roads, 15.0),
        trajectory=Trajectory(poses, zeros, zeros, zeros),
        open_poses=poses,
        poses=poses,
        steering=None,
        revisits=[],
        bundle=BundleResult(
            poses,
            np.zeros((n, 2)),
            CAMERA,
            {},
            np.zeros(1),
            np.zeros((0, 2), int),
            np.zeros(0, int),
            np.zeros(0),
        ),
        part=np.zeros(n, np.int64),
    )
    lane = TracedLane(zeros, zeros, zeros, 30.0, 2.0)
    return MappedSegment(solved, zeros, np.zeros(n, np.int64), lane, [])


def test_edges_name_the_drives_own_frames():
    parts = [segment([0, 1, 5, 6], 1), segment([2, 3, 4], 2)]
    edges = map_edges(parts, NUMBERS, 1.0)
    rows = [0, 1, 5, 6, 2, 3, 4]
    np.testing.assert_array_equal(edges["frame"], np.repeat(NUMBERS[rows], [row + 1 for row in rows]))
    np.testing.assert_array_equal(edges["segment"], np.repeat([0, 1], [1 + 2 + 6 + 7, 3 + 4 + 5]))


def test_each_edge_lies_where_its_frame_saw_it():
    part = segment([2, 3, 4], 2)
    for factor in (1.0, 2.5):
        edges = map_edges([part], NUMBERS, factor)
        at = edges["frame"] == NUMBERS[3]
        assert at.sum() == 4
        pose = part.solved.poses[1] * [factor, factor, 1.0]
        seen = car_from_map(
            np.stack([edges["x_cm"], edges["y_cm"]], 1)[at], pose, factor * CAMERA.wheelbase_cm
        )
        # On the map, the whole car is larger: also its wheelbase.
        np.testing.assert_allclose(
            seen, factor * part.solved.scans.points_cm[part.solved.scans.frame(1)], atol=1e-4
        )
        assert np.hypot(edges["normal_x"], edges["normal_y"]) == pytest.approx(1.0, abs=1e-6)


def test_the_edges_do_not_depend_on_where_the_frames_that_count_lie():
    part = segment([2, 3, 4], 2)
    shifted = replace(part, solved=replace(part.solved, rows=part.rows - 2))
    moved = map_edges([shifted], NUMBERS[2:], 1.0)
    for name, values in map_edges([part], NUMBERS, 1.0).items():
        np.testing.assert_array_equal(moved[name], values)
