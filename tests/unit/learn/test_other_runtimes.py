from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

REPO = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("name", ["general", "small"])
def test_the_model_with_fixed_shapes_gives_the_same_answers(tmp_path: Path, name: str) -> None:
    source, target = REPO / "checkpoints" / name / "model.onnx", tmp_path / "ready.onnx"
    subprocess.run([sys.executable, REPO / "contrib/runtimes/fixed_shapes.py", source, target], check=True)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    before, after = (onnxruntime.InferenceSession(path, options) for path in (source, target))
    assert all(each.shape[0] == 1 for each in (*after.get_inputs(), *after.get_outputs()))
    assert {each.type for each in after.get_inputs()} == {"tensor(float)"}
    raster = np.random.default_rng(0).integers(0, 256, after.get_inputs()[0].shape).astype(np.uint8)
    for width_cm in (0.0, 41.0):
        more = {each.name: np.array([width_cm], np.float32) for each in after.get_inputs()[1:]}
        expected = before.run(None, {"raster": raster, **more})
        for want, got in zip(
            expected, after.run(None, {"raster": raster.astype(np.float32), **more}), strict=True
        ):
            np.testing.assert_array_equal(got, want)
