"""The two verdicts on a map: how good its labels are, and whether the map as a whole is closed.

A network needs frames whose labels are right, not all frames, and not the whole track. So labels are graded
by the share of them that is expected to be off (:mod:`datagen.quality.label_error`), with a least amount.
Joining tracks, driving by the map and reports of lane keeping need the map: it is closed, open, or wrong in
sections.

All checks are rows of one table, see :func:`checks`: what was found, the bounds, the cause, and the remedy.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, PositiveFloat, model_validator

from datagen.slam.camera.self_calibration import MAX_FOCAL_SIGMA, MAX_STRAIN, MIN_REVISITS
from lanenet.config import Settings
from lanenet.data.maps.mapped_drive import AWAY, BETWEEN_LANES, DOUBTFUL, NOT_MAPPED
from lanenet.errors import counted

_log = logging.getLogger(__name__)

#: Lines of a verdict that people are shown at once. Chosen: what is read of a list.
MOST_LINES = 3

Grade = Literal["good", "usable", "reject"]
MapState = Literal["closed", "open", "wrong in sections"]


@dataclass(frozen=True)
class LabelEvidence:
    """What the labels of a map hold.

    Attributes:
        frames: Frames of the drive that might have labels.
        labelled: Frames that have.
        off_1: Share of the labels that is expected to be off by more than 1 cm; NaN without labels.
        off_3: The same for 3 cm.
        metres: Length of road along which frames have labels.
        left_m: Length of it in bends to the left.
        right_m: Length of it in bends to the right.
        in_view: Share of the labels whose places lie in the image; NaN without labels.
        outside_share: Share of the frames with both lines beside the window of the labels.
        not_labelled: Number of these frames without labels, by reason, the most frequent first.
        doubted: Share of the labels that are withheld, by the kind of evidence that speaks against most of
            them, the largest first; see :data:`datagen.quality.label_error.KINDS`.
    """

    frames: int
    labelled: int
    off_1: float
    off_3: float
    metres: float
    left_m: float
    right_m: float
    in_view: float
    outside_share: float
    not_labelled: dict[str, int] = field(default_factory=dict)
    doubted: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class MapEvidence:
    """The figures that decide both verdicts.

    Attributes:
        labels: What the labels hold.
        coverage: Share of the lines' borders in view of held-out frames that met an edge; NaN if no frame was
            held out.
        revisits: Number of revisits.
        closure_across_heights: Median error of the revisits across the road, in camera heights; None without
            a revisit.
        sigma: Sigmas of the camera's parameters if it was found from the drive (focal length relative,
            [rad]); empty for a given camera.
        given_lane_cm: Lane width that the user gave.
        found_lane_cm: Lane width that the camera measures; None if the lane sets the scale.
        height_cm: Height of the camera that follows from the scale.
        tape_cm: Width of the markings that follows from it.
        ahead_cm: Distance of the camera ahead of the front axle.
        laps: Whole turns that the car has driven, or laps between revisits where these are more.
        strain: Distance of a found camera's principal point and roll from those of ordinary ones, and of its
            odometry from the closed loops, in sigmas.
        missed: The part of the strain that is heading which odometry misses in a lap.
        turn_open: Whether places were seen twice, but do not tell how far a lap turns.
        elsewhere: Frames outside the largest segment, which are not joined to it.
        speed_cm_s: Median speed of the car.
        pauses: How often the recording pauses, if it does so again and again.
        wrong_share: Share of the lines' length in sections that the images contradict.
        wrong: These sections, in words, those of the driven lane first.
        open_for: Why the largest segment is not certainly a closed road; empty where it is one.
        bend_lane_cm: Width of the lane in bends, if it is another one there; else None.
        open_lane_cm: Narrowest and widest tenth of a lane of many widths that has no straight; else None.
        outer_lane_cm: Lane width that the user gave, if the lines that are so far apart bound several lanes,
            of which one was driven and mapped; else None.
        given_height_cm: Height of the camera that the user gave; None if none was given.
        given_tape_cm: Width of the tape that the user gave; None if none was given.
        tape_range_cm: Narrowest and widest twentieth of the tape along the line on which it varies most; None
            if it is not known.
        steering: Correlation of the path's curvature with the steering command, both positive to the left;
            None where it is too weak to tell, or nothing was commanded.
    """

    labels: LabelEvidence
    coverage: float
    revisits: int
    closure_across_heights: float | None
    sigma: dict[str, float]
    given_lane_cm: float
    found_lane_cm: float | None
    height_cm: float
    tape_cm: float
    ahead_cm: float
    laps: int
    strain: float
    elsewhere: int
    speed_cm_s: float
    pauses: int
    wrong_share: float
    missed: float = 0.0
    turn_open: bool = False
    wrong: tuple[str, ...] = ()
    open_for: str = ""
    bend_lane_cm: float | None = None
    open_lane_cm: tuple[float, float] | None = None
    outer_lane_cm: float | None = None
    given_height_cm: float | None = None
    given_tape_cm: float | None = None
    tape_range_cm: tuple[float, float] | None = None
    steering: float | None = None


#: Bounds of earlier versions, which no check uses any more.
_OLDER = frozenset(
    ("max_sd_px", "max_p95_px", "min_samples", "min_labelled", "min_coverage", "max_contradicted")
    + ("max_withheld", "max_tape_ratio", "lane_reject", "tape_mismatch", "max_strain", "min_revisits")
)


class VerdictSettings(Settings):
    """Bounds of good labels and of a closed map; ``usable`` ones may exceed a bound by that factor.

    Attributes:
        max_off: Share of the labels that is expected to be off by more than 3 cm. Chosen: one of two hundred,
            a tenth of what a robust loss of the training takes.
        min_frames: Frames with labels, below which a set is small; rejected below a tenth. Chosen: a lap.
        min_metres: The same of the road along which they are, [m].
        min_bend_m: Length of bends to either side, together, below which a set holds straights alone, [m].
            Chosen: one corner.
        max_outside: Share of frames with both lines beside the window of the labels. Chosen: a map three
            times too large, which no residual shows, has more.
        min_in_view: Share of the labels whose places lie in the image. Measured: 0.58 and 0.85 on two real
            drives, whose cameras do not see what is beside the front axle.
        max_focal_sigma: Relative sigma of the focal length, if it was found from the drive. Chosen: it moves
            labels by about as much.
        max_pitch_sigma_rad: Sigma of the camera's pitch, if it was found from the drive. Chosen: 1.7 degrees;
            the principal point takes on most of what the pitch is off. Labels of ``donkey_circuit`` with
            cameras from two parts of it (sigma 0.013 and 0.017) lie 0.4 cm from those of the whole (0.022).
        min_speed_cm_s: Median speed of the car on the map. Chosen: half of the slowest drive here; where
            lamps that are mirrored in the floor held a path back, it was 4.5.
        max_closure_heights: Median error of a revisit across the road, in camera heights. A study of three
            recorded drives reached 0.03.
        lane_mismatch: Relative difference of the lane width that the camera measures, or of the tape's width
            that follows from the scale, from the given one, up to which labels are good. Chosen: lanes of one
            road vary by less, and tape less than from one common width to the next (1.9, 2.5, 3.8, 5 cm).
        usable: Factor on the bounds of good labels up to which they are usable. Chosen.
        height_cm, tape_cm: Least and largest height of the camera, and width of the markings, that a 1:10 car
            and its road can have. Chosen: the recorded drives have 10 to 20 and 2 to 5 cm; a factor of two is
            left on either side.
        height_mismatch: Relative difference between the given height of the camera and the one that follows
            from the lane width, up to which labels are good. Chosen: two sigmas of a height and a lane that
            were measured with a ruler.
    """

    max_off: float = Field(default=0.005, gt=0.0, lt=1.0)
    min_frames: int = Field(default=300, ge=1)
    min_metres: float = Field(default=10.0, gt=0.0)
    min_bend_m: float = Field(default=0.5, ge=0.0)
    max_outside: float = Field(default=0.3, gt=0.0, lt=1.0)
    min_in_view: float = Field(default=0.25, gt=0.0, lt=1.0)
    max_focal_sigma: PositiveFloat = MAX_FOCAL_SIGMA
    max_pitch_sigma_rad: float = Field(default=0.03, gt=0.0)
    min_speed_cm_s: float = Field(default=10.0, ge=0.0)
    max_closure_heights: float = Field(default=0.15, gt=0.0)
    lane_mismatch: float = Field(default=0.25, gt=0.0)
    usable: float = Field(default=2.0, gt=1.0)
    height_cm: tuple[float, float] = (5.0, 40.0)
    tape_cm: tuple[float, float] = (0.8, 10.0)
    height_mismatch: float = Field(default=0.08, gt=0.0)

    @model_validator(mode="before")
    @classmethod
    def _without_older(cls, given: Any) -> Any:
        """Drop bounds of earlier versions: the settings of a map hold them all."""
        if isinstance(given, dict) and (gone := sorted(_OLDER & given.keys())):
            _log.warning("verdict: %s: no check has this bound any more", ", ".join(gone))
            return {name: value for name, value in given.items() if name not in _OLDER}
        return given


@dataclass(frozen=True)
class Verdict:
    """How far labels and map can be trusted.

    Attributes:
        grade: Of the labels: the worst grade of all checks.
        state: Of the map as a whole.
        sentence: What the grade comes from and what to do about it, in plain words.
        reasons: The figures behind it, the worst first, with the bounds that they exceed; for good labels,
            what that is based on.
        remarks: What else to know.
        checks: The table of checks.
    """

    grade: Grade
    state: MapState
    sentence: str
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]
    checks: tuple[Check, ...]


@dataclass(frozen=True)
class Check:
    """One row of the table of checks.

    Attributes:
        name: Of the bound in :class:`VerdictSettings`.
        what: What was found, with a gap for the number.
        value: The number; NaN is beyond all bounds.
        good: Bound of good labels.
        usable: Bound of usable ones; None where nothing is rejected.
        cause: What is wrong if it is exceeded, in plain words.
        remedy: What to do about it.
        unit: Of the number: ``%`` for a share.
        least: Whether the bounds are lower ones.
    """

    name: str
    what: str
    value: float | int
    good: float | int
    usable: float | int | None
    cause: str
    remedy: str
    unit: str = "%"
    least: bool = False

    @property
    def grade(self) -> Grade:
        """Grade of this row."""
        sign = -1.0 if self.least else 1.0
        if sign * self.value <= sign * self.good:
            return "good"
        return "usable" if self.usable is None or sign * self.value <= sign * self.usable else "reject"

    @property
    def found(self) -> str:
        """What was found."""
        return self.what.format(self._number(self.value))

    @property
    def bound(self) -> str:
        """What was expected."""
        beyond = "" if self.usable is None else self._number(self.usable)
        beyond = beyond and f", rejected {'below' if self.least else 'above'} {beyond}"
        return f"{self._number(self.good)} at {'least' if self.least else 'most'}{beyond}"

    def _number(self, value: float | int) -> str:
        return f"{100.0 * value:.3g} %" if self.unit == "%" else f"{value:.3g} {self.unit}".rstrip()


#: What helps where the camera may be wrong: known, or found from the drive.
_CHECK_CAMERA = "check that the camera file and the lane width are those of this car and road"
_CAMERA_FILE = "give a camera file or an earlier map of the car (--camera)"
_WHICH_WIDTH = (
    "is the lane width right? It is the distance between the middles of the two lines that bound the driven "
    "lane, in cm"
)
#: Share of the frames without labels from which on their cause is told. Chosen.
_TOLD = 0.15
#: Factor on the share of wrong labels up to which a set is usable, 2 %. Chosen: a robust loss takes it.
_USABLE_OFF = 4.0
#: Sections of the lines that are wrong, as a share of their length, beyond which the map is. Chosen: one
#: section of 10 cm in 10 m.
_WRONG_SHARE = 0.01
_PAUSED = (
    "the recording has {} pauses, as where it runs only while the throttle is pressed: record all of the "
    "drive (Donkeycar: AUTO_RECORD_ON_THROTTLE = False)"
)
_LOOK = "look at the strip of frames in the report"
_TURN_OPEN = "the road looks alike in more than one place, so that it is open how far a lap turns"
#: Why frames have no labels where no label is doubted: cause and remedy.
_APART = "record without long pauses; the notes of the report tell why each section is left out"
_MISSING = dict.fromkeys((AWAY, BETWEEN_LANES), ("the car drove beside the lane", "drive within one"))
_MISSING[NOT_MAPPED] = "nothing joins them to the map, or they show no lane", _APART
#: Why labels are doubted, by kind of evidence (:data:`datagen.quality.label_error.KINDS`): cause and remedy.
_DOUBTS = {
    "gaps": (
        "they lie where the recording begins, breaks off or ends, and the car's pose is uncertain",
        "record all of the drive in one piece",
    ),
    "camera": ("the drive leaves the camera open", _CAMERA_FILE),
    "line": ("the map itself is uncertain there", "drive another lap along the same path"),
    "unseen": (
        "the images hardly show the line there",
        "look at these frames in the report: worn tape, glare, blur, or a line out of view",
    ),
    "beside": (
        "the images show a line beside the one on the map",
        "look at these frames in the report: another tape, a reflection, or a place that looks like another",
    ),
}


def verdict_lines(reasons: Sequence[str], remarks: Sequence[str]) -> tuple[str, ...]:
    """Order what a verdict says: the two worst findings and the first remark, which are shown; the rest."""
    return (*reasons[:2], *remarks[:1], *reasons[2:], *remarks[1:])


def folded(lines: Sequence[str], page: Path) -> list[str]:
    """Return a verdict and its first lines, and where the others are."""
    shown, more = list(lines[: 1 + MOST_LINES]), len(lines) - 1 - MOST_LINES
    return [*shown, f"and {more} more in {page}"] if more > 0 else shown


def judge(evidence: MapEvidence, settings: VerdictSettings) -> Verdict:
    """Grade a map's labels, and the map."""
    table = tuple(checks(evidence, settings))
    # What is rejected before what is usable, as in the alphabet; of one grade, causes before their outcome.
    found = sorted((check for check in table if check.grade != "good"), key=lambda check: check.grade)
    state, why = map_state(evidence, settings)
    held = _held(evidence.labels)
    sentence, grade = f"{held}; the map is {state}{why}", found[0].grade if found else "good"
    if found:
        more = f"; {counted(len(found) - 1, 'more finding')} in the report" if len(found) > 1 else ""
        remedy = found[0].remedy
        sentence = f"{found[0].cause}{more}; {sentence}. {remedy[:1].upper()}{remedy[1:]}"
    reasons = [f"{one.found}, expected {one.bound} ({one.name})" for one in found] or [held]
    reasons += [f"withheld, likely off by more than 3 cm: {text}" for text in evidence.wrong[:2]]
    return Verdict(grade, state, sentence, tuple(reasons), tuple(_remarks(evidence, settings)), table)


def _held(labels: LabelEvidence) -> str:
    """Say how many labels there are, and how good they are expected to be."""
    off = f", of which {100.0 * labels.off_3:.2g} % are expected to be off by more than 3 cm"
    return f"{labels.labelled:,} of {labels.frames:,} frames have labels{off if labels.labelled else ''}"


def map_state(e: MapEvidence, s: VerdictSettings) -> tuple[MapState, str]:
    """Tell whether a map is closed, open, or wrong in sections, and why."""
    if (e.closure_across_heights or 0.0) > s.max_closure_heights:
        return "wrong in sections", ": its laps do not lie on one another"
    if e.wrong_share > _WRONG_SHARE:
        return "wrong in sections", f" without labels, the longest {e.wrong[0]}" if e.wrong else ""
    if not e.revisits or e.turn_open:
        return "open", f": {_TURN_OPEN if e.turn_open else 'no loop was certainly closed'}"
    apart = f", but for {counted(e.elsewhere, 'frame')} that {'is' if e.elsewhere == 1 else 'are'} not on it"
    return ("open", f": {e.open_for}") if e.open_for else ("closed", apart if e.elsewhere else "")


def checks(e: MapEvidence, s: VerdictSettings) -> Iterator[Check]:
    """Yield the table of checks: causes before what comes of them."""
    yield from _scale(e, s)
    yield from _camera(e, s)
    yield Check(
        "min_speed_cm_s", "the car drives at {}", e.speed_cm_s, s.min_speed_cm_s, s.min_speed_cm_s,
        "the car hardly moves on the map, as where lamps in the floor go with it", _LOOK, "cm/s", least=True,
    )  # fmt: skip
    labels, more = e.labels, _more(e, s)
    yield Check(
        "max_outside", "both lines lie beside the window in {} of the frames", labels.outside_share,
        s.max_outside, s.usable * s.max_outside,
        "in many frames both lines of the lane lie beside the window of the labels",
        "is the lane width right? If it is, tilt the camera, or drive a narrower lane",
    )  # fmt: skip
    if labels.labelled:
        yield Check(
            "max_off", "{} of the labels are expected to be off by more than 3 cm", labels.off_3, s.max_off,
            _USABLE_OFF * s.max_off, "too many labels are expected to be wrong",
            f"look at the worst frames in the report{'' if e.laps >= 2 else ', or drive another lap'}",
        )  # fmt: skip
    for name, what, value, least, unit in (
        ("min_frames", "{} frames have labels", labels.labelled, s.min_frames, ""),
        ("min_metres", "frames with labels show {} of road", labels.metres, s.min_metres, "m"),
    ):
        yield Check(name, what, value, least, 0.1 * least, *more, unit, least=True)
        if not labels.labelled:
            return
    yield Check(
        "min_bend_m", "{} of the road with labels are bends", labels.left_m + labels.right_m, s.min_bend_m,
        None, "the labels show straights alone", "drive a road with bends", "m", least=True,
    )  # fmt: skip
    yield Check(
        "min_in_view", "{} of the labels lie in the image", labels.in_view, s.min_in_view, None,
        "the camera sees few of the places that the labels are of",
        f"tilt the camera down, or, if it is not {e.ahead_cm:.0f} cm ahead of the front axle, give the car's "
        "wheelbase (--wheelbase): the rest a network can only tell from what lies further ahead", least=True,
    )  # fmt: skip
    if e.coverage != e.coverage:
        yield Check(
            "held_out_every", "{} held-out frames show a line of the map", 0, 1, None,
            "nothing has checked the lines", "map a longer drive, or hold frames out", "", least=True,
        )  # fmt: skip


def _more(e: MapEvidence, s: VerdictSettings) -> tuple[str, str]:
    """Why labels are few, and what to do."""
    labels = e.labels
    # Of frames beside the lane there are no labels to be had.
    frames = labels.labelled + sum(labels.not_labelled.values())
    if labels.labelled > (1.0 - _TOLD) * frames or 0 < labels.labelled <= frames < s.min_frames:
        laps = "" if e.laps >= 2 else ": two laps of the track, or more"
        return "the drive is short", f"drive longer{laps}"
    cause, remedy = _why_not(e)
    return f"few frames have labels: {cause}" if labels.labelled else f"no frame has labels: {cause}", remedy


def _why_not(e: MapEvidence) -> tuple[str, str]:
    """The cause of most missing labels, and its remedy."""
    labels = e.labels
    kind = next(iter(labels.doubted), "")
    reason, count = next(iter(labels.not_labelled.items()), ("", 0))
    # What speaks against labels is no cause where frames lack them for another reason.
    if kind in _DOUBTS and reason in ("", DOUBTFUL) and (kind != "camera" or e.sigma):
        if kind == "gaps" and e.pauses:
            return "they lie beside pauses, where the car's pose is uncertain", _PAUSED.format(e.pauses)
        cause, remedy = _DOUBTS[kind]
        return cause, _LOOK if kind == "line" and e.laps >= 2 else remedy
    return _MISSING.get(reason, (f"{count} lack them ({reason})" if reason else "unknown", _LOOK))


def _camera(e: MapEvidence, s: VerdictSettings) -> Iterator[Check]:
    """Rows on a camera that was found, and on loops that were closed with it."""
    laps = "drive two laps of a closed road along the same path, or "
    few = e.laps < 2 and e.revisits < MIN_REVISITS and not e.turn_open
    why = f": {_TURN_OPEN}" if e.turn_open else ", for hardly a place was seen twice" if few else ""
    known = e.found_lane_cm is not None
    remedy = "measure the camera (lanenet calibrate)" if known else f"{laps if few else ''}{_CAMERA_FILE}"
    height = ", or its height (--camera-height)" if e.given_height_cm is None else ""
    if e.closure_across_heights is not None:
        yield Check(
            "max_closure_heights", "revisits miss each other across the road by {} (median)",
            e.closure_across_heights, s.max_closure_heights, None, "the laps do not lie on one another",
            _CHECK_CAMERA if known else remedy, "camera heights",
        )  # fmt: skip
    by_heading = 2.0 * e.missed**2 > e.strain**2
    yield Check(
        "max_strain", f"the {'closed loops are' if by_heading else 'camera is'} {{}} from "
        f"{'what its odometry turns' if by_heading else 'ordinary ones, by principal point or roll'}",
        e.strain, *MAX_STRAIN,
        "the car turned otherwise in a lap than the closed loops say: a place may have been taken for "
        "another that looks like it" if by_heading
        else "the camera that fits the images is unlike ordinary ones", _CAMERA_FILE, "sigmas",
    )  # fmt: skip
    for name, what, key, bound, unit in (
        ("max_focal_sigma", "focal length", "focal", s.max_focal_sigma, "%"),
        ("max_pitch_sigma_rad", "pitch", "pitch", s.max_pitch_sigma_rad, "rad"),
    ):
        yield Check(
            name, f"the camera's {what} is open by {{}}", e.sigma.get(key, 0.0), bound, s.usable * bound,
            f"the {'camera file' if known else 'drive'} does not tell the camera's {what} well enough{why}",
            remedy + height if key == "focal" and not known else remedy, unit,
        )  # fmt: skip


def _scale(e: MapEvidence, s: VerdictSettings) -> Iterator[Check]:
    """Rows on the lane width: a wrong one makes another car or road of this one."""
    lengths = (
        ("height_cm", "camera's height", e.height_cm, e.given_height_cm, "height_mismatch", s.height_cm),
        ("tape_cm", "tape's width", e.tape_cm, e.given_tape_cm, "lane_mismatch", s.tape_cm),
    )
    for _, what, value, given, bound, _ in lengths:
        if given is not None:
            yield _compared(bound, what, value, given, getattr(s, bound), None)
    if e.found_lane_cm is not None:
        beyond = s.usable * s.lane_mismatch
        yield _compared("lane_mismatch", "lane", e.found_lane_cm, e.given_lane_cm, s.lane_mismatch, beyond)
    elif e.open_lane_cm is not None:
        low, high = e.open_lane_cm
        yield Check(
            "open_cm", "the widest tenth of the lane is wider than the narrowest by {}, and no straight is "
            "as long as the lane is wide", high / low - 1.0, 0.0, None,
            f"the lane is {low:.0f} to {high:.0f} cm wide and has no straight, so it is open which width is "
            f"{e.given_lane_cm:g} cm", "give a camera file (--camera), or drive a road that has a straight",
        )  # fmt: skip
    known, wide = e.found_lane_cm is not None, f"{e.tape_cm:.1f} cm wide, which cannot be"
    made, remedy = f"with this camera, the tape would be {wide}", _CHECK_CAMERA
    if not known:
        at_width = f"with a lane width of {e.given_lane_cm:.4g} cm, the camera would be"
        made, remedy = f"{at_width} {e.height_cm:.0f} cm high and the tape {wide}", _WHICH_WIDTH
    # The height of a known camera is as it is.
    for bound, what, value, _, _, (least, most) in lengths[known:]:
        end = least if value < least else most
        yield Check(bound, f"the {what} follows as {{}}", value, end, end, made, remedy, "cm", value < least)


def _compared(
    name: str, what: str, value_cm: float, given_cm: float, good: float, usable: float | None
) -> Check:
    """A row on a length that was given and follows from the map as well."""
    return Check(
        name, f"the {what} is {value_cm:.1f} cm on the map, {given_cm:g} cm was given: off by {{}}",
        max(value_cm / given_cm, given_cm / value_cm) - 1.0, good, usable,
        f"the {what} comes out as {value_cm:.1f} cm, not {given_cm:g} cm",
        "measure the lane between the middles of its two lines, the camera's height, and the tape",
    )  # fmt: skip


def _remarks(e: MapEvidence, s: VerdictSettings) -> Iterator[str]:
    """What a person can check who has the car and the road before them."""
    if e.steering is not None and e.steering < 0.0:
        yield (
            f"the car turns right where it was steered left (correlation {e.steering:.2f}): the sign of the "
            "steering is reversed, or the images are mirrored. The map and its labels follow the images; "
            "before a network drives, exchange STEERING_LEFT_PWM and STEERING_RIGHT_PWM in the car's "
            "myconfig.py, or undo the camera's mirroring (CAMERA_HFLIP)"
        )
    missing = 1.0 - e.labels.labelled / max(e.labels.frames, 1)
    if e.labels.labelled and missing > _TOLD:
        yield f"most of the {100.0 * missing:.0f} % of frames without labels: {'; '.join(_why_not(e))}"
    if e.pauses and _PAUSED.format(e.pauses) != _why_not(e)[1]:
        yield _PAUSED.format(e.pauses)
    if e.tape_range_cm is not None and e.tape_range_cm[1] > (1.0 + s.lane_mismatch) * e.tape_range_cm[0]:
        yield "the tape is {:.1f} cm wide in some places and {:.1f} cm in others".format(*e.tape_range_cm)
    if e.outer_lane_cm is not None:
        height_cm = e.height_cm * e.outer_lane_cm / e.given_lane_cm
        yield (
            f"the two lines that are {e.outer_lane_cm:g} cm apart bound several lanes, and the car drives in "
            f"one of {e.given_lane_cm:.1f} cm, which was mapped: give that width. If the driven lane is "
            f"{e.outer_lane_cm:g} cm wide, the camera is {height_cm:.0f} cm high, not "
            f"{e.height_cm:.0f} cm, and needs another camera file"
        )
    if e.bend_lane_cm is not None:
        width_cm = e.given_lane_cm if e.found_lane_cm is None else e.found_lane_cm
        yield (
            f"the lane is {width_cm:.1f} cm wide on straights and {e.bend_lane_cm:.1f} cm in bends; the lane "
            "width to give is that of the straights"
        )
    # Where a length was measured a check compares it.
    if (e.found_lane_cm, e.given_height_cm, e.given_tape_cm) == (None,) * 3:
        # Which of both would make a more usual car, by the middle of what cars and tape can be.
        usual_cm2 = (s.height_cm[0] * s.height_cm[1] * s.tape_cm[0] * s.tape_cm[1]) ** 0.5
        share, road = (0.5, "the whole road") if e.height_cm * e.tape_cm > usual_cm2 else (2.0, "half a lane")
        other = f"{share * e.height_cm:.1f} and {share * e.tape_cm:.1f} cm, if {road} was measured"
        yield (
            f"is it right that the camera is {e.height_cm:.1f} cm high and the tape {e.tape_cm:.1f} cm wide? "
            f"Both follow from the lane width of {e.given_lane_cm:.4g} cm, which no check here can show to "
            f"be wrong (--lane-width {share * e.given_lane_cm:.4g} would make them {other}). Measure one of "
            "them with a ruler; --camera-height or --tape-width checks it for you"
        )
