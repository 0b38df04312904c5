"""``lanenet stop``: neutral, whatever drives the car."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import OverridesArgument

app = typer.Typer()


@app.command(epilog="Example: lanenet stop configs/car/picamera_pca9685.yaml")
def stop(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML of the car.")],
    overrides: OverridesArgument = None,
) -> None:
    """Put the motor into neutral and end the drive, within a fraction of a second."""
    from lanenet.onboard.stop import hurry, stop_car

    hurry()
    stop_car(config, overrides or (), console.say)
