"""A map with its drive: the lane of each frame, which frames and points get labels, and those labels.

:func:`read_truth_frames` and :func:`read_map_frames` give the frames on which detectors are compared.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lanenet.config import check_settings, read_yaml
from lanenet.data.drives import Drive, open_drive
from lanenet.data.drives.content import other_images
from lanenet.data.drives.folder import TRUTH_FILE, read_truth
from lanenet.data.drives.motion import Motion, motion_of_commands, motion_of_poses
from lanenet.data.label_set import Source
from lanenet.data.maps.folder import SETTINGS_NAME, DriveMap, read_map
from lanenet.data.maps.frame_lines import FrameLines, lines_of_frame, parallel_line
from lanenet.errors import CalibrationError, DriveFormatError, LabelFormatError
from lanenet.geometry.birdseye import BirdseyeWindow
from lanenet.geometry.camera import Camera
from lanenet.geometry.lane import N_POINTS, POINT_NAMES, ROWS_CM, SIDES, STEEPEST, label_rows
from lanenet.perception.edges.road import PerceptionSettings

_log = logging.getLogger(__name__)

#: Times of a frame that differ by less are the same, and share of other ones above which a drive is another
#: one. Chosen: no table of times is rounded to more than a millisecond, and a drive recorded anew has other
#: times throughout.
_SAME_TIME_S, _MOST_OTHER_TIMES = 2e-3, 0.5
#: Sigma of a line's position above which it gives no label, in lane widths. Chosen: 1.4 cm of a 36 cm lane.
_MAX_SIGMA_LANES = 0.04
#: Why a frame gets no labels. The reports count frames under these keys.
DELETED, NO_LINE = "deleted", "no line in the window"
DOUBTFUL = "likely to be wrong"
NOT_MAPPED = "segment not mapped"
BETWEEN_LANES = "on the line between two lanes, or in a swerve beyond it"
#: A wrong map puts the car there, too; so these frames count against the map.
AWAY = "far beside the lane"
#: Of a wide lane or a tight bend, where the images agree with the map.
OUTSIDE = "both lines beside the window"
#: Frames that a complete map would not label either.
NOT_TO_LABEL = (DELETED, BETWEEN_LANES, OUTSIDE)


@dataclass(frozen=True, eq=False)
class MappedDrive:
    """A map and its drive.

    Attributes:
        drive_map: The map.
        drive: The drive.
        rows: Position in the drive of each of the map's frames.
        perception: How the map's edge points were found.
    """

    drive_map: DriveMap
    drive: Drive
    rows: Int[np.ndarray, "n"]
    perception: PerceptionSettings

    @cached_property
    def starts(self) -> Bool[np.ndarray, "n"]:
        """Frames of the map that do not continue the frame before them."""
        rows, segment = self.rows, self.drive_map.segment
        # Frames that could not be mapped leave a gap in the rows.
        starts = self.drive.breaks[rows] | (np.diff(rows, prepend=rows[0] - 2) != 1)
        return np.asarray(starts | (np.diff(segment, prepend=segment[0]) != 0))


def open_mapped_drive(map_folder: Path, drive_path: Path | None = None) -> MappedDrive:
    """Open a map folder and the drive that it names.

    Args:
        map_folder: Folder that :func:`datagen.pipeline.map_drive` wrote.
        drive_path: Where the drive is now, if it has moved since it was mapped.

    Raises:
        MapFormatError: If the map cannot be read.
        DriveFormatError: If the drive is not there, lacks a frame of the map, or was recorded anew.
        CalibrationError: If the map's camera is for images of another size.
    """
    drive_map = read_map(map_folder)
    source = drive_path if drive_path is not None else Path(drive_map.meta.drive)
    if not source.exists():
        hint = "" if source.is_absolute() else f", looked for from {Path.cwd()}"
        raise DriveFormatError(f"{source}: the drive of {map_folder} is not there{hint}")
    drive = open_drive(source)
    if (drive_map.camera.width, drive_map.camera.height) != (drive.width, drive.height):
        raise CalibrationError(
            f"{map_folder / 'camera.yaml'}: is for {drive_map.camera.width}x{drive_map.camera.height} px, "
            f"the images of {source} have {drive.width}x{drive.height}"
        )
    missing = np.setdiff1d(drive_map.frames, drive.frames)
    if missing.size:
        raise DriveFormatError(
            f"{source}: frame {int(missing[0])} of {map_folder} is not in it; map it anew: "
            f"{_map_again(drive_map, source, map_folder)}"
        )
    settings_path = map_folder / SETTINGS_NAME
    found = read_yaml(settings_path).get("perception", {})
    perception = check_settings(PerceptionSettings, found, f"{settings_path}: perception")
    mapped = MappedDrive(drive_map, drive, np.searchsorted(drive.frames, drive_map.frames), perception)
    check_images(mapped, map_folder)
    return mapped


def check_images(mapped: MappedDrive, map_folder: Path, every: bool = False) -> None:
    """Refuse a drive whose images are not those that were mapped: Donkeycar records into one folder again.

    Of a folder the times of the frames are compared, too: a map of an earlier version knows no more.

    Args:
        mapped: The map and its drive.
        map_folder: Its folder, for messages.
        every: Compare the bytes of all images; else their sizes, and the bytes of a sample.

    Raises:
        DriveFormatError: Says how many images differ, and what to type.
    """
    drive_map, drive = mapped.drive_map, mapped.drive.subset(mapped.rows)
    other, what = np.zeros(len(mapped.rows), dtype=bool), "images"
    if drive_map.marks is not None:
        other = other_images(drive, drive_map.marks, every)
    else:
        _warn(
            f"{map_folder}: is a map of an earlier version, which does not know the images that it was made "
            f"from: whether {drive.path} still holds them is not checked; map it anew to have it checked"
        )
    # Readers of videos have learned to read their times since.
    if not other.any() and drive.times_trusted and drive.path.is_dir():
        by_s = np.abs((drive.t_s - drive.t_s[0]) - (drive_map.t_s - drive_map.t_s[0]))
        other, what = by_s > _SAME_TIME_S, "times"
        other &= other.mean() > _MOST_OTHER_TIMES
    if other.any():
        raise DriveFormatError(
            f"{drive.path}: of {len(other)} frames of {map_folder} the {what} of {int(other.sum())} are not "
            f"those that were mapped (first: frame {drive.frames[other][0]}): the drive was recorded anew or "
            f"changed since; map it anew: {_map_again(drive_map, drive.path, map_folder)}"
        )


def _map_again(drive_map: DriveMap, drive_path: Path, map_folder: Path) -> str:
    """Return the command that maps the drive again, where it is now."""
    return drive_map.meta.model_copy(update={"drive": str(drive_path)}).command(map_folder)


def recorded_anew(map_folder: Path) -> list[str]:
    """Say why the drive of a map is not the one that was mapped; nothing if it is, or is not known to be."""
    drive_map = read_map(map_folder)
    drive = open_drive(Path(drive_map.meta.drive))
    rows = np.flatnonzero(np.isin(drive.frames, drive_map.frames))
    if len(rows) < len(drive_map.frames):
        return [
            f"{drive.path}: {len(drive_map.frames) - len(rows)} frames of {map_folder} are not in it any more"
        ]
    try:
        check_images(MappedDrive(drive_map, drive, rows, PerceptionSettings()), map_folder)
    except DriveFormatError as error:
        return [str(error)]
    return []


@cache
def _warn(text: str) -> None:
    """Log a warning once: a command opens its map several times."""
    _log.warning(text)


def lines_at(drive_map: DriveMap, k: int, max_sigma_lanes: float = _MAX_SIGMA_LANES) -> FrameLines:
    """Return the lane of the map's k-th frame, in its direction of travel.

    A line is left out where its sigma exceeds ``max_sigma_lanes`` lane widths or the images contradict it.
    """
    segment = int(drive_map.segment[k])
    return lines_of_frame(
        drive_map.lines[segment],
        drive_map.poses[k],
        float(drive_map.s_cm[k]),
        drive_map.camera.wheelbase_cm,
        int(drive_map.lanes.lane[k]),
        bool(drive_map.lanes.forward[k]),
        max_sigma_lanes * drive_map.meta.mapped_lane_cm,
        steepest_label(drive_map),
    )


def steepest_label(drive_map: DriveMap) -> float:
    """Return how steeply a line may cross a label row, in centimetres across for one along the car.

    What the camera leaves open along the car shows across, times this; it is bounded like a line's own sigma.
    """
    most_cm = _MAX_SIGMA_LANES * drive_map.meta.mapped_lane_cm
    return min(STEEPEST, most_cm / max(drive_map.meta.ahead_sigma_cm, 1e-9))


def label_frame(
    mapped: MappedDrive, k: int, window: BirdseyeWindow
) -> tuple[FrameLines, Float[np.ndarray, "6"]] | str:
    """Return the lane of the map's k-th frame and its six labels, or the reason why it has none.

    A frame has no labels if the driver deleted it, if the car is between two lanes or far beside its own, or
    if all its labels are likely to be wrong (:attr:`lanenet.data.maps.label_errors.LabelErrors.withheld`). A
    point is masked if it is likely to be wrong, if the map does not support it, or if it lies outside the
    window.
    """
    if mapped.drive.deleted[mapped.rows[k]]:
        return DELETED
    if mapped.drive_map.lanes.between[k]:
        return BETWEEN_LANES
    if mapped.drive_map.lanes.away[k]:
        return AWAY
    seen = lines_at(mapped.drive_map, k)
    visible = window.labelled(seen.points_cm)
    if not np.isfinite(visible).any():
        return NO_LINE
    seen = seen.without(mapped.drive_map.errors.withheld[k])
    visible = window.labelled(seen.points_cm)
    return (seen, visible) if np.isfinite(visible).any() else DOUBTFUL


@dataclass(frozen=True, eq=False)
class MapLabels:
    """The labels of a map's frames.

    Attributes:
        reasons: Why a frame has no labels; empty if it has some.
        lines: Lane of each frame; None if it has no labels.
        points_cm: Six labels of each frame; NaN where masked.
        in_window: Which points a complete map would label; none of frames that are not to be labelled.
    """

    reasons: list[str]
    lines: list[FrameLines | None]
    points_cm: Float[np.ndarray, "n 6"]
    in_window: Bool[np.ndarray, "n 6"]


def label_frames(mapped: MappedDrive, window: BirdseyeWindow) -> MapLabels:
    """Label every frame of a map, see :func:`label_frame` and :func:`points_in_window`."""
    n = len(mapped.rows)
    reasons, points_cm = [""] * n, np.full((n, N_POINTS), np.nan)
    lines: list[FrameLines | None] = [None] * n
    in_window = np.zeros(points_cm.shape, dtype=bool)
    for k in range(n):
        labelled = label_frame(mapped, k, window)
        if isinstance(labelled, str):
            reasons[k] = labelled
        else:
            lines[k], points_cm[k] = labelled
        if reasons[k] not in NOT_TO_LABEL:
            in_window[k] = points_in_window(mapped.drive_map, k, window)
        # A wrong map puts lines there, too, but then its labels are doubted.
        if reasons[k] == NO_LINE and not (in_window[k].any() or mapped.drive_map.errors.doubted[k].any()):
            reasons[k] = OUTSIDE
    return MapLabels(reasons, lines, points_cm, in_window)


def points_in_window(drive_map: DriveMap, k: int, window: BirdseyeWindow) -> Bool[np.ndarray, "6"]:
    """Find which of the six points of the map's k-th frame a complete map would label.

    An unknown line is expected parallel to the other one, at the lane's width. A point counts unless its line
    is known to lie outside the window or to turn away before the row.
    """
    lines = lines_at(drive_map, k, np.inf)
    lane_cm = drive_map.meta.mapped_lane_cm
    sides = [
        np.where(np.isfinite(own), own, parallel_line(other, across_cm))
        for own, other, across_cm in (
            (lines.left_cm, lines.right_cm, -lane_cm),
            (lines.right_cm, lines.left_cm, lane_cm),
        )
    ]
    steepest = steepest_label(drive_map)
    points = window.labelled(np.concatenate([label_rows(line, steepest) for line in sides]))
    unknown = np.concatenate([_rows_in_gaps(line) for line in sides])
    return np.asarray(np.isfinite(points) | unknown)


def _rows_in_gaps(line_car_cm: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, "3"]:
    """Find the label rows at which a line may lie in a section where it is unknown."""
    y_cm, known = line_car_cm[:, 1], np.isfinite(line_car_cm).all(axis=1)
    joined = known[:-1] & known[1:]
    met = [bool((joined & ((y_cm[:-1] <= row) != (y_cm[1:] <= row))).any()) for row in ROWS_CM]
    return np.array([not (known.all() or row_is_met) for row_is_met in met])


def labelled_points(
    points_cm: Float[np.ndarray, "n 6"], in_window: Bool[np.ndarray, "n 6"], not_mapped: int = 0
) -> dict[str, float]:
    """Share of each line's points in the window that are labelled.

    Args:
        points_cm: Labels of the frames that count; NaN where there is none.
        in_window: See :func:`points_in_window`.
        not_mapped: Further frames that are not mapped: none of their points is labelled.

    Returns:
        By side; a line without points in the window has no share.
    """
    half = N_POINTS // 2
    shares = {}
    for side, part in zip(SIDES, (slice(half), slice(half, None)), strict=True):
        wanted = in_window[:, part]
        count = int(wanted.sum()) + half * not_mapped
        if count:
            shares[side] = float((np.isfinite(points_cm[:, part]) & wanted).sum()) / count
    return shares


def points_text(shares: dict[str, float]) -> str:
    """Say the result of :func:`labelled_points` in words."""
    said = " and ".join(f"{100.0 * share:.0f} % of the {side} line's" for side, share in shares.items())
    return f"{said} points in the window have labels"


@dataclass(frozen=True, eq=False)
class LabelledFrames:
    """The frames of a drive, read on demand, with their labels.

    Frames without a label are included: a detector with a memory has to see them, as on the car.

    Attributes:
        name: The path, for messages.
        reference: ``truth`` for a simulator's labels, ``map`` for labels from a map made of the drive.
        camera: Camera of the frames.
        lane_width_cm: Between the middles of the lane's two lines.
        marking_cm: Width of the markings; None if unknown.
        perception: How edge points are found in these frames.
        frames: Frame numbers, increasing.
        starts: True where a frame does not continue the one before.
        points_cm: The six labels of each frame, frame car; NaN where there is none.
        image: Reads frame i (by position); DriveFormatError naming the file if it cannot.
        all_cm: As ``points_cm``, with the points that a simulator knows although they are no labels; None
            where the labels are all that is known.
        t_s: Time of each frame; None if unknown.
        motion: Motion of the car, commanded where that was recorded, else by its poses; None if unknown.
    """

    name: str
    reference: Source
    camera: Camera
    lane_width_cm: float
    marking_cm: float | None
    perception: PerceptionSettings
    frames: Int[np.ndarray, "n"]
    starts: Bool[np.ndarray, "n"]
    points_cm: Float[np.ndarray, "n 6"]
    image: Callable[[int], UInt8[np.ndarray, "h w 3"]] = field(repr=False)
    all_cm: Float[np.ndarray, "n 6"] | None = None
    t_s: Float[np.ndarray, "n"] | None = None
    motion: Motion | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def numbered(self, first: int, last: int) -> LabelledFrames:
        """Return the frames with numbers from first to last, both included.

        Raises:
            LabelFormatError: If there is none.
        """
        rows = np.flatnonzero((self.frames >= first) & (self.frames <= last))
        if not rows.size:
            raise LabelFormatError(f"{self.name}: no frame from {first} to {last}")
        return replace(
            self,
            frames=self.frames[rows],
            starts=self.starts[rows],
            points_cm=self.points_cm[rows],
            all_cm=None if self.all_cm is None else self.all_cm[rows],
            t_s=None if self.t_s is None else self.t_s[rows],
            motion=None if self.motion is None else self.motion.only(rows),
            image=partial(_image_at, self.image, rows),
        )


def _image_at(
    read: Callable[[int], UInt8[np.ndarray, "h w 3"]], rows: Int[np.ndarray, "n"], i: int
) -> UInt8[np.ndarray, "h w 3"]:
    """Read the image of row ``rows[i]``; at module level, so that it can be pickled."""
    return read(int(rows[i]))


def read_truth_frames(path: Path, window: BirdseyeWindow | None = None) -> LabelledFrames:
    """Read a simulated drive with its ground truth.

    Args:
        path: Drive folder with ``truth.csv``.
        window: Points outside this bird's-eye window have no label, as in label sets; None takes the default.

    Raises:
        DriveFormatError: If the drive has no truth, camera or lane width, or the truth does not have
            one row for each frame.
    """
    drive, truth = open_drive(path), read_truth(path)
    if truth is None or drive.camera is None or drive.lane_width_cm is None:
        missing = {TRUTH_FILE: truth, "a camera": drive.camera, "a lane width": drive.lane_width_cm}
        raise DriveFormatError(
            f"{path}: comes without {' and '.join(name for name, part in missing.items() if part is None)}, "
            "expected a simulated drive; for labels of another drive map it, and give the map"
        )
    if not np.array_equal(truth["frame"], drive.frames):
        raise DriveFormatError(
            f"{path / TRUTH_FILE}: {len(truth['frame'])} rows for {len(drive)} frames, or rows of other "
            "frames; expected a row for each frame"
        )
    window = BirdseyeWindow() if window is None else window
    starts = drive.breaks.copy()
    starts[0] = True
    all_cm = np.stack([truth[name] for name in POINT_NAMES], axis=1)
    poses = np.stack([truth[name] for name in ("x_cm", "y_cm", "heading_rad")], axis=1)
    return LabelledFrames(
        name=str(path),
        reference="truth",
        camera=drive.camera,
        lane_width_cm=drive.lane_width_cm,
        marking_cm=None,
        perception=PerceptionSettings(),
        frames=drive.frames,
        starts=starts,
        points_cm=window.labelled(all_cm),
        image=drive.image,
        all_cm=all_cm,
        t_s=drive.t_s,
        motion=_motion(drive, poses, starts, drive.camera.wheelbase_cm),
    )


def read_map_frames(
    map_folder: Path, window: BirdseyeWindow | None = None, drive_path: Path | None = None
) -> LabelledFrames:
    """Read the frames of a mapped drive with their labels.

    The labels are those of :func:`datagen.labels.label_map.label_map`; frames without a label are kept.

    Args:
        map_folder: Folder of the map.
        window: Points outside this bird's-eye window have no label; None takes the default.
        drive_path: Where the drive is now, if it has moved since it was mapped.

    Raises:
        LanenetError: As :func:`open_mapped_drive`.
    """
    mapped = open_mapped_drive(map_folder, drive_path)
    drive, drive_map, rows = mapped.drive, mapped.drive_map, mapped.rows
    window = BirdseyeWindow() if window is None else window
    return LabelledFrames(
        name=str(map_folder),
        reference="map",
        camera=drive_map.camera,
        lane_width_cm=drive_map.meta.lane_cm,
        marking_cm=drive_map.meta.tape_cm,
        perception=mapped.perception,
        frames=drive_map.frames,
        starts=mapped.starts,
        points_cm=label_frames(mapped, window).points_cm,
        image=partial(_image_at, drive.image, rows),
        t_s=drive_map.t_s,
        motion=_motion(drive.subset(rows), drive_map.poses, mapped.starts, drive_map.camera.wheelbase_cm),
    )


def _motion(
    drive: Drive, poses: Float[np.ndarray, "n 3"], starts: Bool[np.ndarray, "n"], wheelbase_cm: float
) -> Motion:
    """Return the motion as it was commanded, or by the poses where that was not recorded."""
    commanded = motion_of_commands(drive.commands, drive.t_s, starts, wheelbase_cm)
    return motion_of_poses(poses, starts, wheelbase_cm) if commanded is None else commanded
