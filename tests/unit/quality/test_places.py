"""Places where the images contradict a line: a straight road on a map, and tape that lies elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_map import CAMERA, small_map

from datagen.quality import places
from lanenet.data.drives.recording import Commands, Drive, ImageFiles
from lanenet.data.maps.line import LaneLine, Side
from lanenet.data.maps.mapped_drive import MappedDrive
from lanenet.geometry.frames import car_from_map
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import PerceptionSettings

LENGTH_CM, TAPE_CM, HALF_CM = 300.0, 2.0, 18.0
SIDES: dict[Side, float] = {"left": HALF_CM, "right": -HALF_CM}
S_CM = np.arange(0.0, LENGTH_CM, 0.4)
#: Offset of the tape to the left of where the map has it, NaN without paint.
Offset = Callable[[np.ndarray], np.ndarray]


def where_mapped(s_cm: np.ndarray) -> np.ndarray:
    return np.zeros(len(s_cm))


def bump(height_cm: float) -> Offset:
    """Beside the map between 130 and 200 cm."""
    return lambda s_cm: height_cm * np.clip((35.0 - np.abs(s_cm - 165.0)) / 10.0, 0.0, 1.0)


def dashes(s_cm: np.ndarray) -> np.ndarray:
    return np.where(np.mod(s_cm, 40.0) < 20.0, 0.0, np.nan)


def straight(side: Side) -> LaneLine:
    knots = np.concatenate([np.zeros(3), np.linspace(0.0, LENGTH_CM, 13), np.full(3, LENGTH_CM)])
    s_cm = np.array([knots[i + 1 : i + 4].mean() for i in range(15)])
    control = np.column_stack([s_cm, np.full(15, SIDES[side])])
    return LaneLine(side, knots, control, np.array([[0.0, LENGTH_CM]]), 0.1, marking_cm=TAPE_CM)


def drive_of(monkeypatch: pytest.MonkeyPatch, *tapes: tuple[Side, Offset]) -> MappedDrive:
    """A map of a straight road, whose frames see these tapes."""
    x_cm = np.arange(0.0, LENGTH_CM - 60.0, 4.0)
    n = len(x_cm)
    drive_map = replace(
        small_map(),
        frames=np.arange(n),
        t_s=0.1 * np.arange(n),
        poses=np.column_stack([x_cm, np.zeros(n), np.zeros(n)]),
        lap=np.zeros(n, np.int64),
        segment=np.zeros(n, np.int64),
        s_cm=x_cm,
        match=np.full(n, 0.6),
        lines={0: [straight("left"), straight("right")]},
        tilt_rad=np.zeros((n, 2)),
        held_out=np.zeros(n, dtype=bool),
        contradicted=np.zeros((n, 2), dtype=bool),
    )

    def seen(k: int) -> EdgePixels:
        parts = []
        for side, offset in tapes:
            for border in (1.0, -1.0):
                y_cm = SIDES[side] + offset(S_CM) + 0.5 * border * TAPE_CM
                points = np.column_stack([S_CM, y_cm])[np.isfinite(y_cm)]
                # Towards the middle of the tape it is brighter.
                ends = [
                    CAMERA.project_ground(car_from_map(p, drive_map.poses[k], CAMERA.wheelbase_cm))
                    for p in (points, points - [0.0, 0.1 * border])
                ]
                normal = ends[1] - ends[0]
                good = np.isfinite(normal).all(axis=1) & (ends[0] >= 0.0).all(axis=1)
                good &= (ends[0] < [CAMERA.width - 1, CAMERA.height - 1]).all(axis=1)
                ahead = points[:, 0] - drive_map.poses[k, 0]
                good &= (ahead > CAMERA.wheelbase_cm) & (ahead < 80.0)
                parts.append((ends[0][good], normal[good]))
        normals = np.concatenate([p[1] for p in parts])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return EdgePixels(np.concatenate([p[0] for p in parts]), normals)

    keep = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    monkeypatch.setattr(places, "frame_edges", lambda _, rows: ((int(k), seen(int(k)), keep) for k in rows))
    drive = Drive(
        name="made-up",
        path=Path("made-up"),
        frames=np.arange(n),
        t_s=0.1 * np.arange(n),
        times_trusted=True,
        commands=Commands(angle=np.zeros(n)),
        deleted=np.zeros(n, dtype=bool),
        breaks=np.zeros(n, dtype=bool),
        camera=None,
        lane_width_cm=None,
        problems=(),
        width=CAMERA.width,
        height=CAMERA.height,
        images=ImageFiles([]),
        rows=np.arange(n),
    )
    return MappedDrive(drive_map, drive, np.arange(n), PerceptionSettings())


def test_a_line_that_lies_on_its_tape_is_left_alone(monkeypatch):
    mapped = drive_of(monkeypatch, ("left", dashes), ("right", where_mapped))
    _, wrong = places.withhold_wrong_places(mapped)
    assert wrong == []
    # They were looked at.
    evidence = places.gather_evidence(mapped)
    assert evidence[0, 1].met.sum() > 0.95 * evidence[0, 1].views.sum() > 100


@pytest.mark.parametrize("height_cm", [2.5, 6.0, -12.0])
def test_a_line_beside_its_tape_is_withheld_there(monkeypatch, height_cm):
    mapped = drive_of(monkeypatch, ("left", where_mapped), ("right", bump(height_cm)))
    drive_map, wrong = places.withhold_wrong_places(mapped)
    (place,) = wrong
    assert place.name == "right line"
    from_cm, to_cm = place.section_cm
    assert from_cm == pytest.approx(135.0, abs=8.0) and to_cm == pytest.approx(195.0, abs=8.0)
    if abs(height_cm) > 3.0:
        assert place.beside_cm == pytest.approx(-height_cm, abs=1.0)
    left, right = drive_map.lines[0]
    assert right.contradicted(np.array([100.0, 165.0, 240.0])).tolist() == [False, True, False]
    assert not len(left.contradicted_cm)
    figures = places.withheld_figures(drive_map, wrong)
    assert figures["share"] == pytest.approx(place.length_cm / (2.0 * LENGTH_CM), abs=0.01)


def test_a_line_that_leaves_the_end_of_a_dash_is_off_in_the_gap_behind_it(monkeypatch):
    def leaving(s_cm: np.ndarray) -> np.ndarray:
        return dashes(s_cm) + np.where(
            (s_cm > 120.0) & (s_cm < 140.0), np.maximum(s_cm - 128.0, 0.0) / 4.0, 0.0
        )

    drive_map, wrong = places.withhold_wrong_places(
        drive_of(monkeypatch, ("left", leaving), ("right", where_mapped))
    )
    (place,) = wrong
    assert place.name == "left line"
    left, _ = drive_map.lines[0]
    assert left.contradicted(np.array([110.0, 138.0, 150.0, 210.0])).tolist() == [False, True, True, False]


def test_the_other_tape_of_a_double_line_is_a_thing_of_its_own(monkeypatch):
    def beside(s_cm: np.ndarray) -> np.ndarray:
        return np.full(len(s_cm), 5.0)

    mapped = drive_of(monkeypatch, ("left", dashes), ("left", beside), ("right", where_mapped))
    assert places.withhold_wrong_places(mapped)[1] == []


def test_where_neither_line_is_seen_both_are_withheld(monkeypatch):
    def ends(s_cm: np.ndarray) -> np.ndarray:
        return np.where(np.abs(s_cm - 165.0) < 55.0, np.nan, 0.0)

    both = drive_of(monkeypatch, ("left", ends), ("right", ends))
    assert {place.name for place in places.withhold_wrong_places(both)[1]} == {"left line", "right line"}
    # The other line holds it in place.
    one = drive_of(monkeypatch, ("left", ends), ("right", where_mapped))
    assert places.withhold_wrong_places(one)[1] == []


@pytest.mark.parametrize(("turn_rad", "withheld"), [(0.0, False), (0.3, False), (1.0, True)])
def test_a_corner_that_no_paint_shows_is_withheld(turn_rad, withheld):
    # The other line turns in one place; this one has no paint for 40 cm around it, in every pass.
    knots = np.sort(np.concatenate([straight("left").knots_cm, [150.0] * 3]))
    s_cm = np.array([knots[i + 1 : i + 4].mean() for i in range(len(knots) - 4)])
    control = np.column_stack([s_cm, HALF_CM + np.tan(turn_rad) * np.maximum(s_cm - 150.0, 0.0)])
    kinked = replace(straight("left"), knots_cm=knots, coefficients_cm=control)
    evidence = places.PlaceEvidence.none(2, 150)
    evidence.views[...] = evidence.met[...] = evidence.both[...] = evidence.near[...] = 4
    evidence.met[:, 65:85] = evidence.both[:, 65:85] = evidence.near[:, 65:85] = 0
    other = places.OtherLine(np.ones(150, dtype=bool), places.sharp_places(kinked))
    wrong = places.wrong_places(0, straight("right"), evidence, 36.0, other)
    assert [place.section_cm for place in wrong] == ([(128.0, 172.0)] if withheld else [])
    # Something that one frame sees beside it changes nothing, and neither do passes of few frames.
    evidence.beside[0, 75, 3] = evidence.pairs[0, 75, 3] = 1
    assert len(places.wrong_places(0, straight("right"), evidence, 36.0, other)) == len(wrong)
    evidence.views[:, 65:85] = 1
    assert len(places.wrong_places(0, straight("right"), evidence, 36.0, other)) == len(wrong)
    # Where no frame looks there is nothing to withhold, and no frame to name.
    evidence.views[:, 60:90] = evidence.met[:, 60:90] = 0
    assert places.wrong_places(0, straight("right"), evidence, 36.0, other) == []
    # A gap between two dashes hides little.
    evidence.views[...] = 4
    evidence.met[:, 60:65] = evidence.met[:, 85:90] = 4
    evidence.met[:, 65:74] = evidence.near[:, 65:74] = evidence.met[:, 77:85] = evidence.near[:, 77:85] = 4
    assert places.wrong_places(0, straight("right"), evidence, 36.0, other) == []


def passes_of_which_the_last_disagrees(beside: bool) -> places.PlaceEvidence:
    """Three passes; the last one sees the tape 5 cm beside, or nothing, from place 60 to 90 of 150."""
    evidence = places.PlaceEvidence.none(3, 150)
    evidence.views[...] = evidence.met[...] = evidence.both[...] = evidence.near[...] = 4
    evidence.met[2, 60:90] = evidence.both[2, 60:90] = evidence.near[2, 60:90] = 0
    if beside:
        middle = evidence.beside.shape[2] // 2
        evidence.beside[2, 60:90, middle + 5] = evidence.pairs[2, 60:90, middle + 5] = 4
    return evidence


@pytest.mark.parametrize("beside", [True, False])
def test_a_pass_that_disagrees_with_the_others_lies_elsewhere(monkeypatch, beside):
    evidence = passes_of_which_the_last_disagrees(beside)
    assert places.wrong_places(0, straight("right"), evidence, 36.0) == []
    found = places.sections_against(evidence, 36.0, False)
    assert not found[:2].any()
    assert abs(int(found[2].sum()) - 30) <= 4 and found[2, 65:85].all()
    # All frames of this map are of pass 1.
    mapped = drive_of(monkeypatch, ("left", where_mapped), ("right", where_mapped)).drive_map
    turned = replace(
        evidence, **{name: np.roll(values, 2, axis=0) for name, values in vars(evidence).items()}
    )
    misplaced = places.misplaced_frames(mapped, {(0, 1): turned})
    x_cm = mapped.poses[misplaced, 0] + CAMERA.wheelbase_cm
    assert x_cm.min() >= 120.0 - 45.0 and x_cm.max() <= 180.0 and misplaced.sum() > 15


def test_what_most_passes_contradict_is_no_fault_of_their_frames():
    evidence = passes_of_which_the_last_disagrees(True)
    most = replace(evidence, **{name: values[[0, 2, 2]] for name, values in vars(evidence).items()})
    assert len(places.wrong_places(0, straight("right"), most, 36.0)) == 1
    assert not places.sections_against(most, 36.0, False).any()


@pytest.mark.parametrize("closed", [True, False])
def test_a_wrong_section_goes_on_where_the_line_runs_out_of_view(closed):
    run, off, unseen = np.arange(40, 46), np.zeros(100, dtype=bool), np.zeros(100, dtype=bool)
    off[38:90], unseen[50:88] = True, True
    found = places._with_ends(run, off, unseen, closed)
    np.testing.assert_array_equal(found, np.arange(37, 91))
    # What is looked at and not met may be a gap.
    found = places._with_ends(run, off, np.zeros(100, dtype=bool), closed)
    assert found.max() < 65
    everything = places._with_ends(run, np.ones(100, dtype=bool), np.ones(100, dtype=bool), closed)
    np.testing.assert_array_equal(everything, np.arange(100))
