from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tum import read_tum

from lanenet.data.tables import tum_from_poses, write_tum
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


def test_an_unknown_pose_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(MapFormatError, match="row 1 is not finite"):
        write_tum(tmp_path / "a.tum", np.arange(2.0), np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]))
    assert list(tmp_path.iterdir()) == []
