"""The verdict on a map: good, usable or reject, with reasons."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from lanenet.config import Settings


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
        contradicted_share: Share of the frames' lines that the images contradict.
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
    contradicted_share: float = 0.0


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
        min_coverage: Share of the borders in view that met an edge. Dashes and worn lines lower it; below it,
            a map may be right, but the frames do not show it. Chosen: short dashes leave a third.
        max_contradicted: Share of the frames' lines that the images contradict. Derived: half of the frames
            that may have no labels; a map that is wrong in many places is not trusted elsewhere.
        max_focal_sigma: Relative sigma of the focal length, if it was found from the drive. Chosen.
        max_pitch_sigma_rad: Sigma of the camera's pitch, if it was found from the drive. Chosen: 1 degree.
        max_closure_heights: Median error of a revisit across the road, in camera heights. A study of three
            recorded drives reached 0.03.
        lane_mismatch: Relative difference between measured and given lane width, if the camera sets the
            scale, up to which a map is good. Chosen: lanes of one road vary by less.
        lane_reject: The same, beyond which a map is rejected. Chosen: short of a lane mistaken for a road.
        usable: Factor on the bounds of a good map up to which it is usable. Chosen.
    """

    max_sd_px: float = Field(default=0.5, gt=0.0)
    max_p95_px: float = Field(default=1.5, gt=0.0)
    min_samples: int = Field(default=50, ge=1)
    min_labelled: float = Field(default=0.85, gt=0.0, lt=1.0)
    min_coverage: float = Field(default=0.3, gt=0.0, lt=1.0)
    max_contradicted: float = Field(default=0.075, gt=0.0, lt=1.0)
    max_focal_sigma: float = Field(default=0.05, gt=0.0)
    max_pitch_sigma_rad: float = Field(default=0.02, gt=0.0)
    max_closure_heights: float = Field(default=0.15, gt=0.0)
    lane_mismatch: float = Field(default=0.25, gt=0.0)
    lane_reject: float = Field(default=0.6, gt=0.0)
    usable: float = Field(default=2.0, gt=1.0)


@dataclass(frozen=True)
class Verdict:
    """How far a map can be trusted.

    Attributes:
        grade: The worst grade of all checks.
        reasons: Why it is not better; if it is good, what that is based on.
        remarks: What else to know.
    """

    grade: Grade
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]


#: The grades of one check, with their reasons; none if the map is good.
_Findings = Iterator[tuple[Grade, str]]


def judge(evidence: MapEvidence, settings: VerdictSettings) -> Verdict:
    """Grade a map."""
    checks = (_residuals, _labelled, _contradicted, _camera, _lane_width)
    found = [finding for check in checks for finding in check(evidence, settings)]
    # The worst first.
    found.sort(key=lambda finding: -_ORDER.index(finding[0]))
    reasons = [reason for _, reason in found]
    if not found:
        sds = ", ".join(f"{line.robust_sd_px:.2f} px ({side} line)" for side, line in evidence.lines.items())
        reasons = [
            f"residuals on held-out frames: robust sd {sds}, {evidence.p95_px:.2f} px as p95; "
            f"{_percent(evidence.labelled_share)} of the frames have labels"
        ]
    remarks: tuple[str, ...] = ()
    if evidence.found_lane_cm is None:
        remarks = (
            f"the lane width of {evidence.given_lane_cm:g} cm is the one thing that sets the scale: if it is "
            "wrong, every length is wrong by the same share, and no check here can show it",
        )
    return Verdict(found[0][0] if found else "good", tuple(reasons), remarks)


def _bounded(value: float, bound: float, settings: VerdictSettings) -> Grade:
    """Grade a number that should be small; NaN is rejected."""
    if value <= bound:
        return "good"
    return "usable" if value <= settings.usable * bound else "reject"


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _residuals(e: MapEvidence, s: VerdictSettings) -> _Findings:
    if e.coverage != e.coverage:
        yield "usable", "no frame was held out that shows the lines, so the map could not be checked"
        return
    if not e.coverage > 0.0:
        yield "reject", "no edge was found where the map expects the borders of its lines"
        return
    for side, line in e.lines.items():
        yield from _line(side, line, s)
    if e.p95_px > s.max_p95_px:
        p95 = f"residual on held-out frames: p95 {e.p95_px:.2f} px"
        yield "usable", f"{p95}, expected {s.max_p95_px:g} at most"
    if e.coverage < s.min_coverage:
        met = f"{_percent(e.coverage)} of the lines' borders in view met an edge"
        grade: Grade = "usable" if e.coverage >= s.min_coverage / s.usable else "reject"
        yield grade, f"{met}, expected {_percent(s.min_coverage)} at least"


def _line(side: str, line: LineEvidence, s: VerdictSettings) -> _Findings:
    """Judge one line by its residuals; its coverage says little, since dashes and worn lines lower it."""
    if line.samples < s.min_samples:
        shown = f"held-out frames show {line.samples} places of the {side} line"
        yield "usable", f"{shown}, expected {s.min_samples} at least to check it"
        return
    if not line.coverage > 0.0:
        yield "reject", f"no edge was found where the map expects the borders of its {side} line"
        return
    what = f"residual of the {side} line on held-out frames"
    grade = _bounded(line.robust_sd_px, s.max_sd_px, s)
    if grade != "good":
        yield grade, f"{what}: robust sd {line.robust_sd_px:.2f} px, expected {s.max_sd_px:g} at most"
    bound = s.usable * s.max_p95_px
    if line.p95_px > bound:
        yield "usable", f"{what}: p95 {line.p95_px:.2f} px, expected {bound:g} at most for one line"


def _labelled(e: MapEvidence, s: VerdictSettings) -> _Findings:
    expected = f"have labels, expected {_percent(s.min_labelled)}"
    grade = _bounded(1.0 - e.labelled_share, 1.0 - s.min_labelled, s)
    if grade != "good":
        causes = ", ".join(f"{count} {reason}" for reason, count in e.not_labelled.items() if count)
        yield grade, f"{_percent(e.labelled_share)} of the frames {expected} ({causes})"
    for side, share in e.point_shares.items():
        if share < s.min_labelled:
            points = f"{_percent(share)} of the {side} line's points in the window"
            yield "usable", f"{points} {expected} (frames: {_percent(e.labelled_share)})"


def _contradicted(e: MapEvidence, s: VerdictSettings) -> _Findings:
    grade = _bounded(e.contradicted_share, s.max_contradicted, s)
    if grade != "good":
        share = f"the images disagree with {_percent(e.contradicted_share)} of the frames' lines on the map"
        yield grade, f"{share}, expected {_percent(s.max_contradicted)} at most"


def _camera(e: MapEvidence, s: VerdictSettings) -> _Findings:
    if e.closure_across_heights is not None and e.closure_across_heights > s.max_closure_heights:
        error = f"median error of revisits across the road: {e.closure_across_heights:.2f} camera heights"
        grade = _bounded(e.closure_across_heights, s.max_closure_heights, s)
        yield grade, f"{error}, expected {s.max_closure_heights:g} at most"
    if e.camera_known:
        return
    if not e.revisits:
        sigma = e.sigma["focal"]
        yield (
            max("usable", _bounded(sigma, s.max_focal_sigma, s), key=_ORDER.index),
            "the camera was found from the drive, but no place was seen twice, so its focal length is only a "
            f"guess, here within {_percent(sigma)}: drive two laps of a closed road, the second along the "
            "same path, or calibrate the camera and give it",
        )
    elif (sigma := e.sigma.get("focal", 0.0)) > s.max_focal_sigma:
        grade = _bounded(sigma, s.max_focal_sigma, s)
        yield grade, f"the drive leaves the camera's focal length open by {100.0 * sigma:.1f} %"
    if (sigma := e.sigma.get("pitch", 0.0)) > s.max_pitch_sigma_rad:
        grade = _bounded(sigma, s.max_pitch_sigma_rad, s)
        yield grade, f"the drive leaves the camera's pitch open by {sigma:.3f} rad"


def _lane_width(e: MapEvidence, s: VerdictSettings) -> _Findings:
    if e.found_lane_cm is None:
        return
    ratio = max(e.found_lane_cm / e.given_lane_cm, e.given_lane_cm / e.found_lane_cm)
    if ratio > 1.0 + s.lane_mismatch:
        yield (
            "usable" if ratio <= 1.0 + s.lane_reject else "reject",
            f"the lane measures {e.found_lane_cm:.0f} cm with this camera, but {e.given_lane_cm:g} cm was "
            "given: either the lane width or the camera's height is wrong",
        )
