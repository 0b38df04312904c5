"""The filter on a car that drives: what it knows of each frame, and what becomes of bad ones."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from picture_road import Pictures, loop_drive
from pixel_road import bean, fisheye

from datagen.localise.live_filter import (
    LiveFrame,
    LiveLocaliser,
    LivePose,
    StartSettings,
    live_frames,
    live_motion,
)
from datagen.settings import MapSettings
from datagen.slam.commands import commands_of
from datagen.slam.filter.dp_slam import FilterSettings, ParticleFilter, run_filter
from datagen.slam.odometry.scans import edges_of_drive, scans_of
from datagen.slam.view import mapping_range
from lanenet.data.drives.recording import Commands, Drive
from lanenet.errors import CalibrationError, DriveFormatError, TrackingLostError
from lanenet.perception.edges.road import RoadTable

LAP_FRAMES, LAP_CM = 100, 400.0
STEP_CM = LAP_CM / LAP_FRAMES
SPEED_CM_S = STEP_CM / 0.05
CAMERA = fisheye()
SETTINGS = MapSettings(filter=FilterSettings(particles=100))
KNOWN = StartSettings(factor=1.0)


@pytest.fixture(scope="module")
def road() -> tuple[Drive, np.ndarray]:
    drive, poses = loop_drive(CAMERA, 160, LAP_FRAMES, LAP_CM)
    return replace(drive, commands=Commands(speed_cm_s=np.full(len(drive), SPEED_CM_S))), poses


def ran(frames, start: StartSettings = KNOWN, settings: MapSettings = SETTINGS):
    localiser = LiveLocaliser(CAMERA, settings, start)
    poses = [pose for frame in frames for pose in localiser.take(frame)]
    return localiser, [*poses, *localiser.finish()]


def check_turned(poses: list[LivePose], truth: np.ndarray) -> None:
    """The road begins in a bend, which the filter finds within some frames; then the heading is true."""
    found = stacked(poses)[:, 2]
    turned = truth[-1, 2] - truth[20, 2]
    assert found[-1] - found[20] == pytest.approx(turned, abs=0.04 * turned)


def stacked(poses: list[LivePose]) -> np.ndarray:
    return np.array([pose.estimate.pose for pose in poses])


def scans_and_motion(drive: Drive):
    limits = mapping_range(CAMERA.mounting, SETTINGS.perception.range)
    edges = edges_of_drive(drive, SETTINGS.perception.edges, RoadTable(CAMERA, limits))
    commands = commands_of(drive, CAMERA.wheelbase_cm)
    motion = live_motion(commands, None, 1.0, CAMERA.mounting.height_cm)
    return scans_of(edges, CAMERA, limits), motion


def test_poses_are_those_that_the_filter_has_when_it_has_seen_each_frame(road):
    drive = road[0].subset(slice(0, 60))
    scans, motion = scans_and_motion(drive)
    settings = (SETTINGS.filter, CAMERA.mounting.height_cm, CAMERA.wheelbase_cm)
    plain = ParticleFilter(motion, *settings, np.random.default_rng(SETTINGS.seed))
    known = [plain.step(scans.scan(k), motion, k) for k in range(len(drive))]
    _, poses = ran(live_frames(drive))
    np.testing.assert_allclose(stacked(poses), [estimate.pose for estimate in known], rtol=0, atol=1e-9)
    # The whole drive in one go gives the same matches; its poses are smoothed by what came later.
    whole = run_filter(scans, motion, *settings, np.random.default_rng(SETTINGS.seed))
    np.testing.assert_allclose([pose.estimate.match for pose in poses], whole.match, atol=1e-9)
    np.testing.assert_allclose([pose.estimate.spread_cm for pose in poses], whole.spread_cm, atol=1e-9)


def test_the_path_is_the_true_one(road):
    drive, truth = road
    localiser, poses = ran(live_frames(drive), StartSettings(frames=60))
    assert [pose.frame for pose in poses] == drive.frames.tolist()
    assert localiser.factor == pytest.approx(1.0, abs=0.05)
    found = stacked(poses)
    way = np.hypot(*np.diff(found[:, :2], axis=0).T).sum()
    assert way == pytest.approx(STEP_CM * (len(drive) - 1), rel=0.05)
    check_turned(poses, truth)


def test_how_the_car_answers_to_the_steering_is_learned_on_the_way(road):
    drive, truth = road
    s, curvature = bean(LAP_CM)
    place = np.arange(len(drive)) % LAP_FRAMES * STEP_CM
    angle = -0.02 - 20.0 * np.interp(place, s, curvature)  # Donkeycar's sign
    lag = 3
    told = np.concatenate([angle[lag:], np.full(lag, angle[-1])])
    steered = replace(drive, commands=replace(drive.commands, angle=np.clip(told, -1.0, 1.0)))
    localiser, poses = ran(live_frames(steered), StartSettings(frames=100, factor=1.0))
    assert localiser.steering is not None
    assert localiser.steering.gain == pytest.approx(1.0 / 20.0, rel=0.25)
    assert abs(localiser.steering.lag_frames - lag) <= 2
    check_turned(poses, truth)


def test_the_typical_step_is_found_where_no_speed_was_recorded(road):
    unknown = replace(road[0], commands=Commands()).subset(slice(0, 80))
    localiser = LiveLocaliser(CAMERA, SETTINGS, StartSettings(frames=60))
    counts = [len(localiser.take(frame)) for frame in live_frames(unknown)]
    # Nothing is known until the speed is; then all of it at once, and each frame as it comes.
    assert counts == [0] * 59 + [60] + [1] * 20
    assert localiser.factor == pytest.approx(STEP_CM, rel=0.1)
    told = StartSettings(factor=STEP_CM)
    assert len(ran(live_frames(unknown.subset(slice(0, 10))), told)[1]) == 10


def test_a_drive_shorter_than_the_start_uses_what_there_is(road):
    drive = replace(road[0], commands=Commands())
    localiser, poses = ran(live_frames(drive.subset(slice(0, 62))), StartSettings())
    assert len(poses) == 62
    localiser.check_found()
    localiser, poses = ran(live_frames(drive.subset(slice(0, 40))), StartSettings())
    assert not poses and localiser.dropped == 40
    with pytest.raises(TrackingLostError, match=r"40 frames .* 60 that follow"):
        localiser.check_found()


def test_frames_that_cannot_be_read_are_driven_through(road):
    drive, truth = road
    broken = {20, 50, 51, 52, 53}
    frames = [replace(frame, image=None) if frame.frame in broken else frame for frame in live_frames(drive)]
    localiser, poses = ran(frames)
    assert localiser.unreadable == len(broken) and localiser.segment == 0
    assert [pose.frame for pose in poses] == drive.frames.tolist()
    assert {pose.frame for pose in poses[1:] if np.isnan(pose.estimate.match)} == broken
    check_turned(poses, truth)


def test_after_a_pause_a_new_segment_begins(road):
    drive = road[0].subset(slice(0, 100))
    frames = list(live_frames(drive))
    late = [replace(m, t_s=m.t_s + 5.0) if m.frame >= 60 else m for m in frames]
    told = [replace(m, starts=True) if m.frame == 60 else m for m in frames]
    # For longer than a second the camera gives nothing.
    blind = [replace(m, image=None) if 30 <= m.frame < 60 else m for m in frames]
    for changed in (late, told, blind):
        localiser, poses = ran(changed)
        assert localiser.segment == 1
        first = next(pose for pose in poses if pose.segment == 1)
        assert first.frame == 60 and np.isnan(first.estimate.match)
        np.testing.assert_allclose(first.estimate.pose, np.zeros(3), atol=1e-12)
        assert all(pose.segment == (pose.frame >= 60) for pose in poses)
    # What cannot be believed any more is not made up: a second of prediction, and no more.
    assert [pose.frame for pose in poses if 30 <= pose.frame < 60] == list(range(30, 50))


def test_a_car_that_stands_stays_where_it_is(road):
    drive = replace(road[0], commands=Commands())
    frames = list(live_frames(drive.subset(slice(0, 80))))
    rng = np.random.default_rng(0)
    stop = [
        replace(
            frames[59],
            frame=60 + k,
            t_s=3.0 + 0.05 * k,
            image=np.clip(frames[59].image + rng.normal(0.0, 1.0, frames[59].image.shape), 0, 255).astype(
                np.uint8
            ),
        )
        for k in range(60)
    ]
    after = [replace(m, frame=m.frame + 60, t_s=m.t_s + 3.0) for m in frames[60:]]
    localiser, poses = ran([*frames[:60], *stop, *after], StartSettings(factor=STEP_CM))
    assert localiser.segment == 0 and len(poses) == 140
    # Some frames pass before a stop is told from a crawl.
    assert 52 <= localiser.standing <= 58
    xy = stacked(poses)[:, :2]
    np.testing.assert_array_equal(xy[75], xy[118])
    assert np.hypot(*(xy[118] - xy[59])) < 4.0 * STEP_CM
    assert np.hypot(*(xy[139] - xy[120])) == pytest.approx(19 * STEP_CM, rel=0.2)


def test_memory_does_not_grow_with_the_drive(road):
    drive = road[0].subset(slice(0, 120))
    # Steering that says nothing: what is kept to learn from it is thrown away again and again.
    angle = np.random.default_rng(0).uniform(-1.0, 1.0, len(drive))
    frames = list(live_frames(replace(drive, commands=replace(drive.commands, angle=angle))))
    localiser = LiveLocaliser(CAMERA, SETTINGS, StartSettings(frames=60, factor=1.0))
    sizes = []
    for lap in range(3):
        for m in frames:
            localiser.take(replace(m, frame=m.frame + 120 * lap, t_s=m.t_s + 6.0 * lap))
            if m.frame % 20 == 19:
                sizes.append(len(pickle.dumps(localiser)))
    assert localiser.steering is None and localiser.segment == 0
    # All that it holds; the last times and changes of the pictures are few and small.
    assert max(sizes[9:]) - max(sizes[:9]) < 20_000 < localiser.map_bytes < sizes[0]


def test_bad_input_is_named(road):
    localiser = LiveLocaliser(CAMERA, SETTINGS, KNOWN)
    frames = list(live_frames(road[0].subset(slice(0, 3))))
    localiser.take(frames[1])
    with pytest.raises(DriveFormatError, match=r"frame 0: time 0 s after 0\.05"):
        localiser.take(frames[0])
    with pytest.raises(CalibrationError, match="frame 7: image of 20x10 px, but the camera is for 160x120"):
        localiser.take(LiveFrame(7, 1.0, np.zeros((10, 20, 3), np.uint8), Commands()))


def test_a_frame_that_cannot_be_read_comes_without_its_image(road):
    drive = road[0].subset(slice(0, 3))

    class Torn(Pictures):
        def read(self, row: int) -> np.ndarray:
            if row == 1:
                raise DriveFormatError("torn")
            return super().read(row)

    frames = list(live_frames(replace(drive, images=Torn(drive.images.images))))
    assert [frame.image is None for frame in frames] == [False, True, False]
    assert [float(m.commands.speed_cm_s[0]) for m in frames] == [SPEED_CM_S] * 3
