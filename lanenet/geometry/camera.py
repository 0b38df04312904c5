"""A camera on a car, fisheye or pinhole: which pixel sees which point of the ground plane.

Both lenses use OpenCV's parameters, so that a camera calibrated elsewhere can be used as it is. Rays that a
lens cannot see, and pixels whose ray misses the ground, are NaN, never a guess.

The fisheye lens is that of Kannala and Brandt (2006, eq. 6) with the four terms of OpenCV's ``fisheye``; the
pinhole lens has the distortion of Brown and Conrady, in OpenCV's order of coefficients.
"""

from __future__ import annotations

import hashlib
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

CameraModel = Literal["fisheye", "pinhole"]

#: Distance between the axles of a car of which nobody gave it: a Donkeycar's.
NOMINAL_WHEELBASE_CM = 17.0
_MAX_RESIDUAL_PX = 1e-6


@dataclass(frozen=True)
class Mounting:
    """Where the camera sits on the car and where it looks.

    Attributes:
        height_cm: Height of the optical centre above the ground.
        pitch_down_rad: Downward tilt of the optical axis.
        roll_rad: Rotation about the optical axis; positive lowers the camera's right side.
        yaw_rad: Rotation about the vertical; positive looks left.
        ahead_of_front_axle_cm: Optical centre ahead of the front axle.
        right_of_centre_cm: Optical centre to the right of the car's centre line.
    """

    height_cm: float
    pitch_down_rad: float = 0.0
    roll_rad: float = 0.0
    yaw_rad: float = 0.0
    ahead_of_front_axle_cm: float = 0.0
    right_of_centre_cm: float = 0.0

    @property
    def lead_cm(self) -> float:
        """How far the optical centre is ahead of the front axle; 0 behind it.

        What is near to a camera far before the axle is not near to the axle.
        """
        return max(self.ahead_of_front_axle_cm, 0.0)

    @property
    def position_car_cm(self) -> Float[np.ndarray, "3"]:
        """Optical centre, [cm], frame car with z up."""
        return np.array([self.right_of_centre_cm, self.ahead_of_front_axle_cm, self.height_cm])

    @property
    def at_cm(self) -> tuple[float, float, float]:
        """:attr:`position_car_cm` as plain numbers, for files."""
        return self.right_of_centre_cm, self.ahead_of_front_axle_cm, self.height_cm

    @cached_property
    def camera_from_car(self) -> Float[np.ndarray, "3 3"]:
        """Rotation that turns vectors of the car frame (z up) into the camera frame."""
        cy, sy = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        cp, sp = np.cos(self.pitch_down_rad), np.sin(self.pitch_down_rad)
        cr, sr = np.cos(self.roll_rad), np.sin(self.roll_rad)
        # Undo the yaw, so that the axis points ahead; then x right, y down, z ahead; then tilt; then roll.
        yaw = np.array([[cy, sy, 0.0], [-sy, cy, 0.0], [0.0, 0.0, 1.0]])
        axes = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        pitch = np.array([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]])
        roll = np.array([[cr, sr, 0.0], [-sr, cr, 0.0], [0.0, 0.0, 1.0]])
        return roll @ pitch @ axes @ yaw


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera on a car.

    Attributes:
        model: ``fisheye`` (Kannala-Brandt, D = k1..k4) or ``pinhole`` (D = k1, k2, p1, p2, k3).
        width: Image width, [px].
        height: Image height, [px].
        K: Camera matrix, [px].
        D: Distortion coefficients in OpenCV's order.
        mounting: Pose above the road.
        wheelbase_cm: Distance between the car's axles.
    """

    model: CameraModel
    width: int
    height: int
    K: Float[np.ndarray, "3 3"]
    D: Float[np.ndarray, "_"]
    mounting: Mounting
    wheelbase_cm: float

    @cached_property
    def max_angle_rad(self) -> float:
        """Largest angle from the optical axis that the model maps one-to-one, [rad].

        For the fisheye this is where the radius stops growing (pi if it never does); for the pinhole just
        under a right angle, or where the distortion folds the image back.
        """
        n = 4096
        if self.model == "fisheye":
            theta = np.linspace(0.0, np.pi, n)
            slope = fisheye_slope(theta, self.D)
        else:
            theta = np.linspace(0.0, np.deg2rad(89.0), n)
            slope = np.gradient(pinhole_radius(np.tan(theta), self.D), theta)
        falling = np.flatnonzero(slope <= 0.0)
        return float(theta[falling[0] - 1]) if falling.size else float(theta[-1])

    def project_rays(self, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Project rays of the camera frame to pixels.

        Args:
            rays: Directions (any length), frame camera.

        Returns:
            Pixels u, v, [px], frame image; NaN beyond :attr:`max_angle_rad`. Pixels outside the image are
            kept: cropping is the caller's choice.

        Source:
            Kannala and Brandt 2006, as in OpenCV's ``fisheye`` module; Brown-Conrady for the pinhole.
        """
        x, y, z = rays[:, 0], rays[:, 1], rays[:, 2]
        r = np.hypot(x, y)
        theta = np.arctan2(r, z)
        visible = theta <= self.max_angle_rad
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.model == "fisheye":
                scale = np.where(r > 1e-12, fisheye_radius(theta, self.D) / r, 1.0 / z)
                normalised = np.stack([x * scale, y * scale], axis=1)
            else:
                normalised = distort_pinhole(np.stack([x / z, y / z], axis=1), self.D)
            pixels = np.stack(
                [
                    self.K[0, 0] * normalised[:, 0] + self.K[0, 1] * normalised[:, 1] + self.K[0, 2],
                    self.K[1, 1] * normalised[:, 1] + self.K[1, 2],
                ],
                axis=1,
            )
        pixels[~visible] = np.nan
        return pixels

    def unproject(self, pixels_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Return the unit ray of each pixel in the camera frame; NaN where the lens does not see.

        The inverse of :meth:`project_rays`, by Newton's method; a solution that does not project back to
        within 1e-6 px is NaN.
        """
        v = (pixels_px[:, 1] - self.K[1, 2]) / self.K[1, 1]
        u = (pixels_px[:, 0] - self.K[0, 2] - self.K[0, 1] * v) / self.K[0, 0]
        if self.model == "fisheye":
            radius = np.sqrt(u * u + v * v)
            theta = invert_fisheye(radius, self.D, self.max_angle_rad)
            rays = np.empty((len(u), 3))
            with np.errstate(divide="ignore", invalid="ignore"):
                # What is left of the radius is an error along it.
                error = np.abs(fisheye_radius(theta, self.D) - radius) * max(self.K[0, 0], self.K[1, 1])
                theta[~(error <= _MAX_RESIDUAL_PX)] = np.nan
                sine = np.where(radius <= 1e-12, 1.0, np.sin(theta) / radius)
            np.multiply(u, sine, out=rays[:, 0])
            np.multiply(v, sine, out=rays[:, 1])
            np.cos(theta, out=rays[:, 2])
            return rays
        flat = invert_pinhole(np.stack([u, v], axis=1), self.D)
        rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):
            back = self.project_rays(np.nan_to_num(rays, nan=0.0))
            error = np.linalg.norm(back - pixels_px, axis=1)
            rays[~(error <= _MAX_RESIDUAL_PX)] = np.nan
        return rays

    def project_ground(self, points_car_cm: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Project points of the road into the image, [px]; NaN where the lens does not see them."""
        position = self.mounting.position_car_cm
        above = np.concatenate([points_car_cm, np.zeros((len(points_car_cm), 1))], axis=1) - position
        return self.project_rays(above @ self.mounting.camera_from_car.T)

    def shows_ground(self, points_car_cm: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return which points of the road lie in the image."""
        pixels = self.project_ground(points_car_cm)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -0.5) & (pixels < (self.width - 0.5, self.height - 0.5))
        return np.asarray(inside.all(axis=1))

    def intersect_ground(self, pixels_px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Meet each pixel's viewing ray with the road plane.

        Args:
            pixels_px: Pixel centres u, v, [px], frame image.

        Returns:
            Road points, [cm], frame car. NaN where the ray misses the road or the lens does not see.
        """
        return self.meet_ground(self.unproject(pixels_px) @ self.mounting.camera_from_car)

    def meet_ground(self, rays_car: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Meet viewing rays, directions in the car frame, with the road plane; NaN where they miss it."""
        position = self.mounting.position_car_cm
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(rays_car[:, 2] < -1e-9, -position[2] / rays_car[:, 2], np.nan)
            return np.asarray(position[:2] + rays_car[:, :2] * distance[:, None])

    def with_mounting(self, **changes: float) -> Camera:
        """Return the same camera with some values of its mounting replaced."""
        return replace(self, mounting=replace(self.mounting, **changes))

    def scaled_lengths(self, factor: float) -> Camera:
        """Return the camera with every length (height, offsets, wheelbase) multiplied: a change of scale."""
        m = self.mounting
        mounting = replace(
            m,
            height_cm=m.height_cm * factor,
            ahead_of_front_axle_cm=m.ahead_of_front_axle_cm * factor,
            right_of_centre_cm=m.right_of_centre_cm * factor,
        )
        return replace(self, mounting=mounting, wheelbase_cm=self.wheelbase_cm * factor)

    @property
    def hash(self) -> str:
        """Short hash of everything that decides which pixel sees which point of the road.

        Numbers are rounded to nine significant digits, so that the trip through a YAML file keeps it.
        """
        numbers = [*self.K.ravel(), *self.D.ravel(), *astuple(self.mounting)]
        text = f"{self.model} {self.width} {self.height} " + " ".join(f"{float(v):.9g}" for v in numbers)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


_NEWTON_STEPS = 30
#: Newton's method squares its error: after a step as short as this there is nothing left to gain.
_LAST_STEP_RAD = 1e-12
#: Steps without a bracket, and the last one at most. Chosen: three reach 1e-12 on lenses up to 170 degrees.
_FREE_STEPS, _SMALL_STEP_RAD = 3, 1e-6


def fisheye_radius(angle_rad: Float[np.ndarray, "*n"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "*n"]:
    """Return how far from the optical axis a ray meets the image, in focal lengths.

    Args:
        angle_rad: Angle between ray and optical axis, [rad].
        D: Coefficients k1 to k4.
    """
    t2 = angle_rad * angle_rad
    return angle_rad * (1.0 + t2 * (D[0] + t2 * (D[1] + t2 * (D[2] + t2 * D[3]))))


def fisheye_slope(angle_rad: Float[np.ndarray, "*n"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "*n"]:
    """Return the derivative of :func:`fisheye_radius` by the angle."""
    t2 = angle_rad * angle_rad
    return 1.0 + t2 * (3.0 * D[0] + t2 * (5.0 * D[1] + t2 * (7.0 * D[2] + t2 * 9.0 * D[3])))


def invert_fisheye(
    radius: Float[np.ndarray, "*n"], D: Float[np.ndarray, "_"], max_angle_rad: float
) -> Float[np.ndarray, "*n"]:
    """Return the angle from the optical axis, [rad], that has a radius; NaN where none up to the largest has.

    The radius grows up to there, so that Newton's method, kept in a bracket, converges. Most lenses are so
    close to the start that it converges without one, in a few steps.
    """
    most = fisheye_radius(np.array([max_angle_rad]), D)
    seen = radius <= most
    aimed = np.minimum(radius, most)
    angle_rad = aimed * (1.0 - D[0] * aimed * aimed)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for _ in range(_FREE_STEPS):
            step = (fisheye_radius(angle_rad, D) - aimed) / fisheye_slope(angle_rad, D)
            angle_rad -= step
        # The error after a step is about its square.
        good = (np.abs(step) <= _SMALL_STEP_RAD) & (angle_rad >= 0.0) & (angle_rad <= max_angle_rad)
    angle_rad[~seen] = np.nan
    rest = np.flatnonzero(seen & ~good)
    if rest.size:
        angle_rad.reshape(-1)[rest] = _bracketed(radius.reshape(-1)[rest], D, max_angle_rad)
    return angle_rad


def _bracketed(
    radius: Float[np.ndarray, "n"], D: Float[np.ndarray, "_"], max_angle_rad: float
) -> Float[np.ndarray, "n"]:
    """Return the angle that has each radius, by Newton's method in a bracket."""
    low = np.zeros_like(radius)
    high = np.full_like(radius, max_angle_rad)
    angle_rad = np.clip(radius, 0.0, max_angle_rad)
    for _ in range(_NEWTON_STEPS):
        error = fisheye_radius(angle_rad, D) - radius
        low = np.where(error < 0.0, angle_rad, low)
        high = np.where(error > 0.0, angle_rad, high)
        slope = fisheye_slope(angle_rad, D)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = angle_rad - error / slope
        inside = (step >= low) & (step <= high)
        before, angle_rad = angle_rad, np.where(inside, step, 0.5 * (low + high))
        if np.max(np.abs(angle_rad - before), initial=0.0) <= _LAST_STEP_RAD:
            break
    return np.asarray(angle_rad)


def _coefficients(D: Float[np.ndarray, "_"]) -> tuple[float, float, float, float, float]:
    k1, k2, p1, p2, k3 = (float(v) for v in np.concatenate([D, np.zeros(5)])[:5])
    return k1, k2, p1, p2, k3


def pinhole_radius(r: Float[np.ndarray, "*n"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "*n"]:
    """Return what distortion, but for its tangential part, makes of a radius; both in focal lengths."""
    k1, k2, _, _, k3 = _coefficients(D)
    r2 = r * r
    return r * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))


def distort_pinhole(xy: Float[np.ndarray, "n 2"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "n 2"]:
    """Return where points of the image without distortion go, both in focal lengths.

    Args:
        xy: Points x, y, without distortion.
        D: Coefficients k1, k2, p1, p2, k3; those that are not there are zero.
    """
    k1, k2, p1, p2, k3 = _coefficients(D)
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )


def invert_pinhole(target: Float[np.ndarray, "n 2"], D: Float[np.ndarray, "_"]) -> Float[np.ndarray, "n 2"]:
    """Return the points that :func:`distort_pinhole` sends to the target ones.

    By damped Newton steps with a numerical Jacobian; where they do not converge the answer is not one that
    projects back.
    """
    xy = target.copy()
    if not np.any(D):
        return xy
    eps = 1e-7
    for _ in range(_NEWTON_STEPS):
        base = distort_pinhole(xy, D)
        dx = (distort_pinhole(xy + [eps, 0.0], D) - base) / eps
        dy = (distort_pinhole(xy + [0.0, eps], D) - base) / eps
        error = base - target
        det = dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.stack(
                [
                    (dy[:, 1] * error[:, 0] - dy[:, 0] * error[:, 1]) / det,
                    (dx[:, 0] * error[:, 1] - dx[:, 1] * error[:, 0]) / det,
                ],
                axis=1,
            )
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, 0.5 / np.maximum(length, 1e-12))
        xy = xy - np.nan_to_num(step)
    return xy
