"""What goes into a bundle adjustment and what comes out: settings, observations, estimates and the state.

Poses are in cm outside this room. Inside, in :class:`BundleState` and the kernels, lengths are in camera
heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from pydantic import Field

from datagen.slam.adjustment.kernels import N_FRAME, Pixels
from lanenet.config import Settings
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.pixels import EdgePixels

#: Names of the camera's adjustable numbers, in the order of the kernels.
CAMERA_NAMES = ("focal", "cx", "cy", "k1", "pitch", "roll", "yaw", "lever")


class BundleSettings(Settings):
    """Priors and robustness of the adjustment; lengths in camera heights, angles in radians.

    "Real drives" are ``donkey_circuit``, ``usi_mat`` and ``garage_tape`` (docs/mapping.md). Where no other
    source is named, a value was chosen on them and on simulated drives (``tests/bench/bench_mapping.py``).

    Attributes:
        lags: Frames between the two frames of a pair. With these, a closed ``donkey_circuit`` gave focal
            lengths within 1 px from starts of 50 to 76 px.
        points: Edge points per frame that are compared.
        gates_px: Search radius for the nearest edge, [px], one per round of association. Chosen: it
            shrinks as the poses improve.
        iterations: Levenberg-Marquardt steps per round.
        cauchy_px: Scale of the Cauchy loss, [px]: about three times the robust sd of ``donkey_circuit``.
        pixel_sigma: Standard deviation of a residual, [px]. Larger than the residuals seen, since
            neighbouring edge points share their errors and count for fewer.
        focal: Relative sigma of the focal length's prior; wide, for a guessed lens.
        centre_px: Sigma of the principal point, for images 160 px wide. Tight: with yaw and roll it is nearly
            degenerate. But with half of it, cameras found from half of the frames of ``donkey_circuit`` had
            it 1 px nearer to the image centre, and labels at 30 cm lay twice as far to one side.
        k1: Sigma of the first lens coefficient; the three real drives have -0.03 to -0.07.
        pitch: Sigma of the mounting's pitch.
        roll: Sigma of the mounting's roll: nearly degenerate with the principal point, hence tight.
        yaw: Sigma of the mounting's yaw.
        lever: Sigma of the camera's position ahead of the rear axle.
        frame_pitch: Sigma of each frame's pitch about the mounting's: 0.33 to 0.83 degrees on the real
            drives.
        frame_roll: Sigma of each frame's roll: half of the pitch's.
        slip: Sigma of the rear axle's sideways motion per frame.
        speed_change: Sigma of the change of step length from frame to frame, relative to the commands.
        recorded_speed: Sigma of a step length about recorded speed times its gain, as a share: errors of some
            per cent that last for several frames. With it, steps where nothing across the road is seen no
            longer come out 15 % too long (docs/mapping.md).
        turn_change: Sigma of the change of turn from frame to frame.
    """

    lags: tuple[int, ...] = (1, 4, 9, 14)
    points: int = Field(default=60, ge=10)
    gates_px: tuple[float, ...] = (5.0, 4.0, 3.0, 2.5, 2.5)
    iterations: int = Field(default=2, ge=1)
    cauchy_px: float = Field(default=0.7, gt=0.0)
    pixel_sigma: float = Field(default=2.0, gt=0.0)
    focal: float = Field(default=0.3, gt=0.0)
    centre_px: float = Field(default=2.0, gt=0.0)
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

    def going_on(self) -> BundleSettings:
        """Return the same for a start that was adjusted before, whose edges are looked for nearby alone."""
        return self.model_copy(update={"gates_px": self.gates_px[-2:]})

    def with_free_tilt(self) -> BundleSettings:
        """Return the same with frames that may tilt as they like, for a camera that is yet to be found.

        A prior on tilts makes them too small, and the camera makes up for it: on 62 simulated drives the
        focal length came out right without shaking and 2.5 % too long where the pitch shook by 0.0075 rad.
        """
        return self.model_copy(update={"frame_pitch": 0.03, "frame_roll": 0.02})


@dataclass(frozen=True)
class Observations:
    """What the frames of a drive show, and what was commanded: the same for every adjustment of them.

    Attributes:
        edges: Edge pixels per frame, only such that see the road.
        keep: Pixels in which edges were looked for; None for all.
        relative_steps: Commanded step length to each frame, 1 where it is typical; None for equal steps.
        speed_recorded: Whether these come from a recorded speed.
        periods: Time from the frame before to each frame, in typical time steps (see
            :class:`datagen.slam.commands.CommandedMotion`); None for a drive without gaps.
        uneven: Where that time is another one that is not known closely; None for nowhere.
    """

    edges: Sequence[EdgePixels]
    keep: UInt8[np.ndarray, "h w"] | None = None
    relative_steps: Float[np.ndarray, "n"] | None = None
    speed_recorded: bool = False
    periods: Float[np.ndarray, "n"] | None = None
    uneven: Bool[np.ndarray, "n"] | None = None

    @cached_property
    def pixels(self) -> tuple[Pixels, Pixels]:
        """Edges of all frames, as they were found, and those of each sorted by row, as the kernels search."""
        counts = [len(one.uv_px) for one in self.edges]
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        uv = np.concatenate([one.uv_px for one in self.edges]).astype(np.float64)
        normals = np.concatenate([one.normals for one in self.edges]).astype(np.float64)
        by_row = np.lexsort((uv[:, 1], np.repeat(np.arange(len(counts)), counts)))
        return Pixels(starts, uv, normals), Pixels(starts, uv[by_row], normals[by_row])


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


class BundleState(NamedTuple):
    """The unknowns of the adjustment; lengths in camera heights.

    Attributes:
        poses: Rear-axle poses, frame map.
        tilt: Pitch and roll of each frame beyond the camera's, [rad].
        lens: See :mod:`datagen.slam.adjustment.kernels`.
        mount: See :mod:`datagen.slam.adjustment.kernels`.
        fisheye: Lens model.
    """

    poses: Float[np.ndarray, "n 3"]
    tilt: Float[np.ndarray, "n 2"]
    lens: Float[np.ndarray, "9"]
    mount: Float[np.ndarray, "5"]
    fisheye: bool

    @staticmethod
    def at(estimate: BundleEstimate) -> BundleState:
        """Return the state at an estimate."""
        camera = estimate.camera
        height, fisheye = camera.mounting.height_cm, camera.model == "fisheye"
        poses = estimate.poses / [height, height, 1.0]
        return BundleState(poses, estimate.tilt, *camera_vectors(camera), fisheye)

    def moved(self, step: Float[np.ndarray, "u"], free: Bool[np.ndarray, "8"]) -> BundleState:
        """Return the state after a step: five numbers per frame, then the camera's free numbers."""
        count = N_FRAME * len(self.poses)
        frames = step[:count].reshape(-1, N_FRAME)
        camera = np.zeros(len(CAMERA_NAMES))
        camera[free] = step[count:]
        lens, mount = self.lens.copy(), self.mount.copy()
        lens[:2] *= np.exp(camera[0])
        lens[2:5] += camera[1:4]
        mount[:4] += camera[4:8]
        return BundleState(self.poses + frames[:, :3], self.tilt + frames[:, 3:], lens, mount, self.fisheye)

    def camera_like(self, camera: Camera) -> Camera:
        """Return the camera with this state's numbers."""
        lens, mount = self.lens, self.mount
        K = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
        D = np.array(camera.D, dtype=np.float64)
        D[0] = lens[4]
        return replace(camera, K=K, D=D).with_mounting(
            pitch_down_rad=float(mount[0]),
            roll_rad=float(mount[1]),
            yaw_rad=float(mount[2]),
            ahead_of_front_axle_cm=float(mount[3] * camera.mounting.height_cm - camera.wheelbase_cm),
        )

    def camera_minus(self, other: Camera) -> Float[np.ndarray, "8"]:
        """Return the camera's adjustable numbers minus those of another camera; the focal length relative."""
        lens, mount = camera_vectors(other)
        focal = np.log(self.lens[0] / lens[0])
        return np.array([focal, *(self.lens[2:5] - lens[2:5]), *(self.mount[:4] - mount[:4])])


def camera_vectors(camera: Camera) -> tuple[Float[np.ndarray, "9"], Float[np.ndarray, "5"]]:
    """Return a camera's lens and mount as the kernels take them, lengths in camera heights."""
    m = camera.mounting
    D = np.concatenate([camera.D, np.zeros(5)])[:5]
    lens = np.array([camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], *D])
    lever = (m.ahead_of_front_axle_cm + camera.wheelbase_cm) / m.height_cm
    mount = np.array([m.pitch_down_rad, m.roll_rad, m.yaw_rad, lever, -m.right_of_centre_cm / m.height_cm])
    return lens, mount
