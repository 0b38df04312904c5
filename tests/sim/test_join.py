"""Drives of a track that are joined, and others that are not; run with ``-m slow``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from datagen.pipeline import MapRequest, MapSettings, map_drive
from datagen.tracks.align import Alignment, alignments, refined
from datagen.tracks.car import camera_of_car
from datagen.tracks.join import join_maps
from datagen.tracks.shape import TrackShape, read_shape
from datagen.tracks.visit import read_visit
from lanenet.cli.app import app
from lanenet.data.label_set import read_labels
from lanenet.data.maps.folder import read_map
from lanenet.data.maps.joined import maps_in, read_joined
from lanenet.data.tables import ParquetTable
from lanenet.errors import LanenetError

pytestmark = pytest.mark.slow
DAY_MS = 86_400_000


def cut_tub(tub: Path, out: Path, rows: slice, later_ms: int) -> Path:
    """Write some rows of a tub as a tub of another day."""
    catalogs = sorted(tub.glob("catalog_*.catalog"), key=lambda path: int(path.stem.split("_")[1]))
    records = [json.loads(line) for path in catalogs for line in path.read_text().splitlines()][rows]
    (out / "images").mkdir(parents=True)
    for number, record in enumerate(records):
        image = record["cam/image_array"]
        (out / "images" / image).write_bytes((tub / "images" / image).read_bytes())
        record |= {"_index": number, "_timestamp_ms": record["_timestamp_ms"] + later_ms}
    (out / "catalog_0.catalog").write_text("".join(json.dumps(record) + "\n" for record in records))
    manifest = [json.loads(line) for line in (tub / "manifest.json").read_text().splitlines()]
    manifest[-1] |= {"paths": ["catalog_0.catalog"], "deleted_indexes": [], "current_index": len(records)}
    (out / "manifest.json").write_text("".join(json.dumps(line) + "\n" for line in manifest))
    return out


def laid_over(map_folder: Path, whole: Path, monkeypatch: pytest.MonkeyPatch) -> Alignment:
    """Lay a map over another one rigidly."""
    first, second = read_shape(map_folder), read_shape(whole)
    best = alignments(first, second)[0]
    # The next map's alignments are to be found with their scale again.
    with monkeypatch.context() as patch:
        patch.setattr("datagen.tracks.align._SCALE_SIGMA", 1e-9)
        rigid = refined(first, second, best.move, best.opposite)
    assert rigid is not None
    assert rigid.move.scale == pytest.approx(1.0, abs=1e-6)
    return rigid


@pytest.fixture(scope="module")
def halves(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Path]:
    """Maps of two halves of a tub with a day between them, and of the whole tub."""
    tub, folder = shared_data / "garage_tape", tmp_path_factory.mktemp("halves")
    for name, rows, later_ms in (("monday", slice(0, 750), 0), ("tuesday", slice(750, 1500), DAY_MS)):
        drive = cut_tub(tub, folder / "tubs" / name, rows, later_ms)
        map_drive(MapRequest(drive, 31.0, wheelbase_cm=17.0), MapSettings(), folder / name, pictures=False)
    whole = folder / "whole"
    map_drive(MapRequest(tub, 31.0, wheelbase_cm=17.0), MapSettings(), whole, pictures=False)
    return [folder / "monday", folder / "tuesday"], whole


def beside_tape(folder: Path, at_cm: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Offset of the tape's middle to the right of places, as the edges of its two borders show it."""
    table = ParquetTable(folder / "edges.parquet")
    names = ("x_cm", "y_cm", "normal_x", "normal_y")
    edges = np.column_stack([np.asarray(table.floats(name)) for name in names])
    offsets = []
    for place, ahead in zip(at_cm, along, strict=True):
        right = np.array([ahead[1], -ahead[0]])
        apart, facing = edges[:, :2] - place, edges[:, 2:] @ right
        across = apart @ right
        near = (np.abs(apart @ ahead) < 1.0) & (np.abs(across) < 4.0)
        # The left border brightens to the right.
        borders = [across[near & (side * facing > 0.7)] for side in (1.0, -1.0)]
        assert min(map(len, borders)) > 3
        offsets.append(0.5 * (np.median(borders[0]) + np.median(borders[1])))
    return np.array(offsets)


def turn_rad(shape: TrackShape, place: int) -> float:
    """By how much a line turns within 10 cm of one of its points."""
    near = np.hypot(*(shape.points_cm - shape.points_cm[place]).T) < 10.0
    cosines = shape.tangents[near] @ shape.tangents[place]
    # Not the other line of the lane, which is further away, nor the way back beside it.
    return float(np.arccos(np.clip(cosines[cosines > 0.0].min(), -1.0, 1.0)))


def test_two_halves_of_a_tub_with_a_day_between_them_are_joined_within_a_centimetre(
    halves, tmp_path, monkeypatch
):
    folders, whole = halves
    track = tmp_path / "track"
    report = join_maps(folders, track)
    assert read_joined(track).shared_camera
    assert not report.figures["relaid"]
    for folder in maps_in(track):
        rigid = laid_over(folder, whole, monkeypatch)
        off = np.abs(np.concatenate([rigid.apart_cm, rigid.back_cm]))
        assert np.mean(np.isnan(off)) < 0.01
        off = off[np.isfinite(off)]
        # Measured: 0.56, and 0.7 % beyond 1 cm, by 1.3 cm at most.
        assert np.percentile(off, 95.0) < 0.6
        assert np.mean(off > 1.0) < 0.01
        # There the tape turns in a corner, which one of the lines has and the other one cuts.
        first = read_shape(folder)
        beyond = np.flatnonzero(np.isfinite(rigid.apart_cm) & (np.abs(rigid.apart_cm) > 1.0))
        turned = [float(turn_rad(first, place)) for place in beyond]
        assert min(turned, default=1.0) > 0.35
        # There one of the two lies on the tape; measured: 0.75 cm off at most, within a corner.
        second = read_shape(whole)
        back = np.flatnonzero(np.isfinite(rigid.back_cm) & (np.abs(rigid.back_cm) > 1.0))
        off_whole = beside_tape(whole, second.points_cm[back], second.tangents[back])
        off_joined = beside_tape(folder, first.points_cm[beyond], first.tangents[beyond])
        for place, off_cm in zip(beyond, off_joined, strict=True):
            (moved,) = rigid.move.points(first.points_cm[place][None])
            near = np.hypot(*(second.points_cm[back] - moved).T) < 3.0
            assert min(abs(off_cm), *np.abs(off_whole[near])) < 0.9
    # Joined maps are labelled by the command.
    result = CliRunner().invoke(app, ["label", str(track), "--out", str(tmp_path / "labels.parquet")])
    assert result.exit_code == 0, result.output
    for name in ("monday", "tuesday"):
        labels = read_labels(tmp_path / f"labels-{name}.parquet")
        assert set(labels.drive) == {name}
        assert len(labels) > 600


def test_tubs_of_different_tracks_are_not_joined(shared_data, tmp_path):
    for name, width_cm in (("garage_tape", 31.0), ("usi_mat", 41.0)):
        request = MapRequest(shared_data / name, width_cm, wheelbase_cm=17.0)
        map_drive(request, MapSettings(), tmp_path / name, pictures=False)
    with pytest.raises(LanenetError, match=r"usi_mat is of another track: .*lines"):
        join_maps([tmp_path / "garage_tape", tmp_path / "usi_mat"], tmp_path / "track")
    assert not (tmp_path / "track").exists()


def test_a_camera_of_two_drives_together_is_nearer_to_that_of_the_whole_drive(halves):
    folders, whole = halves
    found = camera_of_car([read_visit(folder) for folder in folders], np.random.default_rng(0))
    focal_px = read_map(whole).camera.K[0, 0]
    alone = [abs(read_map(folder).camera.K[0, 0] / focal_px - 1.0) for folder in folders]
    # Measured: 1.7 and 1.4 % alone, 0.4 % together.
    assert min(alone) > 0.008
    assert abs(found.camera.K[0, 0] / focal_px - 1.0) < 0.008
    assert found.camera.mounting.height_cm == pytest.approx(np.mean(found.height_cm), rel=0.01)
