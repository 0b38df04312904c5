from __future__ import annotations

import numpy as np
import pytest

from lanenet.errors import DriveFormatError
from lanenet.perception.edges.static import find_static, spread_frames, static_mask


def drive(count: int, bumper: bool, seed: int = 0) -> list[np.ndarray]:
    """Frames with a tape that wanders, and a dark bumper in rows 50 to 59, columns 20 to 59."""
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(count):
        frame = np.full((60, 80, 3), 110, np.uint8) + rng.integers(0, 40, dtype=np.uint8)
        u = int(rng.integers(2, 70))
        frame[:, u : u + 5] = 240
        if bumper:
            frame[50:, 20:60] = 20
        frames.append(frame)
    return frames


def test_the_bumper_is_found_with_all_below_it() -> None:
    mask = static_mask(drive(60, bumper=True))
    assert set(np.unique(mask)) == {0, 255}
    assert mask[50:, 21:59].all()
    assert not mask[:45].any()
    assert not mask[:, :14].any() and not mask[:, 66:].any()


def test_a_road_alone_masks_nothing() -> None:
    assert not static_mask(drive(60, bumper=False)).any()


def test_static_things_above_the_car_are_not_the_car() -> None:
    frames = drive(60, bumper=False)
    for frame in frames:
        frame[5:12, 30:50] = 255
    assert not static_mask(frames).any()


def test_a_standing_car_gives_an_error() -> None:
    with pytest.raises(DriveFormatError, match="1 of 50 frames show something new"):
        static_mask(drive(1, bumper=True) * 50)
    with pytest.raises(DriveFormatError, match="0 of 0 frames"):
        static_mask([])


def test_standing_in_between_does_no_harm() -> None:
    frames = drive(60, bumper=True)
    np.testing.assert_array_equal(static_mask(frames + [frames[-1]] * 300), static_mask(frames))


def test_frames_of_two_sizes_are_refused() -> None:
    with pytest.raises(DriveFormatError, match=r"frame 30: 80x40 px.*80x60"):
        static_mask([*drive(30, bumper=True), np.zeros((40, 80, 3), np.uint8)])


def test_how_high_the_car_reaches_decides() -> None:
    found = find_static(drive(60, bumper=True))
    np.testing.assert_array_equal(found.mask, static_mask(drive(60, bumper=True)))
    # A row or two of dilated edge above the bumper's ten.
    assert 10 <= found.rows <= 13
    assert not found.mask[: 60 - found.rows].any() and found.mask[60 - found.rows].any()
    assert found.is_too_high == (found.rows > 12)
    high = drive(60, bumper=True)
    for frame in high:
        frame[40:, 20:60] = 20
    assert find_static(high).is_too_high
    road = find_static(drive(60, bumper=False))
    assert road.rows == 0 and not road.is_too_high


def test_frames_are_taken_from_all_over_a_drive() -> None:
    assert list(spread_frames(5)) == [0, 1, 2, 3, 4]
    assert len(spread_frames(0)) == 0
    for count in (150, 299, 300, 1000, 1001):
        frames = spread_frames(count)
        assert 150 <= len(frames) < 300 and frames[0] == 0 and frames[-1] >= count - frames.step
