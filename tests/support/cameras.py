"""Cameras and camera files, for tests of several rooms."""

from __future__ import annotations

import numpy as np

from lanenet.geometry.camera import Camera, CameraModel, Mounting

MOUNTING = Mounting(19.7, 0.4321, -0.011, 0.02, -2.25, 0.6)


def make_camera(model: CameraModel = "fisheye", n: int = 4, mounting: Mounting = MOUNTING) -> Camera:
    return Camera(
        model=model,
        width=320,
        height=240,
        K=np.array([[107.8, 0.3, 159.123456789], [0.0, 106.3, 119.5], [0.0, 0.0, 1.0]]),
        D=np.array([-0.03, 1e-05, -0.002, 0.0002, 0.004])[:n],
        mounting=mounting,
        wheelbase_cm=26.0,
    )


#: As ROS' camera_calibration writes it.
ROS_FILE = """
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [500.5, 0.0, 320.25, 0.0, 501.5, 240.75, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.3, 0.1, 0.001, -0.002, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
"""
