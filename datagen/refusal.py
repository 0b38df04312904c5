"""The report of a drive that gave no map: what was tried, the frames, and the edges found in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from jaxtyping import Float, UInt8

from datagen.prepare import MapRequest, PreparedDrive
from datagen.quality.without_map import commands_without_map
from datagen.segments import CameraOfDrive, SolvedDrive
from datagen.settings import MapSettings
from datagen.slam.camera.self_calibration import DRIVE_INSTEAD
from datagen.slam.commands import commands_of
from datagen.slam.segment import SolvedSegment
from datagen.slam.view import mapping_range
from lanenet.data.drives import Drive
from lanenet.data.files import atomic_folder, write_text
from lanenet.errors import (
    CalibrationError,
    DriveFormatError,
    LanenetError,
    NoLaneError,
    TrackingLostError,
    counted,
)
from lanenet.geometry.camera import Camera
from lanenet.geometry.frames import map_from_car
from lanenet.page import (
    PAGE_NAME,
    Picture,
    Row,
    bullets,
    commands,
    details,
    gallery,
    note,
    page_of,
    photo,
    remedy,
    section,
    table,
)
from lanenet.perception.edges.canny import find_edges
from lanenet.perception.edges.road import RoadTable

#: What to do where no lane was found; how many laps were driven does not matter then.
_SEE_LINES = (
    "drive between two lines that the camera sees, and give the distance between their middles (--lane-width)"
)
#: The report beside an older map, which a refusal does not replace.
BESIDE_MAP_NAME = "report-refused.html"
#: What ``refused.yaml`` says of its folder.
_FORMAT = "lanenet-refused/1"
#: Frames that are shown, evenly over the drive; width of one, and of the path from above, [px]. Chosen: two
#: rows of four on a page.
_SHOWN, _SHOWN_PX, _PATH_PX = 8, 320, 900
#: BGR: edges on the road that are mapped, and those elsewhere.
_ON_ROAD, _ELSEWHERE = (80, 255, 80), (60, 60, 255)
#: BGR: edges on the path from above.
_EDGE = (230, 170, 90)


@dataclass
class Attempt:
    """How far the mapping of a drive came; each stage notes its result here.

    Attributes:
        request: What was asked for.
        settings: Settings of all stages.
        prepared: The drive without what cannot be mapped.
        camera: The camera that was given or found.
        solved: Segments with their poses.
    """

    request: MapRequest
    settings: MapSettings
    prepared: PreparedDrive | None = None
    camera: CameraOfDrive | None = None
    solved: SolvedDrive | None = None

    @property
    def drive(self) -> Drive:
        """The frames that were to be mapped; the whole recording if it was refused before."""
        return self.request.open_drive() if self.prepared is None else self.prepared.drive

    @property
    def known_camera(self) -> Camera | None:
        """The camera, if there is one for images of this size."""
        if self.camera is not None:
            return self.camera.camera
        return None if self.prepared is None else self.prepared.camera


def report_refusal(attempt: Attempt, error: LanenetError, out: Path) -> Path:
    """Write the report of a drive that gave no map.

    Args:
        attempt: How far the mapping came.
        error: Why it ended.
        out: Where the map was to be; an older map there is kept, and the report is put beside its own.

    Returns:
        The page.

    Raises:
        LanenetError: If it cannot be written, or the drive cannot be read.
    """
    page = refusal_page(attempt, error, out)
    if (out / "map.yaml").is_file():
        write_text(out / BESIDE_MAP_NAME, page)
        return out / BESIDE_MAP_NAME
    with atomic_folder(out, "refused") as folder:
        write_text(folder / PAGE_NAME, page)
        said = {"format": _FORMAT, "drive": str(attempt.request.drive_path.resolve()), "reason": str(error)}
        write_text(folder / "refused.yaml", yaml.safe_dump(said, sort_keys=False, allow_unicode=True))
    return out / PAGE_NAME


def refusal_page(attempt: Attempt, error: LanenetError, out: Path) -> str:
    """Return the page: why there is no map, what to do, what was tried, and what the frames show."""
    drive = attempt.drive
    cause, what_to_do = _cause_and_remedy(error, drive)
    raw, edges = _pictures(attempt, drive)
    camera = "" if attempt.known_camera is None else " Green: on the road that is mapped; red: elsewhere."
    segments = () if attempt.solved is None else attempt.solved.segments
    body = [
        remedy(what_to_do),
        section("Lines all the same"),
        commands(commands_without_map(attempt.request.drive_path, out, None)),
        section("What the camera saw"),
        note(
            "Frames from all over the drive. Are both lines of the lane in view, sharp, and brighter or "
            "darker than the floor?"
        ),
        gallery(raw),
        section("What the mapping saw"),
        note(f"The edges in the same frames. The borders of both lines should be among them.{camera}"),
        gallery(edges),
        section("What was tried"),
        table(tried_rows(attempt, drive), texts=2),
        section("Path") if segments else "",
        *(photo(draw_path(segment, drive)) for segment in segments),
        details("What else was noted", bullets(_notes(attempt, drive))),
    ]
    return page_of(f"No map of {drive.name}", "refused", cause, body)


def remedy_of(error: TrackingLostError) -> str:
    """Tell what to do about a drive that does not determine a map."""
    return _SEE_LINES if isinstance(error, NoLaneError) else DRIVE_INSTEAD


def _cause_and_remedy(error: LanenetError, drive: Drive) -> tuple[str, str]:
    """Tell what an error found from what it advises, which is "" where it advises nothing by itself."""
    reason = str(error).removeprefix(f"{drive.path}: ")
    if isinstance(error, TrackingLostError):
        return reason, remedy_of(error)
    if isinstance(error, CalibrationError):
        # Where it advises something, that is what its last semicolon is for.
        cause, semicolon, advice = reason.rpartition("; ")
        return (cause, advice) if semicolon else (reason, "")
    return reason, ""


def tried_rows(attempt: Attempt, drive: Drive) -> list[Row]:
    """The stages of the mapping, as far as they came, with what each found."""
    request, lane = attempt.request, f"{attempt.request.lane_width_cm:g} cm"
    rows: list[Row] = [("stage", "result"), ("given", f"{request.drive_path}, lane width {lane}")]
    if attempt.prepared is None:
        return [*rows, ("read the recording", f"{len(drive)} frames"), ("check it", "refused")]
    sizes = np.bincount(commands_of(drive, attempt.settings.guess.wheelbase_cm).part)
    parts = counted(len(sizes), "part")
    found = f"{len(drive)} frames in {parts} between long gaps, the longest of {sizes.max()}"
    rows.append(("check it", found))
    if attempt.camera is None:
        return [*rows, ("find the camera", "refused")]
    camera, m = attempt.camera.camera, attempt.camera.camera.mounting
    seen = f"focal length {camera.K[0, 0]:.1f} px, pitch {np.rad2deg(m.pitch_down_rad):.1f} degrees"
    rows.append(("camera", f"{attempt.camera.how}: {seen}"))
    if attempt.solved is None:
        return [*rows, ("track the car", "refused")]
    for one in attempt.solved.segments:
        length = f"{one.path_cm[-1] / m.height_cm:.0f} camera heights"
        at = f"{len(one.poses)} frames, {length} long, {counted(len(one.revisits), 'place')} seen twice"
        rows.append((f"track frames from {drive.frames[one.rows[0]]} on", at))
    rows += [
        (f"track frames from {drive.frames[one.rows[0]]} on", "refused") for one in attempt.solved.refused
    ]
    return [*rows, ("find the lane's two lines", "refused")]


def _notes(attempt: Attempt, drive: Drive) -> Sequence[str]:
    """What the stages had to say, a sentence each."""
    notes = list(drive.problems) if attempt.prepared is None else list(attempt.prepared.notes)
    if attempt.camera is not None:
        notes += attempt.camera.notes
    if attempt.solved is not None:
        notes += [one.note(drive) for one in attempt.solved.refused]
    return notes


def _pictures(attempt: Attempt, drive: Drive) -> tuple[list[Picture], list[Picture]]:
    """Draw some frames as they are, and with their edges."""
    perception = (
        attempt.settings.perception if attempt.prepared is None else attempt.prepared.settings.perception
    )
    keep, camera = np.full((drive.height, drive.width), 255, np.uint8), attempt.known_camera
    if camera is not None:
        try:
            keep = RoadTable(camera, mapping_range(camera.mounting, perception.range)).keep
        except CalibrationError:  # it sees no road: all edges lie elsewhere
            keep = np.zeros_like(keep)
    raw, edges = [], []
    for k in np.unique(np.linspace(0, len(drive) - 1, _SHOWN).astype(int)).tolist():
        try:
            image = drive.image(k)
            uv = np.rint(find_edges(image, perception.edges).uv_px).astype(np.intp)
        except DriveFormatError:  # named among the notes
            image, uv = np.full((drive.height, drive.width, 3), 128, np.uint8), np.empty((0, 2), np.intp)
        u, v = np.clip(uv, 0, [drive.width - 1, drive.height - 1]).T
        marked = image // 2
        marked[v, u] = np.where(keep[v, u, None] > 0, _ON_ROAD, _ELSEWHERE)
        raw.append(_enlarged(image, f"frame {drive.frames[k]}"))
        edges.append(_enlarged(marked, f"frame {drive.frames[k]}: {len(uv)} edge points"))
    return raw, edges


def _enlarged(image: UInt8[np.ndarray, "h w 3"], caption: str) -> Picture:
    """Enlarge a small frame without smoothing, so that single pixels can be told apart."""
    zoom = max(1, round(_SHOWN_PX / image.shape[1]))
    return Picture(np.repeat(np.repeat(image, zoom, axis=0), zoom, axis=1), caption)


def draw_path(segment: SolvedSegment, drive: Drive) -> Picture:
    """Draw the path of a segment with its edge points, from above; its scale is that of its camera."""
    scans, wheelbase_cm = segment.scans, segment.camera.wheelbase_cm
    # All that is mapped, near or not: of a narrow lens nothing is near.
    seen = (
        map_from_car(scans.points_cm[scans.frame(k)], pose, wheelbase_cm)
        for k, pose in enumerate(segment.poses)
    )
    edges = np.concatenate([*seen, np.empty((0, 2))])
    cloud = np.concatenate([edges, segment.poses[:, :2]])
    low, extent = cloud.min(axis=0), np.maximum(np.ptp(cloud, axis=0), 1.0)
    scale = _PATH_PX / float(extent.max())
    width, height = (extent * scale).astype(int) + 1
    image = np.full((height, width, 3), 24, np.uint8)

    def pixels(points: Float[np.ndarray, "m 2"]) -> np.ndarray:
        at = ((points - low) * scale).astype(np.int32)
        return np.stack([at[:, 0], height - 1 - at[:, 1]], axis=1)

    u, v = pixels(edges).T
    image[v, u] = _EDGE
    cv2.polylines(image, [pixels(segment.poses[:, :2])], False, (255, 255, 255), 2, cv2.LINE_AA)
    caption = (
        f"The path from frame {drive.frames[segment.rows[0]]} on (white) and the edges that were seen along "
        "it (blue), from above. Two lines beside the path are what a map is made of."
    )
    return Picture(image, caption)
