from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import DriveWriter
from lanenet.onboard.cameras.replay import ReplaySettings
from lanenet.onboard.devices import Frame
from lanenet.onboard.frame_check import FrameCheck, RepeatCheck
from lanenet.onboard.safety import SafetySettings

NAN = float("nan")
HEIGHT, WIDTH = 120, 160


def frame(t_s: float, number: int = 0, level: int = 0) -> Frame:
    image = np.full((48, 64, 3), 90, np.uint8)
    image[47, 63] = level  # a single pixel
    return Frame(image, t_s, number)


def road() -> np.ndarray:
    """A carpet with two lines, as gray levels of a perfect camera."""
    image = np.random.default_rng(3).normal(70.0, 6.0, (HEIGHT, WIDTH))
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    for bottom_px in (20, 130):
        cv2.line(image, (bottom_px, HEIGHT), (WIDTH // 2, 20), 220.0, 4)
    return image


def exposures(
    seed: int = 0, noise: float = 1.5, light: float = 1.0, quality: int = 0
) -> Iterator[np.ndarray]:
    """Frames of a standing camera whose sensor has noise, through JPEG if a quality is given."""
    rng, scene = np.random.default_rng(seed), light * road()
    while True:
        gray = np.clip(np.rint(scene + rng.normal(0.0, noise, scene.shape)), 0, 255).astype(np.uint8)
        image = cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR)
        if quality:
            data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
            image = cv2.imdecode(data, cv2.IMREAD_COLOR)
        yield image


def test_frames_that_may_not_steer_are_named() -> None:
    check = FrameCheck(SafetySettings())
    assert check.fault_of(frame(10.0), 10.02) == ""
    assert check.fault_of(None, 10.05) == "no frame from the camera"
    assert check.fault_of(frame(10.0, 2, 1), 10.15) == "frame 2 is 150 ms old"
    assert "ahead of the clock" in check.fault_of(frame(11.0, 3, 2), 10.2)
    assert "ahead" in check.fault_of(frame(NAN, 4, 3), 10.2)
    # Where the exposure is unknown the message claims no age.
    arrived = Frame(frame(10.0, 5, 4).image_bgr, 10.0, 5, age_known=False)
    assert check.fault_of(arrived, 10.15) == "frame 5 is 150 ms old since it arrived"


def test_a_repeated_frame_is_a_hanging_camera() -> None:
    check = FrameCheck(SafetySettings())
    assert check.fault_of(frame(0.0, 0, 1), 0.0) == ""
    # One pixel tells them apart.
    assert check.fault_of(frame(0.03, 1, 2), 0.03) == ""
    assert "repeats the one before: the camera hangs" in check.fault_of(frame(0.06, 2, 2), 0.06)
    # A copy counts as well as the very array; a gap between does not make it new.
    assert check.fault_of(None, 0.09) != ""
    assert "the camera hangs" in check.fault_of(frame(0.12, 3, 2), 0.12)
    assert check.fault_of(frame(0.15, 4, 3), 0.15) == ""
    lenient = FrameCheck(SafetySettings(allow_repeated_frames=True))
    assert [lenient.fault_of(frame(0.03 * k, k), 0.03 * k) for k in range(3)] == [""] * 3


def test_a_short_recording_in_a_loop_is_no_hanging_camera(tmp_path: Path) -> None:
    images = list(itertools.islice(exposures(), 5))
    images[3] = images[2]
    with DriveWriter(tmp_path / "drive") as writer:
        for k, image in enumerate(images):
            writer.add(image, 0.05 * k)
    source = ReplaySettings(path=tmp_path / "drive", pace="fast", loop=True).make_source()
    source.open()
    check = FrameCheck(SafetySettings())
    faults = [check.fault_of(frame, frame.t_s) for _ in range(20) if (frame := source.read(1.0)) is not None]
    source.close()
    assert [k % 5 for k, fault in enumerate(faults) if fault] == [3] * 4


@pytest.mark.parametrize("buffers", [2, 3, 32])
def test_buffers_in_rotation_are_found_at_once_and_for_as_long_as_they_rotate(buffers) -> None:
    check, live = RepeatCheck(), exposures()
    assert not any(check.fault_of(next(live)) for _ in range(50))
    held = list(itertools.islice(live, buffers))
    assert not any(check.fault_of(image) for image in held)
    assert all("the camera hangs" in check.fault_of(held[k % buffers].copy()) for k in range(400))
    assert check.fault_of(next(live)) == ""


def with_clock(image: np.ndarray, number: int, row: int) -> np.ndarray:
    image = image.copy()
    cv2.putText(image, f"12:00:{number:06d}", (4, row), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1)
    return image


def with_live_rows(image: np.ndarray, live: np.ndarray, rows: int) -> np.ndarray:
    return np.vstack([live[:rows], image[rows:]])


@pytest.mark.parametrize("quality", [0, 75, 50])
@pytest.mark.parametrize("changes", [10, 60, "clock at 10", "clock at 70", "clock at 118"])
def test_a_picture_that_is_frozen_but_for_a_part_is_found(changes, quality) -> None:
    check, live = RepeatCheck(), exposures(quality=quality)
    frozen = [next(live) for _ in range(3)]
    for image in frozen:
        assert check.fault_of(image) == ""
    for k in range(60):
        image = frozen[k % 3]
        if isinstance(changes, int):
            image = with_live_rows(image, next(live), changes)
        else:
            image = with_clock(image, k, int(changes.split()[-1]))
        assert check.fault_of(image) == "repeats the road of an earlier one: the camera hangs"
    assert check.fault_of(next(live)) == ""


@pytest.mark.parametrize("part", ["saturated", "black", "logo", "bumper", "almost all"])
def test_a_part_that_never_changes_is_no_hanging_camera(part) -> None:
    check, live = RepeatCheck(), exposures()
    logo = np.random.default_rng(9).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    for _ in range(200):
        image = next(live)
        if part == "saturated":
            image[: HEIGHT - 20] = 255
        elif part == "black":
            image[HEIGHT // 2 :] = 0
        elif part == "logo":
            image[-40:, :60] = logo
        elif part == "bumper":
            # A burnt-in picture over a whole band, which has texture.
            image[-8:] = np.tile(logo[:8], (1, 3, 1))[:, :WIDTH]
        else:
            image[: HEIGHT - 6] = 255
        assert check.fault_of(image) == ""


STANDING = list(itertools.product((0.5, 1.0, 2.0), (1.0, 0.25), (0, 95, 75, 50)))


@pytest.mark.parametrize(("noise", "light", "quality"), STANDING)
def test_a_standing_camera_with_noise_does_not_hang(noise, light, quality) -> None:
    check, live = RepeatCheck(), exposures(1, noise, light, quality)
    assert [fault for _ in range(250) if (fault := check.fault_of(next(live)))] == []


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "quality"), [(1.0, 75), (0.5, 50)])
def test_half_an_hour_of_a_standing_camera_is_without_alarm(noise, quality) -> None:
    check, live = RepeatCheck(), exposures(2, noise, 1.0, quality)
    assert sum(check.fault_of(next(live)) != "" for _ in range(30 * 60 * 30)) == 0


@pytest.mark.parametrize("name", ["donkey_circuit", "usi_mat", "garage_tape", "blue_tape"])
def test_in_recorded_drives_only_frames_recorded_twice_are_found(shared_data: Path, name: str) -> None:
    if not (shared_data / name).is_dir():
        pytest.skip(f"no drive {name} at {shared_data}")
    check, drive = RepeatCheck(), open_drive(shared_data / name)
    before = np.zeros(0)
    for row in range(len(drive)):
        image = drive.image(row)
        assert bool(check.fault_of(image)) == np.array_equal(image, before), f"frame {row}"
        before = image
        if row % 20 == 0:
            # The camera hangs here for a moment, and its clock goes on.
            with_a_clock = image.copy()
            with_a_clock[len(image) - 12 : len(image) - 2, : image.shape[1] // 2] = row % 250
            assert "the road" in check.fault_of(with_a_clock), f"frame {row}"
