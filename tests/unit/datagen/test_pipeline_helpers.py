"""The pipeline's small steps: cutting a drive into segments, counting laps, checking sizes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.prepare import check_size, hide_bumper, split_segments
from datagen.settings import MapSettings
from datagen.slam.camera.coarse import guessed_camera
from datagen.slam.loops.places import Revisit
from datagen.slam.segment import count_laps
from datagen.slam.settings import GuessSettings
from lanenet.data.drives import open_drive
from lanenet.data.drives.recording import Commands, Drive
from lanenet.errors import CalibrationError, TrackingLostError


class _NoImages:
    def read(self, row: int) -> np.ndarray:
        raise AssertionError("no image is needed here")


def _drive(n: int, breaks: list[int]) -> Drive:
    flags = np.zeros(n, dtype=bool)
    flags[breaks] = True
    return Drive(
        name="made-up",
        path=Path("made-up"),
        frames=np.arange(n),
        t_s=0.05 * np.arange(n),
        times_trusted=True,
        commands=Commands(),
        deleted=np.zeros(n, dtype=bool),
        breaks=flags,
        camera=None,
        lane_width_cm=None,
        problems=(),
        width=160,
        height=120,
        images=_NoImages(),
        rows=np.arange(n),
    )


def test_an_uninterrupted_drive_is_one_segment():
    assert split_segments(_drive(200, [])) == [slice(0, 200)]
    assert split_segments(_drive(60, [])) == [slice(0, 60)]


def test_a_drive_is_cut_at_its_breaks_and_short_segments_are_left_out():
    assert split_segments(_drive(400, [100, 130, 300])) == [slice(0, 100), slice(130, 300), slice(300, 400)]


def test_a_drive_of_scraps_cannot_be_mapped():
    with pytest.raises(TrackingLostError, match=r"120 frames.* 50.*60"):
        split_segments(_drive(120, [50, 90]))
    with pytest.raises(TrackingLostError, match="59 frames"):
        split_segments(_drive(59, []))


def _revisit(earlier: int, later: int) -> Revisit:
    return Revisit(earlier, later, np.zeros(3), 0.8)


def test_laps_are_as_long_as_the_path_between_visits():
    path = 3.0 * np.arange(350)
    revisits = [_revisit(k, k + 100) for k in range(0, 200, 20)]
    laps = count_laps(path, revisits)
    np.testing.assert_array_equal(laps, np.arange(350) // 100)


def test_revisits_that_skip_a_lap_do_not_lengthen_it():
    path = 3.0 * np.arange(350)
    revisits = [_revisit(k, k + 100) for k in range(0, 100, 20)] + [
        _revisit(k, k + 200) for k in range(0, 140, 20)
    ]
    assert count_laps(path, revisits)[-1] == 3


def test_without_revisits_all_is_one_lap():
    laps = count_laps(3.0 * np.arange(50), [])
    assert laps.dtype.kind == "i"
    assert not laps.any()


def test_a_camera_of_another_size_is_refused():
    drive = _drive(100, [])
    check_size(guessed_camera(160, 120, 80.0, 0.2, GuessSettings()), drive, None)
    with pytest.raises(CalibrationError, match=r"320x240.*160x120"):
        check_size(guessed_camera(320, 240, 80.0, 0.2, GuessSettings()), drive, Path("camera.yaml"))


def test_rows_in_which_the_car_sees_itself_are_left_out(shared_data: Path) -> None:
    """garage_tape shows the car's bumper in its lowest rows; the other drive shows no part of the car."""
    settings, (note,) = hide_bumper(open_drive(shared_data / "garage_tape"), MapSettings())
    assert 5 <= settings.perception.range.bottom_rows <= 9 and "sees itself" in note
    assert hide_bumper(open_drive(shared_data / "donkey_circuit"), MapSettings()) == (MapSettings(), ())
    given = MapSettings(find_bumper=False)
    assert hide_bumper(open_drive(shared_data / "garage_tape"), given) == (given, ())
