from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lanenet.control.controller import ControlSettings, LaneController
from lanenet.control.steering import SteeringSettings
from lanenet.errors import HardwareError, MotorMayRunError
from lanenet.onboard.arming import HoldFile
from lanenet.onboard.devices import Frame, FrameSource, SourceEnded
from lanenet.onboard.guard import StoppedError
from lanenet.onboard.loop import CarParts, DriveLoop, DriveMode, DriveReport, LatencyHistogram, Step
from lanenet.onboard.neutral import CONFIRMED, SENT, Neutral
from lanenet.onboard.safety import LimitSettings, SafetySettings, State
from lanenet.perception.camera_check import CameraCheck, Concern, Finding
from lanenet.perception.estimate import LaneEstimate

RATE_HZ = 30.0
CONTROL = ControlSettings(steering=SteeringSettings(wheelbase_cm=26.0))
LANE = LaneEstimate(np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0]), confidence=1.0)


class Clock:
    """Time that passes only when somebody waits."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Camera:
    """30 frames per second, each 10 ms old when it is read; what ``faults`` says at a frame happens there."""

    def __init__(self, clock: Clock, count: int, faults: dict[int, Callable[[], Frame | None]]) -> None:
        self._clock, self._count, self._faults, self._number = clock, count, faults, -1
        self.closed = 0

    def open(self) -> None:
        pass

    def frame(self, level: int | None = None) -> Frame:
        image = np.full((24, 32, 3), (self._number if level is None else level) % 256, np.uint8)
        return Frame(image, self._clock.now_s - 0.01, self._number)

    def read(self, timeout_s: float) -> Frame | None:
        self._number += 1
        if self._number >= self._count:
            raise SourceEnded
        self._clock.now_s += 1.0 / RATE_HZ
        fault = self._faults.get(self._number)
        return self.frame() if fault is None else fault()

    def close(self) -> None:
        self.closed += 1


class Eye:
    def __init__(self, answer: Callable[[int], LaneEstimate]) -> None:
        self._answer, self._seen = answer, -1
        self.travels_cm: list[float] = []

    def detect(self, frame_bgr: np.ndarray) -> LaneEstimate:
        self._seen += 1
        return self._answer(self._seen)

    def reset(self) -> None:
        self._seen = -1

    def moved(self, travel_cm: float, turn_rad: float, wheelbase_cm: float) -> None:
        self.travels_cm.append(travel_cm)


class Wire:
    """What was sent, and when."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self.log: list[tuple[float, str, float, float, float]] = []
        self.left = CONFIRMED

    def open(self) -> None:
        self.log.append((self._clock(), "open", 0.0, 0.0, 0.0))

    def send(self, steering_rad: float, throttle: float, until_s: float) -> None:
        self.log.append((self._clock(), "send", steering_rad, throttle, until_s))

    def idle(self) -> None:
        self.neutral()

    def neutral(self) -> None:
        self.log.append((self._clock(), "neutral", 0.0, 0.0, 0.0))

    def close(self) -> Neutral:
        self.log.append((self._clock(), "close", 0.0, 0.0, 0.0))
        return self.left

    def moving(self) -> list[tuple[float, float]]:
        """Times from which to which the motor turns."""
        return [(t, until) for t, kind, _, throttle, until in self.log if kind == "send" and throttle > 0.0]


class Car:
    def __init__(
        self,
        count: int = 60,
        faults: dict[int, Callable[[], Frame | None]] | None = None,
        answer: Callable[[int], LaneEstimate] = lambda _: LANE,
        check: CameraCheck | None = None,
        hold: HoldFile | None = None,
        countdown_s: float = 0.0,
        **options: bool,
    ) -> None:
        self.clock = Clock()
        self.camera = Camera(self.clock, count, faults or {})
        self.wire, self.eye = Wire(self.clock), Eye(answer)
        self.steps: list[Step] = []
        self.loop = DriveLoop(
            CarParts(self.camera, self.eye, LaneController(CONTROL), self.wire, None, check, None, hold),
            SafetySettings(countdown_s=countdown_s),
            LimitSettings(),
            CONTROL.speed,
            DriveMode(**options),
            self.steps.append,
            self.clock,
        )


def test_fakes_answer_to_the_protocols() -> None:
    assert isinstance(Camera(Clock(), 1, {}), FrameSource)


def test_the_detector_hears_how_the_car_moves_only_if_it_moves_as_commanded() -> None:
    armed = Car(armed=True)
    armed.loop.run()
    # 60 cm/s in the end, at 30 frames/s.
    assert len(armed.eye.travels_cm) == 59 and armed.eye.travels_cm[-1] == pytest.approx(2.0)
    for pushed in (Car(), Car(steering_only=True), Car(armed=True, record_commands=False)):
        pushed.loop.run()
        assert pushed.eye.travels_cm == []


def test_an_armed_car_drives_and_ends_in_neutral() -> None:
    car = Car(armed=True)
    report = car.loop.run()
    assert report.ended == "the recording is over" and not report.by_fault
    assert report.frames == 60 and report.states == {State.DRIVING: 60}
    throttles = [throttle for _, kind, _, throttle, _ in car.wire.log if kind == "send"]
    # 60 cm/s: 0.1 to begin to roll and 60 / 400 above it; it gets there at one per second.
    assert throttles[-1] == pytest.approx(0.25) and throttles[3] == pytest.approx(3.0 / RATE_HZ)
    assert [kind for _, kind, *_ in car.wire.log][-2:] == ["neutral", "close"]
    assert car.camera.closed == 1
    # Each command is good for 80 ms; its frame, which is 10 ms old, would allow 90.
    sent = [(t, until) for t, kind, _, _, until in car.wire.log if kind == "send"]
    assert all(until == pytest.approx(t + 0.08) for t, until in sent)


@pytest.mark.parametrize(("options", "steers"), [({}, False), ({"steering_only": True}, True)])
def test_without_arming_the_motor_never_turns(options: dict[str, bool], steers: bool) -> None:
    offset = LaneEstimate(LANE.points_cm - 5.0, confidence=1.0)
    car = Car(answer=lambda _: offset, **options)
    car.loop.run()
    assert car.wire.moving() == []
    sent = [steering for _, kind, steering, _, _ in car.wire.log if kind == "send"]
    assert bool(sent) is steers
    if steers:
        assert sent[-1] > 0.1  # the lane is to the left


class Doubting(CameraCheck):
    """Finds something in the 20th frame that it is shown."""

    def __init__(self, concern: Concern) -> None:
        self.found, self.steering_rad = Finding(concern, "the camera was turned"), [0.0][:0]

    def look(self, frame_bgr: np.ndarray, t_s: float, steering_rad: float = np.nan) -> Finding:
        self.steering_rad.append(steering_rad)
        return self.found if len(self.steering_rad) >= 20 else Finding()


@pytest.mark.parametrize(
    ("concern", "state"),
    [(Concern.WARN, State.DRIVING), (Concern.SLOW, State.SLOW), (Concern.STOP, State.ENDED)],
)
def test_a_camera_that_has_moved_warns_slows_and_stops(
    concern: Concern, state: State, caplog: pytest.LogCaptureFixture
) -> None:
    car = Car(120, check=Doubting(concern), armed=True)
    with caplog.at_level(logging.WARNING):
        report = car.loop.run()
    assert car.steps[-1].state is state and report.by_fault is (state is State.ENDED)
    assert "the camera was turned" in caplog.text
    if state is State.SLOW:
        # Half of 60 cm/s: 0.1 to begin to roll and 30 / 400 above it.
        assert car.steps[-1].throttle == pytest.approx(0.175)


def test_the_camera_is_compared_only_while_the_car_drives() -> None:
    standing, dry = Doubting(Concern.NONE), Doubting(Concern.NONE)
    Car(30, check=standing, steering_only=True).loop.run()
    Car(30, check=dry, armed=True, record_commands=False).loop.run()
    assert standing.steering_rad == []
    # Whoever steers in a dry run, it is not the loop.
    assert dry.steering_rad and np.isnan(dry.steering_rad).all()


def test_a_car_that_is_let_go_stops_and_ends(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.touch()

    def answer(number: int) -> LaneEstimate:
        if number == 30:
            key.unlink()
        return LANE

    car = Car(120, answer=answer, hold=HoldFile(key), armed=True)
    report = car.loop.run()
    assert report.by_fault and str(key) in report.ended
    assert max(until for _, until in car.wire.moving()) <= 100.0 + 31.0 / RATE_HZ + 0.1


NOTHING = LaneEstimate()
FAULTS: dict[str, tuple[str, Callable[[int], LaneEstimate] | None, str]] = {
    "nan": ("answer", lambda k: LANE if k < 30 else LaneEstimate(confidence=1.0), "no lane in frame"),
    "inf": (
        "answer",
        lambda k: LANE if k < 30 else LaneEstimate(np.full(6, np.inf), confidence=1.0),
        "no lane in frame",
    ),
    "nothing seen": ("answer", lambda k: LANE if k < 30 else NOTHING, "no lane in frame"),
    "aside": (
        "answer",
        lambda k: LANE if k < 30 else replace(LANE, points_cm=LANE.points_cm + 500.0),
        "520 cm",
    ),
    "jump": (
        "answer",
        lambda k: replace(
            LANE, points_cm=LANE.points_cm + (40.0 if k % 2 and k >= 30 else 0.0 if k < 30 else -40.0)
        ),
        "the lane is in another place in every frame",
    ),
    "sigma": (
        "answer",
        lambda k: LANE if k < 30 else replace(LANE, sigma_cm=np.array([1.0, np.inf, 1.0, 1.0, 1.0, 1.0])),
        "sigma",
    ),
    "doubt": (
        "answer",
        lambda k: LANE if k < 30 else LaneEstimate(LANE.points_cm, confidence=0.1),
        "confidence 0.10",
    ),
    "no frame": ("camera", None, "no frame from the camera"),
    "frozen": ("camera", None, "repeats the one before"),
    "late": ("camera", None, "300 ms old"),
    "ahead": ("camera", None, "ahead of the clock"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_runs_out_within_100_ms_and_is_told(name: str, caplog: pytest.LogCaptureFixture) -> None:
    _, answer, told = FAULTS[name]
    car = Car(90, answer=answer or (lambda _: LANE), armed=True)
    camera = car.camera

    def late(off_s: float) -> Frame:
        return Frame(camera.frame().image_bgr, car.clock.now_s - off_s, camera._number)

    if name == "no frame":
        camera._faults = dict.fromkeys(range(30, 90), lambda: None)
    elif name == "frozen":
        camera._faults = dict.fromkeys(range(30, 90), lambda: camera.frame(level=29))
    elif name in ("late", "ahead"):
        camera._faults = dict.fromkeys(range(30, 90), lambda: late(0.3 if name == "late" else -1.0))
    fault_s = 100.0 + 31.0 / RATE_HZ
    with caplog.at_level(logging.INFO):
        report = car.loop.run()
    moving = car.wire.moving()
    assert moving[-1][0] < fault_s, "the motor was driven by what is no answer"
    # The guard goes to neutral at that time if nothing else comes; and from here on nothing does.
    assert moving[-1][1] <= fault_s + 0.1
    assert report.by_fault and told in report.ended and "stopped for 1 s" in report.ended
    assert any(told in record.message and record.levelno >= logging.WARNING for record in caplog.records)
    # One line for the stop and one for the end, not one per frame.
    assert len([r for r in caplog.records if told in r.message]) <= 3


def test_a_short_gap_goes_on_with_the_throttle_rising_again() -> None:
    car = Car(120, dict.fromkeys(range(60, 70), lambda: None), armed=True)
    report = car.loop.run()
    assert report.ended == "the recording is over"
    # The last command holds for 80 ms: two frames may be missing without a stop.
    assert report.states == {State.DRIVING: 110, State.STOPPED: 8}
    by_time = [(t, throttle) for t, kind, _, throttle, _ in car.wire.log if kind == "send"]
    after = [throttle for t, throttle in by_time if t > 100.0 + 70.5 / RATE_HZ]
    assert after[0] < 0.1 and after[-1] == pytest.approx(0.25)


@pytest.mark.parametrize("where", ["camera", "detector", "controller", "actuator", "watch"])
def test_an_exception_is_neutral_first_and_goes_on_up(where: str, caplog: pytest.LogCaptureFixture) -> None:
    def fail(*_: object) -> LaneEstimate:
        raise RuntimeError("struck by lightning")

    car = Car(armed=True)
    sends = 0

    def send(steering_rad: float, throttle: float, until_s: float) -> None:
        nonlocal sends
        sends += 1
        if sends == 30:
            raise HardwareError("struck by lightning")

    if where == "camera":
        car.camera._faults = {30: fail}  # type: ignore[dict-item]
    elif where == "detector":
        failing = Eye(lambda k: LANE if k < 30 else fail())
        car.loop._parts = replace(car.loop._parts, detector=failing)
    elif where == "controller":
        calls = iter(range(31))
        whole = car.loop._parts.controller.target
        car.loop._parts.controller.target = lambda *words: (  # type: ignore[method-assign]
            whole(*words) if next(calls) < 30 else fail()
        )
    elif where == "actuator":
        car.wire.send = send  # type: ignore[method-assign]
    else:
        car.loop._watch = fail
    with pytest.raises((RuntimeError, HardwareError), match="lightning"), caplog.at_level(logging.INFO):
        car.loop.run()
    kinds = [kind for _, kind, *_ in car.wire.log]
    assert kinds[-1] == "close" and "neutral" in kinds[-3:] and car.camera.closed == 1
    assert any("neutral" in r.message and "lightning" in r.message for r in caplog.records)


def test_a_source_that_cannot_be_opened_leaves_neutral_behind() -> None:
    car = Car(armed=True)

    def refuse() -> None:
        raise HardwareError("no camera")

    car.camera.open = refuse  # type: ignore[method-assign]
    with pytest.raises(HardwareError, match="no camera"):
        car.loop.run()
    assert [kind for _, kind, *_ in car.wire.log][-1] == "close"


def test_a_camera_with_pauses_between_its_frames_ends_the_countdown() -> None:
    """At 15 frames per second every second turn of the loop has none."""
    car = Car(faults=dict.fromkeys(range(1, 60, 2), lambda: None), armed=True, countdown_s=0.5)
    report = car.loop.run()
    assert report.states[State.DRIVING] > 15 and State.STOPPED not in report.states


@pytest.mark.parametrize("asked", [True, False])
def test_the_message_and_the_code_of_a_neutral_that_is_not_confirmed(
    asked: bool, caplog: pytest.LogCaptureFixture
) -> None:
    car = Car(armed=True)
    car.wire.left = Neutral(False, "no answer")
    car.loop._watch = lambda step: car.loop.stop("SIGINT") if asked and step.frame == 20 else None
    with pytest.raises(MotorMayRunError, match=r"disconnect the battery.*no answer.*") as caught:
        car.loop.run()
    assert caught.value.exit_code == 4 and ("SIGINT" in str(caught.value)) == asked
    assert not [r for r in caplog.records if r.message.startswith("neutral:")]


def test_a_neutral_that_cannot_be_read_back_is_a_normal_end(caplog: pytest.LogCaptureFixture) -> None:
    car = Car(armed=True)
    car.wire.left = SENT
    with caplog.at_level(logging.INFO):
        car.loop.run()
    assert "neutral sent, not confirmed: the recording is over" in caplog.text


def test_a_guard_that_was_asked_to_end_is_no_fault() -> None:
    car = Car(armed=True)

    def stopped(*_: object) -> None:
        raise StoppedError("stopped from outside")

    car.wire.send = stopped  # type: ignore[method-assign]
    assert car.loop.run().ended == "stopped from outside" and not car.loop.report.by_fault


def test_stop_is_neutral_at_once_and_for_good() -> None:
    car = Car(armed=True)
    car.loop._watch = lambda step: car.loop.stop("SIGTERM") if step.frame == 20 else None
    report = car.loop.run()
    assert report.ended == "SIGTERM" and report.frames == 21 and not report.by_fault
    kinds = [kind for _, kind, *_ in car.wire.log]
    assert kinds[-2:] == ["neutral", "close"]


def test_frames_nobody_read_and_a_last_frame_are_counted() -> None:
    car = Car()
    numbers = iter([0, 1, 4, 5])
    car.camera.read = lambda _: Frame(  # type: ignore[method-assign]
        np.random.default_rng(0).integers(0, 255, (4, 4, 3), np.uint8), car.clock(), next(numbers)
    )
    report = car.loop.run(max_frames=4)
    assert report.skipped == 2 and report.ended == "4 frames, as asked"
    assert any("2 of the source not read" in line for line in report.lines())


def test_latencies_are_those_of_the_numbers() -> None:
    histogram = LatencyHistogram()
    assert np.isnan(histogram.percentile_ms(50.0))
    values_ms = np.random.default_rng(3).gamma(2.0, 3.0, 5000)
    for value in values_ms:
        histogram.add(1e-3 * value)
    for percent in (50.0, 99.0):
        exact = np.percentile(values_ms, percent, method="inverted_cdf")
        assert exact <= histogram.percentile_ms(percent) <= exact + 0.05 + 1e-9
    assert histogram.above(0.01) == pytest.approx((values_ms > 10.0).sum(), abs=10)
    histogram.add(10.0)
    assert histogram.longest_ms == pytest.approx(10_000.0) and len(histogram) == 5001


def test_an_error_before_the_first_frame_says_so(caplog: pytest.LogCaptureFixture) -> None:
    car = Car(armed=True)

    def fail(_: float) -> Frame:
        raise HardwareError("no such drive")

    car.camera.read = fail  # type: ignore[method-assign]
    with pytest.raises(HardwareError, match="no such drive"):
        car.loop.run()
    assert "neutral: HardwareError before the first frame: no such drive" in caplog.text


@pytest.mark.parametrize(("frames", "word"), [(0, "frames"), (1, "frame"), (2, "frames")])
def test_the_report_counts_in_words(frames: int, word: str) -> None:
    first = DriveReport(frames=frames).lines()[0]
    assert first.startswith(f"{frames} {word} ")


def test_each_frame_is_shown_once_with_what_was_seen_after_its_command() -> None:
    car = Car(count=5, armed=True, faults={2: lambda: None})
    shown: list[tuple[int, LaneEstimate, Step, int]] = []

    def show(frame: Frame, estimate: LaneEstimate, step: Step) -> None:
        shown.append((frame.number, estimate, step, len(car.wire.log)))

    car.loop = DriveLoop(
        CarParts(car.camera, Eye(lambda _: LANE), LaneController(CONTROL), car.wire),
        SafetySettings(countdown_s=0.0),
        LimitSettings(),
        CONTROL.speed,
        DriveMode(armed=True),
        car.steps.append,
        car.clock,
        show,
    )
    car.loop.run()
    assert [number for number, *_ in shown] == [0, 1, 3, 4]
    assert all(estimate is LANE and step.frame == number for number, estimate, step, _ in shown)
    sent = [k for k, (_, kind, *_) in enumerate(car.wire.log) if kind == "send"]
    assert all(logged > sent[k] for k, (*_, logged) in enumerate(shown))
