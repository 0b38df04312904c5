"""Verdicts at their bounds, and the reasons they give."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from datagen.quality.verdict import LineEvidence, MapEvidence, VerdictSettings, judge

LINE = LineEvidence(samples=2000, coverage=0.8, robust_sd_px=0.4, p95_px=1.2)
GOOD = MapEvidence(
    lines={"left": LINE, "right": replace(LINE, robust_sd_px=0.2)},
    p95_px=1.2,
    coverage=0.8,
    labelled_share=0.95,
    point_shares={"left": 0.95, "right": 0.93},
    not_labelled={"pose uncertain": 5},
    revisits=12,
    closure_across_heights=0.03,
    camera_known=False,
    sigma={"focal": 0.006, "pitch": 0.002},
    given_lane_cm=40.0,
    found_lane_cm=None,
)
OPEN = {"revisits": 0, "closure_across_heights": None}
KNOWN = replace(GOOD, camera_known=True, sigma={}, found_lane_cm=40.5)
NAN = float("nan")


def left(**changes: float) -> dict[str, dict[str, LineEvidence]]:
    """Evidence with another left line beside the good right one."""
    return {"lines": {**GOOD.lines, "left": replace(LINE, **changes)}}


def graded(evidence: MapEvidence, **changes):
    return judge(replace(evidence, **changes), VerdictSettings())


def test_a_good_map_says_what_it_rests_on():
    verdict = judge(GOOD, VerdictSettings())
    assert verdict.grade == "good"
    for words in ("0.40 px (left line)", "0.20 px (right line)", "1.20 px as p95", "95 %"):
        assert words in verdict.reasons[0]


def test_sections_that_are_withheld_are_said_first():
    withheld = ("1.2 m of the right line near frame 2704", "30 cm of the left line near frame 9")
    verdict = graded(GOOD, withheld=withheld, withheld_share=0.05)
    assert verdict.grade == "good"
    assert withheld[0] in verdict.sentence and "1 more" in verdict.sentence
    assert graded(GOOD, withheld=withheld, withheld_share=0.2).grade == "usable"
    assert graded(GOOD, withheld=withheld, withheld_share=0.9).grade == "reject"


def test_pauses_of_the_recording_are_named_once():
    paused = graded(GOOD, pauses=82)
    assert paused.grade == "good" and [text for text in paused.remarks if "82 pauses" in text]
    few = graded(GOOD, pauses=82, labelled_share=0.73)
    assert few.grade == "usable" and "82 pauses" in few.sentence and "AUTO_RECORD_ON_THROTTLE" in few.sentence
    # They may not be the cause.
    assert "strip of frames" in few.sentence and "--camera" in few.sentence
    assert not [text for text in few.remarks if "pauses" in text]
    assert "pauses" not in graded(GOOD, labelled_share=0.73).sentence
    assert not [text for text in graded(GOOD).remarks if "pauses" in text]


def test_a_camera_that_does_not_see_what_is_labelled_is_named():
    verdict = graded(GOOD, in_view=0.04, ahead_cm=27.5)
    assert verdict.grade == "usable"
    assert "4 % of the places" in verdict.sentence and "--wheelbase" in verdict.sentence
    assert graded(GOOD, in_view=0.6).grade == "good"


def test_lines_beside_the_window_are_no_labels():
    few = graded(GOOD, outside_share=0.1)
    assert few.grade == "good" and "10 % with both lines beside the window" in few.sentence
    assert graded(GOOD, outside_share=0.45).grade == "usable"
    verdict = graded(GOOD, outside_share=0.72)
    assert verdict.grade == "reject" and "lane width" in verdict.sentence


def test_tape_that_is_wider_in_places_is_named():
    verdict = graded(GOOD, tape_range_cm=(3.4, 5.2))
    assert verdict.grade == "usable"
    assert "3.4 cm" in verdict.sentence and "5.2 cm" in verdict.sentence and "not flat" in verdict.sentence
    assert graded(GOOD, tape_range_cm=(4.6, 5.2)).grade == "good"


def test_what_sets_the_scale_is_named_with_what_follows_from_it():
    remarks = graded(GOOD, height_cm=17.2, tape_cm=1.9).remarks
    assert any("17.2 cm" in remark and "1.9 cm" in remark for remark in remarks)
    assert any("40 cm" in remark for remark in remarks)
    assert judge(KNOWN, VerdictSettings()).remarks == ()


@pytest.mark.parametrize(
    ("height_cm", "tape_cm", "bound"),
    [(60.0, 9.0, "height_cm"), (20.0, 12.0, "tape_cm"), (1.7, 0.2, "height_cm"), (17.0, 1.9, None)],
)
def test_a_lane_width_that_makes_another_car_of_it_is_questioned(height_cm, tape_cm, bound):
    """The width of the whole road, or one in metres or millimetres."""
    found = graded(GOOD, height_cm=height_cm, tape_cm=tape_cm)
    assert found.grade == ("good" if bound is None else "usable")
    if bound is not None:
        assert bound in found.reasons[0] and len(found.reasons) == 1
        assert all(f"{value} cm" in found.sentence for value in (40, round(height_cm), tape_cm))
    assert graded(KNOWN, height_cm=height_cm, tape_cm=tape_cm).grade == "good"


def test_a_lane_width_that_is_twice_another_cars_is_asked_about_once():
    found = graded(GOOD, height_cm=25.1, tape_cm=3.3)
    assert (
        "the width of the whole road?" in found.sentence and "which half the lane width" in found.reasons[0]
    )
    assert not found.remarks


@pytest.mark.parametrize(
    ("given", "bound"),
    [
        ({"given_height_cm": 17.9}, None),
        ({"given_height_cm": 19.0}, "height_mismatch"),
        ({"given_tape_cm": 2.2}, None),
        ({"given_tape_cm": 3.8}, "tape_mismatch"),
    ],
)
def test_a_height_or_a_tape_that_was_measured_checks_the_lane_width(given, bound):
    found = graded(GOOD, height_cm=17.0, tape_cm=1.9, **given)
    assert found.grade == ("good" if bound is None else "usable")
    # The lane width is no longer the one thing that sets the scale.
    (remark,) = found.remarks
    share = {17.9: "5 % smaller", 19.0: "11 % smaller", 2.2: "14 % smaller", 3.8: "50 % smaller"}
    assert all(
        f"{value:g} cm was measured, so that it comes out {share[value]}" in remark
        for value in given.values()
    )
    # Tape alone is no close check, but where it is off already.
    asks = "given_tape_cm" in given and bound is None
    assert ("is it right that the camera is 17.0 cm high?" in remark) == asks
    if bound is not None:
        assert bound in found.reasons[0] and all(f"{v:g} cm" in found.sentence for v in given.values())


@pytest.mark.parametrize(
    ("height_cm", "tape_cm", "instead"),
    [
        # Three recorded drives with the width assumed for them, with twice and with half as much.
        *((17.6, 4.8, ""), (35.2, 9.6, "20"), (8.8, 2.4, "80")),
        *((12.5, 1.7, ""), (25.0, 3.4, "20"), (6.3, 0.85, "80")),
        *((18.5, 2.9, ""), (37.0, 5.8, "20"), (9.3, 1.45, "80")),
        # Neither half nor twice as much would help.
        (15.0, 0.5, ""),
    ],
)
def test_a_lane_width_of_the_whole_road_or_half_a_lane_is_asked_about(height_cm, tape_cm, instead):
    anything = VerdictSettings(height_cm=(0.1, 100.0), tape_cm=(0.1, 100.0))
    found = judge(replace(GOOD, height_cm=height_cm, tape_cm=tape_cm), anything)
    assert found.grade == ("usable" if instead else "good")
    assert ("is 40 cm the width of" in found.sentence) == ("--lane-width" in found.sentence) == bool(instead)
    assert f"--lane-width {instead} " in f"{found.sentence} --lane-width  "
    # What was measured, and a camera that sets the scale, leave nothing to ask.
    for known in ({"given_tape_cm": tape_cm}, {"given_height_cm": height_cm}, {"found_lane_cm": 40.0}):
        told = judge(replace(GOOD, height_cm=height_cm, tape_cm=tape_cm, **known), anything)
        assert told.grade == "good" and "--lane-width" not in told.sentence


@pytest.mark.parametrize(("sigma", "grade"), [(0.04, "usable"), (0.08, "usable"), (0.12, "reject")])
def test_a_height_stands_in_for_a_loop_but_not_for_a_check(sigma, grade):
    found = graded(GOOD, **OPEN, height_given=True, sigma={"focal": sigma})
    assert found.grade == grade and "max_focal_sigma" in found.reasons[0]


@pytest.mark.parametrize(("steering", "remarks"), [(None, 0), (0.9, 0), (-0.9, 1)])
def test_steering_of_the_wrong_sign_is_named(steering, remarks):
    found = graded(KNOWN, steering=steering)
    assert found.grade == "good" and len(found.remarks) == remarks
    assert all("-0.90" in remark and "STEERING_LEFT_PWM" in remark for remark in found.remarks)


@pytest.mark.parametrize(
    ("changes", "grade", "reason"),
    [
        (left(robust_sd_px=0.5) | {"p95_px": 1.5, "labelled_share": 0.85}, "good", "0.50 px"),
        (left(robust_sd_px=0.51), "usable", "left line .* robust sd 0.51 px"),
        (left(robust_sd_px=1.01), "reject", "left line .* robust sd 1.01 px"),
        (left(robust_sd_px=NAN, p95_px=NAN, coverage=0.0), "reject", "borders of its left line"),
        # Worn lines of good maps are found along a tenth of their length.
        (left(coverage=0.1), "good", "0.40 px"),
        (left(p95_px=2.9), "good", "0.40 px"),
        (left(p95_px=3.1), "usable", "left line .* p95 3.10 px"),
        (left(samples=49, robust_sd_px=3.0), "usable", "49 places of the left line, expected 50"),
        ({"p95_px": 1.6}, "usable", "p95 1.60 px"),
        ({"p95_px": 3.1}, "usable", "p95 3.10 px"),
        ({"labelled_share": 0.8}, "usable", r"80 % .*85 % .*\(5 pose uncertain\).*min_labelled"),
        ({"labelled_share": 0.69}, "reject", "69 %"),
        # A frame counts with one point; the points of a line may be fewer.
        ({"point_shares": {"left": 0.95, "right": 0.85}}, "good", "95 %"),
        ({"point_shares": {"left": 0.2, "right": 1.0}}, "usable", "20 % of the left .*frames: 95 %"),
        ({"coverage": 0.2}, "usable", "20 %"),
        ({"coverage": 0.1}, "reject", "10 %"),
        ({"coverage": 0.0, "p95_px": NAN}, "reject", "no edge"),
        ({"coverage": NAN, "p95_px": NAN}, "usable", "no frame was held out"),
        (OPEN | {"sigma": {"focal": 0.3}}, "reject", "no place was seen twice.* 30 %.*max_focal_sigma"),
        # Only where the focal length is known closely beforehand.
        (OPEN | {"sigma": {"focal": 0.04}}, "usable", "no place was seen twice.* 4 %.*max_focal_sigma"),
        ({"revisits": 5}, "reject", "5 places seen twice, expected 6.*min_revisits"),
        ({"revisits": 5, "height_given": True}, "good", "0.40 px"),
        ({"revisits": 6}, "good", "0.40 px"),
        ({"sigma": {"focal": 0.07}}, "usable", "focal length open by 7.0 %"),
        ({"sigma": {"focal": 0.12}}, "reject", "focal"),
        ({"sigma": {"pitch": 0.04}}, "usable", "pitch open by 0.040 rad"),
        ({"closure_across_heights": 0.2}, "usable", "0.20 camera heights"),
        ({"closure_across_heights": 0.5}, "reject", "0.50 camera heights"),
    ],
)
def test_bounds(changes, grade, reason):
    verdict = graded(GOOD, **changes)
    assert verdict.grade == grade
    assert re.search(reason, verdict.reasons[0])
    if grade != "good":
        # Bounds are named by their keys, in the figures; the sentence is for people.
        assert set(re.findall(r"\w+_\w+", verdict.reasons[0])) & {
            *VerdictSettings.model_fields,
            "held_out_every",
        }
        assert not re.search(r"_|\bpx\b|sigma", verdict.sentence) and ". " in verdict.sentence


@pytest.mark.parametrize(
    ("found_cm", "grade"),
    [(32.5, "good"), (49.0, "good"), (31.0, "usable"), (52.0, "usable"), (24.0, "reject"), (80.0, "reject")],
)
def test_the_lane_width_is_checked_where_the_camera_sets_the_scale(found_cm, grade):
    verdict = graded(KNOWN, found_lane_cm=found_cm)
    assert verdict.grade == grade
    if grade != "good":
        assert f"{found_cm:.1f} cm" in verdict.reasons[0] and "40 cm" in verdict.reasons[0]


def test_a_known_camera_needs_no_loop():
    assert graded(KNOWN, **OPEN).grade == "good"


def test_the_worst_reason_comes_first_and_none_is_lost():
    verdict = graded(GOOD, **left(robust_sd_px=1.4), p95_px=2.0, labelled_share=0.8)
    assert verdict.grade == "reject" and len(verdict.reasons) == 3
    assert "robust sd 1.40 px" in verdict.reasons[0]


def test_one_perfect_line_does_not_make_up_for_one_that_is_not_there():
    """Figures of a simulated road with one line, whose map had the other one on bare floor."""
    floor = LineEvidence(samples=1364, coverage=0.037, robust_sd_px=4.14, p95_px=3.63)
    painted = LineEvidence(samples=1774, coverage=0.984, robust_sd_px=0.03, p95_px=0.09)
    for lines in ({"left": floor, "right": painted}, {"left": painted, "right": floor}):
        verdict = graded(KNOWN, lines=lines, p95_px=0.13, coverage=0.57)
        assert verdict.grade == "reject" and "robust sd 4.14 px" in verdict.reasons[0]


@pytest.mark.parametrize(
    ("share", "grade"), [(0.0, "good"), (0.06, "good"), (0.1, "usable"), (0.16, "reject")]
)
def test_pictures_that_disagree_with_the_map_count(share, grade):
    found = judge(replace(GOOD, contradicted_share=share), VerdictSettings())
    assert found.grade == grade
    assert any("disagree" in reason for reason in found.reasons) == (grade != "good")


def test_what_exceeds_a_bound_by_little_does_not_read_like_it():
    (reason,) = graded(GOOD, contradicted_share=0.0771).reasons
    assert "disagree with 7.7 % of the frames' lines" in reason
    assert "expected 7.5 % at most, rejected above 15 %" in reason


def test_nobody_is_told_to_give_what_was_given():
    few = {"labelled_share": 0.8}
    assert "--camera-height" in graded(GOOD, **few).sentence
    measured = graded(GOOD, given_height_cm=17.0, height_cm=17.0, **few).sentence
    assert "--camera)" in measured and "--camera-height" not in measured
    assert "check that the camera file" in graded(KNOWN, **few).sentence


def test_the_sentence_counts_what_it_leaves_to_the_reasons():
    assert "more finding" not in graded(GOOD, p95_px=1.6).sentence
    assert "; 1 more finding is in the report. " in graded(GOOD, p95_px=1.6, contradicted_share=0.1).sentence
    three = graded(GOOD, p95_px=1.6, contradicted_share=0.1, withheld_share=0.2)
    assert "; 2 more findings are in the report. " in three.sentence and len(three.reasons) == 3


def test_a_lane_that_widens_in_bends_is_named_and_one_of_many_widths_has_no_scale():
    remarks = graded(GOOD, bend_lane_cm=49.3).remarks
    assert any("40.0 cm" in remark and "49.3 cm" in remark for remark in remarks)
    verdict = graded(GOOD, open_lane_cm=(31.0, 44.2))
    assert verdict.grade == "usable" and "44.2 cm" in verdict.reasons[0]
    # A known camera sets the scale.
    assert graded(KNOWN, open_lane_cm=(31.0, 44.2)).grade == "good"


def test_labels_of_an_open_map_are_good_and_it_says_what_would_close_it():
    verdict = graded(KNOWN, **OPEN)
    assert verdict.grade == "good"
    assert verdict.sentence.startswith("labels good, but the map stays open") and "lap" in verdict.sentence
    apart = graded(GOOD, segments=3)
    assert apart.grade == "good" and "its 3 segments" in apart.sentence
    # What is worse comes first, and the map is still open.
    worse = graded(KNOWN, labelled_share=0.8, **OPEN)
    assert worse.grade == "usable" and any("stays open" in reason for reason in worse.reasons)
    assert "open" not in graded(KNOWN).sentence
