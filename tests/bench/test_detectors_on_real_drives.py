"""The three papers' detectors on real videos and tubs; run with ``-m slow -s`` to see the figures."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from lanenet.data.drives import open_drive
from lanenet.data.drives.sources import find_mask, open_source
from lanenet.geometry.camera import Camera, Mounting
from lanenet.perception.estimate import Detector, DetectorInputs
from lanenet.perception.hough.detector import HoughSettings, HoughTracker
from lanenet.perception.painter.detector import LanePainter, PainterSettings
from lanenet.perception.registry import build_detector

pytestmark = pytest.mark.slow
PAPER = Path(__file__).resolve().parents[2] / "configs" / "detectors" / "lane_filter_paper.yaml"
LOG = logging.getLogger(__name__)

HOUGH_VALUE = Path(__file__).resolve().parents[2] / "configs" / "detectors" / "hough_value.yaml"

#: Rough cameras of the tubs (focal length, k1, pitch in degrees), not calibrations. The lane's width in cm is
#: assumed, as in the configs of these names: nobody has measured it.
TUBS = {
    "donkey_circuit": (80.0, -0.03, 15.0, 59.0),
    "usi_mat": (105.0, -0.05, 18.0, 41.0),
    "garage_tape": (86.0, -0.07, 13.0, 31.0),
}


def rough_camera(tub: str) -> Camera:
    focal, k1, pitch_deg, _ = TUBS[tub]
    K = np.array([[focal, 0.0, 79.5], [0.0, focal, 59.5], [0.0, 0.0, 1.0]])
    mounting = Mounting(17.0, float(np.deg2rad(pitch_deg)))
    return Camera("fisheye", 160, 120, K, np.array([k1, 0.0, 0.0, 0.0]), mounting, 26.0)


@pytest.mark.parametrize(("name", "least"), [("solidWhiteRight", 0.98), ("udacity_test_video", 0.9)])
def test_painter_finds_both_lines_of_a_road(shared_data: Path, name: str, least: float) -> None:
    source = open_source(shared_data / "road" / f"{name}.mp4")
    painter = LanePainter()
    both = np.array([painter.detect(source.image(i)).confidence == 1.0 for i in range(len(source))])
    LOG.warning("painter, %s: both lines in %d of %d frames", name, both.sum(), both.size)
    assert both.mean() >= least


def test_painter_finds_both_lines_of_the_photos(shared_data: Path) -> None:
    painter = LanePainter(None, PainterSettings(mode="photo"))
    photos = sorted((shared_data / "road").glob("*photos/*.jpg"))
    missed = [p.name for p in photos if painter.detect(open_source(p).image(0)).confidence < 1.0]
    LOG.warning("painter: both lines in %d of %d photos", len(photos) - len(missed), len(photos))
    assert len(photos) == 14 and not missed


@pytest.mark.parametrize("tub", TUBS)
def test_steering_beside_the_drivers(shared_data: Path, tub: str) -> None:
    drive = open_drive(shared_data / tub)
    assert drive.commands.angle is not None
    # Donkeycar's -1 is left.
    driver = -drive.commands.angle
    camera = rough_camera(tub)
    value = HoughSettings.model_validate({"edges": {"channel": "value"}})
    compared: dict[str, Detector] = {
        "hough": HoughTracker(camera),
        "hough, V channel": HoughTracker(camera, value),
        "hough, hough_value.yaml": build_detector("hough", DetectorInputs(camera=camera, config=HOUGH_VALUE)),
        "painter": LanePainter(camera),
    }
    mask, told = find_mask(open_source(shared_data / tub))
    LOG.warning("%s: %s", tub, told)
    for name, config in {"lane filter": None, "lane filter, plain Canny of the paper": PAPER}.items():
        for tape, marking_cm in {"": None, ", 5 cm tape": 5.08}.items():
            inputs = DetectorInputs(
                camera=camera, lane_width_cm=TUBS[tub][3], marking_cm=marking_cm, config=config
            )
            compared[name + tape] = build_detector("lane-filter", inputs)
    if mask is not None:
        inputs = DetectorInputs(camera=camera, lane_width_cm=TUBS[tub][3], mask=mask)
        compared["lane filter, bumper masked"] = build_detector("lane-filter", inputs)
    for name, detector in compared.items():
        steering, confidence = np.full(len(drive), np.nan), np.zeros(len(drive))
        for i in range(len(drive)):
            if drive.breaks[i]:
                detector.reset()
            estimate = detector.detect(drive.image(i))
            steering[i], confidence[i] = estimate.steering_rad, estimate.confidence
        known = np.isfinite(steering) & np.isfinite(driver)
        enough = known.sum() > 10 and np.std(steering[known]) > 0.0
        r = np.corrcoef(steering[known], driver[known])[0, 1] if enough else float("nan")
        LOG.warning(
            "%s, %s: lane in %d, one line or row in %d, steering in %d of %d frames; r = %.2f",
            *(tub, name, (confidence == 1.0).sum(), (confidence == 0.5).sum(), known.sum(), len(drive), r),
        )
        assert np.abs(steering[known]).max(initial=0.0) <= np.pi / 2.0
