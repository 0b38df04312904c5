"""``lanenet doctor``: checks of the installation, the camera and the car."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import CameraOption
from lanenet.cli.shared.standing import look_around, next_on_car, say_next
from lanenet.errors import ConfigError, LanenetError

if TYPE_CHECKING:
    from lanenet.onboard.drive import DriveSettings

app = typer.Typer()


@app.command(epilog="Example: lanenet doctor --config checkpoints/mycar/car.yaml")
def doctor(
    camera: CameraOption = None,
    config: Annotated[Path | None, typer.Option(help="YAML of a car, to check its devices.")] = None,
    wheels_off_ground: Annotated[
        bool,
        typer.Option(
            "--wheels-off-ground",
            help="Turn wheels and motor, ask what they did, and write the answers into --config.",
        ),
    ] = False,
    camera_delay: Annotated[
        bool,
        typer.Option(
            "--camera-delay",
            help="Measure the delay of the camera of --config: cover and uncover its lens when asked.",
        ),
    ] = False,
) -> None:
    """Check the installation, a camera file if one is given, and a whole car with --config."""
    from lanenet.onboard.doctor.installation import run_checks
    from lanenet.onboard.drive import load_drive_settings

    settings = None if config is None else load_drive_settings(config)
    if wheels_off_ground or camera_delay:
        if config is None or settings is None:
            option = "--wheels-off-ground" if wheels_off_ground else "--camera-delay"
            raise ConfigError(f"{option}: needs the car's file as well (--config car.yaml)")
        if camera_delay:
            _measure_delay(config, settings)
        if wheels_off_ground:
            _try_wheels(config, settings)
        return
    checks = run_checks(camera)
    if settings is not None:
        from lanenet.onboard.doctor.car import check_car

        checks += check_car(settings)
    for check in checks:
        console.say(f"{check.state:8s}{check.name}: {check.text}")
    problems = sum(check.state == "problem" for check in checks)
    if problems:
        raise LanenetError(f"{problems} problem(s) found, see above")
    if settings is None or config is None:
        # Without the training packages this is a car.
        trains = any(check.name == "extra train" and check.state == "ok" for check in checks)
        if trains:
            say_next(look_around(Path()))
        else:
            next_on_car()
    elif settings.actuator is None:
        console.next_command("drive", config, "--dry-run")
    else:
        console.next_command("doctor", "--config", config, "--wheels-off-ground")


def _measure_delay(config: Path, settings: DriveSettings) -> None:
    """Ask a person to cover and uncover the lens, and show the camera's delay."""
    from lanenet.onboard.cameras import open_source
    from lanenet.onboard.doctor.camera_delay import measure_delay

    if settings.source.kind == "replay":
        raise ConfigError(f"--camera-delay: {config}: the source is a recording, expected a camera")

    def ask(question: str) -> None:
        typer.prompt(question, default="", show_default=False, prompt_suffix=" ")

    console.show_lines(measure_delay(open_source(settings.source), ask).lines)
    console.next_command("doctor", "--config", config)


def _try_wheels(config: Path, settings: DriveSettings) -> None:
    """Ask about the wheels on the terminal, and write the result into the car's file."""
    from lanenet.data.files import write_text
    from lanenet.onboard.doctor.wheel_trial import pulses_of, set_values, try_wheels
    from lanenet.onboard.drive import build_sink, load_drive_settings

    def ask(question: str, letters: str) -> str:
        while True:
            answer = typer.prompt(f"{question} [{'/'.join(letters)}]", type=str).strip().lower()[:1]
            if answer and answer in letters:
                return str(answer)

    pulses_of(settings)
    result = try_wheels(settings, build_sink(settings), ask)
    console.show_lines(result.lines)
    if result.changes:
        text = config.read_text(encoding="utf-8")
        write_text(config, set_values(text, result.changes, str(config)))
        console.wrote(config)
        # What was found may rule out what the file says: then it is told here, with what to write.
        load_drive_settings(config)
    console.next_command("drive", config, "--steering-only")
