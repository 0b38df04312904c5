from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from datagen.labels.truth import truth_labels
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.control.controller import ControlSettings, LaneController
from lanenet.control.steering import SteeringSettings
from lanenet.data.drives import open_drive
from lanenet.data.label_set import read_labels, write_labels
from lanenet.data.tables import ParquetTable
from lanenet.onboard.cameras.replay import ReplaySettings, ReplaySource
from lanenet.onboard.guard import NoActuator
from lanenet.onboard.loop import CarParts, DriveLoop, DriveMode
from lanenet.onboard.safety import LimitSettings, SafetySettings
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.network.model_file import INPUT_NAME

MODEL = Path(__file__).resolve().parents[2] / "checkpoints" / "small" / "model.onnx"


class Tap:
    """Keeps what the network is given."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self.rasters: list[np.ndarray] = []

    def run(self, names: Any, feeds: dict[str, np.ndarray]) -> Any:
        self.rasters.append(feeds[INPUT_NAME][0].copy())
        return self._session.run(names, feeds)


def test_the_car_shows_the_network_what_training_showed_it(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from lanenet.samples.dataset import LaneSamples

    path = simulate_drive(SimulationSettings(seed=4, frames=12), tmp_path / "drive")
    camera = open_drive(path).camera
    assert camera is not None
    detector = NetworkDetector(MODEL, camera, any_camera=True)
    write_labels(
        tmp_path / "labels.parquet",
        truth_labels(path, detector.meta.perception, detector.meta.window),
    )
    tap = Tap(detector._session)
    detector._session = tap
    control = ControlSettings(steering=SteeringSettings(wheelbase_cm=camera.wheelbase_cm))
    loop = DriveLoop(
        CarParts(
            ReplaySource(ReplaySettings(path=path, pace="fast")),
            detector,
            LaneController(control),
            NoActuator(),
        ),
        SafetySettings(),
        LimitSettings(),
        control.speed,
        DriveMode(),
    )
    report = loop.run()
    labels = read_labels(tmp_path / "labels.parquet")
    assert report.frames == len(tap.rasters) == len(labels) == 12
    trained_on = LaneSamples([labels], ["labels"]).plain_batch(np.arange(12))[0]
    column = list(ParquetTable(tmp_path / "labels.parquet").raw("image"))
    for i, raster in enumerate(tap.rasters):
        assert np.count_nonzero(raster[0]) > 50
        stored = cv2.imdecode(np.frombuffer(column[i]["bytes"], np.uint8), cv2.IMREAD_GRAYSCALE)
        for other in (labels.raster(i), trained_on[i]):
            assert raster.tobytes() == other[: len(raster)].tobytes()
        assert raster[0].tobytes() == np.asarray(stored).tobytes()
