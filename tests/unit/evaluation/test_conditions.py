from dataclasses import replace

import numpy as np
from synthetic_labels import make_label_set

from lanenet.evaluation.sources import at_frames, distance_to_training_cm, lines_seen, nearest_pose_cm
from lanenet.geometry.birdseye import BirdseyeWindow


def test_lines_are_seen_where_their_edges_are():
    labels = make_label_set(4, 0, window=BirdseyeWindow())
    edges = [labels.edges[0], labels.edges[1][: 2 * 144], labels.edges[2][2 * 144 :], labels.edges[3][:0]]
    found = lines_seen(replace(labels, edges=edges))
    np.testing.assert_array_equal(found, [[1, 1], [1, 0], [0, 1], [0, 0]])


def test_only_parts_of_the_same_map_are_near():
    training, test = make_label_set(3, 1), make_label_set(3, 0)
    training.poses[:, 0] = [1.0, 4.0, 8.0]
    test = replace(test, frame=np.array([3, 4, 5]))
    test.poses[:, 0] = [12.0, 8.0, 4.5]
    np.testing.assert_allclose(distance_to_training_cm(test, [training]), [4.0, 0.0, 0.5])
    # After a jump the poses are those of another piece, in a frame of its own.
    away = replace(test, poses=test.poses.copy(), frame=np.array([3, 4, 5]))
    away.poses[1:, 0] += 400.0
    np.testing.assert_allclose(distance_to_training_cm(away, [training]), [4.0, np.nan, np.nan])
    others = [
        replace(training, drive=["other"] * 3),
        replace(training, meta=replace(training.meta, camera_hash="other")),
        replace(training, meta=replace(training.meta, source="truth")),
    ]
    assert np.isnan(distance_to_training_cm(test, others)).all()
    np.testing.assert_allclose(distance_to_training_cm(test, [*others, training]), [4.0, 0.0, 0.5])


def test_values_are_looked_up_by_frame_number():
    values = np.array([[1.0, 2.0], [3.0, 4.0]])
    found = at_frames(values, np.array([10, 12]), np.array([9, 10, 11, 12, 13]))
    np.testing.assert_array_equal(found[[1, 3]], values)
    assert np.isnan(found[[0, 2, 4]]).all()
    assert np.isnan(at_frames(np.empty(0), np.empty(0, int), np.array([1]))).all()


def test_the_nearest_place_counts():
    poses = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 2.0]])
    training = np.array([[3.0, 4.0, 0.0], [10.0, 1.0, -2.0]])
    np.testing.assert_allclose(nearest_pose_cm(poses, training), [5.0, 1.0])
    assert np.isnan(nearest_pose_cm(poses, np.empty((0, 3)))).all()
