"""Which edge points are mapped where a textured floor has too many."""

from __future__ import annotations

import cv2
import numpy as np

from datagen.slam.odometry.likely import MOST_POINTS, likely_markings
from lanenet.perception.edges.canny import EdgeSettings, find_edges
from lanenet.perception.edges.pixels import EdgePixels

#: Left and right border of a vertical tape, [px].
TAPE_PX = (300.0, 328.0)


def carpet(texture: float) -> np.ndarray:
    """A tape on a carpet of strong texture, or on a plain floor."""
    rng = np.random.default_rng(0)
    grains = cv2.GaussianBlur(rng.standard_normal((480, 640)), (0, 0), 1.5)
    gray = 100.0 + texture * grains / grains.std()
    gray[:, int(TAPE_PX[0]) : int(TAPE_PX[1])] = 230.0
    return gray.clip(0, 255).astype(np.uint8)


def on_tape(edges: EdgePixels) -> np.ndarray:
    """Rows in which either border of the tape is among the edge points."""
    off_px = np.abs(edges.uv_px[:, :1] + 0.5 - TAPE_PX)
    return np.unique(np.rint(edges.uv_px[:, 1])[(off_px < 2.0).any(axis=1)])


def test_of_a_carpet_the_borders_of_the_tape_are_kept():
    keep = np.full((480, 640), 255, np.uint8)
    found = find_edges(carpet(60.0), EdgeSettings(), keep)
    assert len(found.uv_px) > 4 * MOST_POINTS
    chosen = likely_markings(found, keep)
    assert len(chosen.uv_px) == len(chosen.normals) == MOST_POINTS
    assert len(on_tape(chosen)) > 0.95 * len(on_tape(found))
    # They are the points that were found, in their order.
    places = {tuple(uv): k for k, uv in enumerate(found.uv_px.tolist())}
    at = [places[tuple(uv)] for uv in chosen.uv_px.tolist()]
    assert at == sorted(at)
    np.testing.assert_array_equal(chosen.normals, found.normals[at])


def test_a_plain_floor_keeps_all_of_its_edge_points():
    keep = np.full((480, 640), 255, np.uint8)
    found = find_edges(carpet(0.0), EdgeSettings(), keep)
    assert 900 < len(found.uv_px) <= MOST_POINTS
    assert likely_markings(found, keep) is found
