from __future__ import annotations

import math
import time

import numpy as np
import pytest
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.errors import ConfigError, HardwareError
from lanenet.onboard.devices import Frame
from lanenet.onboard.doctor import camera_delay
from lanenet.onboard.doctor.camera_delay import CameraDelay, delay_of, measure_delay

PRESSES_S = [10.0 + 6.2 * k for k in range(8)]
DARKENS = [k % 2 == 0 for k in range(8)]


def trace(delay_s: float, hands_s: np.ndarray, rate_hz: float = 30.0, adapts: bool = False):
    """Arrivals of frames, and their brightness; a hand takes 0.06 s to cover the lens."""
    rng = np.random.default_rng(5)
    arrived_s = np.arange(5.0, 70.0, 1.0 / rate_hz)
    light_s = arrived_s - delay_s
    brightness = np.full(len(arrived_s), 110.0)
    for press_s, dark, hand_s in zip(PRESSES_S, DARKENS, hands_s, strict=True):
        since_s = light_s - (press_s + hand_s) + 0.03
        covered = np.clip(since_s / 0.06, 0.0, 1.0)
        # An automatic exposure makes up for half of the change within two seconds.
        kept = 1.0 - 0.5 * np.clip(since_s / 2.0, 0.0, 1.0) * adapts
        brightness += (-95.0 if dark else 95.0) * covered * np.where(since_s > 0.0, kept, 1.0)
    return arrived_s, brightness + rng.normal(0.0, 1.0, len(arrived_s))


@pytest.mark.parametrize("adapts", [False, True])
@pytest.mark.parametrize("delay_s", [0.0, 0.1, 1.0, 3.0])
def test_known_delay_is_found_to_within_a_frame(delay_s, adapts) -> None:
    found = delay_of(PRESSES_S, DARKENS, *trace(delay_s, np.zeros(8), adapts=adapts))
    assert found.delay_s == pytest.approx(delay_s, abs=0.034) and found.changes == 8
    assert found.sd_s < 0.03


def test_hands_scatter_and_one_mistake_does_no_harm() -> None:
    hands_s = np.random.default_rng(2).normal(0.0, 0.08, 8)
    hands_s[3] = 1.5
    found = delay_of(PRESSES_S, DARKENS, *trace(1.0, hands_s))
    assert found.delay_s == pytest.approx(1.0, abs=0.1)
    assert 0.02 < found.sd_s < 0.2


def test_without_changes_there_is_no_delay() -> None:
    arrived_s, brightness = trace(0.1, np.zeros(8))
    with pytest.raises(
        HardwareError, match=r"after 0 of 8 presses, expected 4 at least: cover the whole lens"
    ):
        delay_of(PRESSES_S, DARKENS, arrived_s, np.full_like(brightness, 100.0))
    with pytest.raises(HardwareError, match="after 0 of 8 presses"):
        delay_of(PRESSES_S, DARKENS, arrived_s[:0], brightness[:0])
    # Brighter where it was covered is no answer to it.
    with pytest.raises(HardwareError, match="after 0 of 8 presses"):
        delay_of(PRESSES_S, DARKENS, arrived_s, 220.0 - brightness)


class Lens:
    """A camera in a room with a light that the test's hand covers, ``delay_s`` late."""

    def __init__(self, delay_s: float, age_known: bool) -> None:
        self.delay_s, self.age_known, self.number, self.closed = delay_s, age_known, 0, False
        self.changes: list[tuple[float, bool]] = []

    def open(self) -> None:
        pass

    def read(self, timeout_s: float) -> Frame:
        time.sleep(0.01)
        self.number += 1
        now_s = time.monotonic()
        dark = [covered for at_s, covered in self.changes if at_s <= now_s - self.delay_s]
        image = np.full((12, 16, 3), 20 if dark and dark[-1] else 120, np.uint8)
        return Frame(image, now_s - 0.05 * self.age_known, self.number, self.age_known)

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize("age_known", [True, False])
def test_a_person_measures_the_delay(monkeypatch, age_known) -> None:
    monkeypatch.setattr(camera_delay, "_PAUSE_S", 0.5)
    monkeypatch.setattr(camera_delay, "_LATEST_S", 0.45)
    monkeypatch.setattr(camera_delay, "_EARLIEST_S", -0.05)
    lens, asked = Lens(0.2, age_known), []

    def ask(text: str) -> None:
        asked.append(text)
        lens.changes.append((time.monotonic(), "uncover" not in text))

    found = measure_delay(lens, ask)
    assert lens.closed and len(asked) == 8 and "cover the lens, and press Enter" in asked[0]
    assert found.delay_s == pytest.approx(0.2, abs=0.08)
    text = "\n".join(found.lines)
    assert f"source: {{delay_s: {found.delay_s:.2f}}}" in text
    assert ("by their own times is 0.05 s" if age_known else "age of the frames is unknown") in text


def test_a_camera_that_fails_meanwhile_is_the_error(monkeypatch) -> None:
    monkeypatch.setattr(camera_delay, "_PAUSE_S", 0.0)
    lens = Lens(0.2, True)

    def fails(timeout_s: float) -> Frame:
        raise HardwareError("camera: lost")

    lens.read = fails  # type: ignore[method-assign]
    with pytest.raises(HardwareError, match="camera: lost"):
        measure_delay(lens, lambda text: None)
    assert lens.closed


def test_an_interval_is_that_of_the_median() -> None:
    """1.96 sigma of a median of n normal values: 1.96 * 1.2533 sd / sqrt(n)."""
    text = CameraDelay(1.0, 0.08, 8, math.nan).lines[0]
    assert "1.00 s from the light to here, +- 0.07 s (95 %; 8 changes of 8, one scatters by 0.08 s)" in text


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("doctor", "--camera-delay"), "--camera-delay: needs the car's file"),
        (("doctor", "--camera-delay", "--config"), "the source is a recording, expected a camera"),
    ],
)
def test_the_delay_is_that_of_a_cars_camera(tmp_path, words, told) -> None:
    car = tmp_path / "car.yaml"
    car.write_text(
        "source: {kind: replay, path: drive}\ndetector: {kind: hough}\n"
        "control: {own_target: true, steering: {wheelbase_cm: 20}}\n"
    )
    done = CliRunner().invoke(app, [*words, str(car)] if words[-1] == "--config" else list(words))
    assert done.exit_code != 0
    assert told in done.output or (isinstance(done.exception, ConfigError) and told in str(done.exception))
