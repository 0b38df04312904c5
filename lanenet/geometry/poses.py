"""Poses on the road (SE(2)): compose, compare, move and interpolate them.

A pose is x, y and heading, [cm], [cm], [rad], in the last axis of an array; axes before it broadcast. A
relative pose says how far ahead, how far to the left and how much turned to the left it is. Headings may be
unwrapped: a trajectory counts its turns.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lanenet.geometry.frames import wrap_angle


def compose(
    origin: Float[np.ndarray, "*#n 3"], relative: Float[np.ndarray, "*#n 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Return the pose that is seen at ``relative`` from ``origin``; headings add up and are not wrapped."""
    c, s = np.cos(origin[..., 2]), np.sin(origin[..., 2])
    ahead, left = relative[..., 0], relative[..., 1]
    x = origin[..., 0] + c * ahead - s * left
    y = origin[..., 1] + s * ahead + c * left
    return np.stack([x, y, origin[..., 2] + relative[..., 2]], axis=-1)


def relative_pose(
    origin: Float[np.ndarray, "*#n 3"], pose: Float[np.ndarray, "*#n 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Return ``pose`` as seen from ``origin``, its heading in (-pi, pi]; the inverse of :func:`compose`."""
    c, s = np.cos(origin[..., 2]), np.sin(origin[..., 2])
    dx, dy = pose[..., 0] - origin[..., 0], pose[..., 1] - origin[..., 1]
    turn = wrap_angle(np.asarray(pose[..., 2] - origin[..., 2]))
    return np.stack([c * dx + s * dy, -s * dx + c * dy, turn], axis=-1)


def moved_rigidly(
    poses: Float[np.ndarray, "n 3"], place: Float[np.ndarray, "3"], to: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "n 3"]:
    """Move poses as one rigid body, so that the pose ``place`` comes to lie at ``to``."""
    turn = to[2] - place[2]
    c, s = np.cos(turn), np.sin(turn)
    xy_cm = (poses[:, :2] - place[:2]) @ np.array([[c, s], [-s, c]]) + to[:2]
    return np.column_stack([xy_cm, poses[:, 2] + turn])


def arc_chord(
    heading_rad: float | Float[np.ndarray, "*#n"],
    length_cm: float | Float[np.ndarray, "*#n"],
    turn_rad: float | Float[np.ndarray, "*#n"],
) -> Float[np.ndarray, "*n 2"]:
    """Return the displacement along an arc, [cm].

    The chord of an arc: rotate by half the turn and shorten by sinc(turn / 2).

    Args:
        heading_rad: At the start of the arc.
        length_cm: Of the arc; negative backwards.
        turn_rad: From start to end, positive left.
    """
    chord_cm = length_cm * np.sinc(0.5 * turn_rad / np.pi)
    direction = np.asarray(heading_rad + 0.5 * turn_rad)
    return np.stack([chord_cm * np.cos(direction), chord_cm * np.sin(direction)], axis=-1)


def between_on_arc(
    start: Float[np.ndarray, "n 3"], end: Float[np.ndarray, "n 3"], share: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3"]:
    """Return the poses at a share, 0 to 1, of the arc from one pose to another; headings unwrapped."""
    step = end - start
    turn = step[:, 2]
    sine = np.sin(0.5 * turn)
    straight = np.abs(sine) < 1e-9
    # Two chords of one circle: their lengths are as the sines of half their turns, and the angle between them
    # is half the turn that is left.
    length = np.where(straight, share, np.sin(0.5 * share * turn) / np.where(straight, 1.0, sine))
    back = 0.5 * (share - 1.0) * turn
    c, s = length * np.cos(back), length * np.sin(back)
    xy = start[:, :2] + np.column_stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1]])
    return np.column_stack([xy, start[:, 2] + share * turn])


def path_lengths(poses: Float[np.ndarray, "n _"]) -> Float[np.ndarray, "n"]:
    """Length of the path from the first pose or point up to each of them, [cm]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
