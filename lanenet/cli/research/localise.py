"""``lanenet localise``: the particle filter alone, on a recording or on a running camera."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import (
    MappingOption,
    check_beside,
    check_ending,
    check_not_source,
    lock_outputs,
)
from lanenet.errors import CalibrationError, ConfigError, HardwareError, counted

if TYPE_CHECKING:
    from datagen.localise.live_filter import LiveFrame
    from datagen.localise.localise import LiveReport
    from lanenet.onboard.devices import FrameSource

app = typer.Typer()
log = logging.getLogger(__name__)

#: Longest wait for a frame, and so the longest until a signal is answered; chosen: three frames at 30/s.
_WAIT_S = 0.1


@app.command(
    epilog="Example: lanenet localise data/tub --camera runs/tub/camera.yaml "
    "--config runs/tub/settings.yaml --out runs/poses.csv; "
    "lanenet localise --live car.yaml --out runs/poses.csv"
)
def localise(
    out: Annotated[
        Path,
        typer.Option(help="Poses to write, frame by frame (.csv); beside it a .tum and a .png."),
    ],
    source: Annotated[
        Path | None,
        typer.Argument(metavar="SOURCE", help="Drive, tub or video; none with --live."),
    ] = None,
    live: Annotated[
        Path | None,
        typer.Option(metavar="CONFIG", help="YAML of the car, as for drive: use its running camera."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option("--camera", help="Camera YAML; default: the drive's or the car's."),
    ] = None,
    config: MappingOption = None,
    factor: Annotated[
        float | None,
        typer.Option(
            min=1e-3,
            help="Typical step length, cm per frame; with a recorded speed, its gain. Default: estimated.",
        ),
    ] = None,
    start_frames: Annotated[
        int, typer.Option(min=60, help="Frames from which speed and steering are found.")
    ] = 300,
    speed: Annotated[
        float | None,
        typer.Option(
            min=1e-3, help="With --live: how fast the car is driven, cm/s. Default: the CONFIG's cruise_cm_s."
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="With --live: end after this many frames.")
    ] = None,
) -> None:
    """Run the particle filter alone, as on the car: one pose per frame, in bounded memory."""
    from datagen.localise.live_filter import StartSettings, live_frames
    from datagen.localise.localise import localise as run
    from datagen.settings import MapSettings
    from lanenet.config import load_settings
    from lanenet.data.camera_file import read_camera
    from lanenet.data.drives import open_drive

    check_ending(out, ".csv")
    lock_outputs(out)
    given = source if live is None else live
    if given is None or (source is not None and live is not None):
        raise ConfigError(
            "expected either SOURCE or --live CONFIG, found " + ("both" if given else "neither")
        )
    beside = (out.with_suffix(".tum"), out.with_suffix(".png"))
    check_not_source(given, out, *beside)
    check_beside(out, *beside)
    settings = MapSettings() if config is None else load_settings(MapSettings, config)
    start = StartSettings(frames=start_frames, factor=factor)
    if live is None:
        drive = open_drive(given)
        known = read_camera(camera) if camera is not None else drive.camera
        if known is None:
            raise CalibrationError(
                f"{source}: has no camera, expected --camera camera.yaml; "
                "lanenet map writes one into the map's folder"
            )
        with console.progress_bar("localise") as progress:
            recorded = live_frames(drive)
            report = run(recorded, known, settings, out, start, lambda done: progress(done, len(drive)))
        _show(report)
        console.next_command("map", given, "--lane-width", "CM", "--out", "MAP")
        return
    from lanenet.onboard.cameras import open_source
    from lanenet.onboard.drive import load_drive_settings

    car = load_drive_settings(live)
    chosen = camera if camera is not None else car.camera
    if chosen is None:
        raise CalibrationError(f"{live}: key 'camera' is missing: expected one, or --camera camera.yaml")
    cruise_cm_s = car.control.speed.cruise_cm_s if speed is None else speed
    running = CameraFrames(open_source(car.source), cruise_cm_s, frames)
    with console.live_line() as show:
        report = run(
            running,
            read_camera(chosen),
            settings,
            out,
            start,
            lambda done: show(lambda: f"{done} frames, {running.skipped} left out"),
        )
    _show(report)
    if running.failure is not None:
        raise running.failure
    console.next_command("drive", live, "--dry-run")


class CameraFrames:
    """Frames of a running camera for the filter, each with the speed that the car is meant to hold.

    The filter always gets the newest frame. Frames that it was too slow for are left out; the step to the
    next one is longer by that time. Ctrl-C, the other signals that end a drive, and a camera that is gone for
    good end the iteration; the poses found until then are kept.

    Attributes:
        failure: Why the camera gave no more frames; None if it did not fail.
        skipped: Frames of the camera that were left out.
    """

    def __init__(self, source: FrameSource, speed_cm_s: float, most: int | None = None) -> None:
        """Take the source of the frames; it is opened when the first frame is requested.

        Args:
            source: Camera, or a recording that plays one.
            speed_cm_s: Approximate speed of the car; the filter finds the true one.
            most: Number of frames after which to end; None for no limit.
        """
        self._source, self._speed_cm_s = source, speed_cm_s
        self._most = math.inf if most is None else most
        self.failure: HardwareError | None = None
        self.skipped = 0
        self._asked = ""

    def __iter__(self) -> Iterator[LiveFrame]:
        """Yield frames until a signal, an end or a failure.

        Raises:
            HardwareError: If the camera cannot be opened.
            MissingExtraError: If its driver is not installed.
        """
        from lanenet.onboard.loop import ending_signals

        with ending_signals(self._stop):
            self._source.open()
            try:
                yield from self._frames()
            finally:
                self._source.close()

    def _stop(self, why: str) -> None:
        self._asked = why

    def _frames(self) -> Iterator[LiveFrame]:
        from datagen.localise.live_filter import LiveFrame
        from lanenet.data.drives.recording import Commands
        from lanenet.onboard.devices import SourceEnded

        commands = Commands(speed_cm_s=np.array([self._speed_cm_s]))
        taken, number, t_s = 0, -1, -math.inf
        while taken < self._most and not self._asked:
            try:
                frame = self._source.read(_WAIT_S)
            except SourceEnded:
                return
            except HardwareError as error:
                log.error("the camera is gone: %s", error)
                self.failure = error
                return
            # A driver that corrects its clock may give a frame an earlier time than the last one.
            if frame is None or frame.t_s <= t_s:
                continue
            self.skipped += max(0, frame.number - number - 1) if taken else 0
            taken, number, t_s = taken + 1, frame.number, frame.t_s
            yield LiveFrame(frame.number, frame.t_s, frame.image_bgr, commands)


def _show(report: LiveReport) -> None:
    localiser = report.localiser
    lines = [
        f"{counted(report.poses, 'pose')} of {counted(report.frames, 'frame')}, "
        f"{counted(report.segments, 'segment')}; {localiser.unreadable} unreadable, "
        f"{localiser.standing} standing, {localiser.dropped} left out",
        "time per frame not measured: all poses were found at once, at the end"
        if math.isnan(report.median_ms)
        else f"{1e3 / report.median_ms:.0f} frames/s: {report.median_ms:.2f} ms per frame (median), "
        f"{report.p99_ms:.2f} ms (p99)",
        f"map {localiser.map_bytes / 1e6:.0f} MB"
        + ("" if report.process_mb is None else f", process {report.process_mb:.0f} MB at most"),
        f"gain of the speed {report.factor:.3f}"
        if report.speed_known
        else f"typical step length {report.factor:.2f} cm per frame",
        f"median match {report.match:.2f}",
    ]
    if localiser.steering is not None:
        lines.append(
            f"steering found: correlation {localiser.steering.correlation:.2f}, "
            f"delay {localiser.steering.lag_frames} frames"
        )
    console.show_lines(lines)
    console.wrote(report.out, report.trajectory, report.picture)
