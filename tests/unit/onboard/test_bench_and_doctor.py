from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from lanenet.data.camera_file import write_camera
from lanenet.errors import ModelMismatchError
from lanenet.geometry.camera import Camera
from lanenet.onboard.bench import example_camera, time_stages
from lanenet.onboard.cameras import jpeg
from lanenet.onboard.doctor.installation import check_camera, run_checks
from lanenet.perception.edges import compiled


def test_bench_reports_every_stage_with_its_ratio() -> None:
    before = cv2.getNumThreads()
    report = time_stages(example_camera(), rounds=10)
    assert cv2.getNumThreads() == before
    stages = report["stages"]
    methods = {f"edge stage: {method}" for method in ("canny", "directional", "colour")}
    assert set(stages) == methods | {"canny", "edges", "lift", "raster", "lane filter", "frame to lane"}
    for values in stages.values():
        assert 0.0 < values["median_ms"] <= values["p99_ms"]
        assert values["ratio_to_canny"] == pytest.approx(values["median_ms"] / stages["canny"]["median_ms"])
    assert report["rounds"] == 10 and report["threads"] == 1 and report["image"] == "320x240"
    assert report["edge_points"] > 100
    assert {"processor", "cores", "python", "opencv", "numpy", "onnxruntime"} <= set(report["machine"])


def test_bench_refuses_a_missing_model(tmp_path: Path) -> None:
    with pytest.raises(ModelMismatchError, match=r"none\.onnx"):
        time_stages(example_camera(), tmp_path / "none.onnx", rounds=10)


def test_this_installation_is_in_order() -> None:
    checks = {check.name: check for check in run_checks()}
    expected = {"python", "lanenet", "packages", "extra train", "opencv", "simplejpeg", "compiled loops"}
    assert expected | {"onnxruntime"} <= set(checks)
    assert [c for c in checks.values() if c.state == "problem"] == []


def test_broken_runtime_is_a_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    import onnxruntime

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("illegal instruction")

    monkeypatch.setattr(onnxruntime, "InferenceSession", fail)
    monkeypatch.setattr(cv2, "Canny", lambda *_: np.zeros((32, 32), np.uint8))
    states = {check.name: check.state for check in run_checks()}
    assert states["onnxruntime"] == "problem" and states["opencv"] == "problem"


def test_it_says_whether_images_that_lost_bytes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jpeg, "decode_jpeg", lambda _: np.zeros((64, 64, 3), np.uint8))
    assert {check.name: check.state for check in run_checks()}["simplejpeg"] == "problem"
    monkeypatch.setattr(jpeg, "simplejpeg", None)
    assert {check.name: check.state for check in run_checks()}["simplejpeg"] == "note"


def test_it_says_whether_the_compiled_loops_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    for kernels, state in ((object(), "ok"), (None, "note")):
        monkeypatch.setattr(compiled, "_kernels", kernels)
        assert {check.name: check.state for check in run_checks()}["compiled loops"] == state


def test_good_camera_sees_the_road(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    write_camera(path, example_camera(), "nominal values")
    checks = run_checks(path)
    assert [c for c in checks if c.state == "problem"] == []
    assert any(c.name == "road" and "15, 30 cm" in c.text for c in checks)


def test_unreadable_camera_file(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text("format: something-else/1\n")
    problems = [c for c in run_checks(path) if c.state == "problem"]
    assert len(problems) == 1 and str(path) in problems[0].text


def test_implausible_cameras_are_named() -> None:
    camera = example_camera()
    metres = camera.with_mounting(height_cm=0.2)
    assert "height" in problem_names(metres)
    degrees = camera.with_mounting(pitch_down_rad=25.0)
    assert "pitch down" in problem_names(degrees)
    upwards = camera.with_mounting(pitch_down_rad=-1.5)
    assert {"pitch down", "road"} <= problem_names(upwards)
    other_size = dataclasses.replace(camera, width=1280, height=960)
    assert "principal point" in problem_names(other_size)
    assert problem_names(camera) == set()


def problem_names(camera: Camera) -> set[str]:
    return {check.name for check in check_camera(camera) if check.state == "problem"}
