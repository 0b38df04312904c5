"""Parts of one drive, with nothing known between them, become one map where they show the same places."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from picture_road import Pictures, loop_drive, made_up_drive
from pixel_road import fisheye

from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleSettings
from datagen.slam.commands import BREAK_PERIODS, commands_of, habitual_pauses
from datagen.slam.filter.dp_slam import FilterSettings
from datagen.slam.loops.parts import connected, hanging, joined_twice, placing_revisits, tied_frames
from datagen.slam.loops.pose_graph import close_loops, loop_pairs
from datagen.slam.loops.revisits import Revisit, RevisitSettings
from datagen.slam.segment import SegmentSolver, SolvedSegment
from lanenet.data.drives.recording import Commands, Drive
from lanenet.errors import TrackingLostError
from lanenet.geometry.camera import Camera
from lanenet.geometry.poses import moved_rigidly, relative_pose

SMALL = MapSettings(
    filter=FilterSettings(particles=80, max_points=80),
    bundle=BundleSettings(points=40),
    revisits=RevisitSettings(max_pairs=30),
)
LAP_FRAMES, LAP_CM = 90, 360.0
FIRST = 125
#: The car was lifted, and put down where it had been a lap before.
SECOND = slice(150, 195)
TWO_PARTS = np.repeat([0, 1], [FIRST, SECOND.stop - SECOND.start])


def _camera() -> Camera:
    camera = fisheye(pitch_down_rad=0.42)
    return replace(camera, K=camera.K * np.array([[0.75, 0.0, 1.0], [0.0, 0.75, 1.0], [0.0, 0.0, 1.0]]))


def _drive_in_two_parts() -> tuple[Drive, np.ndarray]:
    """A drive with a break, and its true poses."""
    whole, poses = loop_drive(_camera(), SECOND.stop, LAP_FRAMES, LAP_CM, 0)
    images = [whole.image(k) for k in [*range(FIRST), *range(SECOND.start, SECOND.stop)]]
    n = len(images)
    drive = made_up_drive(
        images,
        camera=_camera(),
        breaks=np.arange(n) == FIRST,
        commands=Commands(speed_cm_s=np.full(n, LAP_CM / LAP_FRAMES / 0.05)),
    )
    return drive, np.concatenate([poses[:FIRST], poses[SECOND]])


@pytest.fixture(scope="module")
def same_road() -> tuple[Drive, np.ndarray, SolvedSegment]:
    drive, poses = _drive_in_two_parts()
    return drive, poses, SegmentSolver(SMALL, np.random.default_rng(0)).solve(drive, _camera())


def _errors_cm(poses: np.ndarray, true: np.ndarray, by: slice) -> np.ndarray:
    """Distance of each frame from the truth, with some of the frames laid over it."""
    here, there = poses[by, :2].mean(axis=0), true[by, :2].mean(axis=0)
    u, _, v = np.linalg.svd((poses[by, :2] - here).T @ (true[by, :2] - there))
    return np.linalg.norm(true[:, :2] - there - (poses[:, :2] - here) @ u @ v, axis=1)


def test_a_part_put_down_on_the_same_road_is_on_its_map(same_road):
    _, true, solved = same_road
    np.testing.assert_array_equal(solved.part, TWO_PARTS)
    # Laid over the truth by the first part alone, the second one is where it was driven.
    error = _errors_cm(solved.poses, true, slice(0, FIRST))
    assert np.sqrt(np.mean(error[FIRST:] ** 2)) < 1.0
    assert error.max() < 2.0
    cross = [r for r in solved.revisits if r.earlier < FIRST <= r.later]
    assert len(cross) >= SMALL.revisits.min_revisits
    assert len(solved.revisits_within_parts) == len(solved.revisits) - len(cross) > 0
    assert not connected(solved.part, solved.revisits).any()
    # What lies between the two parts was not driven.
    assert solved.path_cm[-1] == pytest.approx((len(true) - 2) * LAP_CM / LAP_FRAMES, rel=0.03)


def test_a_part_of_another_road_has_a_map_of_its_own(same_road):
    drive, true, _ = same_road
    # A road that bends the other way, between other walls.
    images = [drive.image(k) for k in range(FIRST)]
    images += [np.ascontiguousarray(drive.image(k)[:, ::-1]) for k in range(FIRST, len(drive))]
    elsewhere = replace(drive, images=Pictures(images))
    solved = SegmentSolver(SMALL, np.random.default_rng(0)).solve(elsewhere, _camera())
    group = connected(solved.part, solved.revisits)
    np.testing.assert_array_equal(group, TWO_PARTS)
    first, second = (solved.only(np.flatnonzero(group == k)) for k in (0, 1))
    assert first.revisits and not second.revisits
    assert all(r.later < FIRST for r in first.revisits)
    np.testing.assert_array_equal(second.rows, np.arange(FIRST, len(drive)))
    assert len(second.scans) == len(second.trajectory.match) == len(second.bundle.tilt) == len(second.rows)
    np.testing.assert_array_equal(second.scans.scan(3).points_cm, solved.scans.scan(FIRST + 3).points_cm)
    assert _errors_cm(first.poses, true[:FIRST], slice(0, FIRST)).max() < 2.0


def test_nothing_is_assumed_across_a_break(same_road):
    drive, _, _ = same_road
    commands = commands_of(drive, 17.0)
    assert commands.periods[FIRST] == BREAK_PERIODS
    assert (np.delete(commands.periods, FIRST) == 1.0).all()
    # A revisit across it moves the second part as a whole, however far that is.
    poses = np.column_stack([4.0 * np.arange(60.0), np.zeros(60), np.zeros(60)])
    periods = np.where(np.arange(60) == 30, BREAK_PERIODS, 1.0)
    visits = [Revisit(k, 30 + k, np.array([0.0, 200.0, 0.0]), 0.8) for k in (2, 12, 22)]
    closed, missed = close_loops(poses, visits, 15.0, periods)
    np.testing.assert_allclose(missed, 0.0, atol=0.1)
    np.testing.assert_allclose(np.diff(closed[30:, 0]), 4.0, atol=0.01)


def _two_parts() -> tuple[np.ndarray, np.ndarray, list[Revisit]]:
    """Poses in two parts, and revisits that place the second where it was driven."""
    poses = np.column_stack([np.arange(60.0) * 4.0, np.zeros(60), np.zeros(60)])
    poses[30:, 0] -= 120.0
    # The second part lies 80 cm further along the road of the first one, turned by half a radian.
    true = moved_rigidly(poses[30:], poses[30], np.array([80.0, 10.0, 0.5]))
    right = [Revisit(k, 30 + k, relative_pose(poses[k], true[k]), 0.8) for k in range(0, 30, 4)]
    return poses, np.repeat([0, 1], 30), right


def test_revisits_that_contradict_each_other_place_nothing():
    rng = np.random.default_rng(2)
    poses, part, right = _two_parts()
    wrong = [replace(r, relative=r.relative + rng.normal(size=3) * [60.0, 60.0, 1.0]) for r in right[::2]]
    places = placing_revisits(poses, part, wrong + right, 15.0)
    assert {(r.earlier, *r.relative) for r in places} == {(r.earlier, *r.relative) for r in right}
    assert len(placing_revisits(poses, part, wrong, 15.0)) < 3


def test_revisits_of_one_place_alone_place_nothing():
    poses, part, right = _two_parts()
    # All lie within a few frames, as where a printed road repeats itself once.
    assert placing_revisits(poses, part, [replace(right[0], later=30 + k) for k in range(4)], 15.0) == []


def test_parts_that_one_place_joins_stay_apart_unless_others_join_them():
    poses, _, right = _two_parts()
    part = np.repeat([0, 1, 2], [15, 15, 30])
    single = right[-1:]
    assert joined_twice(poses, part, [*right[:4], *single], 15.0) == right[:4]
    # Parts 0 and 1 hang together by several places, and so the place of part 1 agrees with those of part 0.
    between = [Revisit(k, 15 + k, relative_pose(poses[k], poses[15 + k]), 0.8) for k in range(0, 15, 3)]
    for kept in ([*right[:4], *single, *between], right, []):
        assert joined_twice(poses, part, kept, 15.0) == kept


def test_of_two_corridors_that_look_alike_it_is_the_one_where_the_car_was():
    poses, part, right = _two_parts()
    # The other corridor is 8 m away, and one more place of it matches.
    more = [*right, replace(right[0], earlier=1, later=31, relative=relative_pose(poses[1], poses[1]))]
    far = [replace(r, relative=r.relative + [0.0, 800.0, 0.0]) for r in more]
    placed = placing_revisits(poses, part, [*far, *right], 15.0)
    assert {(r.earlier, *r.relative) for r in placed} == {(r.earlier, *r.relative) for r in right}
    # Fewer places than such a way is unlikely say nothing.
    assert placing_revisits(poses, part, far[:4], 15.0) == []


def test_a_part_is_placed_once_by_the_larger_set():
    poses, _, right = _two_parts()
    part = np.repeat([0, 1, 2], [15, 15, 30])
    # The third part hangs on both others, by six places and by two: the second set may contradict.
    first = [r for r in right if r.earlier < 15]
    second = [replace(r, relative=r.relative + [0.0, 30.0, 0.0]) for r in right if r.earlier >= 15][:2]
    between = [Revisit(k, 15 + k, relative_pose(poses[k], poses[15 + k]), 0.8) for k in range(0, 15, 3)]
    placed = placing_revisits(poses, part, [*second, *first, *between], 15.0)
    assert {(r.earlier, r.later) for r in placed} == {(r.earlier, r.later) for r in [*first, *between]}
    assert not connected(part, placed).any()
    np.testing.assert_array_equal(connected(part, first), np.repeat([0, 1, 0], [15, 15, 30]))


def test_pairs_beside_a_revisit_keep_to_their_parts():
    part = np.repeat([0, 1], 50)
    pairs = loop_pairs([Revisit(48, 90, np.zeros(3), 0.8), Revisit(10, 52, np.zeros(3), 0.8)], part)
    assert (44, 86) in pairs and (52, 94) not in pairs
    assert (14, 56) in pairs and (6, 48) not in pairs


def test_pauses_of_a_recording_are_counted_where_they_are_a_habit():
    image = np.zeros((12, 16, 3), np.uint8)
    whole = made_up_drive([image] * 100)
    assert habitual_pauses(whole) == 0
    # Three in a hundred frames, two, and ten frames that are missing one by one.
    for missing, expected in (([4, 7, 3], 3), ([4, 7], 0), ([1] * 10, 0)):
        steps = np.ones(100)
        steps[5 : 5 + 9 * len(missing) : 9] += missing
        assert habitual_pauses(replace(whole, t_s=0.05 * np.cumsum(steps))) == expected
    assert habitual_pauses(made_up_drive([image])) == 0


@pytest.mark.parametrize(
    ("sizes", "dark", "keys", "kept"),
    [
        ([6], [], None, [0]),
        ([4, 1, 5], [], None, [0, 2]),
        ([1, 2, 3, 4], [], None, [3]),
        ([1, 1, 1], [], None, []),
        # Frames that show no road tie nothing, but stay in a part that others tie.
        ([4, 8], [0], None, [1]),
        ([5, 8], [0, 5, 6, 7, 8, 9], None, [0]),
        # A slow car is tracked by its keyframes.
        ([9, 9], [], [0, 3, 6, 8, 9, 13, 17], [0]),
    ],
)
def test_parts_that_nothing_ties_are_left_out(sizes, dark, keys, kept):
    part = np.repeat(np.arange(len(sizes)), sizes)
    shows_road = ~np.isin(np.arange(len(part)), dark)
    found = tied_frames(part, np.arange(len(part)) if keys is None else np.array(keys), shows_road)
    np.testing.assert_array_equal(found, np.flatnonzero(np.isin(part, kept)))


@pytest.mark.parametrize("alone", [1, 3])
def test_a_few_frames_between_two_breaks_are_left_out_of_the_segment(alone):
    """The images before and after them do not show where they are, and neither does the motion model."""
    drive, _ = loop_drive(_camera(), 60 + alone, LAP_FRAMES, LAP_CM, 0)
    apart = np.where(np.arange(len(drive)) >= 30, 251.0, 0.0)
    apart += np.where(np.arange(len(drive)) >= 30 + alone, 10.0, 0.0)
    breaks = np.isin(np.arange(len(drive)), [30, 30 + alone])
    speed = Commands(speed_cm_s=np.full(len(drive), LAP_CM / LAP_FRAMES / 0.05))
    broken = replace(drive, t_s=drive.t_s + apart, breaks=breaks, commands=speed)
    segment = SegmentSolver(SMALL, np.random.default_rng(0)).solve(broken, _camera())
    np.testing.assert_array_equal(segment.rows, np.r_[0:30, 30 + alone : 60 + alone])
    assert np.isfinite(segment.poses).all()
    np.testing.assert_array_equal(segment.part, np.repeat([0, 1], 30))


def test_a_recording_of_single_frames_is_refused_in_one_line():
    drive, _ = loop_drive(_camera(), 20, LAP_FRAMES, LAP_CM, 0)
    k = np.arange(len(drive))
    broken = replace(drive, t_s=drive.t_s + 10.0 * k, breaks=k > 0)
    with pytest.raises(TrackingLostError, match=r"20 frames in 20 parts between breaks, none with 4 frames"):
        SegmentSolver(SMALL, np.random.default_rng(0)).solve(broken, _camera())


def test_what_lies_beyond_the_last_revisit_of_a_part_hangs_on_it():
    # Two passes of a straight, the second one in a part of its own, tied to the first over its first half.
    poses = np.column_stack([np.tile(np.arange(100) * 3.0, 2), np.zeros(200), np.zeros(200)])
    part = np.repeat([0, 1], 100)
    tied = [Revisit(k, 100 + k, np.zeros(3), 0.9) for k in range(0, 50, 5)]
    # 5 heights of 12 cm are 20 frames of 3 cm.
    loose = np.flatnonzero(hanging(poses, part, tied, 12.0))
    assert loose.tolist() == [*range(66, 100), *range(166, 200)]
    assert not hanging(poses, part, [*tied, Revisit(99, 199, np.zeros(3), 0.9)], 12.0).any()
    assert hanging(poses, part, [], 12.0).all()
