"""What is known of a finished map, as plain numbers: what a verdict rests on."""

from __future__ import annotations

from dataclasses import dataclass


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
