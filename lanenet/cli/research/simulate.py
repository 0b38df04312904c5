"""``lanenet simulate``: a synthetic drive with ground truth."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from lanenet.cli.research.judge import named_entrant, warn_of_widths
from lanenet.cli.shared import console
from lanenet.cli.shared.options import ConfigArgument, ModelOption, OverridesArgument, lock_outputs
from lanenet.config import load_settings
from lanenet.errors import ConfigError

app = typer.Typer()


@app.command(epilog="Example: lanenet simulate configs/drives/example.yaml seed=3 --out runs/three")
def simulate(
    config: ConfigArgument,
    out: Annotated[Path, typer.Option(help="Folder for the drive.")],
    overrides: OverridesArgument = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that draw the frames.")] = 1,
    detector: Annotated[
        str | None,
        typer.Option(help="Detector that steers instead of the scripted driver."),
    ] = None,
    model: ModelOption = None,
) -> None:
    """Make a synthetic drive with ground truth, by a scripted driver or in closed loop by a detector."""
    from datagen.judge.run import build_pilot
    from datagen.world.car.driver import PilotSettings
    from datagen.world.simulate import simulate_drive
    from datagen.world.world import SimulationSettings

    settings = load_settings(SimulationSettings, config, overrides)
    lock_outputs(out)
    if model is not None and detector is None:
        raise ConfigError("--model: is the network's, expected --detector network as well")
    width_cm = settings.track.lane_width_cm
    pilot = None
    if detector is not None:
        entrant = named_entrant(detector, model, "--detector", any_camera=False)
        warn_of_widths([entrant], [width_cm])
        pilot = partial(build_pilot, entrant=entrant, settings=PilotSettings())
    with console.progress_bar("simulate") as progress:
        drive = simulate_drive(settings, out, progress, workers=workers, pilot=pilot)
    console.wrote(drive)
    console.next_command("map", drive, "--lane-width", f"{width_cm:g}", "--out", "MAP")
