"""Revisits: proposed from images, aligned by edges on a likelihood field."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from picture_road import made_up_drive
from tape_road import HEIGHT_CM, WHEELBASE_CM, TapeRoad, tape_road

from datagen.slam.camera.coarse import guessed_camera
from datagen.slam.commands import BREAK_PERIODS
from datagen.slam.loops.pose_graph import loop_pairs, neighbouring_laps
from datagen.slam.loops.revisits import (
    DirectionField,
    PlaceMatcher,
    Revisit,
    RevisitSettings,
    diagonal_mean,
    propose_beside,
    propose_revisits,
    propose_turned,
    similarities,
    thumbnails,
)
from datagen.slam.odometry.scans import Scan, Scans, pack_scans
from datagen.slam.settings import GuessSettings
from lanenet.geometry.frames import map_from_car, map_from_car_directions, wrap_angle
from lanenet.geometry.poses import compose, path_lengths, relative_pose
from lanenet.perception.edges.road import RoadEdges

LAP = 100


def _one_part(frames: np.ndarray) -> np.ndarray:
    return np.zeros(len(frames), np.int64)


def _matcher(scans: Scans, poses: np.ndarray, part: np.ndarray) -> PlaceMatcher:
    camera = guessed_camera(160, 120, 80.0, 0.2, GuessSettings(wheelbase_cm=WHEELBASE_CM))
    camera = camera.with_mounting(height_cm=HEIGHT_CM)
    return PlaceMatcher(scans, poses, part, camera, RevisitSettings())


def _match(
    scans: Scans, poses: np.ndarray, pair: tuple[int, int], rng: np.random.Generator
) -> Revisit | None:
    return _matcher(scans, poses, _one_part(poses)).match(pair, rng)


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
    pairs = np.array(propose_revisits(thumbs, poses, np.ones(len(thumbs)), HEIGHT_CM, bounds))
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
    assert propose_revisits(thumbs, tight, np.ones(len(thumbs)), HEIGHT_CM, RevisitSettings()) == []
    pairs = np.array(
        propose_revisits(thumbs, tight, np.ones(len(thumbs)), HEIGHT_CM, RevisitSettings(min_gap_heights=3.0))
    )
    assert np.median(pairs[:, 1] - pairs[:, 0]) == LAP


def test_one_lap_has_no_revisits():
    thumbs = _pictures(np.random.default_rng(0), 90)
    assert (
        propose_revisits(thumbs, _circle(90, 0.0), np.ones(len(thumbs)), HEIGHT_CM, RevisitSettings()) == []
    )


def test_fewer_pairs_are_asked_for_than_found():
    thumbs = _pictures(np.random.default_rng(0), 2 * LAP)
    few = RevisitSettings(max_pairs=8, pair_heights=50.0)
    assert (
        3 <= len(propose_revisits(thumbs, _circle(2 * LAP, 0.1), np.ones(len(thumbs)), HEIGHT_CM, few)) <= 8
    )


def test_a_long_drive_gets_as_many_pairs_per_way_as_a_short_one():
    bounds = RevisitSettings(max_pairs=4, pair_heights=4.0)
    counts = []
    for laps in (2, 4):
        thumbs, poses = _pictures(np.random.default_rng(0), laps * LAP), _circle(laps * LAP, 0.1)
        pairs = propose_revisits(thumbs, poses, np.ones(len(thumbs)), HEIGHT_CM, bounds)
        counts.append(len(pairs))
        assert len(pairs) <= path_lengths(poses)[-1] / (4.0 * HEIGHT_CM) + 1.0
    assert counts[0] > 4
    assert counts[1] > 1.5 * counts[0]


def test_frames_of_another_visit_are_proposed_near_a_known_one_but_not_beside_it():
    poses, settings = _circle(210, 0.0), RevisitSettings()
    known = [Revisit(0, LAP, np.zeros(3), 1.0)]
    # A pair in every 60 cm of path, 10 frames; the known visits hold theirs.
    found = propose_beside(poses, np.ones(210), known, 15.0, settings)
    assert found
    assert {later - earlier for earlier, later in found} == {LAP}
    near = {min(min(abs(frame - k) for k in (0, LAP)) for frame in pair) for pair in found}
    assert min(near) >= 10
    assert max(near) <= 30
    held = [Revisit(k, k + LAP, np.zeros(3), 1.0) for k in range(0, 110, 5)]
    assert propose_beside(poses, np.ones(210), held, 15.0, settings) == []
    assert propose_beside(poses, np.ones(210), [], 15.0, settings) == []


@pytest.mark.parametrize(("off", "within_reach"), [([0.0, 20.0, 0.0], True), ([0.0, 40.0, 0.0], False)])
def test_what_lies_out_of_reach_is_not_proposed(off, within_reach):
    poses = _circle(210, 0.0)
    poses[LAP:] = compose(poses[LAP:], np.broadcast_to(off, poses[LAP:].shape))
    known = [Revisit(0, LAP, np.zeros(3), 1.0)]
    pairs = propose_beside(poses, np.ones(210), known, 15.0, RevisitSettings())
    assert bool(pairs) is within_reach


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
    turned = np.abs(wrap_angle(poses[None, :, 2] - poses[:, None, 2])) > 0.25 * np.pi
    expected = set()
    for similarity in (whole, np.where(turned, -1.0, whole)):
        before, after = similarity.argmax(axis=0), similarity.argmax(axis=1)
        expected |= {
            (int(before[k]), k)
            for k in range(frames)
            if similarity[before[k], k] >= 0.01 and abs(after[before[k]] - k) <= 3
        }
    found = propose_revisits(thumbs, poses, np.ones(len(thumbs)), HEIGHT_CM, bounds)
    assert found == sorted(expected, key=lambda pair: pair[::-1])
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
    found = _match(scans, poses, (20, 45), rng)
    assert found is not None
    assert (found.earlier, found.later) == (20, 45)
    assert np.abs(found.relative[:2] - relative[:2]).max() < 0.1 * HEIGHT_CM
    assert abs(found.relative[2] - relative[2]) < np.deg2rad(2.0)
    assert 0.35 <= found.match <= 1.0


def _there_and_back(road: TapeRoad, carried: int) -> tuple[Scans, np.ndarray, np.ndarray, np.ndarray]:
    """A road driven to its end, then back from so many frames before it: true poses, and two parts."""
    back = road.poses[-1 - carried :: -1] + [0.0, 0.0, np.pi]
    true = np.concatenate([road.poses, back])
    apart = np.concatenate([road.poses, compose(np.array([80.0, 30.0, 0.4]), back)])
    return road.scans(true), true, apart, np.repeat([0, 1], [len(road.poses), len(back)])


@pytest.mark.parametrize("carried", [0, 20])
def test_a_car_that_was_turned_round_finds_its_way_back(carried):
    scans, true, apart, part = _there_and_back(tape_road(220), carried)
    matcher, rng = _matcher(scans, apart, part), np.random.default_rng(0)
    proposed = propose_turned(apart, part, HEIGHT_CM, RevisitSettings())
    known = matcher.turned(proposed, rng)
    assert len(proposed) >= 8
    off = np.array([r.relative - relative_pose(true[r.earlier], true[r.later]) for r in known])
    right = (np.abs(off[:, :2]) < 0.1 * HEIGHT_CM).all(axis=1)
    right &= np.abs(wrap_angle(off[:, 2])) < np.deg2rad(2.0)
    # The false ones agree with none.
    assert right.sum() >= max(4, 0.6 * len(known))


def test_a_turn_on_a_straight_or_of_a_short_part_finds_nothing():
    scans, _, apart, part = _there_and_back(tape_road(220, 0.0, 0.0), 0)
    matcher, rng = _matcher(scans, apart, part), np.random.default_rng(0)
    assert propose_turned(apart[:260], part[:260], HEIGHT_CM, RevisitSettings()) == []
    # Without the ends of its dashes the tape is alike all along.
    scans.weights[np.abs(scans.normals[:, 1]) > 0.5] = 0.0
    assert matcher.turned(propose_turned(apart, part, HEIGHT_CM, RevisitSettings()), rng) == []


def test_a_closed_road_that_was_driven_both_ways_is_held_together_all_along():
    scans, true, apart, part = _there_and_back(tape_road(220), 0)
    periods = np.where(np.arange(len(part)) == 220, BREAK_PERIODS, 1.0)
    known = [Revisit(110, 299, relative_pose(true[110], true[299]), 0.8)]
    pairs = propose_beside(true, periods, known, HEIGHT_CM, RevisitSettings())
    found = _matcher(scans, apart, part).matched(pairs, np.random.default_rng(0), true)
    assert len(found) >= 3
    off = np.array([r.relative - relative_pose(true[r.earlier], true[r.later]) for r in found])
    assert np.median(np.abs(off[:, :2])) < 0.1 * HEIGHT_CM
    facing_each_other = neighbouring_laps(true, HEIGHT_CM, RevisitSettings())
    # Those that face each other stay six camera heights apart, also around a revisit.
    for a, b in [*facing_each_other, *loop_pairs(known, part)]:
        assert 4.0 * HEIGHT_CM < np.hypot(*(true[a] - true[b])[:2]) < 8.0 * HEIGHT_CM
    assert len(facing_each_other) > 20


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
    assert _match(other, poses, (20, 45), rng) is None


def test_a_visit_with_hardly_an_edge_does_not_match():
    empty = RoadEdges(np.empty((0, 2)), np.empty((0, 2)))
    scans = pack_scans([empty] * 60, HEIGHT_CM)
    poses = np.column_stack([3.0 * np.arange(60), np.zeros((60, 2))])
    rng = np.random.default_rng(0)
    assert _match(scans, poses, (10, 50), rng) is None


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


CELL_CM = 0.8


class PlainField:
    """The field as a dictionary of cells, point by point, in double precision."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.cells: dict[tuple[int, int], tuple[tuple[int, int], np.ndarray]] = {}

    def insert(self, points: np.ndarray, normals: np.ndarray, weights: np.ndarray) -> None:
        for point, normal, weight in zip(points / CELL_CM, normals, weights, strict=True):
            cx, cy = (int(v) for v in np.floor(point))
            for iy in range(cy - 2, cy + 3):
                for ix in range(cx - 2, cx + 3):
                    blur = np.exp(-0.5 * ((ix + 0.5 - point[0]) ** 2 + (iy + 0.5 - point[1]) ** 2))
                    place = (ix % self.size, iy % self.size)
                    owner, vector = self.cells.get(place, ((ix, iy), np.zeros(2)))
                    if owner != (ix, iy):
                        vector = np.zeros(2)
                    self.cells[place] = ((ix, iy), vector + weight * blur * normal)

    def at(self, point: np.ndarray) -> np.ndarray:
        grid = point / CELL_CM - 0.5
        low = np.floor(grid).astype(int)
        total = np.zeros(2)
        for jx in (0, 1):
            for jy in (0, 1):
                cell = (int(low[0]) + jx, int(low[1]) + jy)
                found = self.cells.get((cell[0] % self.size, cell[1] % self.size))
                if found is not None and found[0] == cell:
                    share = 1.0 - np.abs(grid - cell)
                    total += share[0] * share[1] * found[1]
        return total

    def score(self, pose: np.ndarray, points: np.ndarray, normals: np.ndarray, trust: np.ndarray) -> float:
        placed = map_from_car(points, pose, WHEELBASE_CM)
        turned = map_from_car_directions(normals, pose[2])
        total = 0.0
        for point, normal, weight in zip(placed, turned, trust, strict=True):
            vector = self.at(point)
            total += weight * float(normal @ vector) / (1.0 + float(np.linalg.norm(vector)))
        return total


def _unit(rng: np.random.Generator, n: int) -> np.ndarray:
    angle = rng.uniform(-np.pi, np.pi, n)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _one_point(field: DirectionField, x_cm: float, y_cm: float, normal: tuple[float, float]) -> float:
    """Score of one edge at a place of the map, for a car at the origin that heads along +x."""
    car = np.array([[-y_cm, x_cm - WHEELBASE_CM]])
    normal_car = np.array([[-normal[1], normal[0]]])
    return float(field.score(np.zeros((1, 3)), WHEELBASE_CM, Scan(car, normal_car, np.ones(1)))[0])


def _with_point(x_cm: float, y_cm: float, size: int = 64) -> DirectionField:
    field = DirectionField.empty(CELL_CM, size)
    field.insert(np.array([[x_cm, y_cm]]), np.array([[0.0, 1.0]]), np.ones(1))
    return field


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("reach_cm", [20.0, 120.0])
def test_field_equals_a_plain_reference(seed, reach_cm):
    # 64 cells of 0.8 cm are 51 cm: the small reach fits, the large one wraps around several times.
    rng = np.random.default_rng(seed)
    field, plain = DirectionField.empty(CELL_CM, 64), PlainField(64)
    for _ in range(4):
        points = rng.uniform(-reach_cm, reach_cm, (120, 2))
        normals, weights = _unit(rng, 120), rng.uniform(0.1, 1.0, 120)
        field.insert(points, normals, weights)
        plain.insert(points, normals, weights)
    poses = np.column_stack([rng.uniform(-10.0, 10.0, (5, 2)), rng.uniform(-np.pi, np.pi, 5)])
    points, normals, trust = rng.uniform(-reach_cm, reach_cm, (60, 2)), _unit(rng, 60), rng.uniform(0, 1, 60)
    found = field.score(poses, WHEELBASE_CM, Scan(points, normals, trust))
    expected = [plain.score(pose, points, normals, trust) for pose in poses]
    assert np.ptp(expected) > 0.01
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_an_empty_field_scores_nothing():
    assert _one_point(DirectionField.empty(CELL_CM, 64), 30.0, 0.0, (0.0, 1.0)) == 0.0


def test_only_an_edge_that_brightens_the_same_way_matches():
    field = _with_point(30.0, -4.0)
    same = _one_point(field, 30.0, -4.0, (0.0, 1.0))
    assert same > 0.3
    assert _one_point(field, 30.0, -4.0, (0.0, -1.0)) == pytest.approx(-same, abs=1e-6)
    assert _one_point(field, 30.0, -4.0, (1.0, 0.0)) == pytest.approx(0.0, abs=1e-6)
    assert _one_point(field, 30.0 + 4.0 * CELL_CM, -4.0, (0.0, 1.0)) == 0.0


def test_an_edge_that_was_seen_often_counts_once():
    field = DirectionField.empty(CELL_CM, 64)
    for _ in range(200):
        field.insert(np.array([[30.0, -4.0]]), np.array([[0.0, 1.0]]), np.ones(1))
    assert 0.95 < _one_point(field, 30.0, -4.0, (0.0, 1.0)) < 1.0


@pytest.mark.parametrize("turns", [(1, 0), (0, -1), (-3, 2)])
def test_a_far_point_takes_over_the_cell_and_the_old_content_never_answers(turns):
    size = 64
    lap = size * CELL_CM
    field = _with_point(30.0, -4.0, size=size)
    far = (30.0 + turns[0] * lap, -4.0 + turns[1] * lap)
    # Before it is mapped, the far place is unknown, although it shares the cells.
    assert _one_point(field, *far, (0.0, 1.0)) == 0.0
    field.insert(np.array([far]), np.array([[1.0, 0.0]]), np.ones(1))
    assert _one_point(field, *far, (1.0, 0.0)) > 0.3
    assert _one_point(field, *far, (0.0, 1.0)) == pytest.approx(0.0, abs=1e-6)
    for normal in ((0.0, 1.0), (1.0, 0.0)):
        assert _one_point(field, 30.0, -4.0, normal) == 0.0


@pytest.mark.parametrize("frame", [0, 20, 40])
def test_the_score_is_highest_at_the_true_pose(frame):
    road = tape_road(41)
    scan = road.scans().scan(frame)
    pose = road.poses[frame]
    field = DirectionField.empty(0.6, 512)
    points, normals, trust = scan
    field.insert(map_from_car(points, pose, WHEELBASE_CM), map_from_car_directions(normals, pose[2]), trust)
    rng = np.random.default_rng(frame)
    near = rng.normal(size=(2000, 3)) * [2.0, 2.0, 0.05]
    # Within a tenth of a cell nothing can be told apart.
    near = near[(np.abs(near) > [0.06, 0.06, 0.002]).any(axis=1)]
    scores = field.score(np.vstack([pose, pose + near]), WHEELBASE_CM, scan)
    assert scores[0] >= scores.max() - 0.002 * scores[0]
    best = near[np.argsort(scores[1:])[-10:]]
    assert np.abs(best[:, :2]).max() < 1.0
    assert np.abs(best[:, 2]).max() < np.deg2rad(1.5)
