"""The two verdicts on a map: how good its labels are, and whether the map as a whole is closed.

A network needs frames whose labels are right, not all frames, and not the whole track. So labels are graded
by the share of them that is expected to be off (:mod:`datagen.quality.label_error`), with a least amount.
Joining tracks, driving by the map and reports of lane keeping need the map: it is closed, open, or wrong in
sections.

All checks are rows of one table, see :func:`checks`: what was found, the bounds, the cause, and the remedy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import Field, model_validator

from lanenet.config import Settings
from lanenet.data.maps.mapped_drive import DOUBTFUL
from lanenet.errors import counted

#: Lines of a verdict that people are shown at once. Chosen: what is read of a list.
MOST_LINES = 3

Grade = Literal["good", "usable", "reject"]
MapState = Literal["closed", "open", "wrong in sections"]
_ORDER: tuple[Grade, ...] = ("good", "usable", "reject")


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
        not_labelled: Number of these frames without labels, by reason, the most frequent first.
        doubted: Share of the labels that are withheld, by the kind of evidence that speaks against most of
            them, the largest first; see :data:`datagen.quality.label_error.KINDS`.
        in_view: Share of the labels whose places lie in the image; NaN without labels.
        outside_share: Share of the frames with both lines beside the window of the labels.
    """

    frames: int
    labelled: int
    off_1: float
    off_3: float
    metres: float
    left_m: float
    right_m: float
    not_labelled: dict[str, int] = field(default_factory=dict)
    doubted: dict[str, float] = field(default_factory=dict)
    in_view: float = float("nan")
    outside_share: float = 0.0


@dataclass(frozen=True)
class MapEvidence:
    """The figures that decide both verdicts.

    Attributes:
        labels: What the labels hold.
        coverage: Share of the lines' borders in view of held-out frames that met an edge; NaN if no frame was
            held out.
        revisits: Number of revisits.
        laps: Whole turns that the car has driven, or laps between revisits where these are more.
        comes_round: Whether the road of every segment ends where it begins.
        closure_across_heights: Median error of the revisits across the road, in camera heights; None without
            a revisit.
        camera_known: Whether the camera was given.
        sigma: Sigmas of the camera's parameters if it was found from the drive (focal length relative,
            [rad]).
        strain: Distance of its principal point and roll from those of ordinary cameras, in sigmas.
        given_lane_cm: Lane width that the user gave.
        found_lane_cm: Lane width that the camera measures; None if the lane sets the scale.
        bend_lane_cm: Width of the lane in bends, if it is another one there; else None.
        open_lane_cm: Narrowest and widest tenth of a lane of many widths that has no straight; else None.
        height_cm: Height of the camera that follows from the scale.
        tape_cm: Width of the markings that follows from it.
        height_given: Whether the focal length was found with a given height of the camera.
        given_height_cm: That height; None if none was given.
        given_tape_cm: Width of the tape that the user gave; None if none was given.
        ahead_cm: Distance of the camera ahead of the front axle.
        tape_range_cm: Narrowest and widest twentieth of the tape along the line on which it varies most; None
            if it is not known.
        steering: Correlation of the path's curvature with the steering command, both positive to the left;
            None where it is too weak to tell, or nothing was commanded.
        wrong: Sections of the lines that the images contradict, in words.
        wrong_share: Share of the lines' length in these sections.
        segments: Number of segments of the map.
        pauses: How often the recording pauses, if it does so again and again.
    """

    labels: LabelEvidence
    coverage: float
    revisits: int
    closure_across_heights: float | None
    camera_known: bool
    sigma: dict[str, float]
    given_lane_cm: float
    found_lane_cm: float | None
    laps: int = 0
    comes_round: bool = True
    strain: float = 0.0
    bend_lane_cm: float | None = None
    open_lane_cm: tuple[float, float] | None = None
    height_cm: float = float("nan")
    tape_cm: float = float("nan")
    height_given: bool = False
    given_height_cm: float | None = None
    given_tape_cm: float | None = None
    ahead_cm: float = 0.0
    tape_range_cm: tuple[float, float] | None = None
    steering: float | None = None
    wrong: tuple[str, ...] = ()
    wrong_share: float = 0.0
    segments: int = 1
    pauses: int = 0


#: Bounds of earlier versions, with their defaults.
_OLDER = {
    "max_sd_px": 0.5, "max_p95_px": 1.5, "min_samples": 50, "min_labelled": 0.85, "min_coverage": 0.3,
    "max_contradicted": 0.075, "max_withheld": 0.15, "max_tape_ratio": 1.35,
}  # fmt: skip


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
        max_strain: Distance of a found camera's principal point and roll from ordinary ones, in sigmas.
            Measured on loops of tiles: 1.7 to 2.3 with a false camera, 0.35 with the true one.
        min_revisits: Places seen twice that a camera needs which was found from the drive. Chosen: as for
            ``lanenet calibrate drive``; the three recorded drives have 38 and more.
        max_closure_heights: Median error of a revisit across the road, in camera heights. A study of three
            recorded drives reached 0.03.
        lane_mismatch: Relative difference between measured and given lane width, if the camera sets the
            scale, up to which labels are good. Chosen: lanes of one road vary by less.
        lane_reject: The same, beyond which they are rejected. Chosen: short of a lane mistaken for a road.
        usable: Factor on the bounds of good labels up to which they are usable. Chosen.
        height_cm, tape_cm: Least and largest height of the camera, and width of the markings, that a 1:10 car
            and its road can have. Chosen: the recorded drives have 10 to 20 and 2 to 5 cm; a factor of two is
            left on either side.
        height_mismatch: Relative difference between the given height of the camera and the one that follows
            from the lane width, up to which labels are good. Chosen: two sigmas of a height and a lane that
            were measured with a ruler.
        tape_mismatch: The same of the tape's width, whose borders blur. Chosen: less than from one common
            width to the next (1.9, 2.5, 3.8, 5 cm).
    """

    max_off: float = Field(default=0.005, gt=0.0, lt=1.0)
    min_frames: int = Field(default=300, ge=1)
    min_metres: float = Field(default=10.0, gt=0.0)
    min_bend_m: float = Field(default=0.5, ge=0.0)
    max_outside: float = Field(default=0.3, gt=0.0, lt=1.0)
    min_in_view: float = Field(default=0.25, gt=0.0, lt=1.0)
    max_focal_sigma: float = Field(default=0.05, gt=0.0)
    max_pitch_sigma_rad: float = Field(default=0.03, gt=0.0)
    max_strain: float = Field(default=2.0, gt=0.0)
    min_revisits: int = Field(default=6, ge=0)
    max_closure_heights: float = Field(default=0.15, gt=0.0)
    lane_mismatch: float = Field(default=0.25, gt=0.0)
    lane_reject: float = Field(default=0.6, gt=0.0)
    usable: float = Field(default=2.0, gt=1.0)
    height_cm: tuple[float, float] = (5.0, 40.0)
    tape_cm: tuple[float, float] = (0.8, 10.0)
    height_mismatch: float = Field(default=0.08, gt=0.0)
    tape_mismatch: float = Field(default=0.25, gt=0.0)

    @model_validator(mode="before")
    @classmethod
    def _without_older(cls, given: Any) -> Any:
        """Drop bounds of earlier versions that stand as by default: a map's settings hold them all."""
        if not isinstance(given, dict):
            return given
        return {
            name: value for name, value in given.items() if _OLDER.get(name) != value or name not in _OLDER
        }


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
    """

    grade: Grade
    state: MapState
    sentence: str
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]


class Check(NamedTuple):
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
    value: float
    good: float
    usable: float | None
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
    def figures(self) -> str:
        """What was found and expected, with the name of the bound."""
        end = "at least" if self.least else "at most"
        beyond = "" if self.usable is None else self._number(self.usable)
        beyond = beyond and f", rejected {'below' if self.least else 'above'} {beyond}"
        found = self.what.format(self._number(self.value))
        return f"{found}, expected {self._number(self.good)} {end}{beyond} ({self.name})"

    def _number(self, value: float | int) -> str:
        if self.unit == "%":
            return f"{100.0 * value:.3g} %"
        return f"{value:.3g}{' ' if self.unit else ''}{self.unit}"


#: What helps where the camera may be wrong: known, or found from the drive.
_CHECK_CAMERA = "check that the camera file and the lane width are those of this car and road"
_CAMERA_FILE = "give a camera file or an earlier map of the car (--camera)"
_WHICH_WIDTH = (
    "is the lane width right? It is the distance between the middles of the two lines that bound the driven "
    "lane, in cm"
)
#: Height of the camera and width of the tape of most cars, [cm]; others are asked about if that would help.
#: Measured: three recorded drives have 12 to 19 and 1.7 to 4.8 cm; a sixth is left on either side.
_USUAL_HEIGHT_CM, _USUAL_TAPE_CM = (10.0, 22.0), (1.4, 5.5)
#: Share of the frames without labels from which on their cause is told, and ratio of the widths of a line's
#: tape. Measured: 1.05 to 1.2 on three real drives on flat floors.
_TOLD, _TOLD_TAPE_RATIO = 0.15, 1.35
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
    # Of one grade, causes stand before what comes of them.
    found = sorted(checks(evidence, settings), key=lambda check: -_ORDER.index(check.grade))
    found = [check for check in found if check.grade != "good"]
    state, why = map_state(evidence, settings)
    held = _held(evidence.labels)
    of_map = f"the map is {state}{why}"
    grade = found[0].grade if found else "good"
    if found:
        more = f"; {counted(len(found) - 1, 'more finding')} in the report" if len(found) > 1 else ""
        remedy = found[0].remedy
        sentence = f"{found[0].cause}{more}; {held}; {of_map}. {remedy[:1].upper()}{remedy[1:]}"
    else:
        sentence = f"{held}; {of_map}"
    reasons = [check.figures for check in found] or [held]
    reasons += [f"withheld, where the images disagree with the map: {text}" for text in evidence.wrong[:2]]
    return Verdict(grade, state, sentence, tuple(reasons), tuple(_remarks(evidence, settings)))


def _held(labels: LabelEvidence) -> str:
    """Say how many labels there are, and how good they are expected to be."""
    frames = f"{labels.labelled:,} of {labels.frames:,} frames have labels"
    if not labels.labelled:
        return frames
    return f"{frames}, of which {100.0 * labels.off_3:.2g} % are expected to be off by more than 3 cm"


def map_state(e: MapEvidence, s: VerdictSettings) -> tuple[MapState, str]:
    """Tell whether a map is closed, open, or wrong in sections, and why."""
    askew = e.closure_across_heights is not None and e.closure_across_heights > s.max_closure_heights
    if askew:
        return "wrong in sections", ": its laps do not lie on one another"
    if e.wrong_share > _WRONG_SHARE:
        return "wrong in sections", f", of which the longest is {e.wrong[0]}" if e.wrong else ""
    if e.segments > 1:
        return "open", f": its {e.segments} segments show no place of each other"
    if not e.revisits:
        return "open", ": no place was certainly seen twice"
    return ("closed", "") if e.comes_round else ("open", ": the road does not come round")


def checks(e: MapEvidence, s: VerdictSettings) -> Iterator[Check]:
    """Yield the table of checks: causes before what comes of them."""
    yield from _scale(e, s)
    yield from _camera(e, s)
    labels, more = e.labels, _more(e)
    yield Check(
        "max_outside", "both lines lie beside the window in {} of the frames", labels.outside_share,
        s.max_outside, s.usable * s.max_outside,
        "in many frames both lines of the lane lie beside the window of the labels",
        "is the lane width right? If it is, tilt the camera, or drive a narrower lane",
    )  # fmt: skip
    if not labels.labelled:
        cause, remedy = _why_not(e)
        yield Check(
            "min_frames", "{} frames have labels", 0, s.min_frames, 0.1 * s.min_frames,
            f"no frame has labels: {cause}", remedy, "", least=True,
        )  # fmt: skip
        return
    yield Check(
        "max_off", "{} of the labels are expected to be off by more than 3 cm", labels.off_3, s.max_off,
        _USABLE_OFF * s.max_off, "too many labels are expected to be wrong",
        "look at the worst frames in the report; where the map is wrong, drive another lap",
    )  # fmt: skip
    for name, what, value, least, unit in (
        ("min_frames", "{} frames have labels", labels.labelled, s.min_frames, ""),
        ("min_metres", "frames with labels show {} of road", labels.metres, s.min_metres, "m"),
    ):
        yield Check(name, what, value, least, 0.1 * least, *more, unit, least=True)
    yield Check(
        "min_bend_m", "{} of the road with labels are bends", labels.left_m + labels.right_m, s.min_bend_m,
        None, "the labels show straights alone", "drive a road with bends", "m", least=True,
    )  # fmt: skip
    yield Check(
        "min_in_view", "{} of the labels lie in the image", labels.in_view, s.min_in_view, None,
        "the camera sees few of the places that the labels are of",
        f"tilt the camera down, or, if it is not {e.ahead_cm:.0f} cm ahead of the front axle, give the car's "
        "wheelbase (--wheelbase): the rest a network can only tell from what lies further ahead",
        least=True,
    )  # fmt: skip
    if e.coverage != e.coverage:
        yield Check(
            "held_out_every", "{} frames were held out", 0, 1, None, "nothing has checked the lines",
            "map a longer drive, or hold frames out from its lines", "", least=True,
        )  # fmt: skip


def _more(e: MapEvidence) -> tuple[str, str]:
    """Why labels are few, and what to do."""
    labels = e.labels
    if labels.labelled > (1.0 - _TOLD) * labels.frames:
        laps = "" if e.laps >= 2 else ": two laps of the track, or more"
        return "the drive is short", f"drive longer{laps}"
    cause, remedy = _why_not(e)
    return f"few frames have labels: {cause}", remedy


def _why_not(e: MapEvidence) -> tuple[str, str]:
    """The cause of most missing labels, and its remedy."""
    labels = e.labels
    kind = next(iter(labels.doubted), "")
    reason, count = next(iter(labels.not_labelled.items()), ("", 0))
    # What speaks against labels is no cause where frames lack them for another reason.
    if kind in _DOUBTS and reason in ("", DOUBTFUL) and not (kind == "camera" and e.camera_known):
        cause, remedy = _DOUBTS[kind]
        if kind == "gaps" and e.pauses:
            cause = "they lie beside pauses of the recording, where the car's pose is uncertain"
            remedy = _PAUSED.format(e.pauses)
        return cause, _LOOK if kind == "line" and e.laps >= 2 else remedy
    cause = f"{count} lack them ({reason})" if reason else "unknown"
    return cause, _LOOK


def _camera(e: MapEvidence, s: VerdictSettings) -> Iterator[Check]:
    """Rows on a camera that was found, and on loops that were closed with it."""
    lapped = e.laps >= 2 or e.revisits >= s.min_revisits
    height = "" if e.height_given or e.given_height_cm is not None else ", or its height (--camera-height)"
    laps = "" if lapped else "drive two laps of a closed road along the same path, or "
    remedy = f"{laps}{_CAMERA_FILE}{height}"
    if e.closure_across_heights is not None:
        yield Check(
            "max_closure_heights", "revisits miss each other across the road by {} (median)",
            e.closure_across_heights, s.max_closure_heights, None, "the laps do not lie on one another",
            _CHECK_CAMERA if e.camera_known else remedy, "camera heights",
        )  # fmt: skip
    if e.camera_known:
        return
    if not e.height_given:
        seen = "no place was" if not e.revisits else "hardly any place was"
        yield Check(
            "min_revisits", "the camera was found from {} places seen twice", e.revisits, s.min_revisits,
            0 if not e.revisits else s.min_revisits / s.usable,
            f"the drive does not show what camera this is, for {seen} seen twice", remedy, "", least=True,
        )  # fmt: skip
    yield Check(
        "max_strain", "the camera's principal point or roll is {} from those of ordinary cameras", e.strain,
        s.max_strain, s.usable * s.max_strain,
        "the camera that fits the images is unlike ordinary ones, so that a place may have been taken for "
        "another that looks like it", _CAMERA_FILE, "sigmas",
    )  # fmt: skip
    for name, what, key, bound, unit in (
        ("max_focal_sigma", "focal length", "focal", s.max_focal_sigma, "%"),
        ("max_pitch_sigma_rad", "pitch", "pitch", s.max_pitch_sigma_rad, "rad"),
    ):
        yield Check(
            name, f"the drive leaves the camera's {what} open by {{}}", e.sigma.get(key, 0.0), bound,
            s.usable * bound, f"the drive does not show the camera's {what} well enough", remedy, unit,
        )  # fmt: skip


def _scale(e: MapEvidence, s: VerdictSettings) -> Iterator[Check]:
    """Rows on the lane width: a wrong one makes another car or road of this one."""
    for what, value, given, most, bound in _measured(e, s):
        yield Check(
            bound, f"the {what} is {value:.1f} cm on the map, {given:g} cm was given: off by {{}}",
            max(value / given, given / value) - 1.0, most, None,
            f"the {what} comes out as {value:.1f} cm, not {given:g} cm",
            f"measure the {what}, and the lane between the middles of its two lines",
        )  # fmt: skip
    if e.found_lane_cm is not None:
        yield Check(
            "lane_mismatch",
            f"the lane measures {e.found_lane_cm:.1f} cm, {e.given_lane_cm:g} cm was given: off by {{}}",
            max(e.found_lane_cm / e.given_lane_cm, e.given_lane_cm / e.found_lane_cm) - 1.0,
            s.lane_mismatch, s.lane_reject,
            f"the lane measures {e.found_lane_cm:.0f} cm with this camera, not {e.given_lane_cm:g} cm",
            "measure the lane between the middles of its two lines, and the camera's height",
        )  # fmt: skip
        return
    if e.open_lane_cm is not None:
        low, high = e.open_lane_cm
        yield Check(
            "open_cm", "the widest tenth of the lane is wider than the narrowest by {}, and no straight is "
            "as long as the lane is wide", high / low - 1.0, 0.0, None,
            f"the lane is {low:.0f} to {high:.0f} cm wide and has no straight, so it is open which width is "
            f"{e.given_lane_cm:g} cm", "give a camera file (--camera), or drive a road that has a straight",
        )  # fmt: skip
    if (asked := _other_width(e)) is not None:
        yield asked
    made = (
        f"with a lane width of {e.given_lane_cm:g} cm, the camera would be {e.height_cm:.0f} cm high and the "
        f"tape {e.tape_cm:.1f} cm wide, which cannot be"
    )
    for bound, what, value, (least, most) in (
        ("height_cm", "camera's height", e.height_cm, s.height_cm),
        ("tape_cm", "tape's width", e.tape_cm, s.tape_cm),
    ):
        if value == value:
            end = least if value < least else most
            yield Check(
                bound, f"the {what} follows as {{}}", value, end, end, made, _WHICH_WIDTH, "cm", value < least
            )


def _other_width(e: MapEvidence) -> Check | None:
    """Ask about a lane width if half of it, or twice as much, would make a usual car."""

    def usual(share: float) -> bool:
        sizes_cm = ((e.height_cm, _USUAL_HEIGHT_CM), (e.tape_cm, _USUAL_TAPE_CM))
        return all(low <= share * size <= high for size, (low, high) in sizes_cm)

    if e.given_height_cm is not None or e.given_tape_cm is not None or usual(1.0):
        return None
    for share, times, what in ((0.5, "half", "of the whole road"), (2.0, "twice", "of half a lane")):
        if usual(share):
            made = f"camera {e.height_cm:.1f} cm high and the tape {e.tape_cm:.1f} cm wide"
            instead = f"{share * e.height_cm:.1f} and {share * e.tape_cm:.1f} cm"
            return Check(
                "usual size", f"the {made}, most cars have what {times} the lane width gives: off by {{}}",
                1.0, 0.0, None,
                f"is {e.given_lane_cm:g} cm the width {what}? It makes the {made}; --lane-width "
                f"{share * e.given_lane_cm:g} would make them {instead}, as on most cars",
                "measure the lane between the middles of its two lines; if it is right, give the width of "
                "the tape or the height of the camera as well (--tape-width, --camera-height)",
            )  # fmt: skip
    return None


def _measured(e: MapEvidence, s: VerdictSettings) -> Iterator[tuple[str, float, float, float, str]]:
    """Yield what was measured: its name, its length on the map and as given, its bound, the bound's name."""
    for what, value, given, most, bound in (
        ("camera's height", e.height_cm, e.given_height_cm, s.height_mismatch, "height_mismatch"),
        ("tape's width", e.tape_cm, e.given_tape_cm, s.tape_mismatch, "tape_mismatch"),
    ):
        if given is not None:
            yield what, value, given, most, bound


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
        cause, remedy = _why_not(e)
        yield f"most of the {_percent(missing)} of frames without labels: {cause}" + (
            f"; {remedy}" if remedy else ""
        )
    if e.pauses and _PAUSED.format(e.pauses) != _why_not(e)[1]:
        yield _PAUSED.format(e.pauses)
    if e.tape_range_cm is not None and e.tape_range_cm[1] > _TOLD_TAPE_RATIO * e.tape_range_cm[0]:
        low, high = e.tape_range_cm
        yield (
            f"the tape is {low:.1f} cm wide in some places and {high:.1f} cm in others: tape of several "
            "widths, light that fades, or a floor that is not flat; then lengths are wrong by as much"
        )
    if e.bend_lane_cm is not None:
        width_cm = e.given_lane_cm if e.found_lane_cm is None else e.found_lane_cm
        yield (
            f"the lane is {width_cm:.1f} cm wide on straights and {e.bend_lane_cm:.1f} cm in bends; the lane "
            "width to give is that of the straights"
        )
    if e.found_lane_cm is None:
        yield from _scale_remarks(e, s)


def _scale_remarks(e: MapEvidence, s: VerdictSettings) -> Iterator[str]:
    """What follows from the lane width, and who can check it."""
    follows = f"the camera is {e.height_cm:.1f} cm high and the tape {e.tape_cm:.1f} cm wide"
    if e.given_height_cm is not None or e.given_tape_cm is not None:
        compared = "".join(
            f"; {what}: {given:g} cm was measured, so that it comes out {_off(value / given)}"
            for what, value, given, _, _ in _measured(e, s)
        )
        off = any(
            max(value / given, given / value) > 1.0 + most for _, value, given, most, _ in _measured(e, s)
        )
        if e.given_height_cm is None and not off:
            compared += (
                f". Borders of tape blur, so that this shows a wrong lane width from about "
                f"{_percent(s.tape_mismatch)} on; is it right that the camera is {e.height_cm:.1f} cm high? "
                "Its height, measured (--camera-height), shows one from about "
                f"{_percent(s.height_mismatch)} on"
            )
        yield f"with the given lane width {follows}{compared}"
    elif _other_width(e) is None:  # else a finding asks already
        yield (
            f"is it right that {follows}? Both follow from the lane width of {e.given_lane_cm:g} cm, which "
            "no check here can show to be wrong. Measure one of them with a ruler. If it differs, the lane "
            "width is wrong by the same factor; --camera-height or --tape-width checks it for you"
        )


def _off(ratio: float) -> str:
    """Say by how much a length differs from the one that was measured."""
    if round(100.0 * abs(ratio - 1.0)) == 0:
        return "the same"
    return f"{_percent(abs(ratio - 1.0))} {'larger' if ratio > 1.0 else 'smaller'}"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"
