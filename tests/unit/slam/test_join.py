"""Stretches of one drive, each in a map of its own, become one where they show the same places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from picture_road import Pictures, loop_drive, made_up_drive
from pixel_road import fisheye

from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleEstimate, BundleResult, BundleSettings, Observations
from datagen.slam.filter.dp_slam import FilterSettings
from datagen.slam.join import Stretch, _agreeing, frames_text, join_stretches
from datagen.slam.keyframes import key_pairs
from datagen.slam.loops.pose_graph import loop_pairs
from datagen.slam.loops.revisits import Revisit, RevisitSettings
from datagen.slam.seen import SeenRoad, road_edges
from datagen.slam.segment import solve_segment
from lanenet.data.drives.recording import Commands, Drive
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import moved_rigidly, relative_pose

SMALL = MapSettings(
    filter=FilterSettings(particles=80, max_points=80),
    bundle=BundleSettings(points=40),
    revisits=RevisitSettings(max_pairs=30),
)
#: Where it does not matter how many places join the stretches.
FEW = SMALL.model_copy(update={"revisits": RevisitSettings(max_pairs=8)})
LAP_FRAMES, LAP_CM = 90, 360.0
FIRST = 125
#: The car was lifted, and put down where it had been a lap before.
SECOND = slice(150, 195)


def _camera() -> Camera:
    camera = fisheye(pitch_down_rad=0.42)
    return replace(camera, K=camera.K * np.array([[0.75, 0.0, 1.0], [0.0, 0.75, 1.0], [0.0, 0.0, 1.0]]))


def _stretches() -> tuple[Drive, np.ndarray, list[Stretch]]:
    """A drive with a break, its true poses, and its two stretches, each mapped alone."""
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
    stretches = [Stretch(r, solve_segment(drive.subset(r), _camera(), SMALL, rng, None)) for r in rows]
    return drive, np.concatenate([poses[:FIRST], poses[SECOND]]), stretches


@pytest.fixture(scope="module")
def same_road() -> tuple[Drive, np.ndarray, list[Stretch]]:
    return _stretches()


def _errors_cm(poses: np.ndarray, true: np.ndarray, by: slice) -> np.ndarray:
    """Distance of each frame from the truth, with some of the frames laid over it."""
    here, there = poses[by, :2].mean(axis=0), true[by, :2].mean(axis=0)
    u, _, v = np.linalg.svd((poses[by, :2] - here).T @ (true[by, :2] - there))
    return np.linalg.norm(true[:, :2] - there - (poses[:, :2] - here) @ u @ v, axis=1)


def test_a_stretch_put_down_on_the_same_road_joins_its_map(same_road):
    drive, true, stretches = same_road
    notes: list[str] = []
    joined = join_stretches(stretches, drive, SMALL, np.random.default_rng(1), notes)
    assert len(joined) == 1
    np.testing.assert_array_equal(joined[0].rows, np.arange(len(true)))
    solved = joined[0].solved
    np.testing.assert_array_equal(np.flatnonzero(solved.breaks_or_none()), [FIRST])
    # Laid over the truth by the first stretch alone, the second one is where it was driven.
    error = _errors_cm(solved.poses, true, slice(0, FIRST))
    assert np.sqrt(np.mean(error[FIRST:] ** 2)) < 1.0
    assert error.max() < 2.0
    turn = solved.poses[-1, 2] - solved.poses[0, 2] - (true[-1, 2] - true[0, 2])
    assert abs(np.sin(turn)) < np.deg2rad(2.0) and np.cos(turn) > 0.0
    cross = [r for r in solved.revisits if r.earlier < FIRST <= r.later]
    assert len(cross) >= SMALL.revisits.min_revisits
    assert notes == [f"frames 125-169 lie on the same map as frames 0-124: {len(cross)} places seen in both"]
    assert solved.keys is None
    assert len(solved.uninterrupted_revisits()) == len(solved.revisits) - len(cross)
    assert len(solved.scans) == len(true) == len(solved.trajectory.match) == len(solved.open_poses)
    # What lies between the two stretches was not driven.
    assert solved.path_cm[-1] == pytest.approx((len(true) - 2) * LAP_CM / LAP_FRAMES, rel=0.03)


class _StopError(Exception):
    """The rest is another test's."""


def test_recorded_speeds_of_both_stretches_are_told_in_one_unit(same_road, monkeypatch):
    drive, _, stretches = same_road
    told: list[np.ndarray] = []

    def adjust(observed: Observations, *_: object) -> None:
        assert observed.relative_steps is not None
        told.append(observed.relative_steps)
        raise _StopError

    monkeypatch.setattr("datagen.slam.join.adjust", adjust)
    speed_cm_s = np.where(np.arange(len(drive)) < FIRST, 80.0, 160.0)
    faster = replace(drive, commands=Commands(speed_cm_s=speed_cm_s))
    with pytest.raises(_StopError):
        join_stretches(stretches, faster, FEW, np.random.default_rng(1), [])
    # Nothing is known of the first frame of either.
    np.testing.assert_array_equal(told[0][[0, FIRST]], 0.0)
    np.testing.assert_allclose(told[0][1:FIRST], 1.0)
    np.testing.assert_allclose(told[0][FIRST + 1 :], 2.0)


def test_key_frames_of_a_crawl_are_those_of_the_joined_stretch(same_road, monkeypatch):
    drive, _, (long, short) = same_road
    n = len(drive)
    keys = np.r_[0:FIRST:3, FIRST - 1]
    crawled = replace(long, solved=replace(long.solved, keys=keys))
    cleaned: list[np.ndarray | None] = []
    pairs: list[tuple[int, int]] = []

    def see(*args: object) -> SeenRoad:
        cleaned.append(args[-1])
        return road_edges(*args)

    def adjust(_: Observations, start: BundleEstimate, *args: object) -> BundleResult:
        pairs[:] = args[3]
        return replace(long.solved.bundle, poses=start.poses, tilt=start.tilt)

    monkeypatch.setattr("datagen.slam.join.road_edges", see)
    monkeypatch.setattr("datagen.slam.join.adjust", adjust)
    (joined,) = join_stretches([crawled, short], drive, FEW, np.random.default_rng(1), [])
    # Each stretch is cleaned of reflections by its own frames.
    assert cleaned[0] is keys and cleaned[1] is None
    assert set(key_pairs(keys, SMALL.bundle.lags)) <= set(pairs)
    assert joined.solved.keys is not None
    np.testing.assert_array_equal(joined.solved.keys, np.r_[keys, FIRST:n])
    # In the order of the drive, also where the crawl came later.
    later = drive.subset(np.r_[FIRST:n, 0:FIRST])
    swapped = [
        Stretch(np.arange(n - FIRST), short.solved),
        Stretch(np.arange(n - FIRST, n), crawled.solved),
    ]
    (joined,) = join_stretches(swapped, later, FEW, np.random.default_rng(1), [])
    assert joined.solved.keys is not None
    np.testing.assert_array_equal(joined.solved.keys, np.r_[0 : n - FIRST, n - FIRST + keys])
    assert set(key_pairs(keys, SMALL.bundle.lags)) <= set(pairs)


def test_the_stretch_that_carries_may_be_the_later_one(same_road):
    drive, true, stretches = same_road
    # The short stretch was driven first.
    n = len(true)
    order = np.concatenate([np.arange(FIRST, n), np.arange(FIRST)])
    turned = replace(
        drive,
        images=Pictures([drive.image(int(k)) for k in order]),
        breaks=np.arange(n) == n - FIRST,
    )
    swapped = [
        Stretch(np.arange(n - FIRST), stretches[1].solved),
        Stretch(np.arange(n - FIRST, n), stretches[0].solved),
    ]
    (joined,) = join_stretches(swapped, turned, SMALL, np.random.default_rng(1), [])
    np.testing.assert_array_equal(joined.rows, np.arange(n))
    np.testing.assert_array_equal(np.flatnonzero(joined.solved.breaks_or_none()), [n - FIRST])
    error = _errors_cm(joined.solved.poses, true[order], slice(n - FIRST, n))
    assert error.max() < 2.0
    for r in joined.solved.uninterrupted_revisits():
        assert abs(r.later - r.earlier - LAP_FRAMES) <= 2


def test_a_stretch_of_another_road_stays_apart(same_road):
    drive, _, stretches = same_road
    # A road that bends the other way, between other walls.
    images = [drive.image(k) for k in range(FIRST)]
    images += [np.ascontiguousarray(drive.image(k)[:, ::-1]) for k in range(FIRST, len(drive))]
    elsewhere = replace(drive, images=Pictures(images))
    notes: list[str] = []
    assert join_stretches(stretches, elsewhere, SMALL, np.random.default_rng(1), notes) == stretches
    assert not notes


def test_alignments_that_contradict_each_other_do_not_join():
    rng = np.random.default_rng(2)
    poses = np.column_stack([np.arange(60.0) * 4.0, np.zeros(60), np.zeros(60)])
    poses[30:, 0] -= 120.0
    # The second stretch lies 80 cm further along the road of the first one, turned by half a radian.
    true = moved_rigidly(poses[30:], poses[30], np.array([80.0, 10.0, 0.5]))
    right = [Revisit(k, 30 + k, relative_pose(poses[k], true[k]), 0.8) for k in range(0, 30, 4)]
    wrong = [replace(r, relative=r.relative + rng.normal(size=3) * [60.0, 60.0, 1.0]) for r in right[::2]]
    kept, moved = _agreeing(poses, 30, wrong + right, 15.0)
    assert {(r.earlier, *r.relative) for r in kept} == {(r.earlier, *r.relative) for r in right}
    np.testing.assert_allclose(moved, true, atol=1e-9)
    assert len(_agreeing(poses, 30, wrong, 15.0)[0]) < 3


def test_alignments_of_one_place_alone_do_not_join(same_road, monkeypatch):
    drive, _, stretches = same_road
    # All pairs that look alike lie within a few frames, as where a printed road repeats itself once.
    pairs = [(k, FIRST + k - SECOND.start + LAP_FRAMES) for k in range(70, 76)]
    monkeypatch.setattr("datagen.slam.join._shared_places", lambda *_: pairs)
    assert join_stretches(stretches, drive, SMALL, np.random.default_rng(1), []) == stretches


def test_one_stretch_is_all_there_is(same_road):
    drive, _, stretches = same_road
    assert join_stretches(stretches[:1], drive, SMALL, np.random.default_rng(1), []) == stretches[:1]
    # Nothing to carry the other one over to: none is closed.
    opened = [replace(s, solved=replace(s.solved, revisits=[])) for s in stretches]
    assert join_stretches(opened, drive, SMALL, np.random.default_rng(1), []) == opened


def test_pairs_beside_a_revisit_keep_to_their_stretches():
    breaks = np.arange(100) == 50
    pairs = loop_pairs([Revisit(48, 90, np.zeros(3), 0.8), Revisit(10, 52, np.zeros(3), 0.8)], 100, breaks)
    assert (44, 86) in pairs and (52, 94) not in pairs
    assert (14, 56) in pairs and (6, 48) not in pairs


def test_frames_are_named_run_by_run():
    drive = made_up_drive([np.zeros((6, 8, 3), np.uint8)] * 9)
    numbered = replace(drive, frames=np.arange(9) + 100)
    assert frames_text(numbered, np.array([0, 1, 2, 5, 6])) == "frames 100-102, 105-106"
