"""Revisits: proposed from pictures, aligned by edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from picture_road import made_up_drive
from tape_road import HEIGHT_CM, WHEELBASE_CM, TapeRoad, tape_road

from datagen.slam.loops.revisits import (
    RevisitSettings,
    diagonal_mean,
    match_places,
    propose_revisits,
    similarities,
    thumbnails,
)
from datagen.slam.odometry.scans import Scans, pack_scans
from lanenet.geometry.poses import compose, path_lengths
from lanenet.perception.edges.road import RoadEdges

LAP = 100


def _pictures(rng: np.random.Generator, frames: int, shift: int = 0) -> np.ndarray:
    """Unit thumbnails of a lap that is driven again and again; alike within a few frames of a place."""
    lap = cv2.GaussianBlur(np.tile(rng.normal(size=(LAP, 18 * 24)), (3, 1)), (1, 0), sigmaX=1e-3, sigmaY=2.0)[
        LAP : 2 * LAP
    ]
    thumbs = np.empty((frames, 18 * 24), np.float32)
    for k in range(frames):
        picture = lap[k % LAP].reshape(18, 24) + 0.02 * rng.normal(size=(18, 24))
        picture = np.roll(picture, shift if k >= LAP else 0, axis=1)
        thumbs[k] = (picture - picture.mean()).ravel()
    return thumbs / np.linalg.norm(thumbs, axis=1, keepdims=True)


def _circle(frames: int, drift_rad_per_lap: float) -> np.ndarray:
    step = 2.0 * np.pi / LAP
    heading = np.arange(frames) * (step + drift_rad_per_lap / LAP)
    steps = 6.0 * np.column_stack([np.cos(heading[:-1]), np.sin(heading[:-1])])
    return np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), heading])


@pytest.mark.parametrize("shift", [0, 1, -2])
@pytest.mark.parametrize("seed", range(3))
def test_pictures_of_two_laps_give_the_lap_as_offset(seed, shift):
    thumbs = _pictures(np.random.default_rng(seed), 2 * LAP, shift)
    bounds = RevisitSettings()
    poses = _circle(2 * LAP, np.deg2rad(15.0))
    pairs = np.array(propose_revisits(thumbs, poses, HEIGHT_CM, bounds))
    assert 20 <= len(pairs) <= bounds.max_pairs
    offset = pairs[:, 1] - pairs[:, 0]
    assert np.median(offset) == LAP
    assert (np.abs(offset - LAP) <= 2).all()
    assert (np.diff(pairs[:, 1]) > 0).all()
    path = path_lengths(poses)
    assert (path[pairs[:, 1]] - path[pairs[:, 0]] >= bounds.min_gap_heights * HEIGHT_CM).all()


def test_visits_need_a_stretch_of_path_between_them():
    thumbs = _pictures(np.random.default_rng(0), 2 * LAP)
    # Around a cup: a lap of 63 cm.
    tight = _circle(2 * LAP, 0.0) * [0.1, 0.1, 1.0]
    assert propose_revisits(thumbs, tight, HEIGHT_CM, RevisitSettings()) == []
    pairs = np.array(propose_revisits(thumbs, tight, HEIGHT_CM, RevisitSettings(min_gap_heights=3.0)))
    assert np.median(pairs[:, 1] - pairs[:, 0]) == LAP


def test_one_lap_has_no_revisits():
    thumbs = _pictures(np.random.default_rng(0), 90)
    assert propose_revisits(thumbs, _circle(90, 0.0), HEIGHT_CM, RevisitSettings()) == []


def test_fewer_pairs_are_asked_for_than_found():
    thumbs = _pictures(np.random.default_rng(0), 2 * LAP)
    few = RevisitSettings(max_pairs=8, pair_heights=50.0)
    assert 3 <= len(propose_revisits(thumbs, _circle(2 * LAP, 0.1), HEIGHT_CM, few)) <= 8


def test_a_long_drive_gets_as_many_pairs_per_way_as_a_short_one():
    bounds = RevisitSettings(max_pairs=4, pair_heights=4.0)
    counts = []
    for laps in (2, 4):
        thumbs, poses = _pictures(np.random.default_rng(0), laps * LAP), _circle(laps * LAP, 0.1)
        pairs = propose_revisits(thumbs, poses, HEIGHT_CM, bounds)
        counts.append(len(pairs))
        assert len(pairs) <= path_lengths(poses)[-1] / (4.0 * HEIGHT_CM) + 1.0
    assert counts[0] > 4
    assert counts[1] > 1.5 * counts[0]


def test_likeness_is_averaged_over_neighbours_of_both_frames():
    similarity = np.zeros((30, 40), np.float32)
    similarity[10, 20] = 9.0
    expected = np.zeros_like(similarity)
    for d in range(-4, 5):
        expected[10 + d, 20 + d] = 1.0
    np.testing.assert_allclose(diagonal_mean(similarity), expected, atol=1e-6)


@pytest.mark.parametrize("frames", [3, 240, 256, 259, 261, 700])
def test_revisits_are_those_of_all_pairs_at_once(frames):
    rng = np.random.default_rng(frames)
    # Random walks through pictures, so that neighbours are alike and places far apart may be.
    thumbs = np.cumsum(rng.normal(size=(frames, 18 * 24)), axis=0).astype(np.float32)
    thumbs = thumbs @ np.diag(rng.uniform(size=18 * 24) ** 8).astype(np.float32)
    thumbs /= np.linalg.norm(thumbs, axis=1, keepdims=True)
    poses = np.cumsum(rng.normal(size=(frames, 3)), axis=0)
    bounds = RevisitSettings(min_similarity=0.01, min_gap_heights=1.0, max_pairs=10 * frames)
    whole = diagonal_mean(similarities(thumbs, thumbs))
    path = path_lengths(poses)
    whole[path[None, :] - path[:, None] < HEIGHT_CM] = -1.0
    before, after = whole.argmax(axis=0), whole.argmax(axis=1)
    expected = [
        (int(before[k]), k) for k in range(frames) if whole[before[k], k] >= 0.01 and after[before[k]] == k
    ]
    assert propose_revisits(thumbs, poses, HEIGHT_CM, bounds) == expected
    assert len(expected) > frames // 50 or frames < 10


def test_thumbnails_ignore_brightness_and_contrast():
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(0.0, 120.0, (120, 160, 3)), (0, 0), 6.0)
    picture = 60.0 + 4.0 * (picture - picture.mean())
    other = rng.uniform(0.0, 255.0, (120, 160, 3))
    flat = np.full((120, 160, 3), 90.0)
    images = [np.clip(v, 0, 255).astype(np.uint8) for v in (picture, 0.7 * picture + 60.0, other, flat)]
    thumbs = thumbnails(made_up_drive(images))
    np.testing.assert_allclose(np.linalg.norm(thumbs[:3], axis=1), 1.0, atol=1e-5)
    assert thumbs[0] @ thumbs[1] > 0.98
    assert abs(thumbs[0] @ thumbs[2]) < 0.4
    # A picture of nothing is like no other.
    np.testing.assert_allclose(thumbs[3], 0.0, atol=1e-3)


def _two_visits(
    road: TapeRoad, relative: np.ndarray, rng: np.random.Generator, drift: np.ndarray
) -> tuple[Scans, np.ndarray]:
    """Forty frames of a road, then nine on it again, displaced; with poses that drifted in between."""
    earlier = road.poses[20:61]
    later = np.array([compose(pose, relative) for pose in road.poses[36:45]])
    clean = road.scans(np.concatenate([earlier, later]))
    frames = []
    for k in range(len(clean)):
        rows = clean.frame(k)
        noisy = clean.points_cm[rows] + 0.15 * rng.normal(size=clean.points_cm[rows].shape)
        clutter = rng.uniform([-60.0, 8.0], [60.0, 75.0], (30, 2))
        angle = rng.uniform(-np.pi, np.pi, 30)
        normals = np.column_stack([np.cos(angle), np.sin(angle)])
        frames.append(
            RoadEdges(np.concatenate([noisy, clutter]), np.concatenate([clean.normals[rows], normals]))
        )
    # Open loop, the later visit is somewhere else; only poses within a visit relate to each other.
    moved = np.array([compose(drift, pose) for pose in later])
    return pack_scans(frames, HEIGHT_CM), np.concatenate([earlier, moved])


@pytest.mark.parametrize(
    "relative",
    [(0.0, 0.0, 0.0), (5.0, -8.0, 0.1), (-9.0, 12.0, -0.2), (3.0, 20.0, 0.3), (-4.0, -18.0, -0.25)],
)
@pytest.mark.parametrize("seed", range(2))
def test_matching_recovers_the_relative_pose(seed, relative):
    rng = np.random.default_rng(seed)
    scans, poses = _two_visits(tape_road(75), np.array(relative), rng, np.array([80.0, 30.0, 0.4]))
    # Frame 20 of the first visit is frame 40 of the road, and so is the fifth frame of the second visit.
    found = match_places(scans, poses, (20, 45), HEIGHT_CM, WHEELBASE_CM, RevisitSettings(), rng)
    assert found is not None
    assert (found.earlier, found.later) == (20, 45)
    assert np.abs(found.relative[:2] - relative[:2]).max() < 0.1 * HEIGHT_CM
    assert abs(found.relative[2] - relative[2]) < np.deg2rad(2.0)
    assert 0.35 <= found.match <= 1.0


def test_places_that_differ_do_not_match():
    rng = np.random.default_rng(0)
    road = tape_road(75)
    scans, poses = _two_visits(road, np.zeros(3), rng, np.zeros(3))
    # The second visit sees clutter only.
    count = int(scans.starts[41])
    angle = rng.uniform(-np.pi, np.pi, len(scans.points_cm) - count)
    points, normals = scans.points_cm.copy(), scans.normals.copy()
    points[count:] = rng.uniform([-60.0, 8.0], [60.0, 75.0], (len(angle), 2))
    normals[count:] = np.column_stack([np.cos(angle), np.sin(angle)])
    other = Scans(points, normals, scans.weights, scans.starts)
    assert match_places(other, poses, (20, 45), HEIGHT_CM, WHEELBASE_CM, RevisitSettings(), rng) is None


def test_a_visit_with_hardly_an_edge_does_not_match():
    empty = RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
    scans = pack_scans([empty] * 60, HEIGHT_CM)
    poses = np.column_stack([3.0 * np.arange(60), np.zeros((60, 2))])
    rng = np.random.default_rng(0)
    assert match_places(scans, poses, (10, 50), HEIGHT_CM, WHEELBASE_CM, RevisitSettings(), rng) is None


def test_packed_scans_give_each_frame_its_points_and_trust_near_ones():
    frames = [
        RoadEdges(np.array([[0.0, 60.0], [0.0, 6.0]]), np.array([[1.0, 0.0], [0.0, 1.0]])),
        RoadEdges(np.empty((0, 2)), np.empty((0, 2))),
        RoadEdges(np.array([[3.0, 4.0]]), np.array([[1.0, 0.0]])),
    ]
    scans = pack_scans(frames, HEIGHT_CM)
    assert len(scans) == 3
    np.testing.assert_array_equal(scans.frame_of_point, [0, 0, 2])
    np.testing.assert_array_equal(scans.points_cm[scans.frame(2)], [[3.0, 4.0]])
    assert scans.frame(1) == slice(2, 2)
    # Four camera heights away, the trust is a half.
    np.testing.assert_allclose(scans.weights[:2], [0.5, 1.0 / 1.0001])
    assert len(pack_scans([], HEIGHT_CM)) == 0
