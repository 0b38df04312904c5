"""The memory that a drive states, and what a piece of work took."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from drives import write_drive

from datagen.fleet.memory import memory_bytes, memory_together, stated_bytes
from datagen.fleet.meter import Meter


def test_each_frame_counts_and_images_up_to_a_bound():
    assert stated_bytes(0, 0) == 500_000_000
    assert stated_bytes(1000, 160 * 120) == 500_000_000 + 360_000_000 + 57_600_000
    assert stated_bytes(1000, 1280 * 720) == 500_000_000 + 360_000_000 + 250_000_000


@pytest.mark.parametrize(("frames", "measured_mb"), [(250, 446), (600, 583), (1000, 735), (1200, 799)])
def test_what_was_measured_is_below_what_is_stated(frames: int, measured_mb: int):
    """Peak in RAM of the mapping of tubs of 160 x 120; see docs/fleet.md."""
    stated_mb = stated_bytes(frames, 160 * 120) / 1e6
    assert measured_mb < stated_mb < 1.4 * measured_mb


def test_a_drive_states_what_its_frames_take(tmp_path: Path):
    assert memory_bytes(str(write_drive(tmp_path / "tub", n=5))) == stated_bytes(5, 64 * 48)
    # One that cannot be read is refused soon; one elsewhere is not small.
    (tmp_path / "empty").mkdir()
    assert memory_bytes(str(tmp_path / "empty")) == stated_bytes(0, 0)


def test_drives_that_are_in_memory_together_share_the_program(tmp_path: Path):
    drives = [str(write_drive(tmp_path / name, n=n)) for name, n in (("a", 5), ("b", 7))]
    assert memory_together(drives) == stated_bytes(12, 64 * 48)
    assert memory_together(drives[:1]) == memory_bytes(drives[0])


def test_a_meter_counts_time_and_the_peak_since_it_was_made():
    block = np.ones(100_000_000, np.uint8)
    with_block = Meter()
    del block
    first = with_block.taken()["peak_bytes"]
    meter = Meter()
    end_s = time.process_time() + 0.05
    while time.process_time() < end_s:
        pass
    taken = meter.taken()
    assert first - taken["peak_bytes"] > 90_000_000
    assert 0.04 < taken["cpu_s"] <= taken["wall_s"] + 0.05
