"""The default randomisation beside the three real tubs; run with ``-m slow -s`` to see the table."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from datagen.reality.drives import RealitySettings, measure_all_synthetic
from datagen.reality.measure import measure_drive
from datagen.reality.report import compare, summary, table
from lanenet.data.drives import open_drive
from lanenet.geometry.camera import Camera, Mounting

pytestmark = pytest.mark.slow
LOG = logging.getLogger(__name__)
#: Rough cameras: focal length, k1, pitch in degrees; not calibrations.
TUBS = {
    "donkey_circuit": (80.0, -0.03, 15.0),
    "usi_mat": (105.0, -0.05, 18.0),
    "garage_tape": (86.0, -0.07, 13.0),
}


def rough_camera(tub: str) -> Camera:
    focal, k1, pitch_deg = TUBS[tub]
    K = np.array([[focal, 0.0, 79.5], [0.0, focal, 59.5], [0.0, 0.0, 1.0]])
    mounting = Mounting(17.0, float(np.deg2rad(pitch_deg)))
    return Camera("fisheye", 160, 120, K, np.array([k1, 0.0, 0.0, 0.0]), mounting, 26.0)


def test_each_real_drive_lies_within_the_synthetic_spread(shared_data: Path) -> None:
    missing = [tub for tub in TUBS if not (shared_data / tub).is_dir()]
    if missing:
        pytest.skip(f"no {', '.join(missing)} in {shared_data}")
    settings, cameras = RealitySettings(count=100), [rough_camera(tub) for tub in TUBS]
    real = [
        measure_drive(open_drive(shared_data / tub), camera, settings.sampling(settings.real_frames))
        for tub, camera in zip(TUBS, cameras, strict=True)
    ]
    rows = compare(real, measure_all_synthetic(settings, cameras, workers=2))
    for line in (*table(rows, list(TUBS)), *summary(rows, list(TUBS))):
        LOG.warning("%s", line)
    outside = [(row.name, tub) for row in rows for tub, ok in zip(TUBS, row.inside, strict=True) if not ok]
    assert outside == []
