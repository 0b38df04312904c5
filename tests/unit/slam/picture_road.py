"""Pictures of the made-up road on a speckled floor between walls, as a drive in memory."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from pixel_road import HEIGHT, WIDTH, bean, tape_loop
from tape_road import TAPE_CM, WHEELBASE_CM, dashes_along

from lanenet.data.drives.recording import Commands, Drive
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car

_PX_PER_CM = 4
_MARGIN_CM = 130.0
_FLOOR, _TAPE = 80.0, 220.0


class Pictures:
    """Pictures that are kept; a source of images."""

    def __init__(self, images: list[np.ndarray]) -> None:
        self.images = images

    def read(self, row: int) -> np.ndarray:
        return self.images[row]


def made_up_drive(images: list[np.ndarray], **changes: object) -> Drive:
    """A drive of these pictures, 20 to the second, that recorded nothing else unless told."""
    n = len(images)
    values: dict[str, object] = {
        "name": "made-up",
        "path": Path("made-up"),
        "frames": np.arange(n),
        "t_s": 0.05 * np.arange(n),
        "times_trusted": True,
        "commands": Commands(),
        "deleted": np.zeros(n, dtype=bool),
        "breaks": np.zeros(n, dtype=bool),
        "camera": None,
        "lane_width_cm": 36.0,
        "problems": (),
        "width": images[0].shape[1],
        "height": images[0].shape[0],
        "images": Pictures(images),
        "rows": np.arange(n),
    }
    return Drive(**(values | changes))  # type: ignore[arg-type]


def loop_drive(
    camera: Camera, frames: int, lap_frames: int, lap_cm: float, seed: int = 0
) -> tuple[Drive, np.ndarray]:
    """A drive around a closed road, and its true poses."""
    rng = np.random.default_rng(seed)
    s, curvature = bean(lap_cm)
    poses = tape_loop(frames, lap_frames, lap_cm).poses
    low = poses[:, :2].min(axis=0) - _MARGIN_CM
    size = np.ceil((poses[:, :2].max(axis=0) + _MARGIN_CM - low) * _PX_PER_CM).astype(int)
    floor = _FLOOR + 12.0 * _smooth(rng, (int(size[1]), int(size[0])), 40.0)
    for dash in dashes_along(s, curvature):
        # Sixteenths of a pixel; the tape is as wide as its points say.
        rows = np.rint((dash - low) * _PX_PER_CM * 16.0).astype(np.int32)
        cv2.polylines(floor, [rows], False, _TAPE, int(TAPE_CM * _PX_PER_CM), cv2.LINE_AA, shift=4)
    wall = _FLOOR + 60.0 + 40.0 * _smooth(rng, (1, 720), 12.0)[0]
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    road = camera.intersect_ground(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    # Walls stand where the floor ends for the eye.
    sees_floor = np.nan_to_num(np.hypot(road[:, 0], road[:, 1]), nan=np.inf) < 250.0
    bearing = np.broadcast_to((np.arange(WIDTH) - 0.5 * WIDTH) / camera.K[0, 0], (HEIGHT, WIDTH)).ravel()
    images = []
    for pose in poses:
        spot = (map_from_car(np.nan_to_num(road), pose, WHEELBASE_CM) - low) * _PX_PER_CM
        x, y = spot.T.reshape(2, HEIGHT, WIDTH).astype(np.float32)
        seen = cv2.remap(floor, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=_FLOOR)
        direction = np.rint(np.rad2deg(pose[2] - bearing) * 2.0).astype(int) % 720
        picture = np.where(sees_floor, seen.ravel(), wall[direction]).reshape(HEIGHT, WIDTH)
        picture = cv2.GaussianBlur(picture, (0, 0), 0.7) + rng.normal(0.0, 1.0, (HEIGHT, WIDTH))
        images.append(cv2.cvtColor(np.clip(picture, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR))
    return made_up_drive(images, camera=camera), poses


def _smooth(rng: np.random.Generator, shape: tuple[int, int], sigma_px: float) -> np.ndarray:
    """Blurred noise of unit spread."""
    small = max(1.0, sigma_px / 4.0)
    rows, columns = (int(np.ceil(n / small)) + 1 for n in shape)
    noise = cv2.GaussianBlur(rng.normal(size=(rows, columns)), (0, 0), 4.0)
    noise = cv2.resize(noise, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return (noise - noise.mean()) / noise.std()
