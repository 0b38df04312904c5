import numpy as np

from lanenet.data.segments import map_segments


def test_pieces_begin_where_poses_jump():
    frames = np.array([0, 1, 2, 12, 13, 14, 15])
    x = np.array([0.0, 3.0, 6.0, 36.0, 39.0, 500.0, 503.0])
    poses = np.stack([x, 0 * x, 0 * x], axis=1)
    # Ten frames without labels are way driven; five metres in one frame is not.
    np.testing.assert_array_equal(map_segments(frames, poses), [0, 0, 0, 0, 0, 1, 1])
    np.testing.assert_array_equal(map_segments(frames[:1], poses[:1]), [0])
    assert map_segments(frames[:0], poses[:0]).shape == (0,)
