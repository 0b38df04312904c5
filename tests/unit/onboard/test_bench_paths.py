from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lanenet.errors import ModelMismatchError
from lanenet.onboard.bench import example_camera, smaller_camera, time_paths

MODEL = Path(__file__).resolve().parents[3] / "checkpoints" / "small" / "model.onnx"


def test_a_smaller_camera_sees_the_same_road() -> None:
    camera = example_camera()
    small = smaller_camera(camera, 2)
    assert (small.width, small.height) == (160, 120)
    # The middle of two by two pixels is the middle of the one that replaces them.
    np.testing.assert_allclose(
        small.intersect_ground(np.array([[80.0, 100.0], [20.0, 110.0]])),
        camera.intersect_ground(np.array([[160.5, 200.5], [40.5, 220.5]])),
        rtol=1e-9,
    )


def test_every_path_is_timed_at_both_sizes() -> None:
    before, turns = cv2.getNumThreads(), []
    report = time_paths(
        example_camera(), [MODEL], rounds=10, progress=lambda done, total: turns.append((done, total))
    )
    assert cv2.getNumThreads() == before and turns[-1] == (100, 100)
    assert list(report) == ["320x240", "160x120"]
    for paths in report.values():
        assert list(paths) == ["canny", f"network {MODEL}", "lane-filter", "hough", "painter"]
        assert paths["canny"]["ratio_to_canny"] == 1.0
        for figures in paths.values():
            assert 0.0 < figures["median_ms"] <= figures["p99_ms"]
            assert 0.0 < figures["cpu_median_ms"] <= figures["cpu_p99_ms"]
            assert figures["ratio_to_canny"] > 0.0


def test_a_missing_model_is_named() -> None:
    with pytest.raises(ModelMismatchError, match=r"none\.onnx"):
        time_paths(example_camera(), [Path("none.onnx")], rounds=10)
