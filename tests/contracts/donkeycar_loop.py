"""Runs the parts in Donkeycar's own vehicle loop, on a tub's frames; for an environment with donkeycar.

python donkeycar_loop.py TUB PILOT.yaml CAMERA.yaml FIRST FRAMES OUT.json
"""

from __future__ import annotations

import json
import sys
from importlib import metadata
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import donkeycar
import numpy as np
from donkeycar.parts.image_transformations import ImageTransformations
from donkeycar.parts.tub_v2 import Tub
from donkeycar.templates.cv_control import add_cv_controller
from PIL import Image

import lanenet.onboard.donkey as parts


class TubCamera:
    """Hands out a tub's images as Donkeycar's cameras do, and what the driver did."""

    def __init__(self, tub_path: str, first: int, frames: int) -> None:
        self.tub = Tub(tub_path, read_only=True)
        self.records = list(islice(self.tub, first, first + frames))
        self.images = Path(tub_path) / "images"
        self.next = 0

    def run(self):
        record = self.records[self.next]
        self.next += 1
        return np.asarray(Image.open(self.images / record["cam/image_array"])), record["user/angle"]


class Notes:
    """The last part: keeps what the others said."""

    def __init__(self) -> None:
        self.rows, self.shapes = [], {}

    def run(self, *values):
        self.rows.append([float(v) for v in values[:5]])
        self.shapes = {name: list(v.shape) for name, v in zip(("cv", "view"), values[5:], strict=True)}


def main(tub_path: str, pilot_path: str, camera_path: str, first: int, frames: int, out: Path) -> None:
    cfg = SimpleNamespace(
        LANENET_CONFIG=pilot_path,
        LANENET_CAMERA=camera_path,
        OVERLAY_IMAGE=True,
        TRANSFORMATIONS=["CUSTOM_UNDISTORT"],
        CUSTOM_UNDISTORT_MODULE=parts.__file__,
        CUSTOM_UNDISTORT_CLASS="UndistortTransformer",
        POST_TRANSFORMATIONS=[],
    )
    vehicle = donkeycar.vehicle.Vehicle()
    vehicle.mem.put(["run_pilot"], True)
    vehicle.add(TubCamera(tub_path, first, frames), outputs=["cam/image_array", "user/angle"])
    pilot = parts.LanePilot.from_file(pilot_path)
    vehicle.add(pilot, inputs=["cam/image_array"], outputs=["pilot/angle", "pilot/throttle"])
    # As the template cv_control itself does it.
    add_cv_controller(vehicle, cfg, None, "lanenet.onboard.donkey", "CvLaneController")
    view = ImageTransformations(cfg, "TRANSFORMATIONS", "POST_TRANSFORMATIONS")
    vehicle.add(view, inputs=["cam/image_array"], outputs=["cam/view"])
    notes = Notes()
    said = ["user/angle", "pilot/angle", "pilot/throttle", "pilot/steering", "pilot/throttle"]
    vehicle.add(notes, inputs=[*said, "cv/image_array", "cam/view"])
    vehicle.start(rate_hz=40, max_loop_count=frames)
    versions = {n: metadata.version(n) for n in ("donkeycar", "lanenet", "numpy", "opencv-python-headless")}
    versions["onnxruntime"] = metadata.version("onnxruntime")
    out.write_text(json.dumps({"rows": notes.rows, "shapes": notes.shapes, "versions": versions}))


if __name__ == "__main__":
    tub_, pilot_, camera_, first_, frames_, out_ = sys.argv[1:]
    main(tub_, pilot_, camera_, int(first_), int(frames_), Path(out_))
