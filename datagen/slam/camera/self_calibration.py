"""The camera from the drive itself: found or refined together with the poses, with honest uncertainties.

The numbers of lens and mounting are unknowns of the bundle adjustment. What the pictures leave open is
decided by priors, and what they leave open depends on the drive: only a place that is seen twice ties the
heading down, and with it the focal length.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from datagen.settings import MapSettings
from datagen.slam.adjustment.adjust import CAMERA_NAMES, BundleSettings
from datagen.slam.camera.coarse import Candidate, coarse_camera, looking_alike, nudged
from datagen.slam.odometry.scans import Progress
from datagen.slam.segment import SolvedSegment, solve_segment
from lanenet.data.drives import Drive
from lanenet.errors import CalibrationError
from lanenet.geometry.camera import Camera

#: What to drive where a recording gives no map, or does not determine the camera.
DRIVE_INSTEAD = (
    "drive two laps of a closed track, or of a figure of eight, without a pause, between two lines that the "
    "camera sees"
)
#: Moving frames that the adjustment needs, at least.
MIN_FRAMES = 200
#: Range of the heading below which nothing but a prior tells the focal length from the pitch.
MIN_TURNING_RAD = np.pi
#: Places that have to be seen twice: fewer may be chance.
MIN_REVISITS = 6
#: Relative standard deviation of the focal length beyond which a camera is no result.
MAX_FOCAL_SIGMA = 0.05
#: Numbers that stay as they start until a place is seen twice.
_LENS = ("focal", "cx", "cy", "k1")
#: Numbers whose priors every usual camera meets: far from them, the pictures do not show a flat road alone.
_USUAL = ("cx", "cy", "roll")
#: How far principal points usually are from the middle, for images of 160 px, and cameras from level, [rad]:
#: real ones differ by more than the adjustment's priors, which are close to keep what is nearly degenerate.
_CENTRE_PX, _LEVEL_RAD = 2.0, 0.04
#: Strain beyond which a camera is no result, and strain that is worth a word.
MAX_STRAIN, _STRAINED = 2.0, 1.5
#: Range of the heading from which a drive may turn: with a wrong camera the filter creeps and sees few bends.
_WORTH_ANEW_RAD = 0.25 * np.pi
#: A start whose focal length is this close to what was found from it is good enough.
_CLOSE_START = 0.03
#: Focal lengths to start from anew, relative to the first, where that closes no loop.
_ANEW = (1.0, 1.2)
#: What the adjustment's own standard deviations are multiplied by, as measured on simulated drives with known
#: cameras (docs/calibration.md): edge points of one line share their errors, so that they count for fewer.
SIGMA_FACTOR = 2.0


def refining(settings: BundleSettings) -> BundleSettings:
    """Return the settings with priors about a camera that is known, which are closer than about a guess."""
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
        solved: The drive's longest stretch, with the camera.
        candidates: Cameras of the coarse search; none where one was given.
        sigma: Standard deviation of each number of the camera, in the units of
            :attr:`datagen.slam.adjustment.adjust.BundleResult.sigma`, after :data:`SIGMA_FACTOR`.
        refined: Whether a known camera was the start.
        strain: How far principal point and roll had to go from their priors, in usual standard
            deviations; by so much, if it is more than one, the standard deviations are larger.
    """

    solved: SolvedSegment
    candidates: list[Candidate]
    sigma: dict[str, float]
    refined: bool
    strain: float

    @property
    def camera(self) -> Camera:
        """The camera; its height is the one that it started with."""
        return self.solved.camera

    @property
    def closed(self) -> bool:
        """Whether a place was seen twice."""
        return bool(self.solved.revisits)

    @property
    def how(self) -> str:
        """How the camera was found, for the files."""
        if self.refined:
            return "given, then bundle adjustment of camera and poses"
        return "from the drive: coarse by pairs of pictures, then bundle adjustment of camera and poses"

    @property
    def figures(self) -> dict[str, Any]:
        """For a map's report."""
        return {"candidates": [vars(c) for c in self.candidates], "sigma": self.sigma, "closed": self.closed}

    @property
    def note(self) -> str:
        """The camera in a sentence."""
        focal, m = float(self.camera.K[0, 0]), self.camera.mounting
        found = (
            f"camera {'refined on' if self.refined else 'from'} the drive: focal length {focal:.1f} +- "
            f"{focal * self.sigma['focal']:.1f} px, pitch {np.rad2deg(m.pitch_down_rad):.1f} +- "
            f"{np.rad2deg(self.sigma['pitch']):.1f} degrees"
        )
        return (
            found if self.closed else f"{found}; no place was seen twice, so that the lens is as it started"
        )


def find_camera(
    drive: Drive,
    start: Camera | None,
    settings: MapSettings,
    rng: np.random.Generator,
    progress: Progress | None = None,
    search_progress: Progress | None = None,
) -> FoundCamera:
    """Find a drive's camera, or refine a known one, together with the drive's poses.

    Args:
        drive: One uninterrupted stretch.
        start: Camera to refine, with close priors about it; None looks for one, with wide priors.
        settings: Settings of all mapping stages.
        rng: Source of randomness.
        progress: Called with (done, total) while the drive is followed.
        search_progress: The same for the coarse search.

    Returns:
        The camera, in the scale of the start or of a nominal height.

    Raises:
        TrackingLostError: If too few edge points of the road are seen.
    """
    candidates: list[Candidate] = []
    if start is None:
        camera, candidates = coarse_camera(drive, settings.perception, settings.guess, rng, search_progress)
    else:
        camera = start
        settings = settings.model_copy(update={"bundle": refining(settings.bundle)})
    solved = solve_segment(drive, camera, settings, rng, progress, find_camera=True)
    if start is None:
        solved = _started_anew(drive, camera, solved, settings, rng, progress)
    closed = bool(solved.revisits)
    strain = prior_strain(solved.camera, camera, settings.bundle)
    sigma = honest_sigma(solved.bundle.sigma, closed, strain, settings.bundle, camera.width)
    return FoundCamera(solved, candidates, sigma, start is not None, strain)


def _started_anew(
    drive: Drive,
    searched: Camera,
    first: SolvedSegment,
    settings: MapSettings,
    rng: np.random.Generator,
    progress: Progress | None,
) -> SolvedSegment:
    """Solve a drive again with what was learned of its camera, where the search was off.

    The filter follows the drive, and loops are found, with the camera of the start: poses that a wrong camera
    has bent hold the adjustment back.
    """
    start, found = searched, first
    for factor in _ANEW:
        if found.revisits:
            if abs(found.camera.K[0, 0] / start.K[0, 0] - 1.0) < _CLOSE_START:
                return found
            focal_px = float(found.camera.K[0, 0])
        elif len(drive) < MIN_FRAMES or turning_rad(first.poses) < _WORTH_ANEW_RAD:
            return first
        else:
            focal_px = float(searched.K[0, 0]) * factor
        # A closed loop knows best where to begin, also with the lever, without which every bend is off. But
        # what is believed of principal point, roll and k1 must not walk along with what was found of them.
        turned = looking_alike(searched, found.camera if found.revisits else first.camera)
        believed = nudged(turned, "focal", float(np.log(focal_px / searched.K[0, 0])))
        start = found.camera if found.revisits else believed
        again = solve_segment(drive, start, settings, rng, progress, find_camera=True, believed=believed)
        if len(again.revisits) < 0.5 * len(found.revisits):
            # The map that more places agree on.
            return found
        found = again
    return found if found.revisits else first


def prior_strain(camera: Camera, believed: Camera, priors: BundleSettings) -> float:
    """How far a camera's principal point and roll are from where they were believed, in usual deviations."""
    centre = max(priors.centre_px, _CENTRE_PX) * camera.width / 160.0
    spread = {"cx": centre, "cy": centre, "roll": max(priors.roll, _LEVEL_RAD)}
    off = {
        "cx": camera.K[0, 2] - believed.K[0, 2],
        "cy": camera.K[1, 2] - believed.K[1, 2],
        "roll": camera.mounting.roll_rad - believed.mounting.roll_rad,
    }
    return max(abs(float(off[name])) / spread[name] for name in _USUAL)


def honest_sigma(
    sigma: dict[str, float], closed: bool, strain: float, priors: BundleSettings, width: int
) -> dict[str, float]:
    """Widen the standard deviations of an adjustment to what they are worth.

    Args:
        sigma: As the adjustment gives them.
        closed: Whether a place was seen twice; if not, the lens was held, and is known as well as its prior.
        strain: See :func:`prior_strain`. What bends the principal point bends the other numbers, too.
        priors: Of the adjustment.
        width: Image width, [px].

    Source:
        The strain widens as Birge's ratio does (Birge 1932, "The calculation of errors by the method of least
        squares", Physical Review 40): data that contradict what is known are worse than they say.
    """
    centre = priors.centre_px * width / 160.0
    prior = {"focal": priors.focal, "cx": centre, "cy": centre, "k1": priors.k1}
    return {
        name: prior[name] if name in _LENS and not closed else SIGMA_FACTOR * max(1.0, strain) * sigma[name]
        for name in CAMERA_NAMES
    }


def turning_rad(poses: Float[np.ndarray, "n 3"]) -> float:
    """Range of the heading along a path; swinging about one direction adds nothing to it."""
    return float(np.ptp(poses[:, 2]))


def check_observable(found: FoundCamera, where: str, accept_open_loop: bool) -> list[str]:
    """Refuse a camera that the drive does not determine.

    Args:
        found: The camera.
        where: Names the drive in messages.
        accept_open_loop: Take the focal length's prior where no place was seen twice.

    Returns:
        Notes on what had to be accepted.

    Raises:
        CalibrationError: If the drive is too straight, does not come back to where it was, or leaves the
            focal length open; says what to drive instead.
    """
    solved = found.solved
    turned, length = turning_rad(solved.poses), solved.path_cm[-1] / found.camera.mounting.height_cm
    driven = f"{len(solved.poses)} frames, {length:.0f} camera heights long"
    problem = None
    if turned < MIN_TURNING_RAD:
        problem = (
            f"too straight: {driven}, its heading stays within {np.rad2deg(turned):.0f} degrees, expected "
            f"{np.rad2deg(MIN_TURNING_RAD):.0f}"
        )
    elif len(solved.revisits) < MIN_REVISITS:
        problem = (
            f"{len(solved.revisits) or 'no'} places were seen twice, expected {MIN_REVISITS}: {driven}, with "
            f"bends of {np.rad2deg(turned):.0f} degrees"
        )
    if problem is not None:
        if not accept_open_loop:
            raise CalibrationError(
                f"{where}: {problem}. The pictures alone do not tell the focal length then: {DRIVE_INSTEAD}, "
                "or accept a focal length that is guessed (--accept-open-loop)"
            )
        return [f"{problem}: the focal length is guessed, give or take {100.0 * found.sigma['focal']:.0f} %"]
    strained = (
        f"the pictures pull principal point or roll {found.strain:.1f} times as far as cameras differ: "
        "something in them is not on a flat road, such as lamps mirrored in the floor"
    )
    if found.strain > MAX_STRAIN:
        raise CalibrationError(
            f"{where}: {strained}. {DRIVE_INSTEAD.capitalize()}, without such things in view"
        )
    if found.sigma["focal"] > MAX_FOCAL_SIGMA:
        raise CalibrationError(
            f"{where}: the focal length is known to {100.0 * found.sigma['focal']:.1f} % only ({driven}, "
            f"{len(solved.revisits)} revisits), expected {100.0 * MAX_FOCAL_SIGMA:.0f} %: {DRIVE_INSTEAD}"
        )
    return [strained] if found.strain > _STRAINED else []
