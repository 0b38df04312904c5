from __future__ import annotations

import math
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lanenet.config import check_settings, load_settings
from lanenet.control.controller import ControlSettings
from lanenet.control.steering import SteeringSettings
from lanenet.data.camera_file import read_camera
from lanenet.errors import CalibrationError, ConfigError, ModelMismatchError
from lanenet.onboard.donkey import (
    BirdseyeTransformer,
    CvLaneController,
    DonkeySettings,
    LanePilot,
    UndistortTransformer,
)
from lanenet.perception.camera_check import CameraCheck, Concern, Finding
from lanenet.perception.estimate import LaneEstimate

ROOT = Path(__file__).resolve().parents[3]
CHECKPOINT = ROOT / "checkpoints" / "small"
CONFIG = ROOT / "configs" / "donkeycar" / "pilot.yaml"


@pytest.fixture
def example_rgb() -> np.ndarray:
    """Donkeycar hands out red, green, blue."""
    return cv2.cvtColor(cv2.imread(str(CHECKPOINT / "example.jpg")), cv2.COLOR_BGR2RGB)


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        self.now_s += 0.05
        return self.now_s


class Answers:
    """A detector that gives the lane it was told to and keeps the image it saw."""

    def __init__(self) -> None:
        self.estimate = LaneEstimate()
        self.seen = None
        self.resets = 0

    def detect(self, frame_bgr):
        self.seen = frame_bgr
        return self.estimate

    def reset(self):
        self.resets += 1


@pytest.fixture
def pilot():
    settings = DonkeySettings(
        detector={"kind": "hough"},
        camera=CHECKPOINT / "camera.yaml",
        camera_check=False,
        control=ControlSettings(
            steering=SteeringSettings(wheelbase_cm=20.0, max_steering_rad=0.4), smoothing={"enabled": False}
        ),
        limits={
            "max_steering_rad": 0.4,
            "max_throttle": 0.25,
            "steering_rate_rad_s": 50,
            "throttle_rate_s": 50,
        },
        hold_s=0.12,
        # These tests show the same picture again and again, unless they say otherwise.
        allow_repeated_frames=True,
    )
    return pilot_of(settings)


def pilot_of(settings):
    pilot = LanePilot(settings, clock=Clock())
    pilot._detector = Answers()
    # Before its first image the car stands straight; from there it may turn as fast as its limits allow.
    assert pilot.run(None) == (0.0, 0.0)
    return pilot


def lane(shift_cm: float, confidence: float = 1.0) -> LaneEstimate:
    points = np.array([-20.0, -20, -20, 20, 20, 20]) + shift_cm
    return LaneEstimate(points_cm=points, confidence=confidence)


IMAGE = np.zeros((24, 32, 3), np.uint8)


def test_angle_has_donkeycars_sign(pilot):
    pilot._detector.estimate = lane(-10.0)
    angle, throttle = pilot.run(IMAGE)
    assert angle < -0.2 and 0.1 < throttle <= 0.25, "the lane lies to the left, so the angle is negative"
    pilot.shutdown()
    pilot._detector.estimate = lane(10.0)
    assert pilot.run(IMAGE)[0] == pytest.approx(-angle)
    pilot._detector.estimate = lane(35.0)
    assert pilot.run(IMAGE)[0] == 1.0


def test_detector_sees_blue_first(pilot):
    image = np.zeros((24, 32, 3), np.uint8)
    image[..., 0] = 200
    pilot.run(image[:, ::-1])
    assert pilot._detector.seen[0, 0].tolist() == [0, 0, 200] and pilot._detector.seen.flags.c_contiguous


@pytest.mark.parametrize("shape", [(24, 32), (24, 32, 1)])
def test_gray_camera(pilot, shape):
    """With ``IMAGE_DEPTH = 1`` Donkeycar hands out floats."""
    image = np.full(shape, 99.6)
    image[0, 0] = 255.4
    pilot.run(image)
    seen = pilot._detector.seen
    assert seen.shape == (24, 32, 3) and seen.dtype == np.uint8
    assert (seen[0, 0] == 255).all() and (seen[1:] == 100).all()


class Doubting(CameraCheck):
    def __init__(self, concern):
        self._found = Finding(concern, "the camera was turned")
        self.reset()

    def reset(self):
        self.finding = Finding()

    def look(self, frame_bgr, t_s, steering_rad=math.nan):
        self.finding = self._found
        return self.finding


@pytest.mark.parametrize(
    ("concern", "share"), [(Concern.WARN, 1.0), (Concern.SLOW, 0.5), (Concern.STOP, None)]
)
def test_a_camera_that_has_moved_slows_and_stops_the_car(pilot, caplog, concern, share):
    pilot._detector.estimate = lane(0.0)
    pilot._check = Doubting(concern)
    throttles = [pilot.run(IMAGE)[1] for _ in range(8)]
    # 60 cm/s: 0.1 to begin to roll, and 60 / 400 above it.
    assert throttles[0] == pytest.approx(0.25)
    assert throttles[-1] == (0.0 if share is None else pytest.approx(0.1 + share * 0.15))
    assert caplog.text.count("the camera was turned") == 1
    # A person drove it on: the views start anew, the throttle from 0.
    pilot._clock.now_s += 5.0
    assert [pilot.run(IMAGE)[1] for _ in range(2)] == [0.0, pytest.approx(0.25)]


def test_lost_lane_stops_the_car_after_its_time(pilot):
    pilot._detector.estimate = lane(-5.0)
    angle, throttle = pilot.run(IMAGE)
    pilot._detector.estimate = LaneEstimate()
    answers = [pilot.run(IMAGE) for _ in range(5)]
    assert [a for a, _ in answers] == [angle] * 5
    assert [t > 0.0 for _, t in answers] == [True, True, False, False, False], "0.12 s at 20 frames/s"
    assert throttle > 0.0 and answers[-1][1] == 0.0
    pilot._detector.estimate = lane(-5.0)
    assert pilot.run(IMAGE)[1] > 0.0


def test_camera_that_hangs_stops_the_car_after_its_time(pilot):
    pilot = pilot_of(pilot._settings.model_copy(update={"allow_repeated_frames": False}))
    pilot._detector.estimate = lane(-5.0)
    image = IMAGE.copy()
    assert pilot.run(image)[1] > 0.0
    # One array that is filled again and again, as some of Donkeycar's cameras do.
    for k in range(5):
        image[3, 4] = k + 1
        assert pilot.run(image)[1] > 0.0
    assert [pilot.run(image)[1] > 0.0 for _ in range(5)] == [True, True, False, False, False]
    assert pilot._detector.seen is not None and pilot.estimate.mask.all()
    image[3, 4] = 200
    assert pilot.run(image)[1] > 0.0


@pytest.mark.parametrize("changes", ["buffers in rotation", "upper rows", "clock"])
def test_camera_that_hangs_in_part_stops_the_car(pilot, changes):
    pilot = pilot_of(pilot._settings.model_copy(update={"allow_repeated_frames": False}))
    pilot._detector.estimate = lane(-5.0)
    rng = np.random.default_rng(4)
    held = [rng.integers(0, 255, (120, 160, 3), dtype=np.uint8) for _ in range(3)]
    assert all(pilot.run(image)[1] > 0.0 for image in held)
    throttles = []
    for k in range(9):
        image = held[k % 3].copy()
        if changes == "upper rows":
            image[:40] = rng.integers(0, 255, (40, 160, 3))
        elif changes == "clock":
            image[100:110, 10:70] = 20 * k
        throttles.append(pilot.run(image)[1])
    # It holds its last command for 0.12 s, at 20 images per second.
    assert max(throttles[2:]) == 0.0


def test_throttle_rises_from_zero_after_a_person_drove(pilot):
    limits = pilot._settings.limits.model_copy(update={"throttle_rate_s": 1.0})
    pilot = pilot_of(pilot._settings.model_copy(update={"limits": limits}))
    pilot._detector.estimate = lane(0.0)
    before = [pilot.run(IMAGE)[1] for _ in range(6)][-1]
    assert before == 0.25
    resets = pilot._detector.resets
    pilot._clock.now_s += 10.0
    after = [pilot.run(IMAGE)[1] for _ in range(3)]
    assert pilot._detector.resets == resets + 1, "the lane of before is not continued beside another road"
    assert after == pytest.approx([0.0, 0.05, 0.1])


def test_doubtful_frame_counts_as_none(pilot):
    pilot._detector.estimate = lane(0.0, confidence=0.2)
    assert [pilot.run(IMAGE)[1] for _ in range(3)] == [0.0, 0.0, 0.0]


def test_shipped_settings_drive_on_the_example(example_rgb):
    settings = load_settings(DonkeySettings, CONFIG, ["control.steering.wheelbase_cm=26"]).model_copy(
        update={"allow_repeated_frames": True}
    )
    pilot = LanePilot(settings, CONFIG.parent, clock=Clock())
    throttles = [pilot.run(example_rgb)[1] for _ in range(20)]
    assert np.diff(throttles).max() <= 0.0501, "the throttle rises by 1 per second at most"
    angle, throttle = pilot.run(example_rgb)
    # Steering is pure pursuit of the lane's centre, 15 cm ahead, to the left in this picture.
    assert pilot.estimate.mask.all() and -0.9 < angle < -0.05 and throttle > 0.1
    assert pilot.run_threaded(example_rgb) == (
        pytest.approx(angle, abs=0.05),
        pytest.approx(throttle, abs=0.05),
    )
    pilot.shutdown()


def test_cv_controller(example_rgb):
    cfg = SimpleNamespace(LANENET_CONFIG=str(CONFIG), OVERLAY_IMAGE=True)
    controller = CvLaneController(pid=None, cfg=cfg)
    before = example_rgb.copy()
    controller.run(None)
    time.sleep(0.01)
    angle, throttle, image = controller.run(example_rgb)
    assert angle < 0.0 < throttle and image.shape == example_rgb.shape
    assert (example_rgb == before).all() and (image != before).any(), "drawn into a copy"
    # The left line is drawn in green in either order of colours, the right one in orange: more red than blue.
    changed = image[(image != before).any(axis=2)].astype(int)
    assert (changed[:, 0] - changed[:, 2]).max() > 100
    assert controller.run(None)[2] is None
    gray = controller.run(example_rgb.mean(axis=2))[2]
    assert gray.shape == example_rgb.shape and gray.dtype == np.uint8, "the lane is drawn in colour"
    cfg.OVERLAY_IMAGE = False
    assert CvLaneController(None, cfg).run(example_rgb)[2] is example_rgb
    controller.shutdown()


class MovedLines(Answers):
    """Keeps how far it was told that the car has moved."""

    def moved(self, travel_cm, turn_rad, wheelbase_cm):
        self.travel_cm, self.turn_rad = travel_cm, turn_rad


@pytest.fixture
def controller(pilot):
    limits = pilot._settings.limits.model_copy(update={"throttle_rate_s": 1.0})
    controller = CvLaneController(None, SimpleNamespace(LANENET_CONFIG=str(CONFIG)))
    controller.pilot = pilot_of(pilot._settings.model_copy(update={"limits": limits}))
    controller.pilot._detector = MovedLines()
    controller.pilot._detector.estimate = lane(0.0)
    return controller


@pytest.mark.parametrize(("throttle", "speed_cm_s"), [(0.0, 0.0), (0.2, 40.0), (-0.5, 0.0)])
@pytest.mark.parametrize("mode", ["user", "local_angle"])
def test_a_person_with_the_throttle_moves_the_lane_memory(controller, mode, throttle, speed_cm_s):
    """By the throttle in force, (0.2 - 0.1) x 400 cm/s, not by the one that the pilot would have given."""
    for _ in range(3):
        controller.run(IMAGE, mode, -0.5, throttle)
    detector = controller.pilot._detector
    assert detector.travel_cm == pytest.approx(0.05 * speed_cm_s)
    # Half of 0.4 rad to the left.
    assert detector.turn_rad == pytest.approx(detector.travel_cm * math.tan(0.2) / 20.0)


def test_full_auto_begins_with_the_throttle_that_was_in_force(controller):
    """From Auto Steer, at rest and rolling; the pilot has its own wish ready all the time."""
    for before in (0.0, 0.12):
        for _ in range(8):
            controller.run(IMAGE, "local_angle", 0.0, before)
        throttles = [controller.run(IMAGE, "local", 0.0, before)[1] for _ in range(2)]
        assert throttles == pytest.approx([before + 0.05, before + 0.1])
    assert [controller.run(IMAGE, "local", 0.0, 0.2)[1] for _ in range(3)][-1] == 0.25


def test_full_auto_after_a_person_drove_begins_anew(controller):
    pilot = controller.pilot
    pilot._check = Doubting(Concern.STOP)
    for _ in range(8):
        controller.run(IMAGE, "user", 0.3, 0.25)
    assert pilot._finding.concern is Concern.STOP
    resets = pilot._detector.resets
    throttles = [controller.run(IMAGE, "local", 0.3, 0.25)[1] for _ in range(2)]
    # Clock() goes on by 0.05 s each time it is asked, which is done once more when the pilot takes over.
    assert throttles == pytest.approx([0.05, 0.1]) and pilot._detector.resets == resets + 1


def test_what_is_missing_is_named(tmp_path):
    with pytest.raises(ConfigError, match="LANENET_CONFIG is missing"):
        CvLaneController(None, SimpleNamespace())
    with pytest.raises(ConfigError, match="LANENET_CAMERA is missing"):
        BirdseyeTransformer(SimpleNamespace())
    with pytest.raises(ConfigError, match="no such file"):
        LanePilot.from_file(tmp_path / "lanenet.yaml")
    control = {"steering": {"wheelbase_cm": 20}}
    with pytest.raises(ConfigError, match="did you mean 'min_confidence'"):
        check_settings(DonkeySettings, {"control": control, "min_confidenc": 1}, "lanenet.yaml")


def test_the_wheelbase_is_the_cameras_unless_the_file_says(tmp_path):
    """One number: that of the map, which stands in the camera file. No template has another one."""
    camera = (CHECKPOINT / "camera.yaml").read_text()
    (tmp_path / "camera.yaml").write_text(camera)
    pilot = CONFIG.read_text().replace("../../checkpoints/small/camera.yaml", "camera.yaml")
    pilot = pilot.replace("../../checkpoints/small", str(CHECKPOINT))
    for name, steering in (("own", "{}"), ("given", "{wheelbase_cm: 21}")):
        (tmp_path / f"{name}.yaml").write_text(pilot.replace("steering: {}", f"steering: {steering}"))
    found = [
        LanePilot.from_file(tmp_path / f"{name}.yaml")._settings.control.steering.wheelbase_cm
        for name in ("own", "given")
    ]
    assert found == [read_camera(CHECKPOINT / "camera.yaml").wheelbase_cm, 21.0]


def test_model_of_another_camera_is_refused(tmp_path):
    settings = load_settings(DonkeySettings, CONFIG, ["control.steering.wheelbase_cm=26"])
    text = (CHECKPOINT / "camera.yaml").read_text().replace("height_cm: ", "height_cm: 1")
    (tmp_path / "camera.yaml").write_text(text)
    other = settings.model_copy(update={"camera": tmp_path / "camera.yaml"})
    with pytest.raises(ModelMismatchError, match="trained with camera"):
        LanePilot(other, CONFIG.parent)


def test_transformers(example_rgb):
    cfg = SimpleNamespace(LANENET_CAMERA=str(CHECKPOINT / "camera.yaml"), LANENET_WINDOW={"cell_cm": 1.5})
    birdseye = BirdseyeTransformer(cfg)
    assert birdseye.run(example_rgb).shape == (96, 128, 3)
    assert birdseye.run(None) is None
    assert UndistortTransformer(cfg).run(example_rgb[:, ::-1]).shape == example_rgb.shape
    with pytest.raises(CalibrationError, match="px, expected"):
        birdseye.run(example_rgb[:50, :60])
    cfg.LANENET_WINDOW = {"cells_cm": 1}
    with pytest.raises(ConfigError, match="did you mean 'cell_cm'"):
        BirdseyeTransformer(cfg)
