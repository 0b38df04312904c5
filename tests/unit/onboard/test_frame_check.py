from __future__ import annotations

import numpy as np

from lanenet.onboard.devices import Frame
from lanenet.onboard.frame_check import FrameCheck
from lanenet.onboard.safety import SafetySettings

NAN = float("nan")


def frame(t_s: float, number: int = 0, level: int = 0) -> Frame:
    image = np.full((48, 64, 3), 90, np.uint8)
    image[47, 63] = level  # between the sampled pixels
    return Frame(image, t_s, number)


def test_frames_that_may_not_steer_are_named() -> None:
    check = FrameCheck(SafetySettings())
    assert check.fault_of(frame(10.0), 10.02) == ""
    assert check.fault_of(None, 10.05) == "no frame from the camera"
    assert check.fault_of(frame(10.0, 2, 1), 10.15) == "frame 2 is 150 ms old"
    assert "ahead of the clock" in check.fault_of(frame(11.0, 3, 2), 10.2)
    assert "ahead" in check.fault_of(frame(NAN, 4, 3), 10.2)


def test_a_repeated_frame_is_a_hanging_camera() -> None:
    check = FrameCheck(SafetySettings())
    assert check.fault_of(frame(0.0, 0, 1), 0.0) == ""
    # One pixel that no coarse sample holds tells them apart.
    assert check.fault_of(frame(0.03, 1, 2), 0.03) == ""
    assert "the camera hangs" in check.fault_of(frame(0.06, 2, 2), 0.06)
    # A copy counts as well as the very array; a gap between does not make it new.
    assert check.fault_of(None, 0.09) != ""
    assert "the camera hangs" in check.fault_of(frame(0.12, 3, 2), 0.12)
    assert check.fault_of(frame(0.15, 4, 3), 0.15) == ""
    lenient = FrameCheck(SafetySettings(allow_repeated_frames=True))
    assert [lenient.fault_of(frame(0.03 * k, k), 0.03 * k) for k in range(3)] == [""] * 3
