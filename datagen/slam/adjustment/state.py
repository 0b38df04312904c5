"""What the bundle adjustment changes: poses, each frame's tilt, and the camera's numbers.

Priors and robustness of the bundle adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from pydantic import Field

from datagen.slam.adjustment.kernels import N_FRAME
from lanenet.config import Settings
from lanenet.geometry.camera import Camera

#: Names of the camera's adjustable numbers, in the order of the kernels.
CAMERA_NAMES = ("focal", "cx", "cy", "k1", "pitch", "roll", "yaw", "lever")


@dataclass(frozen=True)
class BundleEstimate:
    """Poses, tilts and camera of a drive: where an adjustment starts, and what it ends with.

    Attributes:
        poses: Rear-axle poses, [cm], [cm], [rad], frame map, in the scale of the camera's height.
        tilt: Pitch and roll of each frame beyond the camera's, [rad].
        camera: The camera.
    """

    poses: Float[np.ndarray, "n 3"]
    tilt: Float[np.ndarray, "n 2"]
    camera: Camera

    @staticmethod
    def level(poses: Float[np.ndarray, "n 3"], camera: Camera) -> BundleEstimate:
        """Return an estimate in which no frame is tilted."""
        return BundleEstimate(poses, np.zeros((len(poses), 2)), camera)


@dataclass(frozen=True)
class BundleState:
    """Lengths in camera heights.

    Attributes:
        poses: Rear-axle poses, frame map.
        tilt: Pitch and roll of each frame beyond the camera's, [rad].
        lens: See :mod:`datagen.slam.adjustment.kernels`.
        mount: The same.
    """

    poses: Float[np.ndarray, "n 3"]
    tilt: Float[np.ndarray, "n 2"]
    lens: Float[np.ndarray, "9"]
    mount: Float[np.ndarray, "5"]

    def moved(self, step: Float[np.ndarray, "u"], free: Bool[np.ndarray, "8"]) -> BundleState:
        """Return the state after a step: five numbers per frame, then those of the camera that are free."""
        count = N_FRAME * len(self.poses)
        frames = step[:count].reshape(-1, N_FRAME)
        camera = np.zeros(len(CAMERA_NAMES))
        camera[free] = step[count:]
        lens, mount = self.lens.copy(), self.mount.copy()
        lens[:2] *= np.exp(camera[0])
        lens[2:5] += camera[1:4]
        mount[:4] += camera[4:8]
        return BundleState(self.poses + frames[:, :3], self.tilt + frames[:, 3:], lens, mount)

    def camera_like(self, camera: Camera) -> Camera:
        """Return the camera with this state's numbers."""
        lens, mount = self.lens, self.mount
        K = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
        mounting = replace(
            camera.mounting,
            pitch_down_rad=float(mount[0]),
            roll_rad=float(mount[1]),
            yaw_rad=float(mount[2]),
            ahead_of_front_axle_cm=float(mount[3] * camera.mounting.height_cm - camera.wheelbase_cm),
        )
        D = np.array(camera.D, dtype=np.float64)
        D[0] = lens[4]
        return replace(camera, K=K, D=D, mounting=mounting)

    def camera_off(self, believed: Camera) -> Float[np.ndarray, "8"]:
        """How far the camera's numbers are from those of another one; the focal length relative."""
        lens, mount = numbers_of(believed)
        focal = np.log(self.lens[0] / lens[0])
        return np.array([focal, *(self.lens[2:5] - lens[2:5]), *(self.mount[:4] - mount[:4])])


def numbers_of(camera: Camera) -> tuple[Float[np.ndarray, "9"], Float[np.ndarray, "5"]]:
    """A camera as the kernels take it: lens, and mounting with lengths in camera heights."""
    m = camera.mounting
    D = np.concatenate([camera.D, np.zeros(5)])[:5]
    lens = np.array([camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], *D])
    lever = (m.ahead_of_front_axle_cm + camera.wheelbase_cm) / m.height_cm
    mount = np.array([m.pitch_down_rad, m.roll_rad, m.yaw_rad, lever, -m.right_of_centre_cm / m.height_cm])
    return lens, mount


def start_state(start: BundleEstimate) -> BundleState:
    """Return the state at an estimate."""
    height = start.camera.mounting.height_cm
    return BundleState(start.poses / [height, height, 1.0], start.tilt, *numbers_of(start.camera))


class BundleSettings(Settings):
    """Priors and robustness; lengths in camera heights, angles in radians.

    Attributes:
        lags: Frames between the frames of a pair.
        points: Edge points per frame that are moved.
        gates_px: Radius of the search for the edge, one per round of association.
        iterations: Steps per round.
        cauchy_px: Residual at which the robust loss sets in.
        pixel_sigma: Standard deviation of a residual, with all that makes neighbours alike.
        focal: Relative standard deviation of the focal length's prior.
        centre_px: Of the principal point, for images of 160 px.
        k1: Of the first coefficient of the lens.
        pitch: Of the mounting's pitch.
        roll: Of the mounting's roll.
        yaw: Of the mounting's yaw.
        lever: Of the camera's place ahead of the rear axle.
        frame_pitch: Of each frame's pitch about the mounting's.
        frame_roll: Of each frame's roll.
        slip: Of the rear axle's sideways motion per frame.
        speed_change: Of the change of the way per frame, from one frame to the next, against the commanded.
        recorded_speed: Of the way per frame about the recorded speed times its gain, as a share of it: errors
            of a few per cent that last for some frames. Only where a speed was recorded.
        turn_change: Of the change of turn per frame, from one frame to the next.
    """

    lags: tuple[int, ...] = (1, 4, 9, 14)
    points: int = Field(default=60, ge=10)
    gates_px: tuple[float, ...] = (5.0, 4.0, 3.0, 2.5, 2.5)
    iterations: int = Field(default=2, ge=1)
    cauchy_px: float = Field(default=0.7, gt=0.0)
    pixel_sigma: float = Field(default=2.0, gt=0.0)
    focal: float = Field(default=0.3, gt=0.0)
    centre_px: float = Field(default=1.0, gt=0.0)
    k1: float = Field(default=0.03, gt=0.0)
    pitch: float = Field(default=0.2, gt=0.0)
    roll: float = Field(default=0.02, gt=0.0)
    yaw: float = Field(default=0.1, gt=0.0)
    lever: float = Field(default=0.4, gt=0.0)
    frame_pitch: float = Field(default=0.012, gt=0.0)
    frame_roll: float = Field(default=0.006, gt=0.0)
    slip: float = Field(default=0.004, gt=0.0)
    speed_change: float = Field(default=0.003, gt=0.0)
    recorded_speed: float = Field(default=0.2, gt=0.0)
    turn_change: float = Field(default=0.01, gt=0.0)
