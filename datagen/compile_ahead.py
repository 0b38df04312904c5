"""Compile the loops of later stages while the first ones run.

The first map after an installation would otherwise wait for them: most of the compile time is that of the
filter and the adjustment. With a filled cache of numba, this takes a third of a second.
"""

from __future__ import annotations

import threading

import numpy as np

from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import BundleEstimate, Observations, adjust
from datagen.slam.camera.coarse import guessed_camera
from datagen.slam.filter.dp_slam import run_filter
from datagen.slam.loops.revisits import DirectionField
from datagen.slam.odometry.odometry import Odometry
from datagen.slam.odometry.scans import pack_scans
from datagen.slam.stripes import true_borders
from datagen.slam.track import motion_about
from datagen.slam.view import mapping_range
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import RoadEdges, RoadTable

#: Frames of the made-up drive: two neighbouring steps are the least that the adjustment compares.
_FRAMES = 3


def compile_ahead() -> threading.Thread:
    """Start a thread that filters, adjusts and matches a made-up drive of a few points.

    Returns:
        The thread; whoever needs one of the loops earlier waits for it by itself.
    """
    thread = threading.Thread(target=_made_up_drive, name="compile ahead")
    thread.start()
    return thread


def _made_up_drive() -> None:
    settings, rng = MapSettings(), np.random.default_rng(0)
    camera = guessed_camera(64, 48, 32.0, 20.0, settings.guess)
    height_cm = camera.mounting.height_cm
    steps, turns = np.full(_FRAMES, 0.1 * height_cm), np.zeros(_FRAMES)
    points = np.stack([np.linspace(-1.0, 1.0, 9), np.linspace(2.0, 3.0, 9)], axis=1) * height_cm
    normals = np.tile([1.0, 0.0], (len(points), 1))
    edges = EdgePixels(camera.project_ground(points), normals)
    true_borders(
        [edges] * _FRAMES, RoadTable(camera, mapping_range(camera.mounting, settings.perception.range))
    )
    scans = pack_scans([RoadEdges(points, normals)] * _FRAMES, height_cm)
    odometry = Odometry(steps, turns)
    motion = motion_about(odometry, settings.motion, height_cm, np.ones(_FRAMES))
    run_filter(scans, motion, settings.filter, height_cm, camera.wheelbase_cm, rng)
    start = BundleEstimate.level(odometry.poses, camera)
    adjust(Observations([edges] * _FRAMES), start, settings.bundle, rng)
    field, scan = DirectionField.empty(height_cm, 64), scans.scan(0)
    field.insert(scan.points_cm, scan.normals, scan.weights)
    field.score(odometry.poses, camera.wheelbase_cm, scan)
