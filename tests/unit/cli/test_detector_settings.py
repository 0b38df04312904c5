"""What a detector can be told: settings files, the lane's measures, and a mask of the car itself."""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
from detections import read_detections
from typer.testing import CliRunner, Result

from lanenet.cli import app as cli
from lanenet.config import check_settings
from lanenet.data.camera_file import write_camera
from lanenet.data.drives.sources import Source, find_mask, read_mask
from lanenet.errors import CalibrationError, ConfigError, DriveFormatError
from lanenet.onboard.bench import example_camera, example_frames
from lanenet.onboard.drive import DriveSettings, build_drive_detector
from lanenet.perception.estimate import DetectorInputs
from lanenet.perception.lane_filter import LaneFilter, lane_filter_settings
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.registry import build_detector

CAMERA = example_camera()
MODEL = Path(__file__).resolve().parents[3] / "checkpoints" / "small" / "model.onnx"
#: Rows of the picture in which the car of these tests sees itself, and the columns.
BUMPER = slice(215, None), slice(90, 230)


@functools.cache
def frames(bumper: bool, count: int = 24) -> list[np.ndarray]:
    painted = example_frames(CAMERA, count, np.random.default_rng(4))
    for k, frame in enumerate(painted):
        # A lamp that wanders, so that frames differ.
        cv2.circle(frame, (20 + 11 * k, 90), 40, (200, 200, 200), -1)
        if bumper:
            frame[BUMPER] = 20
            frame[215:, 150:153] = 240
    return painted


def source_of(pictures: list[np.ndarray]) -> Source:
    n = len(pictures)
    return Source(
        "a drive", np.arange(n), np.arange(n) / 20.0, np.arange(n) == 0, 20.0, lambda i: pictures[i]
    )


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(cli.app, [str(word) for word in words], env={"COLUMNS": "200"})


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for k, frame in enumerate(frames(bumper=True)):
        cv2.imwrite(str(folder / f"{k:03d}.png"), frame)
    write_camera(tmp_path / "camera.yaml", CAMERA, "nominal values")
    return folder


def detect(tmp_path: Path, photos: Path, *more: str | Path, detector: str = "lane-filter") -> Result:
    always = ("detect", photos, "--detector", detector, "--out", tmp_path / "l.csv")
    return run(*always, "--camera", tmp_path / "camera.yaml", *more)


def test_options_go_before_the_file_and_the_file_before_the_drive(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text("filter: {lane_width_cm: 35, marking_cm: 3, polarity: dark}\n")
    settings, _ = lane_filter_settings(DetectorInputs(config=path, drive_lane_width_cm=50.0))
    assert (settings.lane_width_cm, settings.marking_cm, settings.polarity) == (35.0, 3.0, "dark")
    given = DetectorInputs(config=path, lane_width_cm=40.0, drive_lane_width_cm=50.0, marking_cm=2.5)
    settings, _ = lane_filter_settings(given)
    assert (settings.lane_width_cm, settings.marking_cm, settings.polarity) == (40.0, 2.5, "dark")
    path.write_text("filter: {marking_cm: 3}\n")
    assert (
        lane_filter_settings(DetectorInputs(config=path, drive_lane_width_cm=50.0))[0].lane_width_cm == 50.0
    )
    with pytest.raises(ConfigError, match=r"s\.yaml lacks the lane width.*--lane-width"):
        lane_filter_settings(DetectorInputs(config=path))
    with pytest.raises(ConfigError, match="--lane-width"):
        lane_filter_settings(DetectorInputs())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("filtre: {}", r"s\.yaml: unknown key 'filtre', did you mean 'filter'"),
        ("filter: {markng_cm: 2}", r"s\.yaml: filter: unknown key 'markng_cm', did you mean 'marking_cm'"),
        ("filter: {marking_cm: thick}", r"s\.yaml: filter: key 'marking_cm'.*found 'thick'"),
        ("filter: [1]", r"s\.yaml: key 'filter'.*found \[1\]"),
        ("perception: {edges: {method: sobel}}", r"s\.yaml: key 'perception\.edges\.method'"),
    ],
)
def test_mistakes_in_the_file_are_named(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(text + "\n")
    with pytest.raises(ConfigError, match=said):
        lane_filter_settings(DetectorInputs(config=path, lane_width_cm=40.0))


def test_the_files_perception_is_what_the_filter_sees(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text("perception: {edges: {method: canny}, range: {bottom_rows: 30}}\n")
    detector = build_detector("lane-filter", DetectorInputs(camera=CAMERA, lane_width_cm=40.0, config=path))
    assert isinstance(detector, LaneFilter) and detector.extractor is not None
    assert detector.extractor.settings.edges.method == "canny"
    assert not detector.extractor.table.keep[-30:].any() and detector.extractor.table.keep[-31].any()


def test_detect_with_a_settings_file(tmp_path: Path, photos: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text("filter: {lane_width_cm: 70}\n")
    assert detect(tmp_path, photos, "--config", path).exit_code == 0
    assert not np.isfinite(read_detections(tmp_path / "l.csv").points_cm).any()
    result = detect(tmp_path, photos, "--config", path, "--lane-width", "40")
    assert result.exit_code == 0, result.output
    assert np.isfinite(read_detections(tmp_path / "l.csv").points_cm[:, 1]).mean() > 0.8
    assert f"--config {path}" in result.stdout
    paper = Path(__file__).resolve().parents[3] / "configs" / "detectors" / "lane_filter_paper.yaml"
    assert detect(tmp_path, photos, "--config", paper, "--lane-width", "40").exit_code == 0
    assert np.isfinite(read_detections(tmp_path / "l.csv").points_cm[:, 1]).mean() > 0.8


def test_the_car_is_found_in_the_frames() -> None:
    mask, told = find_mask(source_of(frames(bumper=True)))
    assert mask is not None and mask.shape == (240, 320) and "lowest 2" in told
    assert mask[BUMPER][3:, 3:-3].all()
    assert not mask[:205].any() and not mask[:, :80].any() and not mask[:, 240:].any()


def test_no_mask_says_why() -> None:
    assert find_mask(source_of(frames(bumper=False)))[0] is None
    still = find_mask(source_of(frames(bumper=True)[:1] * 40))
    assert still[0] is None and "1 of 40 frames show something new" in still[1]
    high = [frame.copy() for frame in frames(bumper=False)]
    for frame in high:
        frame[180:, 60:260] = 10
    mask, told = find_mask(source_of(high))
    assert mask is None and "too high for the car" in told


def test_unreadable_frames_do_not_hide_the_car() -> None:
    pictures = frames(bumper=True)

    def image(i: int) -> np.ndarray:
        if i == 5:
            raise DriveFormatError("000005.jpg: cannot be read")
        return pictures[i]

    whole = source_of(pictures)
    broken = Source("a drive", whole.frames, whole.t_s, whole.starts, 20.0, image)
    mask, _ = find_mask(broken)
    assert mask is not None and mask[BUMPER][3:, 3:-3].all()


def test_mask_files(tmp_path: Path) -> None:
    path = tmp_path / "m.png"
    picture = np.zeros((240, 320, 3), np.uint8)
    picture[200:, :, 0] = 1
    cv2.imwrite(str(path), picture)
    mask = read_mask(path)
    assert mask.shape == (240, 320) and set(np.unique(mask)) == {0, 255}
    assert mask[200:].all() and not mask[:200].any()
    # Opaque everywhere, painted nowhere.
    cv2.imwrite(str(path), np.dstack([np.zeros((9, 9, 3), np.uint8), np.full((9, 9), 255, np.uint8)]))
    assert not read_mask(path).any()
    cv2.imwrite(str(path), np.full((9, 9), 256, np.uint16))
    with pytest.raises(ConfigError, match="masks the whole image"):
        read_mask(path)
    path.write_bytes(b"no picture")
    with pytest.raises(ConfigError, match=r"m\.png: not a readable image"):
        read_mask(path)
    path.write_bytes(b"")
    with pytest.raises(ConfigError, match=r"m\.png: the image file is empty"):
        read_mask(path)
    with pytest.raises(ConfigError, match=r"none\.png: no such file"):
        read_mask(tmp_path / "none.png")
    with pytest.raises(ConfigError, match=r"expected 'auto' or a \.png"):
        read_mask(tmp_path / "m.jpg")


def test_masked_pixels_give_no_edges() -> None:
    mask = np.zeros((240, 320), np.uint8)
    mask[BUMPER] = 255
    detector = build_detector("lane-filter", DetectorInputs(camera=CAMERA, lane_width_cm=40.0, mask=mask))
    assert isinstance(detector, LaneFilter) and detector.extractor is not None
    assert not detector.extractor.table.keep[BUMPER].any()
    with pytest.raises(CalibrationError, match=r"mask of 9x9 px.*320x240"):
        build_detector(
            "lane-filter",
            DetectorInputs(camera=CAMERA, lane_width_cm=40.0, mask=np.zeros((9, 9), np.uint8)),
        )
    for name in ("hough", "painter"):
        with pytest.raises(ConfigError, match=f"detector {name}: takes no mask"):
            build_detector(name, DetectorInputs(camera=CAMERA, mask=mask))


def test_detect_with_a_mask(tmp_path: Path, photos: Path) -> None:
    result = detect(tmp_path, photos, "--lane-width", "40", "--mask", "auto")
    assert result.exit_code == 0, result.output
    assert "show the car" in result.stdout and "--mask auto" in result.stdout
    assert np.isfinite(read_detections(tmp_path / "l.csv").points_cm[:, 1]).mean() > 0.8
    # A picture that hides all but the sky and a corner leaves no lane.
    picture = np.full((240, 320), 255, np.uint8)
    picture[:130] = 0
    picture[-9:, :9] = 0
    cv2.imwrite(str(tmp_path / "m.png"), picture)
    hidden = detect(tmp_path, photos, "--lane-width", "40", "--mask", tmp_path / "m.png")
    assert hidden.exit_code == 0, hidden.output
    assert not np.isfinite(read_detections(tmp_path / "l.csv").points_cm).any()
    for name in ("hough", "painter"):
        refused = detect(tmp_path, photos, "--mask", "auto", detector=name)
        assert refused.exit_code == 1 and "takes no mask" in refused.stderr
    missing = detect(tmp_path, photos, "--lane-width", "40", "--mask", tmp_path / "n.png")
    assert missing.exit_code == 1 and "n.png" in missing.stderr


def test_a_network_hears_the_lanes_width_from_the_nearest_source() -> None:
    def width_cm(**told: float) -> float | None:
        inputs = DetectorInputs(camera=CAMERA, model=MODEL, any_camera=True, **told)  # type: ignore[arg-type]
        detector = build_detector("network", inputs)
        assert isinstance(detector, NetworkDetector)
        return detector.memory.width_cm

    assert width_cm() is None
    assert width_cm(drive_lane_width_cm=35.0) == 35.0
    assert width_cm(drive_lane_width_cm=35.0, lane_width_cm=42.0) == 42.0
    steering = {"wheelbase_cm": 26.0, "lane_width_cm": 33.0}
    settings = check_settings(
        DriveSettings,
        {
            "source": {"kind": "replay", "path": "nowhere"},
            "detector": {"model": str(MODEL), "any_camera": True},
            "control": {"steering": steering},
        },
        "test",
    )
    detector = build_drive_detector(settings, CAMERA)
    assert isinstance(detector, NetworkDetector) and detector.memory.width_cm == 33.0
