"""Labels that are off are doubted, and only those: a lap that is drawn, and tape that lies elsewhere.

And what is made of their errors: sections that are wrong, and what a set of labels holds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_map import CAMERA, small_map

from datagen.lanes.offset import CubicBasis
from datagen.quality import evidence
from datagen.quality.label_error import KINDS, doubted_by, predict_errors
from datagen.quality.measure import LABELLED, label_evidence, wrong_sections
from lanenet.data.drives.recording import Commands, Drive, ImageFiles
from lanenet.data.maps.label_errors import LabelErrors
from lanenet.data.maps.line import LaneLine, Side
from lanenet.data.maps.mapped_drive import DELETED, DOUBTFUL, OUTSIDE, MappedDrive
from lanenet.geometry.frames import car_from_map
from lanenet.geometry.lane import ROWS_CM
from lanenet.perception.edges.pixels import EdgePixels
from lanenet.perception.edges.road import PerceptionSettings

LAP_CM, TAPE_CM, STEP_CM, PER_LAP = 600.0, 2.0, 4.0, 150
RADIUS_CM = LAP_CM / (2.0 * np.pi)
#: Lines, to the left of the lane's middle.
SIDES: dict[Side, float] = {"left": 18.0, "right": -18.0}
#: Offset of tape to the left of its line by position along the lap; NaN without paint.
Tape = tuple[Side, Callable[[np.ndarray], np.ndarray]]


def ring(s_cm: np.ndarray, left_cm: np.ndarray | float) -> np.ndarray:
    """Points beside the middle of a lane that turns to the left."""
    angle = s_cm / RADIUS_CM
    return np.stack([np.sin(angle), -np.cos(angle)], axis=1) * np.reshape(RADIUS_CM - left_cm, (-1, 1))


def line(side: Side) -> LaneLine:
    basis = CubicBasis(np.linspace(0.0, LAP_CM, 31), periodic=True)
    # Control points lie beyond the arc, the first a knot before the seam.
    beyond = 3.0 / (2.0 + np.cos(2.0 * np.pi / 30))
    control = basis.unfolded(beyond * ring(np.arange(-20.0, 580.0, 20.0), SIDES[side]))
    s_cm, whole = np.linspace(0.0, 595.0, 60), np.array([[0.0, LAP_CM]])
    return LaneLine(side, basis.knots_cm, control, whole, 0.1, 0, LAP_CM, s_cm, np.full(60, 0.1), TAPE_CM)


def where_mapped(s_cm: np.ndarray) -> np.ndarray:
    return np.zeros(len(s_cm))


def aside(s_cm: np.ndarray) -> np.ndarray:
    """3 cm beside the map from 260 to 340 cm."""
    return 3.0 * np.clip((50.0 - np.abs(s_cm - 300.0)) / 10.0, 0.0, 1.0)


def dashes(s_cm: np.ndarray) -> np.ndarray:
    return np.where(np.mod(s_cm, 40.0) < 20.0, 0.0, np.nan)


def beside(s_cm: np.ndarray) -> np.ndarray:
    return np.full(len(s_cm), 5.0)


LEFT: Tape = ("left", where_mapped)
RIGHT: Tape = ("right", where_mapped)


def drawn(monkeypatch: pytest.MonkeyPatch, *tapes: Tape, moved_cm: np.ndarray | float = 0.0) -> MappedDrive:
    """A map of two laps whose frames see these tapes, with poses to the left of the true ones."""
    n = 2 * PER_LAP
    way_cm = STEP_CM * np.arange(n)
    true = np.column_stack([ring(way_cm, 0.0), way_cm / RADIUS_CM])
    drive_map = replace(
        small_map(),
        frames=np.arange(n),
        t_s=0.1 * np.arange(n),
        poses=np.column_stack([ring(way_cm, moved_cm), true[:, 2]]),
        lap=np.arange(n) // PER_LAP,
        segment=np.zeros(n, np.int64),
        s_cm=np.mod(way_cm, LAP_CM),
        match=np.full(n, 0.6),
        lines={0: [line("left"), line("right")]},
        tilt_rad=np.zeros((n, 2)),
        held_out=np.zeros(n, dtype=bool),
        errors=LabelErrors.none(n),
    )
    s_cm = np.arange(0.0, LAP_CM, 0.4)
    borders = []
    for side, offset in tapes:
        left_cm = SIDES[side] + offset(s_cm)
        for sign in (1.0, -1.0):
            # Towards the middle of the tape it is brighter.
            ends = [ring(s_cm, left_cm + (0.5 * TAPE_CM - inwards) * sign) for inwards in (0.0, 0.1)]
            borders.append(np.stack(ends)[:, np.isfinite(left_cm)])
    on_map = np.concatenate(borders, axis=1)

    def seen(k: int) -> EdgePixels:
        at, inwards = (car_from_map(points, true[k], CAMERA.wheelbase_cm) for points in on_map)
        uv, ends = CAMERA.project_ground(at), CAMERA.project_ground(inwards)
        good = np.isfinite(ends - uv).all(axis=1) & (uv >= 0.0).all(axis=1)
        good &= (uv < [CAMERA.width - 1, CAMERA.height - 1]).all(axis=1)
        good &= (at[:, 1] > 0.0) & (at[:, 1] < 65.0)
        normals = (ends - uv)[good]
        return EdgePixels(uv[good], normals / np.linalg.norm(normals, axis=1, keepdims=True))

    keep = np.full((CAMERA.height, CAMERA.width), 255, np.uint8)
    monkeypatch.setattr(evidence, "frame_edges", lambda _, rows: ((k, seen(k), keep) for k in rows.tolist()))
    drive = Drive(
        name="made-up",
        path=Path("made-up"),
        frames=np.arange(n),
        t_s=drive_map.t_s,
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


def judged(mapped: MappedDrive) -> tuple[evidence.LabelFeatures, LabelErrors]:
    features = evidence.label_features(mapped)
    assert np.isfinite(features.s_cm).all()
    return features, predict_errors(features)


def feature(features: evidence.LabelFeatures, name: str) -> np.ndarray:
    return features.values[..., features.names.index(name)]


def places(features: evidence.LabelFeatures, number: int) -> np.ndarray:
    """Where the labels of a line lie along the lap; NaN for those of the other one."""
    return np.where(features.line == number, np.mod(features.s_cm, LAP_CM), np.nan)


@pytest.mark.parametrize("tapes", [(LEFT, RIGHT), (("left", dashes), RIGHT), (LEFT, ("left", beside), RIGHT)])
def test_labels_on_their_tape_are_not_doubted(monkeypatch, tapes):
    """Nor in the gaps of a dashed line, and another tape that lies beside it everywhere is no rival."""
    mapped = drawn(monkeypatch, *tapes)
    features, errors = judged(mapped)
    assert errors.off_1.max() < 0.05 and wrong_sections(mapped.drive_map, features, errors) == ((), 0.0)
    met = feature(features, "others_met")
    assert met[:, 3:].min() > 0.95 and np.nanmax(feature(features, "own_rival")) < 0.5
    if tapes[0][1] is dashes:
        along_cm = np.mod(places(features, 0), 40.0)
        assert (
            met[np.abs(along_cm - 10.0) < 2.0].min() > 0.7 and met[np.abs(along_cm - 30.0) < 2.0].max() < 0.3
        )


@pytest.mark.parametrize("across", [1.0, -1.0])
def test_labels_beside_their_tape_are_doubted_there_alone(monkeypatch, across):
    features, errors = judged(drawn(monkeypatch, LEFT, ("right", lambda s_cm: across * aside(s_cm))))
    s_cm = places(features, 1)
    assert errors.withheld[np.abs(s_cm - 300.0) < 38.0].mean() > 0.9
    assert not errors.withheld[~(np.abs(s_cm - 300.0) < 55.0)].any()
    shares = doubted_by(features, errors, ~errors.withheld)
    assert next(iter(shares)) == "beside" and sum(shares.values()) == pytest.approx(1.0)


def test_labels_of_a_pass_whose_poses_are_off_are_doubted_and_the_lines_are_not_wrong(monkeypatch):
    k = np.arange(2 * PER_LAP)
    moved = (k >= 200) & (k < 250)
    mapped = drawn(monkeypatch, LEFT, RIGHT, moved_cm=np.where(moved, 4.0, 0.0))
    features, errors = judged(mapped)
    assert errors.withheld[202:248].mean() > 0.9 and not errors.withheld[(k < 198) | (k >= 252)].any()
    assert wrong_sections(mapped.drive_map, features, errors)[0] == ()


def test_a_pass_is_compared_with_the_others_also_where_it_crosses_the_seam(monkeypatch):
    k = np.arange(2 * PER_LAP)
    moved = (k >= 120) & (k < 170)
    mapped = drawn(monkeypatch, LEFT, RIGHT, moved_cm=np.where(moved, 2.5, 0.0))
    features = evidence.label_features(mapped)
    own_cm, pass_cm, others_cm, shift_cm = (
        feature(features, f"{name}_cm")[135:155]
        for name in ("own_offset", "pass_offset", "others_offset", "passes_shift")
    )
    assert min(np.nanmedian(seen_cm) for seen_cm in (own_cm, pass_cm, shift_cm)) > 2.0
    # Within a window's length of the seam, the other end of the lap counts.
    assert np.nanpercentile(others_cm, 90.0) < 0.5


def test_a_section_without_paint_on_either_line_is_doubted_more_than_where_one_holds_it(monkeypatch):
    def ends(s_cm: np.ndarray) -> np.ndarray:
        return np.where(np.abs(s_cm - 300.0) < 40.0, np.nan, 0.0)

    found = []
    for left in (("left", ends), LEFT):
        features, errors = judged(drawn(monkeypatch, left, ("right", ends)))
        off_cm = np.abs(places(features, 1) - 300.0)
        found.append(errors.off_1[off_cm < 20.0].mean())
        # From the nearest paint.
        bridged_cm = feature(features, "bridged_cm")
        assert (
            bridged_cm[off_cm < 4.0] == pytest.approx(40.0, abs=6.0) and bridged_cm[off_cm > 50.0].max() < 3.0
        )
    assert found[0] > 1.5 * found[1]


SPOILT = {
    "gaps": {"gap_before": 0.0, "gap_after": 0.0, "sideways": 3.0},
    "camera": {"ahead_cm": 3.0, "focal_cm": 3.0, "pitch_cm": 3.0},
    "line": {"sigma_cm": 3.0, "bridged": 80.0, "width_off": 0.5, "turn_rad": 1.5},
    "unseen": {"_met": 0.0, "_both": 0.0, "_views": 3.0, "visible": 0.1},
    "beside": {"_rival": 0.8, "offset_cm": 2.5, "_apart": 2.0, "_shift": 3.0, "one_border": 1.0},
}


def test_what_speaks_against_labels_is_the_kind_that_was_spoilt(monkeypatch):
    features = evidence.label_features(drawn(monkeypatch, LEFT, RIGHT))
    wrong = np.zeros(features.line.shape, dtype=bool)
    wrong[100:150] = True
    assert set(SPOILT) == set(KINDS)
    for kind, parts in SPOILT.items():
        values = features.values.copy()
        for i, name in enumerate(features.names):
            for value in (value for part, value in parts.items() if part in name):
                values[100:150, :, i] = value
        spoilt = replace(features, values=values)
        shares = doubted_by(spoilt, LabelErrors.withholding(wrong), ~wrong)
        assert next(iter(shares)) == kind
    assert doubted_by(features, LabelErrors.none(len(wrong)), ~wrong) == {}
    assert doubted_by(features, LabelErrors.withholding(wrong), ~wrong & wrong) == {}


def sections(mapped: MappedDrive, number: int, off_cm: list[tuple[float, float]], frames: int = 2 * PER_LAP):
    """Wrong sections where a line is off between some positions, in the first frames."""
    n = 2 * PER_LAP
    s_cm = STEP_CM * np.arange(n)[:, None] + CAMERA.wheelbase_cm + np.tile(ROWS_CM, 2)
    index = np.tile(np.repeat([0, max(number, 1)], 3), (n, 1))
    features = evidence.LabelFeatures((), np.zeros((n, 6, 0), np.float32), index, s_cm)
    wrong = np.zeros((n, 6), dtype=bool)
    for low, high in off_cm:
        wrong[:frames] |= ((np.mod(s_cm - low, LAP_CM) < high - low) & (features.line == number))[:frames]
    return wrong_sections(mapped.drive_map, features, LabelErrors.withholding(wrong))


@pytest.mark.parametrize("number", [0, 1])
@pytest.mark.parametrize(("low", "high"), [(100.0, 140.0), (580.0, 630.0), (200.0, 214.0)])
def test_a_section_of_which_most_labels_are_off_is_wrong_also_across_the_seam(monkeypatch, number, low, high):
    mapped = drawn(monkeypatch, LEFT, RIGHT)
    (one,), share = sections(mapped, number, [(low, high)])
    assert (one.segment, one.index, one.name) == (0, number, ("left line", "right line")[number])
    assert one.section_cm == pytest.approx((low, high), abs=4.0)
    assert share == pytest.approx(one.length_cm / (2.0 * LAP_CM))
    # Its frames are those that see it, in both laps.
    ahead_cm = np.mod(low - STEP_CM * np.array(one.frames), LAP_CM)
    assert (np.minimum(ahead_cm, LAP_CM - ahead_cm) < 60.0).all() and np.ptp(one.frames) > PER_LAP - 20


def test_what_one_lap_sees_or_is_short_is_no_section_and_the_longest_comes_first(monkeypatch):
    mapped = drawn(monkeypatch, LEFT, RIGHT)
    assert sections(mapped, 0, [(100.0, 160.0)], PER_LAP) == ((), 0.0)
    assert sections(mapped, 0, [(100.0, 105.0)])[0] == ()
    found, share = sections(mapped, 1, [(100.0, 130.0), (300.0, 380.0)])
    assert [one.section_cm[0] > 250.0 for one in found] == [True, False] and share > 0.08
    (whole,), share = sections(mapped, 1, [(0.0, LAP_CM)])
    assert whole.length_cm == LAP_CM and share == 0.5
    # Frames that see it and have right labels there are none of it.
    (one,), _ = sections(mapped, 0, [(100.0, 140.0)], PER_LAP + 20)
    assert PER_LAP <= max(one.frames) < PER_LAP + 20
    # A line of another lane is none of the driven one's.
    lines = {0: [line("left"), replace(line("right"), rank=1)]}
    other = replace(mapped, drive_map=replace(mapped.drive_map, lines=lines))
    (one,), share = sections(other, 2, [(100.0, 140.0)])
    assert "adjacent" in one.name and share == 0.0


@pytest.mark.parametrize("turn", [1.0, -1.0, 0.0])
def test_what_a_set_holds(monkeypatch, turn):
    """Every third frame is deleted, doubted or labelled; one jump is not road that was seen."""
    mapped, n = drawn(monkeypatch, LEFT, RIGHT), 2 * PER_LAP
    status = [(DELETED, DOUBTFUL, LABELLED)[k % 3] for k in range(n)]
    status[0] = OUTSIDE
    given = np.array([why == LABELLED for why in status])
    points_cm = np.where(given[:, None], [-18.0, -18.0, np.nan, 18.0, 18.0, 18.0], np.nan)
    poses = mapped.drive_map.poses * [1.0, 1.0, turn]
    poses[n // 2 + 2 :, 0] += 1000.0
    errors = LabelErrors(*(np.where(np.isfinite(points_cm), p, 1.0) for p in (0.1, 0.04, 0.002)))
    mapped = replace(mapped, drive_map=replace(mapped.drive_map, poses=poses, errors=errors))
    held = label_evidence(mapped.drive_map, status, points_cm, {})
    # What was deleted counts nowhere; what lies beside the lane is no frame that might have labels.
    assert (held.labelled, held.frames) == (n // 3, 2 * n // 3)
    assert held.not_labelled == {DOUBTFUL: n // 3, OUTSIDE: 1}
    assert (held.off_1, held.off_3) == pytest.approx((0.04, 0.002))
    places = np.column_stack([points_cm[2], np.tile(ROWS_CM, 2)])[[0, 1, 3, 4, 5]]
    assert held.in_view == pytest.approx(CAMERA.shows_ground(places).mean())
    assert held.outside_share == pytest.approx(1.0 / (2 * n // 3 + 1))
    # A third of two laps.
    assert held.metres == pytest.approx(4.0, abs=0.15)
    bends = (held.left_m, held.right_m)[:: 1 if turn >= 0.0 else -1]
    assert bends == pytest.approx((4.0, 0.0) if turn else (0.0, 0.0), abs=0.3)
    nothing = label_evidence(mapped.drive_map, status, np.full(points_cm.shape, np.nan), {})
    assert np.isnan(nothing.off_3) and nothing.metres == 0.0
