"""Small drives in every format, for tests of several rooms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lanenet.data.drives.folder import DriveWriter
from lanenet.geometry.camera import Camera, Mounting

#: Frames of a video.
VIDEO_FRAMES = 40

CAMERA = Camera(
    model="fisheye",
    width=64,
    height=48,
    K=np.array([[30.0, 0.0, 31.5], [0.0, 30.0, 23.5], [0.0, 0.0, 1.0]]),
    D=np.zeros(4),
    mounting=Mounting(height_cm=20.0, pitch_down_rad=0.4),
    wheelbase_cm=26.0,
)


def frame_image(k: int, width: int = 64, height: int = 48) -> np.ndarray:
    """A smooth picture that differs from frame to frame and survives JPEG."""
    v, u = np.mgrid[:height, :width]
    return np.stack([np.full_like(u, 20 * k % 256), 2 * u, 4 * v], axis=-1).astype(np.uint8)


def write_drive(path: Path, n: int = 5, camera: Camera | None = CAMERA) -> Path:
    with DriveWriter(path, camera, lane_width_cm=40.0, notes="a test", jpeg_quality=95) as writer:
        for k in range(n):
            writer.add(frame_image(k), 0.05 * k, speed_cm_s=60.0, steering_rad=0.01 * k)
    return path


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def record(k: int, **changes: Any) -> dict[str, Any]:
    return {
        "_index": k,
        "_session_id": "24-01-01_0",
        "_timestamp_ms": 1700000000000 + 50 * k,
        "cam/image_array": f"{k}_cam_image_array_.jpg",
        "user/angle": -0.25,
        "user/mode": "user",
        "user/throttle": 0.01 * k,
        **changes,
    }


def write_tub(
    path: Path, records: list[dict[str, Any] | str], deleted: list[int] | None = None, per_catalog: int = 1000
) -> Path:
    """A tub as Donkeycar 4 writes it; a text in place of a record is written as it is."""
    (path / "images").mkdir(parents=True)
    picture = cv2.imencode(".jpg", np.full((12, 16, 3), 90, np.uint8))[1].tobytes()
    names = []
    for start in range(0, len(records), per_catalog):
        names.append(f"catalog_{len(names)}.catalog")
        lines = [r if isinstance(r, str) else json.dumps(r) for r in records[start : start + per_catalog]]
        (path / names[-1]).write_text("\n".join(lines) + "\n")
    for r in records:
        if isinstance(r, dict) and isinstance(r.get("cam/image_array"), str):
            (path / "images" / r["cam/image_array"]).write_bytes(picture)
    inputs = ["cam/image_array", "user/angle", "user/throttle", "user/mode"]
    catalogs = {
        "paths": names,
        "current_index": len(records),
        "max_len": 1000,
        "deleted_indexes": deleted or [],
    }
    lines = [inputs, ["image_array", "float", "float", "str"], {}, {"created_at": 1.0}, catalogs]
    (path / "manifest.json").write_text("\n".join(json.dumps(line) for line in lines) + "\n")
    return path


def write_video(path: Path, n: int = VIDEO_FRAMES, fps: float = 25.0) -> Path:
    """Frame k is gray with the level 5 k, so that each image tells its number."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), fps, (64, 48))
    noise = np.random.default_rng(0).integers(0, 3, (48, 64, 3))
    for k in range(n):
        writer.write((5 * k + noise).astype(np.uint8))
    writer.release()
    return path
