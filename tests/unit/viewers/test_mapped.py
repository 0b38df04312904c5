"""What a map says about its frames."""

from __future__ import annotations

import numpy as np
import pytest
from watched import mapped_drive

from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.mapped_drive import lines_at
from lanenet.viewers.drawing import Artist, strips_of
from lanenet.viewers.mapped import MapToSee, map_lines
from lanenet.viewers.seen import Seen


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[MapToSee, DriveMap]:
    folder, drive_map = mapped_drive(tmp_path_factory.mktemp("mapped"))
    return MapToSee(folder), drive_map


def test_lines_are_those_of_the_map_and_broken_where_it_has_none(mapped: tuple[MapToSee, DriveMap]) -> None:
    lines = map_lines(mapped[1])
    assert list(lines) == ["0/left_0", "0/right_0", "1/left_0", "1/right_0"]
    # Supported from 0 to 80 and from 120 to 200 cm.
    first, second = strips_of(lines["0/left_0"])
    assert first[0, 0] == pytest.approx(0.0, abs=2.0) and first[-1, 0] == pytest.approx(80.0, abs=6.0)
    assert second[0, 0] == pytest.approx(120.0, abs=6.0) and abs(second[:, 1] - 18.0).max() < 3.0
    assert strips_of(lines["1/right_0"]) == []


def test_frames_have_pose_tilt_lines_and_steering_to_the_left(mapped: tuple[MapToSee, DriveMap]) -> None:
    to_see, drive_map = mapped
    seen = list(to_see.frames())
    assert [one.frame for one in seen] == list(range(30))
    np.testing.assert_allclose([one.pose for one in seen], drive_map.poses, rtol=1e-7)
    np.testing.assert_allclose([one.t_s for one in seen], drive_map.t_s)
    # Donkeycar's -0.5 is half to the left.
    assert {one.values["steering_share"] for one in seen} == {0.5}
    assert seen[7].camera is not None
    nods = seen[7].camera.mounting.pitch_down_rad - drive_map.camera.mounting.pitch_down_rad
    assert nods == pytest.approx(drive_map.tilt_rad[7, 0]) and nods != 0.0
    expected = lines_at(to_see.drive_map, 7)
    np.testing.assert_array_equal(seen[7].lanes["reference"].points_cm, expected.points_cm)
    np.testing.assert_array_equal(seen[7].lanes["reference"].on_road_cm[0], expected.left_cm)
    assert "map_match" not in Artist(to_see.scene).draw(seen[0]).values  # NaN: there was no map yet
    assert seen[7].values["map_match"] == pytest.approx(drive_map.match[7])


def test_frames_that_the_map_lacks_stay_as_they_are(mapped: tuple[MapToSee, DriveMap]) -> None:
    alone = Seen(999, 0.0, None)
    assert mapped[0].add_to(alone) is alone


def test_the_scene_has_the_path_and_the_edges(mapped: tuple[MapToSee, DriveMap]) -> None:
    scene = mapped[0].scene
    np.testing.assert_allclose(scene.path_map, mapped[1].poses, rtol=1e-7)
    np.testing.assert_allclose(scene.edges_map_cm, np.column_stack([np.linspace(0.0, 9.0, 10)] * 2))
