from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.data.trajectory import poses_from_tum, read_tum, tum_from_poses, write_tum
from lanenet.errors import MapFormatError

poses_lists = st.lists(
    st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-3.0, 3.0)), min_size=1, max_size=12
)


def accumulated(rows: list[tuple[float, float, float]]) -> np.ndarray:
    """Poses whose heading changes by less than half a circle per row, and may wind up."""
    poses = np.array(rows)
    poses[:, 2] = np.cumsum(poses[:, 2])
    return poses


def test_known_rows() -> None:
    poses = np.array([[100.0, -50.0, 0.0], [0.0, 0.0, np.pi / 2]])
    rows = tum_from_poses(np.array([0.5, 1.0]), poses)
    half = np.sqrt(0.5)
    expected = [[0.5, 1.0, -0.5, 0.0, 0.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, half, half]]
    np.testing.assert_allclose(rows, expected, atol=1e-12)


@given(poses_lists)
def test_rows_convert_back(rows: list[tuple[float, float, float]]) -> None:
    poses = accumulated(rows)
    back = poses_from_tum(tum_from_poses(np.arange(len(poses), dtype=np.float64), poses))
    np.testing.assert_allclose(back, poses, atol=1e-8)


@given(poses_lists)
def test_file_round_trip(
    tmp_path_factory: pytest.TempPathFactory, rows: list[tuple[float, float, float]]
) -> None:
    path = tmp_path_factory.mktemp("tum") / "trajectory.tum"
    poses = accumulated(rows)
    t_s = 1.6e9 + 0.05 * np.arange(len(poses))
    write_tum(path, t_s, poses)
    t_back, poses_back = read_tum(path)
    np.testing.assert_allclose(t_back, t_s, rtol=0, atol=1e-6)
    np.testing.assert_allclose(poses_back, poses, rtol=0, atol=1e-6)


def test_a_rotation_by_the_opposite_quaternion_is_the_same() -> None:
    rows = tum_from_poses(np.zeros(1), np.array([[0.0, 0.0, 0.7]]))
    rows[:, 4:] *= -1.0
    np.testing.assert_allclose(poses_from_tum(rows)[0, 2], 0.7)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0 1 2 0 0 0 0", "line 3: expected eight numbers"),
        ("0 1 2 0 0 0 0 one", "line 3: expected eight numbers"),
        ("0 nan 2 0 0 0 0 1", "line 3: expected eight numbers"),
        ("0 1 2 0 0 0 0 0.5", "line 3: expected a unit quaternion, found length 0.5"),
        ("-1 1 2 0 0 0 0 1", "line 3: time -1.0 after 0.0"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "a.tum"
    path.write_text(f"# comment\n0 0 0 0 0 0 0 1 # first\n{line}\n")
    with pytest.raises(MapFormatError) as caught:
        read_tum(path)
    assert f"a.tum: {message}" in str(caught.value)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(MapFormatError, match="no such file"):
        read_tum(tmp_path / "a.tum")


def test_an_unknown_pose_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(MapFormatError, match="row 1 is not finite"):
        write_tum(tmp_path / "a.tum", np.arange(2.0), np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]))
    assert list(tmp_path.iterdir()) == []
