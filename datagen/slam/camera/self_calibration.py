"""Self-calibration: the camera is found or refined together with the poses, with realistic uncertainties.

The numbers of lens and mounting are unknowns of the bundle adjustment. What the images leave open is decided
by priors, and that depends on the drive: only a loop closure ties down the heading, and with it the focal
length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from datagen.slam.adjustment.adjust import CAMERA_NAMES, BundleSettings
from datagen.slam.camera.coarse import Candidate, coarse_camera, looking_alike, nudged
from datagen.slam.segment import SegmentSolver, SolvedSegment
from lanenet.data.drives import Drive
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera

#: What to drive where a recording gives no map, or does not determine the camera.
DRIVE_INSTEAD = (
    "drive two laps of a closed track, or of a figure of eight, without a pause, between two lines that the "
    "camera sees"
)
#: What helps where more laps do not.
_MEASURE_INSTEAD = "measure the camera (lanenet calibrate print, chessboard, ground)"
#: Moving frames that the adjustment needs. Chosen: ten seconds at 20 frames a second, less than any lap.
MIN_FRAMES = 200
#: Range of the heading below which focal length and pitch can only be told apart by a prior. Chosen: half a
#: turn; a closed lap has twice as much.
MIN_TURNING_RAD = np.pi
#: Revisits needed: fewer may agree by chance. Chosen: twice as many as a map needs
#: (``RevisitSettings.min_revisits``), for a wrong camera does more harm than a wrong map.
MIN_REVISITS = 6
#: Relative sigma of the focal length beyond which a camera is refused. Chosen: it changes lengths ahead by
#: about as much, 1 cm at a lane's half width of 20 cm.
MAX_FOCAL_SIGMA = 0.05
#: Numbers that stay as they start until a loop is closed.
_LENS = ("focal", "cx", "cy", "k1")
#: Standard deviations of the principal point from the image centre, for images 160 px wide, and of the roll,
#: [rad], among real cameras. Wider than the adjustment's priors, which are close because these numbers are
#: nearly degenerate with the yaw; a real drive had a roll of 3 degrees.
_CENTRE_PX, _LEVEL_RAD = 2.0, 0.04
#: Sigma of a roll that was searched for, [rad]. Measured on six simulated drives, cameras rolled by 3 to 10
#: degrees: up to 6 degrees off, 2 as a rule.
_SEARCHED_ROLL_RAD = 0.06
#: The same of a principal point that was searched for, for images 160 px wide. Measured on four simulated
#: drives, three of pinholes and one of a narrow lens: 3, 6, 8 and 11 px off.
_SEARCHED_CENTRE_PX = 8.0
#: Width of the images for which priors in pixels are given, [px].
_REFERENCE_WIDTH = 160.0
#: Strain from which on a camera is in doubt, and is refused, in standard deviations. Measured: 1.5 to 2.3 on
#: real drives; on rings of tiles 1 at most, and 1.2 to 5 where a loop was closed on the wrong corner.
MAX_STRAIN = 2.0, 3.0
#: Range of the heading from which a drive without a closed loop is worth a restart: with a wrong camera the
#: filter creeps and sees few bends. Chosen: a quarter of ``MIN_TURNING_RAD``.
_WORTH_RESTART_RAD = 0.25 * np.pi
#: Heading that the odometry misses in a lap, in sigmas, from which on a restart is tried. Measured, with the
#: camera that was found: 1.6 at most on real drives, 1.8 to 4 on three of four rings with a wrong corner.
_AGAIN = 1.75
#: Relative difference of the focal lengths of start and result below which no restart is needed: about the
#: sigma of a good drive.
_CLOSE_START = 0.03
#: The same for the camera's place ahead of the rear axle, in camera heights. It says how far a camera moves
#: sideways in a bend, and where the road begins that counts. Chosen: ordinary ones are found within half.
_CLOSE_LEVER = 1.0
#: Focal lengths of restarts, relative to the first start, where no loop was closed: once with the pitch that
#: was found, and once longer by about what the search may be off. A loop that was closed may take a third:
#: the first one may have closed on the wrong corner, and the second on the right one.
_RESTARTS = (1.0, 1.2, None)


def refining(settings: BundleSettings) -> BundleSettings:
    """Return the settings with closer priors, as for a known camera."""
    close = {
        "focal": 0.05,
        "centre_px": 1.0,
        "k1": 0.02,
        "pitch": 0.05,
        "roll": 0.02,
        "yaw": 0.03,
        "lever": 0.15,
    }
    return settings.model_copy(update={name: min(v, getattr(settings, name)) for name, v in close.items()})


@dataclass(frozen=True)
class FoundCamera:
    """A camera that was adjusted together with the poses of a drive, in the scale that it started with.

    Attributes:
        solved: The segment, with the camera.
        candidates: Cameras of the coarse search; none where one was given.
        sigma: Standard deviation of each number of the camera, in the units of
            :attr:`datagen.slam.adjustment.adjust.BundleResult.sigma`, after :func:`honest_sigma`.
        refined: Whether a known camera was the start.
        strain: Distance of principal point and roll from their priors, see :func:`prior_strain`, and of the
            odometry with this camera from the closed loop, in sigmas. A closure on the wrong corner has both.
        height_given: Whether the focal length fits a given height, see :func:`datagen.segments.fit_height`.
    """

    solved: SolvedSegment
    candidates: list[Candidate]
    sigma: dict[str, float]
    refined: bool
    strain: float
    height_given: bool = False

    @property
    def camera(self) -> Camera:
        """The camera; its height is the one that it started with."""
        return self.solved.camera

    @property
    def closed(self) -> bool:
        """Whether a loop was closed that tells how far a lap turns."""
        return self.solved.ties_camera

    @property
    def how(self) -> str:
        """How the camera was found, for the files."""
        if self.refined:
            return "given, then bundle adjustment of camera and poses"
        return "from the drive: coarse from pairs of images, then bundle adjustment of camera and poses"

    @property
    def figures(self) -> dict[str, Any]:
        """For a map's report."""
        return {
            "candidates": [c.figures for c in self.candidates],
            "sigma": self.sigma,
            "closed": self.closed,
            "alike": self.solved.alike,
            "height_given": self.height_given,
            "strain": self.strain,
            "missed": self.solved.missed,
        }

    @property
    def note(self) -> str:
        """The camera in one sentence."""
        focal, m = float(self.camera.K[0, 0]), self.camera.mounting
        found = (
            f"camera {'refined on' if self.refined else 'from'} the drive: focal length {focal:.1f} +- "
            f"{focal * self.sigma['focal']:.1f} px, pitch {np.rad2deg(m.pitch_down_rad):.1f} +- "
            f"{np.rad2deg(self.sigma['pitch']):.1f} degrees"
        )
        off_px = self.camera.K[:2, 2] - 0.5 * (np.array([self.camera.width, self.camera.height]) - 1.0)
        if np.hypot(*off_px) > MAX_STRAIN[0] * _CENTRE_PX * self.camera.width / _REFERENCE_WIDTH:
            found += (
                f"; its axis is {off_px[0]:+.0f}, {off_px[1]:+.0f} px off the middle of the image, as "
                "where images were cropped, or rectified with another camera's file"
            )
        if self.closed:
            return found
        if self.height_given:
            return f"{found}; the focal length fits the lane width at the camera's height"
        if self.solved.revisits:
            return f"{found}; places that were seen twice look like others, which leaves the lens open"
        return f"{found}; no loop was certainly closed, so the lens is as it started"


def find_camera(drive: Drive, start: Camera | None, solver: SegmentSolver) -> FoundCamera:
    """Find a drive's camera, or refine a known one, together with the drive's poses.

    Args:
        drive: One segment.
        start: Camera to refine, with close priors about it; None looks for one, with wide priors.
        solver: Solves the segment.

    Returns:
        The camera, in the scale of the start or of a nominal height.

    Raises:
        TrackingLostError: If too few edge points of the road are seen.
    """
    candidates: list[Candidate] = []
    settings = solver.settings
    if start is None:
        camera, candidates = coarse_camera(
            drive, settings.perception, settings.guess, solver.rng, partial(solver.tell, "try cameras")
        )
        wide = {}
        if any(candidate.look.roll_deg for candidate in candidates):
            wide["roll"] = max(settings.bundle.roll, _SEARCHED_ROLL_RAD)
        if any(candidate.look.off_px != (0.0, 0.0) for candidate in candidates[:1]):
            wide["centre_px"] = max(settings.bundle.centre_px, _SEARCHED_CENTRE_PX)
        settings = settings.model_copy(update={"bundle": settings.bundle.model_copy(update=wide)})
        solver = replace(solver, settings=settings)
    else:
        camera = start
        settings = settings.model_copy(update={"bundle": refining(settings.bundle)})
        solver = replace(solver, settings=settings)
    first = solved = solver.solve(drive, camera, find_camera=True)

    def strain_of(one: SolvedSegment) -> float:
        return float(np.hypot(prior_strain(one.camera, camera, settings.bundle), one.missed))

    if start is None:
        solved = _restarted(drive, camera, first, solver)
        # Each way to close the loops has a camera, with which its odometry agrees if the way is the true one.
        for rival in first.rivals:
            if strain_of(solved) <= MAX_STRAIN[0]:
                break
            prior = _prior(camera, rival, float(rival.K[0, 0]))
            again = solver.solve(drive, rival, find_camera=True, prior_camera=prior)
            if again.ties_camera:
                solved = min(solved, again, key=strain_of)
    strain = prior_strain(solved.camera, camera, settings.bundle)
    sigma = honest_sigma(solved, strain, settings.bundle, camera.width)
    return FoundCamera(solved, candidates, sigma, start is not None, strain_of(solved))


def _restarted(drive: Drive, searched: Camera, first: SolvedSegment, solver: SegmentSolver) -> SolvedSegment:
    """Solve a drive again from the camera that was found, where the search was off.

    The filter tracks the drive, and loops are found, with the camera of the start: poses that are bent by a
    wrong camera hold the adjustment back.
    """
    start, found = searched, first
    for factor in _RESTARTS:
        if found.revisits:
            if _close(found.camera, start) and found.missed < _AGAIN:
                return found
            focal_px = float(found.camera.K[0, 0])
        elif len(drive) < MIN_FRAMES or turning_rad(first.poses) < _WORTH_RESTART_RAD:
            return first
        elif factor is None:
            break
        else:
            focal_px = float(searched.K[0, 0]) * factor
        # The camera of a closed loop is the best start, also for the lever, which every bend depends on.
        prior = _prior(searched, found.camera if found.revisits else first.camera, focal_px)
        start = found.camera if found.revisits else prior
        again = solver.solve(drive, start, find_camera=True, prior_camera=prior)
        if len(again.revisits) < 0.5 * len(found.revisits):
            # Keep the map with more revisits.
            return found
        found = again
    return found if found.revisits else first


def _prior(searched: Camera, found: Camera, focal_px: float) -> Camera:
    """Centre of the priors beside a camera that was found: those of principal point, roll and k1 stay."""
    return nudged(looking_alike(searched, found), "focal", float(np.log(focal_px / searched.K[0, 0])))


def _close(found: Camera, start: Camera) -> bool:
    """Whether a camera is near enough to that of the start for the drive's tracking to be right."""
    focal = abs(found.K[0, 0] / start.K[0, 0] - 1.0)
    lever_cm = abs(found.mounting.ahead_of_front_axle_cm - start.mounting.ahead_of_front_axle_cm)
    return bool(focal < _CLOSE_START and lever_cm < _CLOSE_LEVER * start.mounting.height_cm)


def prior_strain(camera: Camera, prior: Camera, priors: BundleSettings) -> float:
    """Distance of a camera's principal point and roll from their priors, in sigmas of ordinary cameras.

    Every ordinary camera meets these priors: far from them, the images show more than a flat road. A search
    that began with an unusual camera may come back to a level one with its axis in the middle.
    """
    centre_px = max(priors.centre_px, _CENTRE_PX) * camera.width / _REFERENCE_WIDTH
    middle_px = 0.5 * (np.array([camera.width, camera.height]) - 1.0)
    off_px = min(float(np.abs(camera.K[:2, 2] - at_px).max()) for at_px in (prior.K[:2, 2], middle_px))
    roll_rad = min(abs(camera.mounting.roll_rad - level_rad) for level_rad in (prior.mounting.roll_rad, 0.0))
    return max(off_px / centre_px, roll_rad / max(priors.roll, _LEVEL_RAD))


def honest_sigma(
    solved: SolvedSegment, strain: float, priors: BundleSettings, width: int
) -> dict[str, float]:
    """Widen the standard deviations of an adjustment to realistic ones.

    Args:
        solved: The drive with its camera. If no loop was closed that ties the lens, the lens was held, and is
            known as well as its prior; if one was, heading that odometry misses in a lap may be the lens's.
        strain: See :func:`prior_strain`; what bends the principal point bends the other numbers too.
        priors: Of the adjustment.
        width: Image width, [px].

    Source:
        The strain widens as Birge's ratio does (Birge 1932, "The calculation of errors by the method of least
        squares", Physical Review 40): data that contradict the priors are worse than their scatter shows.
    """
    centre = priors.centre_px * width / _REFERENCE_WIDTH
    prior = {"focal": priors.focal, "cx": centre, "cy": centre, "k1": priors.k1}
    sigma, held = solved.bundle.sigma, () if solved.ties_camera else _LENS
    wide = {name: prior[name] if name in held else max(1.0, strain) * sigma[name] for name in CAMERA_NAMES}
    return wide if held else wide | {"focal": float(np.hypot(wide["focal"], solved.focal_by_drift))}


def turning_rad(poses: Float[np.ndarray, "n 3"]) -> float:
    """Range of the heading along a path; oscillation about one heading does not increase it."""
    return float(np.ptp(poses[:, 2]))


def check_observable(found: FoundCamera, where: str, accept_open_loop: bool) -> list[str]:
    """Refuse a camera that the drive does not determine.

    Args:
        found: The camera.
        where: Name of the drive for messages.
        accept_open_loop: Accept the focal length's prior where no loop was closed.

    Returns:
        Notes on what was accepted.

    Raises:
        CalibrationError: If the drive is too straight, does not come back to where it was, or leaves the
            focal length open; says what to drive instead.
    """
    solved = found.solved
    turned, length = turning_rad(solved.poses), solved.path_cm[-1] / found.camera.mounting.height_cm
    driven = f"{len(solved.poses)} frames, {length:.0f} camera heights long"
    instead = DRIVE_INSTEAD if turned < 4.0 * np.pi else _MEASURE_INSTEAD
    problem = None
    if turned < MIN_TURNING_RAD:
        problem = (
            f"too straight: {driven}, its heading stays within {np.rad2deg(turned):.0f} degrees, expected "
            f"{np.rad2deg(MIN_TURNING_RAD):.0f}"
        )
    elif len(solved.revisits) < MIN_REVISITS:
        problem = (
            f"{len(solved.revisits) or 'no'} places were certainly seen twice, expected {MIN_REVISITS}: "
            f"{driven}, with bends of {np.rad2deg(turned):.0f} degrees"
        )
    elif not found.closed:
        problem, instead = (
            f"{len(solved.revisits)} places were seen twice, but look like others along the road, so that it "
            f"is open how far a lap turns: {driven}",
            _MEASURE_INSTEAD,
        )
    if problem is not None:
        if not accept_open_loop:
            raise CalibrationError(
                f"{where}: {problem}. Such a drive does not determine the focal length: {instead}, or "
                "accept a guessed one (--accept-open-loop)"
            )
        return [f"{problem}: the focal length is guessed, give or take {100.0 * found.sigma['focal']:.0f} %"]
    strained = (
        f"the camera is {found.strain:.1f} standard deviations from ordinary ones, by principal point, "
        "roll and the heading that its odometry misses in a lap: something in the images is not on a flat "
        "road, such as lamps mirrored in the floor, or a place was taken for another"
    )
    if found.strain > MAX_STRAIN[1]:
        raise CalibrationError(f"{where}: {strained}; {_MEASURE_INSTEAD}")
    focal_sigma = found.sigma["focal"]
    if focal_sigma > MAX_FOCAL_SIGMA:
        raise CalibrationError(
            f"{where}: the focal length has a sigma of {100.0 * focal_sigma:.1f} % ({driven}, "
            f"{len(solved.revisits)} revisits), expected at most {100.0 * MAX_FOCAL_SIGMA:.0f} %: {instead}"
        )
    return [strained] if found.strain > MAX_STRAIN[0] else []
