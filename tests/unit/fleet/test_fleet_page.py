"""The page of a run: what it counts, what it shows, and that it stays small."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from datagen.fleet.page import fleet_page, write_page
from datagen.fleet.result import FAILED, LEFT, FleetResult, Labelled
from datagen.fleet.storage import Storage
from datagen.fleet.task import FleetDrive


def marker(cpu_s: float, on: str = "host-a", **more: Any) -> dict[str, Any]:
    took = {"wall_s": 2 * cpu_s, "cpu_s": cpu_s, "peak_bytes": 500_000_000}
    return {"took": took, "made": {"on": on}, "bytes": 1_500_000, **more}


def labelled(k: int, verdict: str = "good", reason: str = "", on: str = "host-a") -> Labelled:
    drive = FleetDrive(f"tub-{k}", f"/drives/tub-{k}", "", 40.0)
    mapped = None if verdict in (FAILED, LEFT) else marker(30.0, on, frames=1200, driven_s=60.0)
    labels = (
        marker(6.0, on, frames_labelled=1100, residual_cm=0.42) if verdict in ("good", "usable") else None
    )
    return Labelled(drive, verdict, reason, True, f"map-{k}", f"labels-{k}", mapped, labels)


def noise(size_px: int) -> bytes:
    """A picture that packs as badly as one can."""
    pixels = np.random.default_rng(0).integers(0, 255, (size_px, size_px, 3), np.uint8)
    return bytes(cv2.imencode(".jpg", pixels)[1].tobytes())


def words(page: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<style>.*?</style>|<[^>]+>", " ", page, flags=re.DOTALL))


def test_drives_reasons_hours_and_cost_are_counted():
    drives = [labelled(k) for k in range(60)]
    drives += [
        labelled(60, "reject", "tub-60: the lines lie 3.5 cm off"),
        labelled(61, "reject", "tub-61: the lines lie 4.25 cm off"),
        labelled(62, "refused", "the car stands still", on="host-b"),
        labelled(63, FAILED, "out of memory"),
    ]
    said = words(fleet_page(FleetResult(tuple(drives)), {}))
    assert "60 of 64 drives have labels: 60 min of driving, 66,000 labelled frames." in said
    assert "good 60 60 min 72,000 66,000" in said and "failed 1 0 s 0 0" in said
    # Two maps are rejected for the same thing.
    assert "rejected tub-60: the lines lie 3.5 cm off 2 refused the car stands still 1" in said
    # 63 maps of 30 s and 60 label sets of 6 s, for 63 minutes of driving.
    assert "maps labels together results 63 60 123 time 63 min 12 min 75 min" in said
    assert "processor time 32 min 6 min 38 min the same, per hour driven 30 min 6 min 36 min" in said
    assert "most memory 500 MB 500 MB 500 MB storage 94.5 MB 90.0 MB 184.5 MB" in said
    assert "host-a 122 37 min" in said and "host-b 1 30 s" in said


def test_a_full_disk_and_drives_that_are_left_are_named():
    result = FleetResult(
        (labelled(0), labelled(1, LEFT, "the run ended before")), "the disk of host-a is full"
    )
    said = words(fleet_page(result, {}))
    assert "1 of 2 drives have labels" in said and "the disk of host-a is full." in said
    assert "left the run ended before 1" in said


def test_without_a_map_the_page_still_tells(tmp_path: Path):
    said = words(fleet_page(FleetResult((labelled(0, FAILED, "<b>bad</b>"),)), {}))
    assert "0 of 1 drive have labels: 0 s of driving, 0 labelled frames" in said
    assert "&lt;b&gt;bad&lt;/b&gt;" in said


def test_of_many_drives_some_are_shown_and_none_is_large():
    verdicts = ("good", "usable", "reject")
    drives = [labelled(k, verdicts[k % 3], f"bad {k}" if k % 3 == 2 else "") for k in range(3000)]
    page = fleet_page(FleetResult(tuple(drives)), dict.fromkeys((f"map-{k}" for k in range(3000)), noise(8)))
    assert page.count("<img") == 450 and "150 of 1000, evenly chosen" in page
    # The first and the last are among them.
    assert "tub-0: 1200 frames" in page and "tub-2999: 1200 frames" in page
    large = {"map-0": noise(1000)}
    with_one, with_none = (len(fleet_page(FleetResult((labelled(0),)), found)) for found in (large, {}))
    # Noise is ten times as large as a map, and 450 of them would be 27 MB.
    assert 10_000 < with_one - with_none < 60_000


def test_the_page_is_written_with_the_maps_that_have_a_picture(tmp_path: Path):
    storage = Storage(str(tmp_path))
    storage.claim()
    for k in (0, 1):
        with storage.new("maps", f"map-{k}") as folder:
            (folder / "result.json").write_text("{}")
            if k == 0:
                (folder / "thumbnail.jpg").write_bytes(noise(360))
    write_page(FleetResult((labelled(0), labelled(1))), storage)
    page = (tmp_path / "index.html").read_text()
    assert page.count("<img") == 1 and "tub-0: 1200 frames, 60 s, residual 0.4 cm" in page
