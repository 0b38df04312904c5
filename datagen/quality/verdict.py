"""The verdict on a map: good, usable or reject, in one sentence, with the figures that it rests on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from pydantic import Field

from lanenet.config import Settings
from lanenet.errors import counted

#: Lines of a verdict that people are shown at once. Chosen: what is read of a list.
MOST_LINES = 3


@dataclass(frozen=True)
class LineEvidence:
    """Figures of one line in held-out frames; pixels of an image 160 px wide.

    Attributes:
        samples: Number of places in view on its borders.
        coverage: Share of them that met an edge; NaN if none was in view.
        robust_sd_px: Robust standard deviation of the residuals; NaN if no edge was found.
        p95_px: 95th percentile of the absolute residuals; NaN if no edge was found.
    """

    samples: int
    coverage: float
    robust_sd_px: float
    p95_px: float


@dataclass(frozen=True)
class MapEvidence:
    """The figures that decide the verdict.

    Attributes:
        lines: The left and the right line in held-out frames.
        p95_px: 95th percentile of both lines' absolute residuals, image 160 px wide; NaN if there are none.
        coverage: Share of both lines' borders in view that met an edge; NaN if no frame was held out.
        labelled_share: Share of frames with labels, of those that are to be labelled.
        outside_share: Share of frames with both lines beside the window, of these and of those.
        point_shares: Share of each line's points in the window that have labels, in the same frames.
        not_labelled: Number of frames without labels, by reason.
        revisits: Number of revisits.
        closure_across_heights: Median error of the revisits across the road, in camera heights; None without
            a revisit.
        camera_known: Whether the camera was given.
        sigma: Sigmas of the camera's parameters if it was found from the drive (focal length relative,
            [rad]).
        given_lane_cm: Lane width that the user gave.
        found_lane_cm: Lane width that the camera measures; None if the lane sets the scale.
        bend_lane_cm: Width of the lane in bends, if it is another one there; else None.
        open_lane_cm: Narrowest and widest tenth of a lane of many widths that has no straight; else None.
        contradicted_share: Share of the frames' lines that the images contradict.
        height_cm: Height of the camera that follows from the scale.
        tape_cm: Width of the markings that follows from it.
        height_given: Whether the focal length was found with a given height of the camera.
        given_height_cm: That height; None if none was given.
        given_tape_cm: Width of the tape that the user gave; None if none was given.
        in_view: Share of the labels whose places lie in the image; NaN if unknown.
        ahead_cm: Distance of the camera ahead of the front axle.
        tape_range_cm: Narrowest and widest twentieth of the tape along the line on which it varies most; None
            if it is not known.
        steering: Correlation of the path's curvature with the steering command, both positive to the left;
            None where it is too weak to tell, or nothing was commanded.
        withheld: Sections of the lines that are withheld because the images contradict them, in words.
        withheld_share: Share of the lines' length in these sections.
        segments: Number of segments of the map.
        pauses: How often the recording pauses, if it does so again and again.
    """

    lines: dict[str, LineEvidence]
    p95_px: float
    coverage: float
    labelled_share: float
    point_shares: dict[str, float]
    not_labelled: dict[str, int]
    revisits: int
    closure_across_heights: float | None
    camera_known: bool
    sigma: dict[str, float]
    given_lane_cm: float
    found_lane_cm: float | None
    bend_lane_cm: float | None = None
    open_lane_cm: tuple[float, float] | None = None
    contradicted_share: float = 0.0
    height_cm: float = float("nan")
    tape_cm: float = float("nan")
    height_given: bool = False
    given_height_cm: float | None = None
    given_tape_cm: float | None = None
    outside_share: float = 0.0
    in_view: float = float("nan")
    ahead_cm: float = 0.0
    tape_range_cm: tuple[float, float] | None = None
    steering: float | None = None
    withheld: tuple[str, ...] = ()
    withheld_share: float = 0.0
    segments: int = 1
    pauses: int = 0


Grade = Literal["good", "usable", "reject"]

_ORDER: tuple[Grade, ...] = ("good", "usable", "reject")


class VerdictSettings(Settings):
    """Bounds of a good map; a usable one may exceed each bound by the factor ``usable``.

    Residuals are in pixels of an image 160 px wide, on held-out frames, up to 45 cm ahead.

    Attributes:
        max_sd_px: Robust standard deviation of each line by itself; a perfect line does not make up for a
            missing one. Measured: all 122 lines on 61 maps of simulated drives keep below 0.23 px, those of
            recorded drives below 0.5; edges met by chance have 3.
        max_p95_px: 95th percentile of both lines' absolute residuals. A map beyond it is usable: marks beside
            a line make long tails even if the line is right. Chosen: three times ``max_sd_px``.
        min_samples: Least number of places in view to judge a line. Chosen: about half of one
            frame's samples of a line (two borders over 45 cm).
        min_labelled: Share of frames with labels (one of six points at least), without those that the driver
            deleted. Where one line's points in the window have a smaller share, the map is usable. Chosen.
        max_outside: Share of frames with both lines beside the window of the labels. Chosen: twice what may
            have no labels; a map three times too large, which no residual shows, has more.
        min_in_view: Share of the labels whose places lie in the image; a map with less is usable. Measured:
            0.58 and 0.85 on two real drives, whose cameras do not see what is beside the front axle.
        min_coverage: Share of the borders in view that met an edge. Dashes and worn lines lower it; below it,
            a map may be right, but the frames do not show it. Chosen: short dashes leave a third.
        max_contradicted: Share of the frames' lines that the images contradict. Derived: half of the frames
            that may have no labels; a map that is wrong in many places is not trusted elsewhere.
        max_withheld: Share of the lines' length that is withheld because the images contradict it there.
            Chosen: a bend of a lap; the labels of the rest are as good.
        max_focal_sigma: Relative sigma of the focal length, if it was found from the drive. Chosen.
        max_pitch_sigma_rad: Sigma of the camera's pitch, if it was found from the drive. Chosen: 1.7 degrees;
            the principal point takes on most of what the pitch is off. Labels of ``donkey_circuit`` with
            cameras from two parts of it (sigma 0.013 and 0.017) lie 0.4 cm from those of the whole (0.022).
        min_revisits: Places seen twice that a camera needs which was found from the drive. Chosen: as for
            ``lanenet calibrate drive``; three that only looked alike passed on a simulated drive, with labels
            1.7 cm off. The three recorded drives have 38 and more.
        max_closure_heights: Median error of a revisit across the road, in camera heights. A study of three
            recorded drives reached 0.03.
        lane_mismatch: Relative difference between measured and given lane width, if the camera sets the
            scale, up to which a map is good. Chosen: lanes of one road vary by less.
        lane_reject: The same, beyond which a map is rejected. Chosen: short of a lane mistaken for a road.
        max_tape_ratio: Ratio of the widths of a line's tape, percentiles 5 and 95, beyond which a map is
            usable. Measured: 1.05 to 1.2 on three real drives on flat floors, 1.5 on sheets that bulge.
        usable: Factor on the bounds of a good map up to which it is usable. Chosen.
        height_cm, tape_cm: Least and largest height of the camera, and width of the markings, of a 1:10 car.
            Where the lane width sets the scale, a map beyond them is usable, for the lane width may be that
            of the whole road, or in another unit. Chosen: the three recorded drives have 10 to 20 and 2 to 4
            cm; a factor of two is left on either side.
        height_mismatch: Relative difference between the given height of the camera and the one that follows
            from the lane width, up to which a map is good. Chosen: two sigmas of a height and a lane that
            were measured with a ruler.
        tape_mismatch: The same of the tape's width, whose borders blur. Chosen: less than from one common
            width to the next (1.9, 2.5, 3.8, 5 cm).
    """

    max_sd_px: float = Field(default=0.5, gt=0.0)
    max_p95_px: float = Field(default=1.5, gt=0.0)
    min_samples: int = Field(default=50, ge=1)
    min_labelled: float = Field(default=0.85, gt=0.0, lt=1.0)
    max_outside: float = Field(default=0.3, gt=0.0, lt=1.0)
    min_in_view: float = Field(default=0.25, gt=0.0, lt=1.0)
    min_coverage: float = Field(default=0.3, gt=0.0, lt=1.0)
    max_contradicted: float = Field(default=0.075, gt=0.0, lt=1.0)
    max_withheld: float = Field(default=0.15, gt=0.0, lt=1.0)
    max_focal_sigma: float = Field(default=0.05, gt=0.0)
    max_pitch_sigma_rad: float = Field(default=0.03, gt=0.0)
    min_revisits: int = Field(default=6, ge=0)
    max_closure_heights: float = Field(default=0.15, gt=0.0)
    lane_mismatch: float = Field(default=0.25, gt=0.0)
    lane_reject: float = Field(default=0.6, gt=0.0)
    max_tape_ratio: float = Field(default=1.35, gt=1.0)
    usable: float = Field(default=2.0, gt=1.0)
    height_cm: tuple[float, float] = (5.0, 40.0)
    tape_cm: tuple[float, float] = (0.8, 8.0)
    height_mismatch: float = Field(default=0.08, gt=0.0)
    tape_mismatch: float = Field(default=0.25, gt=0.0)


@dataclass(frozen=True)
class Verdict:
    """How far a map can be trusted.

    Attributes:
        grade: The worst grade of all checks.
        sentence: What that comes from and what to do about it, in plain words.
        reasons: The figures behind it, the worst first, with the bounds that they exceed; if the map is good,
            what that is based on.
        remarks: What else to know.
    """

    grade: Grade
    sentence: str
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]


class Finding(NamedTuple):
    """What keeps a map from being good.

    Attributes:
        grade: Usable or reject.
        cause: What is wrong, in plain words.
        remedy: What to do about it.
        figures: What was measured and expected, with the name of the bound.
    """

    grade: Grade
    cause: str
    remedy: str
    figures: str


#: What one check finds; nothing if the map is good.
_Findings = Iterator[Finding]

#: What helps where the camera may be wrong: known, or found from the drive; see :func:`_right_camera`.
_CHECK_CAMERA = "check that the camera file and the lane width are those of this car and road"
_LOOP_OR_CAMERA = (
    "drive two laps of a closed road along the same path, or give a camera file or an earlier map of the car "
    "(--camera)"
)
_RECORD_WHOLE = (
    "the recording has {} pauses, as where it runs only while the throttle is pressed, and what lies in "
    "longer ones is not seen: record all of the drive (Donkeycar: AUTO_RECORD_ON_THROTTLE = False)"
)

#: Height of the camera and width of the tape of most cars, [cm]; others are asked about if that would help.
#: Measured: three recorded drives have 12 to 19 and 1.7 to 4.8 cm; a sixth is left on either side.
_USUAL_HEIGHT_CM, _USUAL_TAPE_CM = (10.0, 22.0), (1.4, 5.5)
#: Share of frames that is worth naming.
_TOLD = 0.02


def verdict_lines(reasons: Sequence[str], remarks: Sequence[str]) -> tuple[str, ...]:
    """Order what a verdict says: the two worst findings and the first remark, which are shown; the rest."""
    return (*reasons[:2], *remarks[:1], *reasons[2:], *remarks[1:])


def folded(lines: Sequence[str], page: Path) -> list[str]:
    """Return a verdict and its first lines, and where the others are."""
    shown, more = list(lines[: 1 + MOST_LINES]), len(lines) - 1 - MOST_LINES
    return [*shown, f"and {more} more in {page}"] if more > 0 else shown


def judge(evidence: MapEvidence, settings: VerdictSettings) -> Verdict:
    """Grade a map."""
    # Causes before what comes of them.
    checks = (
        _lane_width,
        _scale,
        _uneven,
        _outside,
        _in_view,
        _residuals,
        _labelled,
        _contradicted,
        _withheld,
        _camera,
    )
    found = [finding for check in checks for finding in check(evidence, settings)]
    # The worst first.
    found.sort(key=lambda finding: -_ORDER.index(finding.grade))
    remarks, opened = tuple(_remarks(evidence, settings)), _open_text(evidence)
    withheld = _withheld_text(evidence.withheld)
    if found:
        worst = found[0]
        cause = worst.cause
        if len(found) > 1:
            are = "is" if len(found) == 2 else "are"
            cause += f"; {counted(len(found) - 1, 'more finding')} {are} in the report"
        sentence = f"{cause}. {worst.remedy[:1].upper()}{worst.remedy[1:]}"
        figures = [finding.figures for finding in found]
        figures += [text for text in (withheld, opened) if text]
        return Verdict(worst.grade, sentence, tuple(figures), remarks)
    sds = ", ".join(f"{line.robust_sd_px:.2f} px ({side} line)" for side, line in evidence.lines.items())
    labelled = f"{_percent(evidence.labelled_share)} of the frames have labels"
    if evidence.outside_share >= _TOLD:
        labelled += f" (not counting {_percent(evidence.outside_share)} with both lines beside the window)"
    sentence = f"the lines lie on those in the images, and {labelled}: it can be used as it is"
    if withheld:
        # A map with a wrong section is good only without that section.
        sentence = f"labels good; {withheld}; elsewhere {sentence}"
    if opened:
        # The next metre is known, the way back to where the drive began is not.
        sentence = f"labels good, but {opened}; {sentence.removeprefix('labels good; ')}"
    measured = f"residuals on held-out frames: robust sd {sds}, {evidence.p95_px:.2f} px as p95; {labelled}"
    return Verdict("good", sentence, (measured,), remarks)


def _withheld_text(withheld: tuple[str, ...]) -> str:
    """Name the longest section that is withheld; empty if there is none."""
    if not withheld:
        return ""
    more = len(withheld) - 1
    rest = f", and {more} more section{'s' if more > 1 else ''}" if more else ""
    return f"{withheld[0]}{rest} withheld, where the images disagree with the map"


def _open_text(e: MapEvidence) -> str:
    """Say that the map is open, and what would close it; empty if it is closed."""
    if e.segments > 1:
        return (
            f"the map stays open: its {e.segments} segments show no place of each other, so where they lie "
            "relative to each other is not known; a drive over the road between them would join them"
        )
    # Without a known camera this is a finding of its own.
    if e.camera_known and not e.revisits:
        return (
            "the map stays open: no place was seen twice, so distant parts of it may lie askew; a second lap "
            "along the same path would close it"
        )
    return ""


def _remarks(e: MapEvidence, s: VerdictSettings) -> Iterator[str]:
    """What a person can check who has the car and the road before them."""
    if e.steering is not None and e.steering < 0.0:
        yield (
            f"the car turns right where it was steered left (correlation {e.steering:.2f}): the sign of the "
            "steering is reversed, or the images are mirrored. The map and its labels follow the images; "
            "before a network drives, exchange STEERING_LEFT_PWM and STEERING_RIGHT_PWM in the car's "
            "myconfig.py, or undo the camera's mirroring (CAMERA_HFLIP)"
        )
    # Where too few frames have labels, that is a remedy.
    if e.pauses and e.labelled_share >= s.min_labelled:
        yield _RECORD_WHOLE.format(e.pauses)
    if e.bend_lane_cm is not None:
        width_cm = e.given_lane_cm if e.found_lane_cm is None else e.found_lane_cm
        yield (
            f"the lane is {width_cm:.1f} cm wide on straights and {e.bend_lane_cm:.1f} cm in bends; the lane "
            "width to give is that of the straights"
        )
    if e.found_lane_cm is not None:
        return
    follows = f"the camera is {e.height_cm:.1f} cm high and the tape {e.tape_cm:.1f} cm wide"
    if e.given_height_cm is not None or e.given_tape_cm is not None:
        yield f"with the given lane width {follows}{_compared(e, s)}"
        return
    if any(_other_width(e)):  # a finding, which asks already
        return
    yield (
        f"is it right that {follows}? Both follow from the lane width of {e.given_lane_cm:g} cm, which no "
        "check here can show to be wrong. Measure one of them with a ruler. If it differs, the lane width is "
        "wrong by the same factor; --camera-height or --tape-width checks it for you"
    )


def _compared(e: MapEvidence, s: VerdictSettings) -> str:
    """Say how the lengths that were measured differ from those that follow, and what they cannot show."""
    text = "".join(
        f"; {what}: {given:g} cm was measured, so that it comes out {_off(value / given)}"
        for what, value, given, _, _ in _measured(e, s)
    )
    if e.given_height_cm is None and not any(_measured_otherwise(e, s)):
        text += (
            f". Borders of tape blur, so that this shows a wrong lane width from about "
            f"{_percent(s.tape_mismatch)} on; is it right that the camera is {e.height_cm:.1f} cm high? Its "
            f"height, measured (--camera-height), shows one from about {_percent(s.height_mismatch)} on"
        )
    return text


def _off(ratio: float) -> str:
    """Say by how much a length differs from the one that was measured."""
    if round(100.0 * abs(ratio - 1.0)) == 0:
        return "the same"
    return f"{_percent(abs(ratio - 1.0))} {'larger' if ratio > 1.0 else 'smaller'}"


def _bounded(value: float, bound: float, settings: VerdictSettings) -> Grade:
    """Grade a number that should be small; NaN is rejected."""
    if value <= bound:
        return "good"
    return "usable" if value <= settings.usable * bound else "reject"


def _at_most(name: str, bound: float, settings: VerdictSettings, unit: str = "") -> str:
    """Say what was expected of a number that should be small, and from where on the map is rejected."""
    return f"expected {bound:g}{unit} at most, rejected above {settings.usable * bound:g}{unit} ({name})"


def _share_at_most(name: str, bound: float, settings: VerdictSettings) -> str:
    """The same of a share, in per cent."""
    most = 100.0 * settings.usable * bound
    return f"expected {100.0 * bound:.3g} % at most, rejected above {most:.3g} % ({name})"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _right_camera(e: MapEvidence) -> str:
    """Say what helps where the camera may be wrong, without what was given already."""
    if e.camera_known:
        return _CHECK_CAMERA
    height_known = e.height_given or e.given_height_cm is not None
    return _LOOP_OR_CAMERA if height_known else f"{_LOOP_OR_CAMERA}, or its height (--camera-height)"


def _residuals(e: MapEvidence, s: VerdictSettings) -> _Findings:
    if e.coverage != e.coverage:
        yield Finding(
            "usable",
            "nothing has checked this map",
            "map a longer drive, or hold frames out from its lines",
            "no frame was held out that shows the lines (held_out_every)",
        )
        return
    remedy = _right_camera(e)
    if not e.coverage > 0.0:
        yield Finding(
            "reject",
            "the images show nothing where the map has its lines",
            remedy,
            "no edge was found where the map expects the borders of its lines (min_coverage)",
        )
        return
    for side, line in e.lines.items():
        yield from _line(side, line, s, remedy)
    if e.p95_px > s.max_p95_px:
        yield Finding(
            "usable",
            "some sections of the lines lie beside those in the images",
            f"look at the worst frames of the report; {remedy}",
            f"residual on held-out frames: p95 {e.p95_px:.2f} px, expected {s.max_p95_px:g} px at most "
            "(max_p95_px)",
        )
    if e.coverage < s.min_coverage:
        least = s.min_coverage / s.usable
        yield Finding(
            "usable" if e.coverage >= least else "reject",
            "the images rarely show the lines",
            "renew worn tape, and light the road evenly",
            f"{_percent(e.coverage)} of the lines' borders in view met an edge, expected "
            f"{_percent(s.min_coverage)} at least, rejected below {_percent(least)} (min_coverage)",
        )


def _line(side: str, line: LineEvidence, s: VerdictSettings, remedy: str) -> _Findings:
    """Judge one line by its residuals; its coverage says little, since dashes and worn lines lower it."""
    if line.samples < s.min_samples:
        yield Finding(
            "usable",
            f"the {side} line was in view too rarely to be checked",
            "turn or tilt the camera so that it sees both lines, or drive longer",
            f"held-out frames show {line.samples} places of the {side} line, expected {s.min_samples} at "
            "least to check it (min_samples)",
        )
        return
    if not line.coverage > 0.0:
        yield Finding(
            "reject",
            f"the images show nothing where the map has its {side} line",
            f"drive between two lines; {remedy}",
            f"no edge was found where the map expects the borders of its {side} line (min_coverage)",
        )
        return
    what = f"residual of the {side} line on held-out frames"
    beside = f"the {side} line lies beside the one in the images"
    grade = _bounded(line.robust_sd_px, s.max_sd_px, s)
    if grade != "good":
        sd = f"{what}: robust sd {line.robust_sd_px:.2f} px"
        yield Finding(grade, beside, remedy, f"{sd}, {_at_most('max_sd_px', s.max_sd_px, s, ' px')}")
    bound = s.usable * s.max_p95_px
    if line.p95_px > bound:
        yield Finding(
            "usable",
            f"{beside} in some sections",
            f"look at the worst frames of the report; {remedy}",
            f"{what}: p95 {line.p95_px:.2f} px, expected {bound:g} px at most for one line (max_p95_px)",
        )


def _labelled(e: MapEvidence, s: VerdictSettings) -> _Findings:
    expected = f"have labels, expected {_percent(s.min_labelled)} at least"
    grade = _bounded(1.0 - e.labelled_share, 1.0 - s.min_labelled, s)
    if grade != "good":
        causes = ", ".join(f"{count} {reason}" for reason, count in e.not_labelled.items() if count)
        most = next(iter(e.not_labelled), "unknown")
        paused = f"{_RECORD_WHOLE.format(e.pauses)}; or " if e.pauses else ""
        yield Finding(
            grade,
            f"only {_percent(e.labelled_share)} of the frames have labels; most of the others: {most}",
            f"{paused}look at the strip of frames in the report, and {_right_camera(e)}",
            f"{_percent(e.labelled_share)} of the frames {expected} ({causes}), rejected below "
            f"{_percent(1.0 - s.usable * (1.0 - s.min_labelled))} (min_labelled)",
        )
    for side, share in e.point_shares.items():
        if share < s.min_labelled:
            yield Finding(
                "usable",
                f"the {side} line has few labels",
                "turn or tilt the camera so that it sees both lines of the lane",
                f"{_percent(share)} of the {side} line's points in the window {expected} (frames: "
                f"{_percent(e.labelled_share)}; min_labelled)",
            )


def _outside(e: MapEvidence, s: VerdictSettings) -> _Findings:
    grade = _bounded(e.outside_share, s.max_outside, s)
    if grade != "good":
        share = _percent(e.outside_share)
        yield Finding(
            grade,
            f"in {share} of the frames both lines of the lane lie beside the window of the labels",
            "is the lane width right? If it is, tilt the camera, or drive a narrower lane",
            f"both lines lie beside the window in {share} of the frames, "
            f"{_share_at_most('max_outside', s.max_outside, s)}",
        )


def _in_view(e: MapEvidence, s: VerdictSettings) -> _Findings:
    if e.in_view < s.min_in_view:
        yield Finding(
            "usable",
            f"the camera sees {_percent(e.in_view)} of the places that the labels are of",
            f"tilt the camera down, or, if it is not {e.ahead_cm:.0f} cm ahead of the front axle, give the "
            "car's wheelbase (--wheelbase): the rest a network can only tell from what lies further ahead",
            f"{_percent(e.in_view)} of the labels lie in the image, expected {_percent(s.min_in_view)} at "
            f"least (min_in_view); the camera is taken to be {e.ahead_cm:.0f} cm ahead of the front axle",
        )


def _contradicted(e: MapEvidence, s: VerdictSettings) -> _Findings:
    grade = _bounded(e.contradicted_share, s.max_contradicted, s)
    if grade != "good":
        # To a tenth: the bound is no whole number, and what exceeds it by little would read like it.
        share = f"{100.0 * round(e.contradicted_share, 3):.3g} %"
        yield Finding(
            grade,
            "in many frames the images disagree with the map",
            f"look at the worst frames of the report; {_right_camera(e)}",
            f"the images disagree with {share} of the frames' lines on the map, "
            f"{_share_at_most('max_contradicted', s.max_contradicted, s)}",
        )


def _withheld(e: MapEvidence, s: VerdictSettings) -> _Findings:
    grade = _bounded(e.withheld_share, s.max_withheld, s)
    if grade != "good":
        yield Finding(
            grade,
            "in many places the images disagree with the map",
            f"look at the withheld places of the report; {_right_camera(e)}",
            f"the images disagree with the map along {_percent(e.withheld_share)} of its lines, "
            f"{_share_at_most('max_withheld', s.max_withheld, s)}",
        )


def _camera(e: MapEvidence, s: VerdictSettings) -> _Findings:
    if e.closure_across_heights is not None and e.closure_across_heights > s.max_closure_heights:
        yield Finding(
            _bounded(e.closure_across_heights, s.max_closure_heights, s),
            "the laps do not lie on one another",
            _right_camera(e),
            f"median error of revisits across the road: {e.closure_across_heights:.2f} camera heights, "
            f"{_at_most('max_closure_heights', s.max_closure_heights, s)}",
        )
    if e.camera_known:
        return
    if e.height_given and not e.revisits:
        sigma = e.sigma["focal"]
        yield Finding(
            max("usable", _bounded(sigma, s.max_focal_sigma, s), key=_ORDER.index),
            "only the camera's height shows what camera this is, for no place was seen twice",
            _right_camera(e),
            f"the focal length is known to {_percent(sigma)} from the camera's height, expected "
            f"{_percent(s.max_focal_sigma)} at most and a place that is seen twice (max_focal_sigma)",
        )
    elif not e.revisits:
        sigma = e.sigma["focal"]
        yield Finding(
            max("usable", _bounded(sigma, s.max_focal_sigma, s), key=_ORDER.index),
            "the drive does not show what camera this is, for no place was seen twice",
            _right_camera(e),
            f"no place was seen twice, so the focal length is only a guess, here within {_percent(sigma)}, "
            f"expected {_percent(s.max_focal_sigma)} at most (max_focal_sigma)",
        )
    elif e.revisits < s.min_revisits and not e.height_given:
        yield Finding(
            "reject",
            "the drive does not show what camera this is, for hardly any place was seen twice",
            _right_camera(e),
            f"the camera was found from {counted(e.revisits, 'place')} seen twice, expected "
            f"{s.min_revisits}: fewer may look alike by chance (min_revisits)",
        )
    elif (sigma := e.sigma.get("focal", 0.0)) > s.max_focal_sigma:
        yield Finding(
            _bounded(sigma, s.max_focal_sigma, s),
            "the drive does not show the focal length well enough",
            _right_camera(e),
            f"the drive leaves the camera's focal length open by {100.0 * sigma:.1f} %, expected "
            f"{_percent(s.max_focal_sigma)} at most, rejected above {_percent(s.usable * s.max_focal_sigma)} "
            "(max_focal_sigma)",
        )
    if (sigma := e.sigma.get("pitch", 0.0)) > s.max_pitch_sigma_rad:
        yield Finding(
            _bounded(sigma, s.max_pitch_sigma_rad, s),
            "the drive does not show the camera's pitch well enough",
            _right_camera(e),
            f"the drive leaves the camera's pitch open by {sigma:.3f} rad, "
            f"{_at_most('max_pitch_sigma_rad', s.max_pitch_sigma_rad, s, ' rad')}",
        )


def _uneven(e: MapEvidence, s: VerdictSettings) -> _Findings:
    if e.tape_range_cm is None:
        return
    low, high = e.tape_range_cm
    if high > s.max_tape_ratio * low:
        yield Finding(
            "usable",
            f"the tape is {low:.1f} cm wide in some places and {high:.1f} cm in others, so the floor is not "
            "flat, and lengths are wrong by as much",
            "lay the floor flat; labels lie on the tape as the camera sees it, not where a ruler has it. If "
            "the tape is of several widths, all is well",
            f"5 % of a line's tape is narrower than {low:.1f} cm, 5 % wider than {high:.1f} cm: a ratio of "
            f"{high / low:.2f}, expected {s.max_tape_ratio:g} at most (max_tape_ratio)",
        )


def _lane_width(e: MapEvidence, s: VerdictSettings) -> _Findings:
    if e.found_lane_cm is None:
        return
    ratio = max(e.found_lane_cm / e.given_lane_cm, e.given_lane_cm / e.found_lane_cm)
    if ratio > 1.0 + s.lane_mismatch:
        rejects = ratio > 1.0 + s.lane_reject
        yield Finding(
            "reject" if rejects else "usable",
            f"the lane measures {e.found_lane_cm:.0f} cm with this camera, not {e.given_lane_cm:g} cm",
            "measure the lane between the middles of its two lines, and the camera's height",
            f"the lane measures {e.found_lane_cm:.1f} cm, {e.given_lane_cm:g} cm was given: a factor of "
            f"{ratio:.2f}, expected {1.0 + s.lane_mismatch:g} at most (lane_mismatch), rejected above "
            f"{1.0 + s.lane_reject:g} (lane_reject)",
        )


def _measured(e: MapEvidence, s: VerdictSettings) -> Iterator[tuple[str, float, float, float, str]]:
    """Yield what was measured: its name, its length on the map and as given, its bound, the bound's name."""
    for what, value, given, most, bound in (
        ("camera's height", e.height_cm, e.given_height_cm, s.height_mismatch, "height_mismatch"),
        ("tape's width", e.tape_cm, e.given_tape_cm, s.tape_mismatch, "tape_mismatch"),
    ):
        if given is not None:
            yield what, value, given, most, bound


def _measured_otherwise(e: MapEvidence, s: VerdictSettings) -> _Findings:
    """Name the lengths that were measured and come out otherwise."""
    for what, value, given, most, bound in _measured(e, s):
        if max(value / given, given / value) > 1.0 + most:
            yield Finding(
                "usable",
                f"the {what} comes out as {value:.1f} cm, not {given:g} cm",
                f"measure the {what}, and the lane between the middles of its two lines",
                f"the {what} is {value:.1f} cm on the map, {given:g} cm was given: expected a difference of "
                f"{_percent(most)} at most ({bound})",
            )


def _scale(e: MapEvidence, s: VerdictSettings) -> _Findings:
    """Question a lane width that makes another car or road of this one."""
    yield from _measured_otherwise(e, s)
    if e.found_lane_cm is not None:
        return
    if e.open_lane_cm is not None:
        low, high = e.open_lane_cm
        yield Finding(
            "usable",
            f"the lane is {low:.0f} to {high:.0f} cm wide and has no straight, so it is open which width is "
            f"{e.given_lane_cm:g} cm",
            "give a camera file (--camera), or drive a road that has a straight",
            f"the narrowest tenth of the lane is {low:.1f} cm wide, the widest {high:.1f} cm, and no "
            "straight is as long as the lane is wide (open_cm)",
        )
    if asked := list(_other_width(e)):
        yield from asked
        return
    for name, value, (least, most) in (
        ("height_cm", e.height_cm, s.height_cm),
        ("tape_cm", e.tape_cm, s.tape_cm),
    ):
        if value < least or value > most:
            yield Finding(
                "usable",
                f"with a lane width of {e.given_lane_cm:g} cm, the camera would be {e.height_cm:.0f} cm high "
                f"and the tape {e.tape_cm:.1f} cm wide",
                "is the lane width right? It is the distance between the middles of the two lines that bound "
                "the driven lane, in cm",
                f"{'camera height' if name == 'height_cm' else 'tape width'} {value:.1f} cm, expected "
                f"{least:g} to {most:g} cm on a 1:10 car ({name})",
            )
            return


def _other_width(e: MapEvidence) -> _Findings:
    """Ask about a lane width if half of it, or twice as much, would make a usual car."""

    def usual(share: float) -> bool:
        sizes_cm = ((e.height_cm, _USUAL_HEIGHT_CM), (e.tape_cm, _USUAL_TAPE_CM))
        return all(low <= share * size <= high for size, (low, high) in sizes_cm)

    if e.given_height_cm is not None or e.given_tape_cm is not None or usual(1.0):
        return
    for share, times, what in ((0.5, "half", "of the whole road"), (2.0, "twice", "of half a lane")):
        if usual(share):
            made = f"camera {e.height_cm:.1f} cm high and the tape {e.tape_cm:.1f} cm wide"
            instead = f"{share * e.height_cm:.1f} and {share * e.tape_cm:.1f} cm"
            ranges = " and ".join(
                f"{low:g} to {high:g} cm" for low, high in (_USUAL_HEIGHT_CM, _USUAL_TAPE_CM)
            )
            yield Finding(
                "usable",
                f"is {e.given_lane_cm:g} cm the width {what}? It makes the {made}; --lane-width "
                f"{share * e.given_lane_cm:g} would make them {instead}, as on most cars",
                "measure the lane between the middles of its two lines; if it is right, give the width of "
                "the tape or the height of the camera as well (--tape-width, --camera-height)",
                f"the {made}, usual are {ranges}, which {times} the lane width gives",
            )
            return
