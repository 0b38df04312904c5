"""Folders of joined maps, and what is refused before any work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from datagen.tracks.join import join_maps
from datagen.tracks.together import views_shared
from lanenet.data.maps.folder import read_map
from lanenet.data.maps.joined import FORMAT, JoinedDrive, JoinedMeta, maps_in, read_joined, write_joined
from lanenet.errors import LanenetError, MapFormatError


def joined(folder: Path, *names: str) -> JoinedMeta:
    drives = [
        JoinedDrive(
            map=n, made_from=f"/maps/{n}", x_cm=1.0, y_cm=-2.0, turn_rad=0.5, scale=1.01, opposite=False
        )
        for n in names
    ]
    meta = JoinedMeta(format=FORMAT, shared_camera=True, drives=tuple(drives))
    folder.mkdir(exist_ok=True)
    write_joined(folder, meta)
    return meta


def test_joined_maps_are_read_back_and_name_their_maps(tmp_path):
    meta = joined(tmp_path / "track", "monday", "tuesday")
    assert read_joined(tmp_path / "track") == meta
    assert maps_in(tmp_path / "track") == [tmp_path / "track" / name for name in ("monday", "tuesday")]
    assert maps_in(tmp_path / "other") == [tmp_path / "other"]


def test_a_damaged_file_and_a_name_that_leads_elsewhere_are_refused(tmp_path):
    joined(tmp_path, "monday", "../tuesday")
    with pytest.raises(MapFormatError, match="is not the name of a folder"):
        read_joined(tmp_path)
    (tmp_path / "joined.yaml").write_text("format: lanenet-joined/9\n")
    with pytest.raises(MapFormatError, match="expected 'lanenet-joined/1'"):
        maps_in(tmp_path)
    (tmp_path / "joined.yaml").write_text("format: lanenet-joined/1\ndrives: []\n")
    with pytest.raises(MapFormatError):
        read_joined(tmp_path)


def test_what_reads_one_map_says_that_there_are_several(tmp_path):
    joined(tmp_path, "monday", "tuesday")
    with pytest.raises(MapFormatError, match="joined maps"):
        read_map(tmp_path)


def test_maps_to_join_are_checked_first(tmp_path):
    joined(tmp_path / "track", "monday", "tuesday")
    for folders, message in (
        ([tmp_path / "a"], "at least two"),
        ([tmp_path / "a", tmp_path / "b", tmp_path / "a"], "given twice"),
        ([tmp_path / "a", tmp_path / "track"], "joined already"),
        ([tmp_path / "a", tmp_path / "b"], "is not a map"),
    ):
        with pytest.raises(LanenetError, match=message):
            join_maps(folders, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_frames_are_paired_where_they_see_the_same_road_from_either_side():
    height_cm = 15.0
    there = np.column_stack([np.arange(0.0, 200.0, 3.0), np.zeros(67), np.zeros(67)])
    back = np.column_stack([np.arange(250.0, 50.0, -3.0), np.full(67, 4.0), np.full(67, np.pi)])
    poses = np.concatenate([there, back])
    pairs = views_shared(poses, np.arange(67), np.arange(67, 134), height_cm)
    assert len(pairs) > 15
    for a, b in pairs:
        # Three heights ahead of both lies the same place.
        assert abs((poses[a, 0] + 45.0) - (poses[b, 0] - 45.0)) < 2.5 * height_cm
    side = np.column_stack([there[:, 1], there[:, 0], np.full(67, np.pi / 2.0)])
    assert views_shared(np.concatenate([there, side]), np.arange(67), np.arange(67, 134), height_cm) == []
