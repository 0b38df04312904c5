"""``lanenet detect``: any detector over a photo, a video, a drive or a tub."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import (
    AnyCameraOption,
    FramesOption,
    MarkingOption,
    ModelOption,
    check_not_source,
    frame_range,
    lane_cm,
    lock_outputs,
)
from lanenet.cli.shared.standing import next_on_car
from lanenet.cli.shared.viewing import NO_VIEWS, Views, with_viewers
from lanenet.config import read_yaml
from lanenet.errors import (
    CalibrationError,
    DriveFormatError,
    LanenetError,
    UnreadableFrameError,
    counted,
)
from lanenet.perception.edges.road import PerceptionSettings
from lanenet.perception.estimate import DetectorInputs
from lanenet.perception.registry import (
    KINDS,
    build_detector,
    detector_for,
    detector_names,
    kind_of,
    listed,
    refuse_mask,
)

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import UInt8

    from lanenet.data.drives.sources import Source
    from lanenet.evaluation.detect import DetectReport, SeenFrame
    from lanenet.geometry.camera import Camera
    from lanenet.perception.estimate import Detector, LaneMemory
    from lanenet.viewers.mapped import MapToSee

    DetectorName = str
else:
    DetectorName = StrEnum("DetectorName", {name: name for name in KINDS})

app = typer.Typer()

_WITHOUT_CAMERA = listed(detector_names(lambda kind: not kind.needs_camera))
_WITH_LANE_WIDTH = listed(detector_names(lambda kind: kind.takes_lane_width))
_WITH_SETTINGS = listed(detector_names(lambda kind: kind.settings is not None), "or")
_WITH_MASK = listed(detector_names(lambda kind: kind.takes_mask))


@app.command(
    epilog="Example: lanenet detect tub --model checkpoints/general --camera runs/my_map --out runs/lanes.csv"
)
@with_viewers
def detect(
    source: Annotated[
        Path,
        typer.Argument(metavar="SOURCE", help="Photo, folder of photos, video, drive, tub, or a map of one."),
    ],
    out: Annotated[Path, typer.Option(help="Table to write (.parquet or .csv).")],
    model: ModelOption = None,
    detector: Annotated[
        DetectorName | None, typer.Option(help="Which detector; --model alone means the network.")
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", help=f"Camera YAML, or a map of the same car; {_WITHOUT_CAMERA} need none."),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(help="Annotated video to write (.mp4); of one photo a picture (.png, .jpg)."),
    ] = None,
    lane_width: Annotated[
        float | None,
        typer.Option(
            parser=lane_cm,
            metavar="CM",
            help=f"Lane width for {_WITH_LANE_WIDTH}, cm; default: from the settings file or the drive.",
        ),
    ] = None,
    marking: MarkingOption = None,
    any_camera: AnyCameraOption = False,
    frames: FramesOption = None,
    skip_unreadable: Annotated[
        bool, typer.Option("--skip-unreadable", help="Give unreadable frames an empty row and continue.")
    ] = False,
    config: Annotated[
        Path | None,
        typer.Option(help=f"YAML with the settings of {_WITH_SETTINGS}."),
    ] = None,
    mask: Annotated[
        str | None,
        typer.Option(
            help=f"Ignore the car itself, for {_WITH_MASK}: 'auto' finds what never moves; "
            "or a PNG that is black except on the car.",
            metavar="auto|FILE.png",
        ),
    ] = None,
    views: Views = NO_VIEWS,
) -> None:
    """Run a detector over a photo, a video, a drive or a tub."""
    numbers = None if frames is None else frame_range(frames)
    asked = Asked(
        source,
        out,
        model=model,
        detector=detector,
        camera=camera,
        video=video,
        lane_width_cm=lane_width,
        marking_cm=marking,
        any_camera=any_camera,
        frames=numbers,
        skip_unreadable=skip_unreadable,
        config=config,
        mask=mask,
    )
    report, chosen = detect_lanes(asked, views)
    console.show_problems(report.problems)
    console.say(
        f"{counted(report.frames, 'frame')}, {report.complete} with all six points, {report.steered} with a "
        f"steering target; {report.median_ms:.2f} ms per frame (median), {report.p99_ms:.2f} ms (p99)"
    )
    if lane_width is None and (told := _used_width(chosen, report.width_cm)):
        console.say(told)
    hint = getattr(chosen, "hint", "")
    if hint:
        console.say(f"hint: {hint}")
    console.wrote(report.out, report.video, *views.files)
    if report.video is None:
        drawn = out.with_suffix(".png" if report.frames == 1 else ".mp4")
        if drawn.resolve() == source.resolve():
            drawn = drawn.with_stem(f"{drawn.stem}_lanes")
        again = {
            "--detector": detector,
            "--model": model,
            "--camera": camera,
            "--lane-width": lane_width,
            "--marking": marking,
            "--any-camera": any_camera,
            "--frames": frames,
            "--skip-unreadable": skip_unreadable,
            "--config": config,
            "--mask": mask,
            "--out": out,
            "--video": drawn,
        }
        console.next_command("detect", source, *console.given(again))
    elif report.complete and not hint:
        next_on_car()


def _used_width(detector: Detector, seen_cm: float) -> str:
    """Say of which lane width a detector that can be told one answered; empty if it cannot, or of none."""
    memory: LaneMemory | None = getattr(detector, "memory", None)
    if memory is None:
        return ""
    if memory.given_cm is not None:
        return f"lane width: {memory.given_cm:g} cm, that of the source"
    if math.isnan(seen_cm):
        return ""
    return f"lane width: not given; the answers are of {seen_cm:.0f} cm (--lane-width CM, if that is wrong)"


@dataclass(frozen=True)
class Asked:
    """What a run of a detector is asked for: the options of ``lanenet detect``.

    Attributes:
        source: Photo, folder of photos, video, drive, tub, or a map of one.
        out: Table to write.
        model, detector, camera, video, marking_cm, any_camera, skip_unreadable, config, mask: As there.
        lane_width_cm: Between the middles of the lane's two lines.
        frames: First and last number of the frames; None for all.
    """

    source: Path
    out: Path
    model: Path | None = None
    detector: str | None = None
    camera: Path | None = None
    video: Path | None = None
    lane_width_cm: float | None = None
    marking_cm: float | None = None
    any_camera: bool = False
    frames: tuple[int, int] | None = None
    skip_unreadable: bool = False
    config: Path | None = None
    mask: str | None = None


def detect_lanes(asked: Asked, views: Views = NO_VIEWS) -> tuple[DetectReport, Detector]:
    """Run a detector as the command does, with its progress and without its words; also returns the detector.

    Raises:
        LanenetError: If the source, the model or the camera cannot be used, or an output cannot be written.
    """
    from lanenet.data.camera_file import read_camera
    from lanenet.data.detections import check_table_path
    from lanenet.data.drives.sources import check_size
    from lanenet.evaluation.detect import run_detector

    name = detector_for(asked.detector, asked.model)
    source, out, video = asked.source, asked.out, asked.video
    check_not_source(source, out, video)
    lock_outputs(out, video)
    views.check(source)
    check_table_path(out)
    whole, of_map = _open(source, out, video)
    camera = asked.camera or of_map
    if asked.camera is not None:
        earlier = _other_recording(asked.camera, Path(whole.name))
        console.show_problems([f"{why}; its camera is used all the same" for why in earlier])
    opened = whole if asked.frames is None else whole.numbered(*asked.frames)
    used_camera = read_camera(camera) if camera is not None else opened.camera
    if used_camera is not None:
        check_size(opened, used_camera, camera or source)
    elif kind_of(name).needs_camera:
        raise CalibrationError(
            f"{source}: has no camera, expected --camera with a camera file or a map; {opened.way_to_camera}"
        )
    inputs = DetectorInputs(
        camera=used_camera,
        model=asked.model,
        any_camera=asked.any_camera,
        lane_width_cm=asked.lane_width_cm,
        drive_lane_width_cm=opened.lane_width_cm,
        marking_cm=asked.marking_cm,
        mask=_mask_of(asked.mask, whole, name),
        config=asked.config,
    )
    chosen = build_detector(name, inputs)
    console.show_problems(getattr(chosen, "problems", ()))
    with ExitStack() as stack:
        watch = (
            _watch(views, stack, opened, chosen, used_camera, _map_of(camera, Path(opened.name)))
            if views
            else None
        )
        progress = stack.enter_context(console.progress_bar(f"detect ({name})"))
        try:
            report = run_detector(
                opened,
                chosen,
                used_camera,
                out,
                video,
                progress,
                skip_unreadable=asked.skip_unreadable,
                watch=watch,
            )
        except UnreadableFrameError as error:
            way_on = "--skip-unreadable leaves such frames out, with an empty row"
            raise UnreadableFrameError(f"{error}; {way_on}") from None
    return report, chosen


def _open(source: Path, *outs: Path | None) -> tuple[Source, Path | None]:
    """Open the frames; of a map those of its drive with its lane width, and the map, which has the camera."""
    from lanenet.data.drives.sources import open_source

    if not any((source / name).is_file() for name in ("map.yaml", "refused.yaml")):
        return open_source(source), None
    # Not before: maps need SciPy, which the car does not have.
    from lanenet.data.maps.folder import read_map_meta

    meta = read_map_meta(source)
    drive = Path(meta.drive)
    if not drive.exists():
        raise DriveFormatError(
            f"{source}: the drive of this map, {drive}, is not there: type where it is now, with "
            f"--camera {source}"
        )
    check_not_source(drive, *outs)
    if other := _other_recording(source, drive):
        raise DriveFormatError(f"{other[0]}; for the map's camera alone give {drive} with --camera {source}")
    console.say(f"{source} is a map: its drive {drive} is read, with its camera and lane width")
    return replace(open_source(drive), lane_width_cm=meta.lane_cm), source


def _map_of(camera: Path | None, drive: Path) -> MapToSee | None:
    """Open the map of a drive, where the camera was given as that map; None otherwise."""
    if camera is None or not _is_map_of(camera, drive):
        return None
    from lanenet.viewers.mapped import MapToSee

    return MapToSee(camera)


def _is_map_of(folder: Path, drive: Path) -> bool:
    file = folder / "map.yaml"
    return file.is_file() and Path(str(read_yaml(file).get("drive"))).resolve() == drive.resolve()


def _other_recording(folder: Path, drive: Path) -> list[str]:
    """Say that a map was made of an earlier recording in the drive's folder; nothing if it was not."""
    if not _is_map_of(folder, drive):
        return []
    try:
        from lanenet.data.maps.mapped_drive import recorded_anew

        return recorded_anew(folder)
    except (ImportError, LanenetError):  # the car has no SciPy; and the camera of a damaged map is whole
        return []


def _watch(
    views: Views,
    stack: ExitStack,
    source: Source,
    detector: Detector,
    camera: Camera | None,
    mapped: MapToSee | None,
) -> Callable[[SeenFrame], None]:
    """Open the viewers, until the stack ends; returns what shows them a frame, in its place on the map."""
    from lanenet.evaluation.detect import ONE
    from lanenet.viewers.seen import Scene, Seen, error_cm, lane_of, values_of

    meta = getattr(detector, "meta", None)
    perception = PerceptionSettings() if meta is None else meta.perception
    plain = Scene(source.name, camera, perception)
    scene = plain if mapped is None else replace(mapped.scene, name=source.name, perception=perception)
    recording = stack.enter_context(views.record(scene))

    def watch(found: SeenFrame) -> None:
        estimate, i = found.estimates[ONE], found.index
        lane = lane_of(estimate, getattr(detector, "last", None) if found.image is not None else None)
        frame, t_s = int(source.frames[i]), float(source.t_s[i])
        seen = Seen(frame, t_s, found.image, {"detected": lane}, values_of(estimate), reason=estimate.reason)
        if mapped is not None:
            seen = mapped.add_to(seen)
            if "reference" in seen.lanes:
                off_cm = error_cm(estimate.points_cm, seen.lanes["reference"].points_cm)
                seen = replace(seen, values={**seen.values, "error_cm": off_cm})
        recording.add(seen)

    return watch


def _mask_of(mask: str | None, source: Source, detector: str) -> UInt8[np.ndarray, "h w"] | None:
    """Find or read the mask, and print what was found."""
    from lanenet.data.drives.sources import find_mask, read_mask

    if mask is None:
        return None
    refuse_mask(detector)
    if mask != "auto":
        return read_mask(Path(mask))
    found, message = find_mask(source)
    console.say(message)
    return found
