"""Wheels and lines: when the car counts as having left its lane."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from datagen.world.track import Track
from lanenet.geometry.frames import map_from_car

_BACK_INSIDE_CM = 1.0


def wheel_offsets_cm(
    track: Track, pose: Float[np.ndarray, "3"], wheelbase_cm: float, track_width_cm: float, near_s_cm: float
) -> Float[np.ndarray, "4"]:
    """Return the offsets of the wheels' contact points from the lane's centre, [cm], left positive.

    Args:
        track: The road.
        pose: Rear-axle centre x, y and heading, frame map.
        wheelbase_cm: Distance between the axles.
        track_width_cm: Distance between the contact points of an axle.
        near_s_cm: Place of the car along the road.

    Returns:
        Front left, front right, rear left, rear right.
    """
    half_cm = 0.5 * track_width_cm
    wheels_cm = np.array(
        [[-half_cm, 0.0], [half_cm, 0.0], [-half_cm, -wheelbase_cm], [half_cm, -wheelbase_cm]]
    )
    places_cm = map_from_car(wheels_cm, pose, wheelbase_cm)
    return np.array([track.nearest(place_cm, near_s_cm)[1] for place_cm in places_cm])


class DepartureCounter:
    """Counts how often a wheel goes over the middle of a line; one way out and back is one departure.

    Attributes:
        count: Departures so far.
        over: Whether the car is out now: until all its wheels are 1 cm inside again, so that a wheel that
            runs along the line does not count anew with every frame.
    """

    def __init__(self, lane_width_cm: float) -> None:
        """Start inside."""
        self.count, self.over = 0, False
        self._half_cm = 0.5 * lane_width_cm

    def update(self, offsets_cm: Float[np.ndarray, "wheels"]) -> bool:
        """Take the wheels' offsets of the next frame; return whether the car is out."""
        furthest_cm = float(np.max(np.abs(offsets_cm)))
        if furthest_cm > self._half_cm:
            self.count += not self.over
            self.over = True
        elif furthest_cm < self._half_cm - _BACK_INSIDE_CM:
            self.over = False
        return self.over

    def put_back(self) -> None:
        """The car stands in the lane again."""
        self.over = False
