"""The compiled loops give the bytes of NumPy and OpenCV."""

from __future__ import annotations

import os
import sys
from dataclasses import astuple
from types import ModuleType

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.onboard.bench import example_camera, example_frames, smaller_camera
from lanenet.perception.edges import compiled
from lanenet.perception.edges.canny import EdgeSettings, find_edges
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.raster import PLANES, fill_raster, new_raster
from lanenet.perception.edges.road import PerceptionSettings, RangeSettings, RoadEdgeExtractor, RoadTable

pytestmark = pytest.mark.skipif(not compiled.is_here(), reason="installed without a C++ compiler")
CAMERA = smaller_camera(example_camera(), 4)
TABLE = RoadTable(CAMERA, RangeSettings())
EDGES = st.builds(
    lambda thresholds, **others: EdgeSettings(low=min(thresholds), high=max(thresholds), **others),
    thresholds=st.tuples(st.floats(0.5, 300.0), st.floats(0.5, 300.0)),
    method=st.sampled_from(["canny", "directional"]),
    blur_px=st.sampled_from([0, 3, 5]),
    contrast_share=st.sampled_from([0.0, 0.3, 0.95]),
    colour_weight=st.sampled_from([0.0, 0.333, 0.75, 1.0]),
)


@pytest.fixture(scope="module", autouse=True)
def threads():
    """Two, whatever other tests of this process chose: with one, OpenCV's Canny may leave out a pixel."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    yield
    cv2.setNumThreads(before)


@st.composite
def images(draw, least_px=1, most_px=70):
    """Noise, few gray levels, or patches with a little noise; in colour or gray."""
    height, width = (draw(st.integers(least_px, most_px)) for _ in range(2))
    colours = draw(st.sampled_from([(), (3,)]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    kind = draw(st.sampled_from(["noise", "levels", "patches"]))
    if kind == "levels":
        return (rng.integers(0, 3, (height, width, *colours)) * rng.integers(1, 128)).astype(np.uint8)
    side = 1 if kind == "noise" else draw(st.integers(2, 12))
    image = rng.integers(0, 256, (-(-height // side), -(-width // side), *colours))
    image = image.repeat(side, axis=0).repeat(side, axis=1)[:height, :width]
    noisy = image + (kind == "patches") * rng.normal(0.0, 3.0, image.shape)
    return noisy.clip(0.0, 255.0).astype(np.uint8)


def by_numpy(work):
    """Return what ``work`` gives without the compiled loops."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled, "_kernels", None)
        return work()


def assert_same(found, expected):
    for ours, theirs in zip(astuple(found), astuple(expected), strict=True):
        assert (ours is None) == (theirs is None)
        if ours is not None:
            assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
            assert ours.tobytes() == theirs.tobytes()


@settings(max_examples=400, deadline=None)
@given(images(), EDGES, st.booleans(), st.integers(0, 100))
def test_edges_are_the_same(image, edges, masked, seed):
    keep = None
    if masked:
        keep = np.where(np.random.default_rng(seed).random(image.shape[:2]) < 0.7, 255, 0).astype(np.uint8)
    assert_same(find_edges(image, edges, keep), by_numpy(lambda: find_edges(image, edges, keep)))


@settings(max_examples=100, deadline=None)
@given(images(40, 40), EDGES, st.sampled_from([1, len(PLANES)]), st.floats(0.3, 6.0))
def test_road_and_raster_are_the_same(patches, edges, planes, cell_cm):
    image = np.resize(patches, (CAMERA.height, CAMERA.width, *patches.shape[2:]))
    extractor = RoadEdgeExtractor(CAMERA, PerceptionSettings(edges=edges))
    window = BirdseyeWindow(-31.7, 1.3, cell_cm, 33, 41)

    def road_and_rasters():
        road = extractor.extract(image)
        double = TABLE.lift(TABLE.find(image, edges))
        rasters = [fill_raster(window, each, new_raster(window, planes)) for each in (road, double)]
        return road, double, rasters

    (road, double, rasters), (road_numpy, double_numpy, rasters_numpy) = (
        road_and_rasters(),
        by_numpy(road_and_rasters),
    )
    assert_same(road, road_numpy)
    assert_same(double, double_numpy)
    np.testing.assert_array_equal(rasters, rasters_numpy)


def test_frames_of_a_road_are_the_same():
    settings_ = PerceptionSettings().with_colours()
    extractor = RoadEdgeExtractor(example_camera(), settings_)
    for frame in example_frames(example_camera(), 4, np.random.default_rng(0)):
        found = extractor.extract(frame)
        assert len(found.points_cm) > 300 and np.ptp(found.hues) > 0.5
        assert_same(found, by_numpy(lambda frame=frame: extractor.extract(frame)))


def test_points_off_the_road_are_left_out_alike():
    sky = EdgePixels(
        np.array([[3.0, 0.2], [30.0, 50.4], [79.4, 0.0]]), np.tile([0.6, 0.8], (3, 1)), np.zeros((3, 2))
    )
    found = TABLE.lift_single(sky)
    assert len(found.points_cm) == 1
    assert_same(found, by_numpy(lambda: TABLE.lift_single(sky)))


def test_a_result_is_free_to_be_changed_and_outlives_the_next_frame():
    first, second = example_frames(CAMERA, 2, np.random.default_rng(0))
    found = find_edges(first, EdgeSettings())
    before = found.uv_px.copy()
    find_edges(second, EdgeSettings())
    np.testing.assert_array_equal(found.uv_px, before)
    found.uv_px[:] = 0.0


def test_memory_beyond_the_arguments_is_not_read():
    """The checks of the compiled code itself, behind those of its callers."""
    frame, raising = np.zeros((4, 5), np.uint8), (2.0, 0.5, 5.0)
    good = [frame, 4, 5, None, None, 3, 40.0, 80.0, 0.0, 0.0, True, raising]
    assert len(compiled._kernels.find(*good)) == 0
    for at, wrong in (
        (0, frame[:3]),
        (1, 2),
        (1, -4),
        (3, frame[:3]),
        (4, np.array([20])),
        (4, np.array([-1])),
    ):
        with pytest.raises(ValueError, match=r"expected|not of|beyond"):
            compiled._kernels.find(*good[:at], wrong, *good[at + 1 :])
    points, table = np.zeros((2, 2)), np.zeros((20, 6))
    assert len(compiled._kernels.extract(*good, table, 0, 4)) == 0
    for wrong in ((table[1:], 0, 4), (table, 0, 5), (table[:0], 0, 0)):
        with pytest.raises(ValueError, match="table: not of"):
            compiled._kernels.extract(*good, *wrong)
    for arguments in (
        (points, points[:1], None, table),
        (points, points, points[:1], table),
        (points, points, None, table[1:]),
    ):
        with pytest.raises(ValueError, match=r"differ|not of"):
            compiled._kernels.lift(*arguments, 4, 5, False)
    # Rows times columns times six, that of the table in 32 bits.
    with pytest.raises(ValueError, match="not of"):
        compiled._kernels.lift(points, points, None, table, 4, 5 + 2**29, False)
    place = (0.0, 10.0, 1.0, 4, 5)
    for arguments in (
        (points, points[:1], None, frame),
        (points, points, points[:1], frame),
        (points, points, None, frame[1:]),
    ):
        with pytest.raises(ValueError, match=r"differ|not of"):
            compiled._kernels.raster(*arguments, *place, 1, 128, 127, False)
    nowhere = compiled._kernels.lift(np.full((1, 2), np.nan), points[:1], None, table, 4, 5, False)
    assert np.isnan(np.frombuffer(nowhere)[:2]).all()


def test_loops_that_are_older_than_their_source_are_not_used(tmp_path, caplog, monkeypatch):
    module = ModuleType("lanes._kernels")
    monkeypatch.setitem(sys.modules, "lanes._kernels", module)
    monkeypatch.setitem(sys.modules, "lanes", ModuleType("lanes"))
    assert compiled.loops_of("lanenet") is None
    module.__file__ = str(tmp_path / "_kernels.abi3.so")
    built, source = tmp_path / "_kernels.abi3.so", tmp_path / "_kernels.cpp"
    built.touch()
    # As in a wheel, without the source.
    assert compiled.loops_of("lanes") is module
    source.touch()
    os.utime(source, (1000.0, 1000.0))
    assert compiled.loops_of("lanes") is module and not caplog.records
    os.utime(built, (999.0, 999.0))
    assert compiled.loops_of("lanes") is None
    assert "_kernels.cpp is newer" in caplog.text
