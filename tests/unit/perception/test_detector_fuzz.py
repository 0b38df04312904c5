"""Whatever comes in: a clear error or an empty estimate, never a fault from within or an invented lane."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import cv2
import jaxtyping
import numpy as np
import pytest
from detections import read_detections
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from typer.testing import CliRunner

from lanenet.cli import app as cli
from lanenet.data.camera_file import read_camera, write_camera
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError
from lanenet.onboard.bench import example_camera, example_frames
from lanenet.perception.estimate import Detector, DetectorInputs, LaneEstimate
from lanenet.perception.hough.detector import HoughSettings, HoughTracker
from lanenet.perception.registry import build_detector

NAMES = ("hough", "painter")


def detectors() -> list[Detector]:
    value = HoughSettings.model_validate({"edges": {"channel": "value"}})
    return [*(build_detector(name, DetectorInputs()) for name in NAMES), HoughTracker(None, value)]


def assert_empty(estimate: LaneEstimate) -> None:
    assert not estimate.mask.any() and estimate.confidence == 0.0 and np.isnan(estimate.steering_rad)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.integers(0, 2**32 - 1), st.integers(1, 260), st.integers(1, 360), st.booleans())
def test_noise_is_no_lane(seed: int, height: int, width: int, colour: bool) -> None:
    shape = (height, width, 3) if colour else (height, width)
    frame = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    for detector in detectors():
        assert_empty(detector.detect(frame))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=3, min_side=1, max_side=60)))
def test_any_array_is_answered_or_refused(frame: np.ndarray) -> None:
    for detector in detectors():
        if frame.ndim == 3 and frame.shape[2] != 3:
            with pytest.raises(DriveFormatError, match="frame: expected"):
                detector.detect(frame)
        else:
            estimate = detector.detect(frame)
            assert 0.0 <= estimate.confidence <= 1.0 and not estimate.mask.any()


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 1), (1, 500, 3), (500, 1, 3), (2, 3000, 3), (240, 320, 3)])
@pytest.mark.parametrize("value", [0, 128, 255])
def test_plain_frames_are_no_lane(shape: tuple[int, ...], value: int) -> None:
    for detector in detectors():
        assert_empty(detector.detect(np.full(shape, value, np.uint8)))


@pytest.mark.parametrize("name", [*NAMES, "lane-filter"])
def test_plain_frames_and_noise_of_a_calibrated_camera(name: str) -> None:
    camera = example_camera()
    detector = build_detector(name, DetectorInputs(camera=camera, lane_width_cm=40.0))
    for value in (0, 255):
        assert_empty(detector.detect(np.full((camera.height, camera.width, 3), value, np.uint8)))
    rng = np.random.default_rng(0)
    for _ in range(5):
        noise = rng.integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)
        assert_empty(detector.detect(noise))


@pytest.fixture
def without_type_checks() -> Iterator[None]:
    """As on the car: the tests' own checks of types would answer first."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)


@pytest.mark.parametrize("name", [*NAMES, "lane-filter", "network"])
@pytest.mark.parametrize(
    ("frame", "found"),
    [
        (None, "NoneType"),
        ([[0, 0], [0, 0]], "list"),
        ("frame.jpg", "str"),
        (np.zeros((240, 320, 3)), r"float64 \(240, 320, 3\)"),
        (np.zeros((0, 0, 3), np.uint8), r"uint8 \(0, 0, 3\)"),
    ],
)
def test_what_is_no_image_is_named(without_type_checks: None, name: str, frame: object, found: str) -> None:
    folder = Path(__file__).resolve().parents[3] / "checkpoints" / "small"
    model = folder / "model.onnx" if name == "network" else None
    camera = read_camera(folder / "camera.yaml")
    detector = build_detector(name, DetectorInputs(camera=camera, model=model, lane_width_cm=40.0))
    with pytest.raises(DriveFormatError, match=rf"expected a uint8 image .* found {found}"):
        detector.detect(frame)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["network", "lane-filter"])
def test_the_others_need_a_camera(name: str) -> None:
    with pytest.raises(CalibrationError, match="--camera"):
        build_detector(name, DetectorInputs())


def test_settings_file_is_read_and_refused_with_another_key(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text("edges: {channel: value}\n")
    tracker = build_detector("hough", DetectorInputs(config=path))
    assert isinstance(tracker, HoughTracker) and tracker.settings.edges.channel == "value"
    path.write_text("edges: {chanel: value}\n")
    with pytest.raises(ConfigError, match="did you mean 'channel'"):
        build_detector("hough", DetectorInputs(config=path))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    camera = dataclasses.replace(example_camera())
    path = tmp_path / "drive.avi"
    size = (camera.width, camera.height)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, size)
    for frame in example_frames(camera, 12, np.random.default_rng(0)):
        writer.write(frame)
    writer.release()
    write_camera(tmp_path / "camera.yaml", camera, "nominal values")
    return path


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("with_camera", [True, False])
def test_detect_on_a_video(tmp_path: Path, video: Path, name: str, with_camera: bool) -> None:
    out, annotated = tmp_path / "l.csv", tmp_path / "l.mp4"
    words = ["detect", str(video), "--detector", name, "--out", str(out), "--video", str(annotated)]
    words += ["--camera", str(tmp_path / "camera.yaml")] if with_camera else []
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    assert len(read_detections(out).frame) == 12 and annotated.stat().st_size > 0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kept", [0.0, 0.02, 0.3, 0.7, 0.95])
def test_truncated_video(tmp_path: Path, video: Path, name: str, kept: float) -> None:
    data = video.read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(data[: int(kept * len(data))])
    out = tmp_path / "l.csv"
    result = CliRunner().invoke(cli.app, ["detect", str(cut), "--detector", name, "--out", str(out)])
    if result.exit_code == 0:
        assert 0 < len(read_detections(out).frame) <= 12
    else:
        assert result.exit_code == 1 and "error: " in result.stderr and not out.exists()
        assert isinstance(result.exception, SystemExit)


def test_photos_of_different_sizes_make_one_video(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for i, (height, width) in enumerate([(240, 320), (120, 160), (300, 300)]):
        cv2.imwrite(str(folder / f"{i}.png"), np.full((height, width, 3), 90, np.uint8))
    (folder / "00.png").write_bytes(b"no picture")
    out, annotated = tmp_path / "l.csv", tmp_path / "l.mp4"
    words = ["detect", str(folder), "--detector", "painter", "--out", str(out), "--video", str(annotated)]
    refused = CliRunner().invoke(cli.app, words)
    assert refused.exit_code == 1 and "00.png" in refused.stderr and not out.exists()
    words.append("--skip-unreadable")
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    assert len(read_detections(out).frame) == 4
    capture = cv2.VideoCapture(str(annotated))
    count = 0
    while capture.read()[0]:
        count += 1
    capture.release()
    assert count == 4
