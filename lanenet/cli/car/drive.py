"""``lanenet drive``: the onboard loop, from camera to actuator."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import OverridesArgument
from lanenet.cli.shared.viewing import NO_VIEWS, Views, with_viewers
from lanenet.errors import ConfigError, LanenetError

if TYPE_CHECKING:
    from lanenet.onboard.devices import Frame
    from lanenet.onboard.drive import DriveSettings
    from lanenet.onboard.loop import Step
    from lanenet.perception.estimate import LaneEstimate

    Show = Callable[[Frame, LaneEstimate, Step], None]

app = typer.Typer()


@app.command(epilog="Example: lanenet drive configs/car/replay.yaml --dry-run")
@with_viewers
def drive(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML of the car.")],
    overrides: OverridesArgument = None,
    arm: Annotated[bool, typer.Option("--arm", help="Let the motor turn, after a countdown.")] = False,
    steering_only: Annotated[
        bool, typer.Option("--steering-only", help="Move the wheels, never the motor.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Use no actuator; show what would be sent.")
    ] = False,
    hold: Annotated[
        Path | None,
        typer.Option(help="With --arm: the car drives only while this file exists; removed, it stops."),
    ] = None,
    hold_fresh: Annotated[
        float | None,
        typer.Option(min=0.1, help="With --hold: the file must be touched at least this often, s."),
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="End after this many frames.")] = None,
    views: Views = NO_VIEWS,
) -> None:
    """Drive the car by what its camera sees; without --arm the motor stays in neutral."""
    from lanenet.onboard.arming import HoldFile
    from lanenet.onboard.drive import build_loop, load_drive_settings

    if hold_fresh is not None and hold is None:
        raise ConfigError("--hold-fresh: expected --hold FILE as well")
    held = None if hold is None else HoldFile(hold, hold_fresh)
    settings = load_drive_settings(config, overrides)
    views.check()
    with ExitStack() as stack:
        seen = _show(views, stack, settings) if views else None
        show = stack.enter_context(console.live_line())

        def watch(step: Step) -> None:
            show(lambda: f"{loop.report.text}  {step.text}")

        loop = build_loop(
            settings, arm=arm, steering_only=steering_only, dry_run=dry_run, hold=held, watch=watch, show=seen
        )
        with console.told_or_lost():
            console.show_problems(loop.problems)
        report = loop.run(frames)
    with console.told_or_lost():
        console.show_lines(report.lines())
        console.wrote(report.recording, *views.files)
    if report.by_fault:
        raise LanenetError(f"the car had to stop: {report.ended}; it does not start again by itself")
    words: list[str | Path]
    if report.recording is not None:
        words = ["map", report.recording, "--lane-width", "CM", "--out", "MAP"]
    elif settings.actuator is not None and not arm:
        words = ["drive", config, *(overrides or []), "--arm" if steering_only else "--steering-only"]
    else:
        words = ["doctor", "--config", config]
    with console.told_or_lost():
        console.next_command(*words)


def _show(views: Views, stack: ExitStack, settings: DriveSettings) -> Show:
    """Open the viewers, until the stack ends; returns what shows them a frame, without waiting for them."""
    from lanenet.data.camera_file import read_camera
    from lanenet.perception.edges.road import PerceptionSettings
    from lanenet.perception.network.model_file import find_model, read_model_meta
    from lanenet.viewers.seen import Scene, Seen, lane_of, values_of

    model = settings.detector.model
    perception = PerceptionSettings() if model is None else read_model_meta(find_model(model)).perception
    camera = None if settings.camera is None else read_camera(settings.camera)
    recording = stack.enter_context(views.in_background(Scene("drive", camera, perception)))

    def show(frame: Frame, estimate: LaneEstimate, step: Step) -> None:
        values = {"sent_steering_rad": step.steering_rad, "throttle": step.throttle, **values_of(estimate)}
        recording.add(
            Seen(
                frame.number,
                frame.t_s,
                frame.image_bgr,
                {"detected": lane_of(estimate)},
                values,
                reason=estimate.reason,
            )
        )

    return show
