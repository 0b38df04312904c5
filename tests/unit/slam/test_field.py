"""The likelihood field: against a plain reference, and what its scores mean."""

from __future__ import annotations

import numpy as np
import pytest
from tape_road import WHEELBASE_CM, tape_road

from datagen.slam.loops.revisits import DirectionField
from datagen.slam.odometry.scans import Scan
from lanenet.geometry.frames import map_from_car, map_from_car_directions

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
