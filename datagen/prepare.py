"""First stage of mapping: from a recording to the frames that can be tracked, or a refusal."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.quality.measure import held_out_frames
from datagen.settings import MapSettings, with_wheelbase
from datagen.slam.commands import habitual_pauses
from datagen.slam.odometry.likely import MOST_POINTS
from datagen.slam.odometry.stillness import following_frames, shrink_image
from lanenet.data.camera_file import read_camera
from lanenet.data.drives import Commands, Drive, open_drive
from lanenet.data.drives.content import image_marks
from lanenet.data.drives.recording import COMMAND_NAMES, MAX_PAUSE_S, ImageSource
from lanenet.data.segments import true_runs
from lanenet.errors import CalibrationError, DriveFormatError, NoLaneError, TrackingLostError, counted
from lanenet.geometry.camera import Camera
from lanenet.perception.edges.canny import EdgeSettings, find_edges
from lanenet.perception.edges.static import find_static, lens_circle_px, spread_frames

#: Frames of a drive at least, and of what hangs together of it. Chosen: three seconds at 20 frames a second;
#: the steering is fitted to 50.
LEAST_FRAMES = 60
#: Memory for the images of a drive; the rest is read again. About 1100 frames of 320 x 240 px.
MOST_IMAGE_BYTES = 250_000_000
#: Frames looked at, evenly over the drive. Chosen: enough for a median, and quick.
_CHECKED = 40
#: Mean difference below which frames from all over a drive are the same, [gray levels] of block means.
#: Chosen: sensor noise of block means is a few tenths.
_SAME = 1.0
#: The same, for noisy images: below the first they are the same if distant frames differ less than the second
#: times as much as neighbours. Chosen: noise and flicker change both alike, motion changes distant frames
#: more.
_NOISY_SAME, _NOISY_RATIO = 4.0, 1.3
#: Least median number of edge points in the lower two thirds of a frame. Chosen: a border of one line, 20 px
#: long.
_LEAST_EDGES = 20
#: Share of frames without a readable image above which a drive is not mapped. Chosen: more is no accident.
_UNREADABLE_SHARE = 0.1


@dataclass(frozen=True)
class MapRequest:
    """What is to be mapped, and what is known about it.

    Attributes:
        drive_path: Drive folder, Donkeycar tub or video.
        lane_width_cm: Distance between the middles of the two lines of the driven lane. It sets the scale
            where the camera is not known.
        camera_path: Camera file; None takes the drive's own, or calibrates from the drive.
        refine_camera: Adjust a known camera together with the poses; its height stays and sets the scale.
        wheelbase_cm: Distance between the axles; None takes the camera's own, or a nominal one.
        camera_height_cm: Height of the lens above the road, for a camera that is to be found: together with
            the lane width it determines the focal length. None if it was not measured.
        tape_width_cm: Width of the tape, with which the scale is checked. None if it was not measured.
        frames: First and last number of the frames to map; None for the whole recording.
    """

    drive_path: Path
    lane_width_cm: float
    camera_path: Path | None = None
    refine_camera: bool = False
    wheelbase_cm: float | None = None
    camera_height_cm: float | None = None
    tape_width_cm: float | None = None
    frames: tuple[int, int] | None = None

    @property
    def options(self) -> tuple[str, ...]:
        """Options of ``lanenet map`` that ask for this, but for the lane width."""
        lengths = {
            "--wheelbase": self.wheelbase_cm,
            "--camera-height": self.camera_height_cm,
            "--tape-width": self.tape_width_cm,
        }
        words = [] if self.camera_path is None else ["--camera", str(self.camera_path.resolve())]
        words += ["--refine-camera"] * self.refine_camera
        words += [word for name, cm in lengths.items() if cm is not None for word in (name, f"{cm:g}")]
        words += [] if self.frames is None else ["--frames", f"{self.frames[0]}:{self.frames[1]}"]
        return tuple(words)

    def open_drive(self) -> Drive:
        """Open the frames of the recording that are to be mapped.

        Raises:
            DriveFormatError: If the recording cannot be read, or has none of them.
        """
        drive = open_drive(self.drive_path)
        return drive if self.frames is None else drive.numbered(*self.frames)


@dataclass(frozen=True)
class PreparedDrive:
    """A drive that can be tracked.

    Attributes:
        request: What was asked for.
        drive: The frames in which the car drives forward.
        held_out: Frames whose edge points are held out from the lines.
        settings: Settings, with the drive's wheelbase and without the rows in which the car sees itself.
        camera: The camera, where it is known.
        notes: What was left out or assumed, a sentence each.
        pauses: How often the recording pauses, if it does so again and again.
        marks: By what the image of each frame is known again, see
            :func:`lanenet.data.drives.content.image_marks`; none if it is not to be.
    """

    request: MapRequest
    drive: Drive
    held_out: Bool[np.ndarray, "n"]
    settings: MapSettings
    camera: Camera | None
    notes: tuple[str, ...]
    pauses: int = 0
    marks: tuple[str, ...] = ()

    @property
    def known_lane_cm(self) -> float | None:
        """Lane width in the scale of the camera; None where it still sets the scale."""
        return None if self.camera is None else self.request.lane_width_cm


def prepare(request: MapRequest, settings: MapSettings) -> PreparedDrive:
    """Open a recording, and keep the frames in which the car drives forward.

    Raises:
        TrackingLostError: If the car stands still, or there are too few frames of a car that drives.
        CalibrationError: If the known camera is for images of another size, or another height was given; or
            if the images are those of a full-circle fisheye, and the camera is not known.
        DriveFormatError: If the recording cannot be read.
    """
    stored = request.open_drive()
    # Before the images are used: what is recorded over them meanwhile is not what was mapped.
    marks = dict(zip(stored.rows.tolist(), image_marks(stored), strict=True))
    opened = keep_images(stored)
    recorded, unreadable = readable_frames(opened)
    check_count(recorded)
    check_moving(recorded)
    notes = [*recorded.problems, *unreadable, *_command_notes(recorded)]
    if request.frames is not None:
        notes.append(f"only the frames from {recorded.frames[0]} to {recorded.frames[-1]} were asked for")
    drive, found = following_frames(recorded)
    drive, deleted = without_deleted(drive)
    check_count(drive)
    # Deleted frames get no labels; where the car leaves the road, they show nothing of the lines.
    held_out = held_out_frames(len(drive), settings.held_out_every, settings.seed) & ~drive.deleted
    known = read_camera(request.camera_path) if request.camera_path is not None else drive.camera
    settings, known, nominal = with_wheelbase(settings, known, request.wheelbase_cm)
    settings, hidden = hide_bumper(drive, settings)
    if known is None:
        check_lens(drive)
    else:
        check_size(known, drive, request.camera_path)
        if request.camera_height_cm is not None:
            raise CalibrationError(
                f"{request.camera_path or drive.path}: the camera is known, {known.mounting.height_cm:g} cm "
                f"high, but --camera-height gives {request.camera_height_cm:g} cm: expected one of them"
            )
    notes += [*found, *deleted, *nominal, *hidden, *_texture_notes(drive, settings.perception.edges)]
    pauses = habitual_pauses(opened)
    of_frames = tuple(marks[row] for row in drive.rows.tolist())
    return PreparedDrive(request, drive, held_out, settings, known, tuple(notes), pauses, of_frames)


class KeptImages:
    """Images kept in memory after the first read, because mapping reads every frame a dozen times.

    The first ones are kept until they take up too much.
    """

    def __init__(self, source: ImageSource, most_bytes: int = MOST_IMAGE_BYTES) -> None:
        self._source, self._free = source, most_bytes
        self._kept: dict[int, UInt8[np.ndarray, "h w 3"]] = {}

    def read(self, row: int) -> UInt8[np.ndarray, "h w 3"]:
        """Read one image, which must not be drawn on."""
        kept = self._kept.get(row)
        if kept is not None:
            return kept
        image = self._source.read(row)
        if image.nbytes <= self._free:
            self._free -= image.nbytes
            image.flags.writeable = False
            self._kept[row] = image
        return image


def keep_images(drive: Drive) -> Drive:
    """Return the drive with images that are read once, as far as they fit into memory."""
    return replace(drive, images=KeptImages(drive.images))


def readable_frames(drive: Drive) -> tuple[Drive, list[str]]:
    """Leave out frames whose image cannot be read: a power cut leaves empty ones behind.

    Returns:
        The drive that is left, and a note on what was left out.

    Raises:
        DriveFormatError: If these are more than a few; says how many, and what is wrong with the first.
    """
    errors: dict[int, DriveFormatError] = {}
    for k in range(len(drive)):
        try:
            drive.image(k)
        except DriveFormatError as error:
            errors[k] = error
    if not errors:
        return drive, []
    first = next(iter(errors.values()))
    if len(errors) > _UNREADABLE_SHARE * len(drive):
        raise DriveFormatError(
            f"{drive.path}: {len(errors)} of {len(drive)} images cannot be read, expected at most "
            f"{_UNREADABLE_SHARE:.0%}; the first: {first}"
        )
    kept = np.setdiff1d(np.arange(len(drive)), list(errors))
    return drive.subset(kept), [f"{len(errors)} images cannot be read and are left out, the first: {first}"]


def without_deleted(drive: Drive) -> tuple[Drive, list[str]]:
    """Leave out the long sections that the driver deleted: there the car left the road, or was carried.

    Poses that follow such motion draw the lines away from the tape. Short sections stay, though they get no
    labels: they hold together what lies before and after them.

    Returns:
        The drive that is left, and a note on what was left out.
    """
    seconds = drive.t_s
    out = np.zeros(len(drive), dtype=bool)
    for run in true_runs(drive.deleted):
        out[run] = seconds[run[-1]] - seconds[run[0]] > MAX_PAUSE_S
    if not out.any() or len(drive) - out.sum() < LEAST_FRAMES:
        return drive, []
    return drive.subset(~out), [f"{out.sum()} frames are left out, long sections that the driver deleted"]


def _throttle_notes(commands: Commands) -> list[str]:
    """Say what the sign of the throttle is taken for, where it is not the usual one."""
    if commands.speed_cm_s is not None or commands.throttle is None:
        return []
    negative = float(np.mean(commands.throttle < 0.0))
    if negative <= float(np.mean(commands.throttle > 0.0)):
        return []
    return [
        f"the throttle is negative in {100.0 * negative:.0f} % of the frames: taken as driving forward; a "
        "drive in reverse gives no good map"
    ]


def _command_notes(drive: Drive) -> list[str]:
    """Say that a drive has no commands, and where they are expected if it is a single file."""
    commands = drive.commands
    if any(getattr(commands, name) is not None for name in COMMAND_NAMES):
        return _throttle_notes(commands)
    table = drive.path.with_suffix(".csv")
    expected = "" if drive.path.is_dir() else f" (expected in {table}, with frame and t_s)"
    return [
        f"the drive has neither speed nor steering{expected}: the images alone decide, and pauses of the "
        "recording or a reversed steering are not seen"
    ]


def check_lens(drive: Drive) -> None:
    """Refuse a full-circle fisheye where the camera is to be found: its lens is beyond the search.

    Raises:
        CalibrationError: Names the circle.
    """
    frames = np.unique(np.linspace(0, len(drive) - 1, _CHECKED).astype(int)).tolist()
    radius_px = lens_circle_px(drive.image(k) for k in frames)
    if radius_px is not None:
        raise CalibrationError(
            f"{drive.path}: the images show a circle with a radius of {radius_px:.0f} px in black, as a "
            "fisheye of about 180 degrees does, and such a lens is not found from a drive; calibrate it with "
            "photos of a chessboard (lanenet calibrate chessboard) and give it with --camera"
        )


def check_count(drive: Drive) -> None:
    """Refuse a drive with too few frames to map.

    Raises:
        TrackingLostError: Names the number of frames.
    """
    if len(drive) < LEAST_FRAMES:
        raise TrackingLostError(
            f"{drive.path}: found {counted(len(drive), 'frame')} of a car that drives, expected "
            f"{LEAST_FRAMES} at least"
        )


def hide_bumper(drive: Drive, settings: MapSettings) -> tuple[MapSettings, tuple[str, ...]]:
    """Leave out the lowest rows in which the car sees itself.

    The rows become part of the perception settings, so that labels, model and car leave out the same ones.
    They are whole rows: masks of two drives of one car differ in some pixels, and label sets whose edge
    points were found differently are not trained on together.

    Returns:
        The settings, and a note where something was found.
    """
    if not settings.find_bumper or settings.perception.range.bottom_rows:
        return settings, ()
    try:
        static = find_static(drive.image(k) for k in spread_frames(len(drive)))
    except DriveFormatError:  # too few frames of a moving car to tell it from the road
        return settings, ()
    if not static.rows:
        return settings, ()
    if static.is_too_high:
        note = f"something in the lowest {static.rows} rows never moves; set bottom_rows if it is the car"
        return settings, (note,)
    limits = settings.perception.range.model_copy(update={"bottom_rows": static.rows})
    perception = settings.perception.model_copy(update={"range": limits})
    note = f"the car sees itself in the lowest {static.rows} rows, which are left out"
    return settings.model_copy(update={"perception": perception}), (note,)


def check_size(camera: Camera, drive: Drive, camera_path: Path | None) -> None:
    """Refuse a camera for images of another size.

    Raises:
        CalibrationError: Names both sizes.
    """
    if (camera.width, camera.height) != (drive.width, drive.height):
        raise CalibrationError(
            f"{camera_path or drive.path}: the camera is for {camera.width}x{camera.height} px, "
            f"the images of {drive.path} have {drive.width}x{drive.height}: expected the camera that took "
            "them, at this size; without --camera it is found from the drive"
        )


def check_moving(drive: Drive) -> None:
    """Refuse a drive whose images do not change.

    Raises:
        TrackingLostError: If the car stands still; names the changes.
    """
    at = np.unique(np.linspace(0, len(drive) - 2, _CHECKED).astype(int))
    blocks = np.array([[_blocks(drive, int(k) + d) for d in (0, 1)] for k in at])
    neighbours = float(np.median(_difference(blocks[:, 0], blocks[:, 1])))
    # A third of the drive apart, so that a lap driven twice is not compared with itself.
    spread = float(np.median(_difference(blocks[:, 0], np.roll(blocks[:, 0], len(at) // 3, axis=0))))
    if spread < _SAME or (spread < _NOISY_SAME and spread < _NOISY_RATIO * neighbours):
        raise TrackingLostError(
            f"{drive.path}: the car stands still: {len(drive)} frames, which differ by {spread:.1f} gray "
            f"levels from distant ones and by {neighbours:.1f} from their neighbours; mapping needs a "
            "moving car"
        )


def check_edges(drive: Drive, settings: EdgeSettings) -> None:
    """Refuse a drive with hardly any edges on the road, before the camera is searched for.

    Raises:
        NoLaneError: Names the number of edge points.
    """
    count = _usual_edges(drive, settings)
    if count < _LEAST_EDGES:
        raise NoLaneError(
            f"{drive.path}: {count:.0f} edge points in the lower two thirds of a frame, expected "
            f"{_LEAST_EDGES} at least: no line is visible"
        )


def _texture_notes(drive: Drive, settings: EdgeSettings) -> list[str]:
    """Say how many edge points are left out where the floor has a strong texture."""
    count = _usual_edges(drive, settings)
    if count <= MOST_POINTS:
        return []
    return [
        f"the floor has a strong texture: {count:,.0f} edge points in the lower two thirds of a frame, the "
        f"median; mapping uses at most {MOST_POINTS:,} of a frame, those most like borders of a marking"
    ]


def _usual_edges(drive: Drive, settings: EdgeSettings) -> float:
    """Median number of edge points in the lower two thirds of a frame.

    The horizon is unknown without a camera; below the upper third most cameras show road, and a steep one
    shows its lines hardly any lower.
    """
    frames = np.unique(np.linspace(0, len(drive) - 1, _CHECKED).astype(int)).tolist()
    lower = (drive.image(k)[drive.height // 3 :] for k in frames)
    return float(np.median([len(find_edges(image, settings).uv_px) for image in lower]))


def _blocks(drive: Drive, k: int) -> Float[np.ndarray, "d"]:
    """Block means of a frame relative to its brightness: suppresses noise and flicker."""
    small = shrink_image(drive.image(k)).astype(np.float64)
    return (small - small.mean()).ravel()


def _difference(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.abs(a - b).mean(axis=1))
