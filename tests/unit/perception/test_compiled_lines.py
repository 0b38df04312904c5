"""The compiled loops of the network's detector give the bytes of NumPy."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lanenet.data.camera_file import read_camera
from lanenet.onboard.bench import example_camera, example_frames
from lanenet.perception.edges.road import RoadEdges
from lanenet.perception.network import compiled, refinement
from lanenet.perception.network.detector import NetworkDetector
from lanenet.perception.network.refinement import RoadBorders, refine_lines

pytestmark = pytest.mark.skipif(not compiled.is_here(), reason="installed without a C++ compiler")
GENERAL = Path(__file__).parents[3] / "checkpoints" / "general"


def by_numpy(work):
    """Return what ``work`` gives without these compiled loops."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled, "_kernels", None)
        return work()


def assert_same(found, expected):
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape == theirs.shape
        assert ours.tobytes() == theirs.tobytes()


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 700),
    m=st.integers(1, 6),
    hues=st.booleans(),
    single=st.booleans(),
    spread_cm=st.sampled_from([0.1, 1.0, 8.0]),
)
def test_lines_are_the_same(seed, n, m, hues, single, spread_cm):
    rng = np.random.default_rng(seed)
    y = rng.uniform(-8.0, 50.0, n)
    turn = rng.normal(0.0, 0.3, n) + np.pi * rng.integers(0, 2, n)
    x = rng.choice([-21.5, -18.5, 18.5, 21.5], n) + 0.1 * y + rng.normal(0.0, spread_cm, n)
    number = np.float32 if single else np.float64
    edges = RoadEdges(
        np.stack([x, y], axis=1).astype(number),
        np.stack([np.cos(turn), np.sin(turn)], axis=1).astype(number),
        rng.uniform(-1.0, 1.0, (n, 2)).astype(number) if hues else None,
    )
    points_cm = rng.choice([-20.0, 20.0], (m, 1)) + rng.normal(0.0, 3.0, (m, 3))
    known = np.where(rng.random((m, 1)) < 0.5, rng.uniform(-1.0, 1.0, (m, 2)), np.nan)
    lines = points_cm, rng.uniform(0.1, 9.0, (m, 3))
    marking = rng.choice([-3.0, 2.0, 3.0], m), rng.choice([0.3, 2.0], m)

    def refined():
        return refine_lines(*lines, RoadBorders(edges), *marking, known if hues else None)

    assert_same(refined(), by_numpy(refined))


@pytest.mark.parametrize("real", [True, False])
def test_answers_of_a_drive_are_the_same(real):
    if real:
        camera, photo = read_camera(GENERAL / "camera.yaml"), cv2.imread(str(GENERAL / "example.jpg"))
        frames = [np.roll(photo, shift, axis=1) for shift in range(0, 24, 2)]
    else:
        camera = example_camera()
        frames = example_frames(camera, 12, np.random.default_rng(0))

    def answers():
        detector = NetworkDetector(GENERAL, camera, any_camera=True, keep="right")
        return [
            np.hstack(
                [value for value in astuple(detector.detect(frame)) if isinstance(value, np.ndarray | float)]
            )
            for frame in frames
        ]

    found = answers()
    assert np.isfinite(np.stack(found)[:, :6]).any(axis=1).all()
    assert_same(found, by_numpy(answers))


def test_a_line_does_not_depend_on_those_asked_with_it():
    rng = np.random.default_rng(3)
    y = rng.uniform(0.0, 40.0, 400)
    points_cm = np.stack([rng.choice([-21.5, -18.5, 18.5, 21.5], 400) + rng.normal(0.0, 2.0, 400), y], axis=1)
    borders = RoadBorders(RoadEdges(points_cm, np.tile([1.0, 0.0], (400, 1))))
    known = [2.0] * 3
    asked = np.array(
        [[-20.0] * 3 + known + [3.0, 2.0] + [np.nan] * 2, [19.0] * 3 + known + [8.0, 0.3, 0.1, 0.2]]
    )

    def together():
        return refinement.refined(asked, borders)

    def apart():
        return np.concatenate([refinement.refined(line[None], borders) for line in asked])

    for work in (together, apart):
        assert_same([work()], by_numpy(lambda work=work: [work()]))
    assert_same([together()], [apart()])


def test_memory_beyond_the_arguments_is_not_read():
    """The checks of the compiled code itself, behind those of its callers."""
    edges = np.zeros((9, 2))
    good = [np.ones((2, 10)), edges, edges, edges, refinement._NUMBERS, False]
    assert len(compiled._kernels.refine(*good)) == 2 * compiled._PER_LINE * 8
    # A bin beside the first label row.
    wrong_bin = refinement._NUMBERS.copy()
    wrong_bin[9 + 9 + 64 + 8 + 3] = 64.0
    with pytest.raises(ValueError, match=r"differ"):
        compiled._kernels.refine(good[0].ravel()[:-1], *good[1:])
    for at in range(1, len(good) - 2):
        with pytest.raises(ValueError, match=r"differ"):
            compiled._kernels.refine(*good[:at], good[at][:1], *good[at + 1 :])
    for numbers in (good[-2][1:], wrong_bin):
        with pytest.raises(ValueError, match=r"numbers"):
            compiled._kernels.refine(*good[:-2], numbers, False)
