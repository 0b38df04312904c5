"""Good, usable or reject: what a map's figures amount to, with the reasons.

What is known of a finished map, as plain numbers: what a verdict rests on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from lanenet.config import Settings


@dataclass(frozen=True)
class LineEvidence:
    """What held-out frames show of one line.

    Attributes:
        samples: Places on its borders in view.
        coverage: Share of them that met an edge; NaN where none was in view.
        robust_sd_px: Of the residuals, image 160 px wide; NaN where nothing was found.
        p95_px: Likewise.
    """

    samples: int
    coverage: float
    robust_sd_px: float
    p95_px: float


@dataclass(frozen=True)
class MapEvidence:
    """What a verdict rests on.

    Attributes:
        lines: The left and the right line in held-out frames.
        p95_px: Of the residuals of both, image 160 px wide; NaN where nothing was held out or found.
        coverage: Share of both lines' borders in view that met an edge; NaN where nothing was held out.
        labelled_share: Of the frames that the driver did not delete.
        point_shares: Of the left and the right line's points that lie in the window in these frames: those
            that have labels.
        contradicted_share: Of the lines that these frames have: those with which the pictures around
            disagree.
        not_labelled: Why the others have none, and how many.
        revisits: Places seen twice.
        closure_across_heights: What the revisits miss across the road, as median; None without any.
        camera_known: Whether the camera was given.
        sigma: Uncertainty of the camera's numbers where the drive told them (focal length relative, [rad]).
        given_lane_cm: Lane width that the user gave.
        found_lane_cm: Lane width on the road as the camera sees it; None where the lane sets the scale.
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
    """What counts as a good map; a usable one may miss each bound by the factor ``usable``.

    Residuals are in pixels of an image 160 px wide, on frames held out from the map, up to 45 cm ahead.

    Attributes:
        max_sd_px: Robust standard deviation of the residuals of each line by itself: one perfect line does
            not make up for one that is not there. Of 122 lines on 61 maps of simulated drives all keep below
            0.23 px, of real drives below 0.5; edges met by chance have 3.
        max_p95_px: 95th percentile of the size of both lines' residuals. A map beyond it is usable: marks
            beside a line make long tails, also where it is right.
        min_samples: Places on a line in view, of all held-out frames, that tell whether it is right.
        min_labelled: Share of the frames, without those that the driver deleted, that get labels: one of six
            points at least. A usable map may leave out ``usable`` times as many. Where the points of one line
            have fewer, of those that lie in the window, the map is usable.
        min_coverage: Share of the borders in view that met an edge. Dashes and worn lines lower it; a map
            below it may be right, but the frames do not show that it is.
        max_contradicted: Share of the frames' lines with which the pictures around disagree, which get no
            labels: half of what may go without. A map that is bent in many places is not to be trusted in
            others.
        max_focal_sigma: Relative uncertainty of the focal length, where the drive had to tell it.
        max_pitch_sigma_rad: Uncertainty of the camera's pitch, likewise.
        max_closure_heights: What a revisit misses across the road, in camera heights, as median.
        lane_mismatch: Share by which the lane on the road may differ from the given width, where the camera
            sets the scale, before a map is no longer good.
        lane_reject: The same for a map that is not to be used.
        usable: Factor on the bounds of a good map up to which it is usable.
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
        grade: The worst of all that was looked at.
        reasons: What kept it from being better; what a good map rests on if nothing did.
        remarks: What to know besides.
    """

    grade: Grade
    reasons: tuple[str, ...]
    remarks: tuple[str, ...]


def judge(evidence: MapEvidence, settings: VerdictSettings) -> Verdict:
    """Grade a map."""
    found: list[tuple[Grade, str]] = [
        *_residuals(evidence, settings),
        *_labelled(evidence, settings),
        *_contradicted(evidence, settings),
        *_camera(evidence, settings),
        *_lane_width(evidence, settings),
    ]
    grades: list[Grade] = [grade for grade, _ in found]
    grade: Grade = max(grades, key=_ORDER.index, default="good")
    if grade == "good":
        reasons = [
            "held-out frames agree with the map to "
            + ", ".join(f"{line.robust_sd_px:.2f} px ({side} line)" for side, line in evidence.lines.items())
            + f" as robust sd, {evidence.p95_px:.2f} px as p95, and {100.0 * evidence.labelled_share:.0f} % "
            "of the frames have labels"
        ]
    else:
        # The worst first; the rest of the list says what else to look at.
        reasons = [text for _, text in sorted(found, key=lambda item: -_ORDER.index(item[0]))]
    return Verdict(grade, tuple(reasons), tuple(_remarks(evidence)))


def _bounded(value: float, bound: float, settings: VerdictSettings) -> Grade:
    """Grade a number that should be small; NaN is not good."""
    if value <= bound:
        return "good"
    return "usable" if value <= settings.usable * bound else "reject"


def _residuals(e: MapEvidence, s: VerdictSettings) -> list[tuple[Grade, str]]:
    if e.coverage != e.coverage:
        return [("usable", "no frame was held out that shows the lines, so that nothing checks the map")]
    if not e.coverage > 0.0:
        return [("reject", "no edge was found where the map expects the borders of its lines")]
    found: list[tuple[Grade, str]] = [
        reason for side, line in e.lines.items() for reason in _line(side, line, s)
    ]
    if e.p95_px > s.max_p95_px:
        found.append(
            (
                "usable",
                f"residual on held-out frames: p95 {e.p95_px:.2f} px, expected {s.max_p95_px:g} at most",
            )
        )
    if e.coverage < s.min_coverage:
        grade: Grade = "usable" if e.coverage >= s.min_coverage / s.usable else "reject"
        found.append(
            (
                grade,
                f"only {100.0 * e.coverage:.0f} % of the lines' borders in view met an edge, expected "
                f"{100.0 * s.min_coverage:.0f} %",
            )
        )
    return found


def _line(side: str, line: LineEvidence, s: VerdictSettings) -> list[tuple[Grade, str]]:
    """Judge one line by itself; how much of it met an edge says little, as dashes and worn lines meet few."""
    if line.samples < s.min_samples:
        return [
            (
                "usable",
                f"held-out frames show {line.samples} places of the {side} line, expected {s.min_samples}: "
                "too few to check it",
            )
        ]
    if not line.coverage > 0.0:
        return [("reject", f"no edge was found where the map expects the borders of its {side} line")]
    found: list[tuple[Grade, str]] = []
    grade = _bounded(line.robust_sd_px, s.max_sd_px, s)
    if grade != "good":
        found.append(
            (
                grade,
                f"residual of the {side} line on held-out frames: robust sd {line.robust_sd_px:.2f} px, "
                f"expected {s.max_sd_px:g} at most",
            )
        )
    if line.p95_px > s.usable * s.max_p95_px:
        found.append(
            (
                "usable",
                f"residual of the {side} line on held-out frames: p95 {line.p95_px:.2f} px, expected "
                f"{s.usable * s.max_p95_px:g} at most of one line",
            )
        )
    return found


def _labelled(e: MapEvidence, s: VerdictSettings) -> list[tuple[Grade, str]]:
    found: list[tuple[Grade, str]] = []
    causes = ", ".join(f"{count} {reason}" for reason, count in e.not_labelled.items() if count)
    grade = _bounded(1.0 - e.labelled_share, 1.0 - s.min_labelled, s)
    if grade != "good":
        found.append(
            (
                grade,
                f"{100.0 * e.labelled_share:.0f} % of the frames have labels, expected "
                f"{100.0 * s.min_labelled:.0f} % ({causes})",
            )
        )
    return found + [
        (
            "usable",
            f"{100.0 * share:.0f} % of the {side} line's points in the window have labels, expected "
            f"{100.0 * s.min_labelled:.0f} % (frames: {100.0 * e.labelled_share:.0f} %)",
        )
        for side, share in e.point_shares.items()
        if share < s.min_labelled
    ]


def _contradicted(e: MapEvidence, s: VerdictSettings) -> list[tuple[Grade, str]]:
    grade = _bounded(e.contradicted_share, s.max_contradicted, s)
    if grade == "good":
        return []
    return [
        (
            grade,
            f"the pictures disagree with {100.0 * e.contradicted_share:.0f} % of the frames' lines on the "
            f"map, expected {100.0 * s.max_contradicted:.0f} % at most",
        )
    ]


def _camera(e: MapEvidence, s: VerdictSettings) -> list[tuple[Grade, str]]:
    found: list[tuple[Grade, str]] = []
    if e.closure_across_heights is not None and e.closure_across_heights > s.max_closure_heights:
        grade = _bounded(e.closure_across_heights, s.max_closure_heights, s)
        found.append(
            (grade, f"revisits miss {e.closure_across_heights:.2f} camera heights across the road (median)")
        )
    if e.camera_known:
        return found
    bounds = {"focal": ("focal length", s.max_focal_sigma), "pitch": ("pitch", s.max_pitch_sigma_rad)}
    if not e.revisits:
        _, bound = bounds.pop("focal")
        sigma = e.sigma["focal"]
        found.append(
            (
                max("usable", _bounded(sigma, bound, s), key=_ORDER.index),
                "the camera was found from the drive, but no place was seen twice, without which its focal "
                f"length is a guess, here to {100.0 * sigma:.0f} %: drive two laps of a closed road, so that "
                "the second one passes where the first did, or calibrate the camera and give it",
            )
        )
    for name, (what, bound) in bounds.items():
        sigma = e.sigma.get(name, 0.0)
        if sigma > bound:
            unit = f"{100.0 * sigma:.1f} %" if name == "focal" else f"{sigma:.3f} rad"
            found.append((_bounded(sigma, bound, s), f"the drive leaves the camera's {what} open by {unit}"))
    return found


def _lane_width(e: MapEvidence, s: VerdictSettings) -> list[tuple[Grade, str]]:
    if e.found_lane_cm is None:
        return []
    ratio = max(e.found_lane_cm / e.given_lane_cm, e.given_lane_cm / e.found_lane_cm)
    if ratio <= 1.0 + s.lane_mismatch:
        return []
    grade: Grade = "usable" if ratio <= 1.0 + s.lane_reject else "reject"
    return [
        (
            grade,
            f"the lane measures {e.found_lane_cm:.0f} cm with this camera, but {e.given_lane_cm:g} cm was "
            "given: one of lane width and camera height is wrong",
        )
    ]


def _remarks(e: MapEvidence) -> list[str]:
    if e.found_lane_cm is None:
        return [
            f"the lane width of {e.given_lane_cm:g} cm is the one thing that sets the scale: nothing here "
            "tells if it is wrong, and every length is wrong by the same share"
        ]
    return []
