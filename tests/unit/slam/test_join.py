"""Segments of one drive, each in a map of its own, become one where they show the same places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from picture_road import Pictures, loop_drive, made_up_drive
from pixel_road import fisheye

from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleEstimate, BundleResult, BundleSettings, Observations
from datagen.slam.filter.dp_slam import FilterSettings
from datagen.slam.join import JoinedSegments, _agreeing, frames_text, join_segments
from datagen.slam.keyframes import keyframe_pairs
from datagen.slam.loops.pose_graph import loop_pairs
from datagen.slam.loops.revisits import Revisit, RevisitSettings
from datagen.slam.segment import SegmentSolver, SolvedSegment
from datagen.slam.view import RoadView, view_road
from lanenet.data.drives.recording import Commands, Drive
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import moved_rigidly, relative_pose

SMALL = MapSettings(
    filter=FilterSettings(particles=80, max_points=80),
    bundle=BundleSettings(points=40),
    revisits=RevisitSettings(max_pairs=30),
)
#: Where it does not matter how many places join the segments.
FEW = SMALL.model_copy(update={"revisits": RevisitSettings(max_pairs=8)})
LAP_FRAMES, LAP_CM = 90, 360.0
FIRST = 125
#: The car was lifted, and put down where it had been a lap before.
SECOND = slice(150, 195)


def _camera() -> Camera:
    camera = fisheye(pitch_down_rad=0.42)
    return replace(camera, K=camera.K * np.array([[0.75, 0.0, 1.0], [0.0, 0.75, 1.0], [0.0, 0.0, 1.0]]))


def _segments() -> tuple[Drive, np.ndarray, list[SolvedSegment]]:
    """A drive with a break, its true poses, and its two segments, each mapped alone."""
    whole, poses = loop_drive(_camera(), SECOND.stop, LAP_FRAMES, LAP_CM, 0)
    images = [whole.image(k) for k in [*range(FIRST), *range(SECOND.start, SECOND.stop)]]
    n = len(images)
    drive = made_up_drive(
        images,
        camera=_camera(),
        breaks=np.arange(n) == FIRST,
        commands=Commands(speed_cm_s=np.full(n, LAP_CM / LAP_FRAMES / 0.05)),
    )
    rng = np.random.default_rng(0)
    rows = [np.arange(FIRST), np.arange(FIRST, n)]
    solver = SegmentSolver(SMALL, rng)
    segments = [replace(solver.solve(drive.subset(r), _camera()), rows=r) for r in rows]
    return drive, np.concatenate([poses[:FIRST], poses[SECOND]]), segments


@pytest.fixture(scope="module")
def same_road() -> tuple[Drive, np.ndarray, list[SolvedSegment]]:
    return _segments()


def _errors_cm(poses: np.ndarray, true: np.ndarray, by: slice) -> np.ndarray:
    """Distance of each frame from the truth, with some of the frames laid over it."""
    here, there = poses[by, :2].mean(axis=0), true[by, :2].mean(axis=0)
    u, _, v = np.linalg.svd((poses[by, :2] - here).T @ (true[by, :2] - there))
    return np.linalg.norm(true[:, :2] - there - (poses[:, :2] - here) @ u @ v, axis=1)


def test_a_segment_put_down_on_the_same_road_joins_its_map(same_road):
    drive, true, segments = same_road
    joined = join_segments(segments, drive, SMALL, np.random.default_rng(1))
    (solved,) = joined.segments
    np.testing.assert_array_equal(solved.rows, np.arange(len(true)))
    np.testing.assert_array_equal(np.flatnonzero(solved.break_flags), [FIRST])
    # Laid over the truth by the first segment alone, the second one is where it was driven.
    error = _errors_cm(solved.poses, true, slice(0, FIRST))
    assert np.sqrt(np.mean(error[FIRST:] ** 2)) < 1.0
    assert error.max() < 2.0
    turn = solved.poses[-1, 2] - solved.poses[0, 2] - (true[-1, 2] - true[0, 2])
    assert abs(np.sin(turn)) < np.deg2rad(2.0) and np.cos(turn) > 0.0
    cross = [r for r in solved.revisits if r.earlier < FIRST <= r.later]
    assert len(cross) >= SMALL.revisits.min_revisits
    note = f"frames 125-169 lie on the same map as frames 0-124: {len(cross)} places seen in both"
    assert joined.notes == (note,)
    assert solved.keys is None
    assert len(solved.uninterrupted_revisits) == len(solved.revisits) - len(cross)
    assert len(solved.scans) == len(true) == len(solved.trajectory.match) == len(solved.open_poses)
    # What lies between the two segments was not driven.
    assert solved.path_cm[-1] == pytest.approx((len(true) - 2) * LAP_CM / LAP_FRAMES, rel=0.03)


class _StopError(Exception):
    """The rest is another test's."""


def test_recorded_speeds_of_both_segments_are_in_one_unit(same_road, monkeypatch):
    drive, _, segments = same_road
    told: list[np.ndarray] = []

    def adjust(observed: Observations, *_: object, **__: object) -> None:
        told.append(np.asarray(observed.relative_steps))
        raise _StopError

    monkeypatch.setattr("datagen.slam.join.adjust", adjust)
    speed_cm_s = np.where(np.arange(len(drive)) < FIRST, 80.0, 160.0)
    faster = replace(drive, commands=Commands(speed_cm_s=speed_cm_s))
    with pytest.raises(_StopError):
        join_segments(segments, faster, FEW, np.random.default_rng(1))
    # Nothing is known of the first frame of either.
    np.testing.assert_array_equal(told[0][[0, FIRST]], 0.0)
    np.testing.assert_allclose(told[0][1:FIRST], 1.0)
    np.testing.assert_allclose(told[0][FIRST + 1 :], 2.0)


def test_keyframes_of_a_slow_car_are_those_of_the_joined_segment(same_road, monkeypatch):
    drive, _, (long, short) = same_road
    n = len(drive)
    keys = np.r_[0:FIRST:3, FIRST - 1]
    slow = replace(long, keys=keys)
    cleaned: list[np.ndarray | None] = []
    pairs: list[tuple[int, int]] = []

    def view(*args: object) -> RoadView:
        cleaned.append(args[-1])
        return view_road(*args)

    def adjust(_: object, start: BundleEstimate, *args: object) -> BundleResult:
        pairs[:] = args[3]
        return replace(long.bundle, poses=start.poses, tilt=start.tilt)

    monkeypatch.setattr("datagen.slam.join.view_road", view)
    monkeypatch.setattr("datagen.slam.join.adjust", adjust)
    (joined,) = join_segments([slow, short], drive, FEW, np.random.default_rng(1)).segments
    # Each segment is cleaned of reflections by its own frames.
    assert cleaned[0] is keys and cleaned[1] is None
    assert set(keyframe_pairs(keys, SMALL.bundle.lags)) <= set(pairs)
    assert joined.keys is not None
    np.testing.assert_array_equal(joined.keys, np.r_[keys, FIRST:n])
    # In the order of the drive, also where the slow car came later.
    later = drive.subset(np.r_[FIRST:n, 0:FIRST])
    swapped = [
        replace(short, rows=np.arange(n - FIRST)),
        replace(slow, rows=np.arange(n - FIRST, n)),
    ]
    (joined,) = join_segments(swapped, later, FEW, np.random.default_rng(1)).segments
    assert joined.keys is not None
    np.testing.assert_array_equal(joined.keys, np.r_[0 : n - FIRST, n - FIRST + keys])
    assert set(keyframe_pairs(keys, SMALL.bundle.lags)) <= set(pairs)


@pytest.mark.slow
def test_the_segment_that_carries_may_be_the_later_one(same_road):
    drive, true, segments = same_road
    # The short segment was driven first.
    n = len(true)
    order = np.concatenate([np.arange(FIRST, n), np.arange(FIRST)])
    turned = replace(
        drive,
        images=Pictures([drive.image(int(k)) for k in order]),
        breaks=np.arange(n) == n - FIRST,
    )
    swapped = [
        replace(segments[1], rows=np.arange(n - FIRST)),
        replace(segments[0], rows=np.arange(n - FIRST, n)),
    ]
    (joined,) = join_segments(swapped, turned, SMALL, np.random.default_rng(1)).segments
    np.testing.assert_array_equal(joined.rows, np.arange(n))
    np.testing.assert_array_equal(np.flatnonzero(joined.break_flags), [n - FIRST])
    error = _errors_cm(joined.poses, true[order], slice(n - FIRST, n))
    assert error.max() < 2.0
    for r in joined.uninterrupted_revisits:
        assert abs(r.later - r.earlier - LAP_FRAMES) <= 2


def test_a_segment_of_another_road_stays_apart(same_road):
    drive, _, segments = same_road
    # A road that bends the other way, between other walls.
    images = [drive.image(k) for k in range(FIRST)]
    images += [np.ascontiguousarray(drive.image(k)[:, ::-1]) for k in range(FIRST, len(drive))]
    elsewhere = replace(drive, images=Pictures(images))
    joined = join_segments(segments, elsewhere, SMALL, np.random.default_rng(1))
    assert joined == JoinedSegments(tuple(segments))


def test_alignments_that_contradict_each_other_do_not_join():
    rng = np.random.default_rng(2)
    poses = np.column_stack([np.arange(60.0) * 4.0, np.zeros(60), np.zeros(60)])
    poses[30:, 0] -= 120.0
    # The second segment lies 80 cm further along the road of the first one, turned by half a radian.
    true = moved_rigidly(poses[30:], poses[30], np.array([80.0, 10.0, 0.5]))
    right = [Revisit(k, 30 + k, relative_pose(poses[k], true[k]), 0.8) for k in range(0, 30, 4)]
    wrong = [replace(r, relative=r.relative + rng.normal(size=3) * [60.0, 60.0, 1.0]) for r in right[::2]]
    places, moved = _agreeing(poses, 30, wrong + right, 15.0)
    assert {(r.earlier, *r.relative) for r in places} == {(r.earlier, *r.relative) for r in right}
    np.testing.assert_allclose(moved, true, atol=1e-9)
    assert len(_agreeing(poses, 30, wrong, 15.0)[0]) < 3


def test_alignments_of_one_place_alone_do_not_join(same_road, monkeypatch):
    drive, _, segments = same_road
    # All pairs that look alike lie within a few frames, as where a printed road repeats itself once.
    pairs = [(k, FIRST + k - SECOND.start + LAP_FRAMES) for k in range(70, 76)]
    monkeypatch.setattr("datagen.slam.join._alike_frames", lambda *_: pairs)
    joined = join_segments(segments, drive, SMALL, np.random.default_rng(1))
    assert joined == JoinedSegments(tuple(segments))


def test_one_segment_is_all_there_is(same_road):
    drive, _, segments = same_road
    alone = join_segments(segments[:1], drive, SMALL, np.random.default_rng(1))
    assert alone == JoinedSegments(tuple(segments[:1]))
    # Nothing to carry the other one over to: none is closed.
    opened = [replace(s, revisits=[]) for s in segments]
    joined = join_segments(opened, drive, SMALL, np.random.default_rng(1))
    assert joined == JoinedSegments(tuple(opened))


def test_pairs_beside_a_revisit_keep_to_their_segments():
    breaks = np.arange(100) == 50
    pairs = loop_pairs([Revisit(48, 90, np.zeros(3), 0.8), Revisit(10, 52, np.zeros(3), 0.8)], 100, breaks)
    assert (44, 86) in pairs and (52, 94) not in pairs
    assert (14, 56) in pairs and (6, 48) not in pairs


def test_frames_are_named_run_by_run():
    drive = made_up_drive([np.zeros((6, 8, 3), np.uint8)] * 9)
    numbered = replace(drive, frames=np.arange(9) + 100)
    assert frames_text(numbered, np.array([0, 1, 2, 5, 6])) == "frames 100-102, 105-106"
