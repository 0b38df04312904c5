"""The labelled frames of a drive as pictures: the image file, and the labels in its pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from lanenet.data.drives import Drive, open_drive
from lanenet.data.drives.folder import TRUTH_FILE, read_truth
from lanenet.data.drives.recording import ImageFiles
from lanenet.data.label_set import LabelSet, read_labels
from lanenet.data.maps.folder import DriveMap
from lanenet.data.maps.mapped_drive import open_mapped_drive
from lanenet.data.tables import png_bytes
from lanenet.errors import DriveFormatError, LabelFormatError
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import ROWS_CM
from lanenet.image_header import orientation
from lanenet.reading import MAX_IMAGE, read_bytes

#: Image files that every tool reads, taken over byte for byte; others become PNG.
_KEPT_ENDINGS = (".jpg", ".jpeg", ".png")
#: Distance of the points of a line that are projected. Chosen: a pixel or two, on which a lens bends nothing.
_STEP_CM = 0.25
_POSE_NAMES = ("x_cm", "y_cm", "heading_rad")
#: Poses of a label set and of its map, or of the simulator's truth, differ by less. Chosen: by ten times what
#: rounding takes from 100 m.
_SAME_POSE_CM = 0.01


@dataclass(frozen=True, eq=False)
class Picture:
    """A labelled frame.

    Attributes:
        name: Name of its image file.
        data: Content of that file.
        row: Its row in the label set.
        camera: The camera, tilted as it was in this frame.
        points_px: The six labels in pixels, pixel centres at integers; NaN where masked or outside the image.
    """

    name: str
    data: bytes
    row: int
    camera: Camera
    points_px: Float[np.ndarray, "6 2"]


@dataclass(eq=False)
class Pictures:
    """The pictures of a label set, read one by one.

    Attributes:
        path: File of the label set.
        labels: The label set.
        drive: Its drive.
        camera: Camera of the drive.
        rows: Row in the drive of each row of the label set.
        drive_map: The map, with its frame of each row of the label set; None for a simulated drive.
        problems: Frames that could not be read, filled while the pictures are.
        progress: Called with pictures read and all pictures.
    """

    path: Path
    labels: LabelSet
    drive: Drive
    camera: Camera
    rows: Int[np.ndarray, "n"]
    drive_map: tuple[DriveMap, Int[np.ndarray, "n"]] | None
    problems: list[str] = field(default_factory=list)
    progress: Callable[[int, int], None] | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def __iter__(self) -> Iterator[Picture]:
        for i, row in enumerate(self.rows.tolist()):
            try:
                data, ending = self._file(row)
            except DriveFormatError as error:
                self.problems.append(f"{error}; left out")
                continue
            camera = self.camera
            if self.drive_map is not None:
                camera = self.drive_map[0].camera_at(int(self.drive_map[1][i]))
            if self.progress is not None:
                self.progress(i + 1, len(self))
            name = f"{self.drive.name}_{self.labels.frame[i]:06d}{ending}"
            yield Picture(name, data, i, camera, label_pixels(self.labels.points_cm[i], camera))

    def _file(self, row: int) -> tuple[bytes, str]:
        """Return the content and the ending of an image that can be read."""
        image, source = self.drive.image(row), self.drive.images
        if isinstance(source, ImageFiles):
            path = source.paths[int(self.drive.rows[row])]
            data = read_bytes(path, DriveFormatError, MAX_IMAGE)
            # Other tools turn an image as its Exif data say, or do not; the labels are of the turned one.
            if path.suffix.lower() in _KEPT_ENDINGS and orientation(data) == 1:
                return data, path.suffix.lower()
        return png_bytes(image), ".png"


def open_pictures(path: Path, frames: Path) -> Pictures:
    """Open a label set and the drive that it was made from.

    Args:
        path: The label set.
        frames: The map, or the simulated drive, that it was made from.

    Raises:
        LabelFormatError: If it was not made from that drive with that camera, or the drive was mapped or
            simulated anew since.
        LanenetError: As :func:`open_mapped_drive` or :func:`open_drive`.
    """
    labels = read_labels(path)
    drive_map, poses = None, None
    if (frames / "map.yaml").is_file():
        mapped = open_mapped_drive(frames)
        drive, camera = mapped.drive, mapped.drive_map.camera
        known, rows, poses = mapped.drive_map.frames, mapped.rows, mapped.drive_map.poses
        anew = f"mapped anew since; make the labels again: lanenet label {frames} --out {path}"
    else:
        drive = open_drive(frames)
        if drive.camera is None:
            raise LabelFormatError(
                f"{frames}: has no camera, expected the map, or the simulated drive, of {path}"
            )
        camera, known, rows = drive.camera, drive.frames, np.arange(len(drive))
        truth = read_truth(frames) if labels.meta.source == "truth" else None
        if truth is not None and not np.array_equal(truth["frame"], known):
            raise DriveFormatError(f"{frames / TRUTH_FILE}: expected a row for each frame of the drive")
        if truth is not None:
            poses = np.stack([truth[name] for name in _POSE_NAMES], axis=1)
        anew = "simulated anew since; make the labels again"
    if camera.hash != labels.meta.camera_hash or set(labels.drive) != {drive.name}:
        raise LabelFormatError(
            f"{path}: labels of {', '.join(sorted(set(labels.drive)))}, camera {labels.meta.camera_hash}; "
            f"{frames} is of {drive.name}, camera {camera.hash}: expected what the labels were made from"
        )
    found = np.searchsorted(known, labels.frame).clip(max=len(known) - 1)
    if (absent := known[found] != labels.frame).any():
        raise LabelFormatError(f"{path}: frame {labels.frame[absent][0]} is not in {frames}")
    if (frames / "map.yaml").is_file():
        drive_map = (mapped.drive_map, found)
    off_cm = 0.0 if poses is None else np.abs(poses[found] - labels.poses)[:, :2].max(initial=0.0)
    if off_cm > _SAME_POSE_CM:
        raise LabelFormatError(
            f"{path}: its poses lie up to {off_cm:.2g} cm from those of {frames}, which was {anew}"
        )
    return Pictures(path, labels, drive, camera, rows[found], drive_map)


def label_pixels(points_cm: Float[np.ndarray, "6"], camera: Camera) -> Float[np.ndarray, "6 2"]:
    """Project the six labels into the image, [px]; NaN where masked or outside it."""
    ground = np.column_stack([points_cm, np.tile(ROWS_CM, 2)])
    return _inside(camera.project_ground(ground), camera)


def line_pixels(line_cm: Float[np.ndarray, "n 2"], camera: Camera) -> Float[np.ndarray, "m 2"]:
    """Project a lane line, ahead of the camera, into the image, [px]; NaN breaks it, also where it leaves.

    Args:
        line_cm: Polyline in the direction of travel, frame car; NaN rows break it.
        camera: The camera of the frame.
    """
    if len(line_cm) < 2:
        return np.empty((0, 2))
    steps = np.linalg.norm(np.diff(line_cm, axis=0), axis=1)
    counts = np.ceil(np.nan_to_num(steps, nan=_STEP_CM) / _STEP_CM).astype(int).clip(min=1)
    # Where each dense point lies between its two neighbours.
    first = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[first]
    dense = line_cm[first] + share[:, None] * (line_cm[first + 1] - line_cm[first])
    dense = np.concatenate([dense, line_cm[-1:]])
    dense[dense[:, 1] <= camera.mounting.ahead_of_front_axle_cm] = np.nan
    return _inside(camera.project_ground(dense), camera)


def _inside(pixels: Float[np.ndarray, "n 2"], camera: Camera) -> Float[np.ndarray, "n 2"]:
    limit = (camera.width - 1.0, camera.height - 1.0)
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels >= 0.0) & (pixels <= limit), axis=1, keepdims=True)
    return np.where(inside, pixels, np.nan)
