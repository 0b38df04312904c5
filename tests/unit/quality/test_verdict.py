"""The table of checks at its bounds, the two verdicts, and causes and remedies that are true."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
from pydantic import ValidationError

from datagen.quality.label_error import KINDS
from datagen.quality.verdict import Check, LabelEvidence, MapEvidence, VerdictSettings, checks, judge
from datagen.slam.camera.self_calibration import MAX_STRAIN
from lanenet.data.maps.mapped_drive import AWAY, BETWEEN_LANES, DOUBTFUL

LABELS = LabelEvidence(
    1000, 950, off_1=0.04, off_3=0.002, metres=25.0, left_m=6.0, right_m=2.0, in_view=0.8, outside_share=0.02
)
GOOD = MapEvidence(
    labels=LABELS,
    coverage=0.8,
    revisits=12,
    laps=3,
    closure_across_heights=0.03,
    sigma={"focal": 0.006, "pitch": 0.002},
    given_lane_cm=40.0,
    found_lane_cm=None,
    height_cm=17.0,
    tape_cm=1.9,
    ahead_cm=0.0,
    strain=0.0,
    elsewhere=0,
    speed_cm_s=60.0,
    pauses=0,
    wrong_share=0.0,
)
KNOWN = replace(GOOD, sigma={}, found_lane_cm=40.5)
OPEN = {"revisits": 0, "closure_across_heights": None, "laps": 1}
#: Few frames have labels, because they are doubted.
FEW = {"labelled": 200, "not_labelled": {DOUBTFUL: 800}}
S = VerdictSettings()
NAN = float("nan")
_OF_LABELS = {field.name for field in fields(LabelEvidence)}


def changed(evidence: MapEvidence, **changes) -> MapEvidence:
    """Evidence with other values, also of its labels."""
    labels = {name: changes.pop(name) for name in _OF_LABELS & changes.keys()}
    return replace(evidence, labels=replace(evidence.labels, **labels), **changes)


def judged(evidence: MapEvidence = GOOD, **changes):
    return judge(changed(evidence, **changes), VerdictSettings())


def found(evidence: MapEvidence = GOOD, **changes) -> list[Check]:
    """Rows that are not good, in the order of the table."""
    rows = checks(changed(evidence, **changes), VerdictSettings())
    return [check for check in rows if check.grade != "good"]


def off(evidence: MapEvidence = GOOD, **changes) -> dict[str, str]:
    return {check.name: check.grade for check in found(evidence, **changes)}


def test_a_good_set_has_no_findings():
    for evidence in (GOOD, KNOWN):
        verdict = judge(evidence, VerdictSettings())
        assert off(evidence) == {} and (verdict.grade, verdict.state) == ("good", "closed")
        assert len(verdict.reasons) == 1
        assert "950 of 1,000" in verdict.sentence and "0.2 %" in verdict.sentence


#: Name of a row, what is changed for a value, and values up to the bounds of good and of usable labels.
ROWS = [
    ("max_off", lambda x: {"off_3": x}, S.max_off, 4.0 * S.max_off),
    ("max_outside", lambda x: {"outside_share": x}, S.max_outside, 2.0 * S.max_outside),
    ("min_frames", lambda x: {"labelled": round(x)}, S.min_frames, S.min_frames // 10),
    ("min_metres", lambda x: {"metres": x}, S.min_metres, 0.1 * S.min_metres),
    ("min_bend_m", lambda x: {"left_m": 0.1, "right_m": x - 0.1}, S.min_bend_m, None),
    ("min_in_view", lambda x: {"in_view": x}, S.min_in_view, None),
    ("max_closure_heights", lambda x: {"closure_across_heights": x}, S.max_closure_heights, None),
    ("max_strain", lambda x: {"strain": x}, *MAX_STRAIN),
    ("max_focal_sigma", lambda x: {"sigma": {"focal": x}}, S.max_focal_sigma, 2.0 * S.max_focal_sigma),
    (
        "max_pitch_sigma_rad",
        lambda x: {"sigma": {"pitch": x}},
        S.max_pitch_sigma_rad,
        2.0 * S.max_pitch_sigma_rad,
    ),
    (
        "height_mismatch",
        lambda x: {"height_cm": 15.0 * (1.0 + x), "given_height_cm": 15.0},
        S.height_mismatch,
        None,
    ),
    ("lane_mismatch", lambda x: {"tape_cm": 2.0 / (1.0 + x), "given_tape_cm": 2.0}, S.lane_mismatch, None),
    ("lane_mismatch", lambda x: {"found_lane_cm": 40.0 * (1.0 + x)}, S.lane_mismatch, 2.0 * S.lane_mismatch),
    ("lane_mismatch", lambda x: {"found_lane_cm": 40.0 / (1.0 + x)}, S.lane_mismatch, 2.0 * S.lane_mismatch),
    # What cannot be is not usable.
    ("height_cm", lambda x: {"height_cm": x}, *2 * (S.height_cm[0],)),
    ("height_cm", lambda x: {"height_cm": x}, *2 * (S.height_cm[1],)),
    ("tape_cm", lambda x: {"tape_cm": x}, *2 * (S.tape_cm[0],)),
    ("tape_cm", lambda x: {"tape_cm": x}, *2 * (S.tape_cm[1],)),
]
_LEAST = {("height_cm", S.height_cm[0]), ("tape_cm", S.tape_cm[0])}


@pytest.mark.parametrize(("name", "made", "good", "usable"), ROWS)
def test_every_row_at_its_bounds(name, made, good, usable):
    worse = -1.0 if name.startswith("min_") or (name, good) in _LEAST else 1.0
    step = worse * (1 if isinstance(good, int) else 1e-6)
    assert name not in off(**made(good - (0 if isinstance(good, int) else step)))
    beyond = found(**made(good + step))
    (row,) = (check for check in beyond if check.name == name)
    assert row.grade == ("reject" if usable == good else "usable")
    assert row.cause and row.remedy and row.bound in judged(**made(good + step)).reasons[0]
    assert judged(**made(good + step)).grade == row.grade
    if usable is None:
        assert off(**made(good + 1e3 * step))[name] == "usable"
    elif usable != good:
        assert off(**made(usable - (0 if isinstance(good, int) else step)))[name] == "usable"
        assert off(**made(usable + step))[name] == "reject" == judged(**made(usable + step)).grade


def test_what_the_user_set_moves_the_bounds():
    loose = VerdictSettings(max_off=0.05, tape_cm=(0.8, 15.0), min_frames=10, usable=3.0)
    wide = changed(GOOD, off_3=0.04, tape_cm=12.0, labelled=12, strain=1.2 * MAX_STRAIN[0])
    assert [(check.name, check.grade) for check in checks(wide, loose) if check.grade != "good"] == [
        ("max_strain", "usable")
    ]


@pytest.mark.parametrize("made", [{"tape_cm": 12.0}, {"height_cm": 55.0, "tape_cm": 7.0}, {"height_cm": 1.7}])
def test_lengths_that_cannot_be_are_rejected_and_the_lane_width_is_asked_for(made):
    verdict = judged(**made)
    assert verdict.grade == "reject" and "is the lane width right?" in verdict.sentence.lower()
    # A camera whose height is known says itself how wide the lane is; tape is no wider for it.
    assert off(KNOWN, **made) == ({"tape_cm": "reject"} if made.get("tape_cm") == 12.0 else {})


def test_where_nothing_measures_the_scale_it_is_asked_about_and_grades_nothing():
    # A car of half the usual size, or the whole road told for a lane: no figure can tell which.
    small, made = {"height_cm": 8.8, "tape_cm": 2.4}, {"height_cm": 35.2, "tape_cm": 9.6}
    for sizes, width, other in ((made, 20, "17.6 and 4.8 cm"), (small, 80, "17.6 and 4.8 cm")):
        assert off(**sizes) == {}
        said = judged(**sizes).remarks
        assert any(f"--lane-width {width} " in text and other in text for text in said)
    assert not any("--lane-width" in text for text in judged(**made, given_tape_cm=9.6).remarks)
    assert "wide" not in " ".join(judged(KNOWN, **made).remarks)


def test_nothing_is_good_that_nobody_knows():
    assert off(coverage=NAN) == {"held_out_every": "usable"}
    assert off(off_3=NAN) == {"max_off": "reject"}
    assert off(open_lane_cm=(31.0, 44.2)) == {"open_cm": "usable"}
    # A drive that shows no place twice rests on what is known of the camera beforehand.
    assert off(**OPEN, sigma={"focal": 0.3})["max_focal_sigma"] == "reject"
    assert off(**OPEN, given_height_cm=17.0) == {} == off(KNOWN, **OPEN)
    none = {"labelled": 0, "off_1": NAN, "off_3": NAN, "metres": 0.0, "left_m": 0.0, "right_m": 0.0}
    assert off(**none, in_view=NAN, not_labelled={AWAY: 1000}) == {"min_frames": "reject"}


@pytest.mark.parametrize(
    ("changes", "state"),
    [
        ({}, "closed"),
        (OPEN, "open"),
        ({"elsewhere": 300, "open_for": "nothing certainly closes the lap"}, "open"),
        ({"wrong": ("20 cm of the left line",), "wrong_share": 0.0099}, "closed"),
        ({"wrong": ("20 cm of the left line",), "wrong_share": 0.0101}, "wrong in sections"),
        ({"closure_across_heights": 0.2}, "wrong in sections"),
        # What is wrong is worse than what is open.
        ({"elsewhere": 300, "wrong": ("20 cm of the left line",), "wrong_share": 0.1}, "wrong in sections"),
    ],
)
def test_the_map_is_judged_apart_from_its_labels(changes, state):
    for labels, grade in (({}, "good"), ({"off_3": 0.01}, "usable"), ({"off_3": 0.1}, "reject")):
        verdict = judged(KNOWN, **changes, **labels)
        assert verdict.state == state and state in verdict.sentence
        if "closure_across_heights" not in changes or grade == "reject":
            assert verdict.grade == grade
    assert any("left line" in reason for reason in judged(**changes).reasons) == ("wrong" in changes)


def test_the_worst_comes_first_and_of_one_grade_the_cause():
    verdict = judged(off_3=0.1, labelled=200, strain=1.1 * MAX_STRAIN[0])
    names = [reason.rsplit("(", 1)[1].rstrip(")") for reason in verdict.reasons]
    assert verdict.grade == "reject" and names == ["max_off", "max_strain", "min_frames"]
    assert (
        "2 more findings" in verdict.sentence
        and "more finding" not in judged(strain=1.1 * MAX_STRAIN[0]).sentence
    )


def test_a_car_between_two_lanes_is_not_told_to_drive_longer():
    frames = {"frames": 210, "labelled": 200, "not_labelled": {BETWEEN_LANES: 800, DOUBTFUL: 10}}
    told = judged(**frames).sentence
    assert "short" not in told and "drive within one" in told.lower()


@pytest.mark.parametrize(("missed", "said"), [(0.5, "unlike ordinary ones"), (2.2, "taken for another")])
def test_strain_is_told_by_what_most_of_it_is(missed, said):
    (row,) = found(strain=2.5, missed=missed)
    assert row.name == "max_strain" and said in row.cause


def test_a_car_that_hardly_moves_is_no_map():
    assert off(speed_cm_s=20.0) == {} and off(speed_cm_s=4.5) == {"min_speed_cm_s": "reject"}


def test_an_earlier_maps_camera_is_judged_by_its_sigmas():
    assert off(KNOWN, sigma={"focal": 0.08}) == {"max_focal_sigma": "usable"}
    assert "lanenet calibrate" in judged(KNOWN, sigma={"focal": 0.3}).sentence


def test_four_laps_are_not_told_to_drive_two():
    short, open_camera = {"labelled": 200, "frames": 210}, {"revisits": 5, "sigma": {"focal": 0.2}}
    # How far a lap of a circle turns stays open however many are driven.
    assert "two laps" not in judged(**open_camera, laps=1, turn_open=True).sentence
    for changes in (short, open_camera):
        assert "two laps" in judged(**changes, laps=1).sentence, changes
        assert "two laps" not in judged(**changes, laps=4).sentence, changes


@pytest.mark.parametrize("kind", ["", *KINDS])
def test_a_given_camera_is_not_told_to_give_one(kind):
    """Whatever is wrong."""
    doubted = {"doubted": {kind: 1.0} if kind else {}}
    worse = ({"off_3": 0.1}, {"labelled": 0}, {"found_lane_cm": 90.0}, {"closure_across_heights": 0.3}, OPEN)
    for changes in ({}, {"in_view": 0.1}, *worse):
        verdict = judged(KNOWN, **doubted, **FEW | changes)
        assert "(--camera)" not in " ".join((verdict.sentence, *verdict.remarks))
    assert ("(--camera)" in judged(**doubted, **FEW).sentence) == (kind == "camera")


@pytest.mark.parametrize("kind", ["", *KINDS])
def test_only_a_drive_with_pauses_is_told_of_them(kind):
    changes = {**FEW, "doubted": {kind: 0.9, "unseen": 0.1} if kind else {}}
    for more in ({}, {"off_3": 0.1}, {"labelled": 0}):
        assert "pause" not in judged(**{**changes, **more}).sentence
    told = judged(**changes, pauses=82)
    assert ("AUTO_RECORD_ON_THROTTLE" in told.sentence) == (kind == "gaps")
    # Once, but in any case.
    assert sum("82 pauses" in text for text in (told.sentence, *told.remarks)) >= 1


def test_each_kind_of_doubt_has_a_cause_of_its_own_where_labels_lack_for_it():
    said = {kind: judged(**FEW, doubted={kind: 1.0}).sentence for kind in KINDS}
    assert len(set(said.values())) == len(KINDS)
    # Frames far beside the lane do not lack labels because some others were doubted.
    away = {"labelled": 200, "not_labelled": {AWAY: 790, DOUBTFUL: 10}}
    assert {judged(**away, doubted={kind: 1.0}).sentence for kind in KINDS} == {judged(**away).sentence}
    assert "beside the lane" in judged(**away).sentence


def test_what_else_there_is_to_know():
    def more(**changes) -> set[str]:
        return set(judged(**changes).remarks) - set(judged().remarks)

    assert not more(labelled=860) and len(more(labelled=840)) == 1
    assert not more(tape_range_cm=(4.0, 4.9)) and len(more(tape_range_cm=(4.0, 5.1))) == 1
    assert len(more(bend_lane_cm=49.3)) == 1
    assert any("85 cm" in remark and "36 cm high" in remark for remark in more(outer_lane_cm=85.0))
    assert not more(steering=0.9) and len(more(steering=-0.9)) == 1
    # The scale of a lane is told with what follows from it; that of a given camera is not.
    assert any("17.0 cm high" in remark and "40 cm" in remark for remark in judged().remarks)
    assert judge(KNOWN, VerdictSettings()).remarks == ()
    # What was measured is compared by a check.
    assert judged(given_height_cm=18.0).remarks == ()


def test_settings_of_an_older_map_are_read_and_bounds_that_are_gone_are_named(caplog):
    assert VerdictSettings.model_validate({"max_sd_px": 0.5, "lane_reject": 0.6}) == VerdictSettings()
    assert "lane_reject, max_sd_px" in caplog.text
    with pytest.raises(ValidationError, match="max_of"):
        VerdictSettings.model_validate({"max_of": 0.5})
