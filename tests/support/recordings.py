"""Drives past a made texture, so small that a copy, a cut and another lap of it take no time."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 96, 72
_STEP_PX = 6.0


@cache
def texture(seed: int = 0) -> np.ndarray:
    """A long strip of floor with spots of many sizes."""
    rng = np.random.default_rng(seed)
    strip = np.zeros((160, 2400), np.float32)
    for size in (2, 4, 8, 16):
        noise = rng.standard_normal((160 // size + 1, 2400 // size + 1)).astype(np.float32)
        strip += size**0.5 * cv2.resize(noise, (2400, 160), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 18 * strip, 0, 255).astype(np.uint8)


def lap(seed: int = 0, frames: int = 150, *, track: int = 0, off_px: float = 0.0) -> list[np.ndarray]:
    """What a car sees that drives along the strip; each lap sways and sees noise of its own."""
    rng = np.random.default_rng([seed, track])
    strip = texture(track)
    sway = np.convolve(rng.standard_normal(frames + 20), np.ones(21) / 21, "valid") * 12.0
    pictures = []
    for k in range(frames):
        x = 100 + _STEP_PX * k
        centre = (x + WIDTH / 2, 80.0 + off_px + sway[k])
        picture = cv2.getRectSubPix(strip, (WIDTH, HEIGHT), centre).astype(np.float32)
        picture += rng.standard_normal(picture.shape) * 2.0
        pictures.append(cv2.cvtColor(np.clip(picture, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR))
    return pictures


def write_recording(
    path: Path, pictures: list[np.ndarray], *, quality: int = 95, scale: float = 1.0, first: int = 0
) -> Path:
    """Write a drive folder of pictures, encoded anew; its frames are numbered from ``first``."""
    (path / "images").mkdir(parents=True)
    rows = ["frame,file,t_s,angle"]
    for k, picture in enumerate(pictures):
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        name = f"images/{k:04d}.jpg"
        (path / name).write_bytes(
            cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        )
        rows.append(f"{first + k},{name},{0.05 * k:.3f},{0.001 * k:.3f}")
    (path / "frames.csv").write_text("\n".join(rows) + "\n")
    return path
