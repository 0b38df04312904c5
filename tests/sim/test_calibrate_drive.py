"""The camera of simulated drives, found from the drives alone."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from datagen.calibrate_drive import calibrate_drive
from datagen.settings import MapSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.camera_file import read_camera, write_camera


def simulated(folder: Path, seed: int) -> SimulationSettings:
    """Two laps of a small loop, as a Donkeycar or with commands; the drive itself knows no camera."""
    settings = SimulationSettings.model_validate(
        {
            "seed": seed,
            "frames": 500,
            "camera": {
                "width": 160,
                "height": 120,
                "field_of_view_rad": math.radians(120.0),
                "height_cm": 17.0,
                "pitch_down_rad": math.radians(15.0),
                "roll_rad": 0.02,
                "yaw_rad": -0.03,
                "distortion": (-0.04, 0.0, 0.0, 0.0),
            },
            "recording": "donkeycar" if seed % 2 else "commands",
            "track": {"preset": {11: "donkey_tape", 12: "mat"}[seed], "closed": True, "length_cm": 850.0},
            "driver": {"speed_cm_s": 70.0, "speed_variation": 0.1},
        }
    )
    simulate_drive(settings, folder)
    (folder / "drive.yaml").unlink()
    (folder / "camera.yaml").unlink()
    return settings


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "focal_px", "pitch_deg"), [(11, 65.0, 8.0), (12, 88.0, 18.0)])
def test_two_laps_give_the_camera_from_a_coarse_start(tmp_path, seed, focal_px, pitch_deg):
    simulation = simulated(tmp_path / "drive", seed)
    truth = simulation.camera.build(simulation.car.wheelbase_cm)
    guess = {"focal_px": [focal_px], "pitch_deg": [pitch_deg], "wheelbase_cm": truth.wheelbase_cm}
    settings = MapSettings.model_validate({"guess": guess})
    width_cm = simulation.track.lane_width_cm
    result = calibrate_drive(tmp_path / "drive", width_cm, None, None, settings)
    check_near(result.camera, truth)
    assert result.revisits and result.lane_cm == pytest.approx(width_cm)
    focal_error = abs(result.camera.K[0, 0] - truth.K[0, 0])
    assert focal_error < 3.0 * result.sigma["focal_px"] < 0.15 * truth.K[0, 0]
    path = tmp_path / "camera.yaml"
    write_camera(path, result.camera, result.method, result.residuals)
    assert read_camera(path).hash == result.camera.hash


@pytest.mark.slow
def test_refining_keeps_a_good_camera_and_its_height(tmp_path):
    simulation = simulated(tmp_path / "drive", 12)
    truth = simulation.camera.build(simulation.car.wheelbase_cm)
    result = calibrate_drive(tmp_path / "drive", None, None, truth, MapSettings())
    check_near(result.camera, truth)
    assert result.camera.mounting.height_cm == pytest.approx(truth.mounting.height_cm)
    assert "height_cm" not in result.sigma and result.method.startswith("given")
    assert result.lane_cm == pytest.approx(simulation.track.lane_width_cm, rel=0.03)


def check_near(camera, truth):
    m, t = camera.mounting, truth.mounting
    assert camera.K[0, 0] == pytest.approx(truth.K[0, 0], rel=0.03)
    assert math.degrees(m.pitch_down_rad) == pytest.approx(math.degrees(t.pitch_down_rad), abs=0.5)
    assert m.height_cm == pytest.approx(t.height_cm, rel=0.03)
