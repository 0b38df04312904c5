"""The camera of a car, found from several of its drives together, whatever their tracks.

Each drive leaves its camera open by some per cent, and another drive in other ones; only one camera fits all.
Which drives had the same camera is tested first, by the cameras that each of them gives by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from datagen.lanes.scale import measure_lane
from datagen.slam.camera.coarse import with_known_scale
from datagen.tracks.cameras import (
    MOST_SIGMAS,
    DriveCamera,
    difference,
    lens_of,
    pairwise_sigmas,
    same_lens,
)
from datagen.tracks.shape import Similarity
from datagen.tracks.together import Together, solve_together
from datagen.tracks.visit import Visit
from lanenet.errors import TrackingLostError
from lanenet.geometry.camera import Camera

#: Sigma of a lane width that was measured with a ruler, relative. Chosen: half a centimetre of 40.
_WIDTH_SIGMA = 0.012


@dataclass(frozen=True)
class Odd:
    """A drive whose camera is another one.

    Attributes:
        place: Of the drive among all.
        than: Place of the drive that it was compared with.
        text: How its camera differs from that one's.
    """

    place: int
    than: int
    text: str


@dataclass(frozen=True)
class CarCamera:
    """A camera that was found from several drives.

    Attributes:
        camera: The camera, [cm].
        sigma: Standard deviation of each of its numbers, focal length relative.
        height_cm: Height by the lane of each drive; NaN where none was found.
    """

    camera: Camera
    sigma: dict[str, float]
    height_cm: tuple[float, ...]


def agreeing_drives(cameras: Sequence[DriveCamera]) -> tuple[list[int], list[Odd]]:
    """Find the most drives whose cameras agree in all pairs, and those that do not agree with them.

    Args:
        cameras: What each drive gives by itself.

    Returns:
        The places of the agreeing ones, those that know the focal length best first; and the others.
    """
    order = sorted(range(len(cameras)), key=lambda k: (cameras[k].sigma.get("focal", 0.0), k))
    agree = _agreement([cameras[k] for k in order])
    best: list[int] = []
    for first in range(len(order)):
        group, left = [first], agree[first].copy()
        left[first] = False
        while left.any():
            nearest = int(left.argmax())
            group.append(nearest)
            left &= agree[nearest]
            left[nearest] = False
        best = max(best, sorted(group), key=len)
        if len(best) == len(order):
            break
    odd = []
    for k in set(range(len(order))) - set(best):
        place, than = order[k], order[next(other for other in best if not agree[k, other])]
        odd.append(Odd(place, than, unlike(cameras[place], cameras[than])))
    return [order[k] for k in best], sorted(odd, key=lambda one: one.place)


def _agreement(cameras: Sequence[DriveCamera]) -> Bool[np.ndarray, "n n"]:
    """Tell for all pairs of cameras whether they may be one."""
    lenses = [lens_of(one) for one in cameras]
    same = np.array([[one == other for other in lenses] for one in lenses])
    near: Bool[np.ndarray, "n n"] = (np.abs(pairwise_sigmas(cameras)) <= MOST_SIGMAS).all(axis=-1)
    return same & near


def may_be_one(one: DriveCamera, other: DriveCamera) -> bool:
    """Tell whether two cameras may be one."""
    return bool(_agreement([one, other])[0, 1])


def unlike(one: DriveCamera, other: DriveCamera) -> str:
    """Say how two cameras differ."""
    if not same_lens([one, other]):
        return "images of another size or lens"
    return difference(other, one).text


def camera_of_car(visits: Sequence[Visit], rng: np.random.Generator) -> CarCamera:
    """Find the camera that fits several drives best, with the poses of all of them.

    Its height is the mean of those that follow from the drives' lane widths.

    Args:
        visits: Drives whose cameras agree.
        rng: Draws the edges that are compared.

    Raises:
        TrackingLostError: If none of them shows a lane with that camera.
    """
    height_cm = visits[0].camera.mounting.height_cm
    scaled = [one.moved(Similarity(scale=height_cm / one.camera.mounting.height_cm)) for one in visits]
    together = solve_together(scaled, True, rng, one_track=False)
    camera, sigma = together.visits[0].camera, together.visits[0].sigma
    factors, sigmas, reason = [], [], ""
    for number in range(len(visits)):
        try:
            factor, width_sigma = _scale_of(together, number)
        except TrackingLostError as error:
            factor, width_sigma, reason = float("nan"), float("inf"), str(error)
        factors.append(factor)
        sigmas.append(width_sigma)
    weights = np.array(sigmas) ** -2.0
    if not weights.any():
        raise TrackingLostError(f"with one camera for all, no drive shows a lane: {reason}")
    factor = float(np.exp(np.average(np.log(np.where(weights > 0.0, factors, 1.0)), weights=weights)))
    settings = visits[0].prepared.settings
    return CarCamera(
        with_known_scale(camera, factor, settings.guess.wheelbase_cm),
        sigma,
        tuple(one * camera.mounting.height_cm for one in factors),
    )


def _scale_of(together: Together, number: int) -> tuple[float, float]:
    """Factor to centimetres by the lane of one drive, and its relative sigma."""
    one = together.visits[number].prepared
    lane = measure_lane(together.solved_of(number), {}, one.settings.trace, one.settings.fit)
    return one.request.lane_width_cm / lane.width_cm, float(np.hypot(lane.sigma, _WIDTH_SIGMA))
