"""A mapped drive of a track, ready to be adjusted together with others."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from datagen.prepare import MapRequest, PreparedDrive, keep_images
from datagen.settings import MapSettings
from datagen.slam.commands import CommandedMotion, commands_of
from datagen.slam.keyframes import choose_keyframes
from datagen.slam.view import RoadView, view_road
from datagen.tracks.cameras import DriveCamera, camera_sigma
from datagen.tracks.shape import Similarity, longest_segment
from lanenet.config import load_settings
from lanenet.data.maps.folder import SETTINGS_NAME
from lanenet.data.maps.mapped_drive import MappedDrive, open_mapped_drive
from lanenet.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class Visit:
    """A mapped drive of a track: what the longest segment of its map holds.

    Attributes:
        folder: Folder of the map.
        mapped: The map with its whole drive.
        prepared: The frames of the segment, as they were mapped.
        poses: Their rear-axle poses.
        tilt_rad: Their pitch and roll beyond the camera's mounting.
        match: Matched share of each frame's edges.
        camera: The camera.
        sigma: Standard deviation of each of its numbers, focal length relative; none for a given camera.
    """

    folder: Path
    mapped: MappedDrive
    prepared: PreparedDrive
    poses: Float[np.ndarray, "n 3"]
    tilt_rad: Float[np.ndarray, "n 2"]
    match: Float[np.ndarray, "n"]
    camera: Camera
    sigma: dict[str, float]

    @property
    def name(self) -> str:
        """Name of the drive."""
        return self.prepared.drive.name

    @property
    def found_camera(self) -> DriveCamera:
        """The camera, to be compared with others."""
        return DriveCamera(self.name, self.camera, self.sigma)

    @property
    def commands(self) -> CommandedMotion:
        """What was commanded."""
        return commands_of(self.prepared.drive, self.camera.wheelbase_cm)

    @property
    def keys(self) -> Int[np.ndarray, "k"] | None:
        """Keyframes of a slow car; None where every frame is one."""
        steps = np.hypot(*np.diff(self.poses[:, :2], axis=0, prepend=self.poses[:1, :2]).T)
        keys = choose_keyframes(steps / self.camera.mounting.height_cm, self.commands.part)
        return None if len(keys) == len(self.poses) else keys

    def moved(self, by: Similarity) -> Visit:
        """Return the visit on another map, with its lengths in the scale of that map."""
        # The wheelbase is the car's own; the lever arm is measured from the rear axle.
        camera = self.camera.scaled_lengths(by.scale)
        lever_cm = camera.wheelbase_cm + camera.mounting.ahead_of_front_axle_cm
        camera = replace(camera, wheelbase_cm=self.camera.wheelbase_cm)
        camera = camera.with_mounting(ahead_of_front_axle_cm=lever_cm - camera.wheelbase_cm)
        return replace(self, poses=by.poses(self.poses), camera=camera)

    def road(self, camera: Camera) -> RoadView:
        """Find the edges of the road in every frame, as a camera shows it."""
        return view_road(self.prepared.drive, camera, self.prepared.settings, self.keys)


def read_visit(folder: Path, drive_path: Path | None = None) -> Visit:
    """Read a map and the frames of its longest segment.

    Args:
        folder: The map.
        drive_path: Where its drive is, if not where it was mapped.

    Raises:
        LanenetError: If the map or its drive cannot be read.
    """
    mapped = open_mapped_drive(folder, drive_path)
    drive_map, meta = mapped.drive_map, mapped.drive_map.meta
    chosen = np.flatnonzero(drive_map.segment == longest_segment(drive_map))
    drive = keep_images(mapped.drive.subset(mapped.rows[chosen]))
    known = drive_map.camera if meta.scale_from == "camera" else None
    request = MapRequest(mapped.drive.path, meta.lane_width_cm)
    settings = load_settings(MapSettings, folder / SETTINGS_NAME)
    marks = drive_map.marks
    prepared = PreparedDrive(
        request,
        drive,
        drive_map.held_out[chosen],
        settings,
        known,
        (),
        marks=() if marks is None else tuple(marks[k] for k in chosen.tolist()),
    )
    return Visit(
        folder,
        mapped,
        prepared,
        drive_map.poses[chosen],
        drive_map.tilt_rad[chosen],
        drive_map.match[chosen],
        drive_map.camera,
        camera_sigma(folder),
    )
