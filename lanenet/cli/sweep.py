"""``lanenet sweep``: a search for the network's settings on a config's validation drives."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import ConfigArgument, OverridesArgument, lock_outputs
from lanenet.cli.train import run_settings_schema
from lanenet.config import load_settings

app = typer.Typer()


@app.command(epilog="Example: lanenet sweep configs/small.yaml learn.epochs=10 --minutes 60")
def sweep(
    config: ConfigArgument,
    overrides: OverridesArgument = None,
    minutes: Annotated[
        float, typer.Option(min=0.0, help="Stop after this long; called again, it resumes.")
    ] = 60.0,
    trials: Annotated[int, typer.Option(min=1, help="Stop after this many finished trials, in all.")] = 100,
) -> None:
    """Try windows, sizes, losses and learning rates on CONFIG's validation drives, and keep the table."""
    from datagen.datasets.build import prepare
    from lanenet.learn.checkpoint import check_start
    from lanenet.learn.sweep import sweep as sweep_networks

    settings: Any = load_settings(run_settings_schema(), config, overrides)
    out = settings.work_folder / "sweep"
    lock_outputs(out)
    check_start(settings.learn, settings.data.window, settings.data.perceptions)
    with console.progress_bar("data") as progress:
        data = prepare(settings.data, settings.work_folder, progress)
    with console.progress_bar("trials") as progress:
        table = sweep_networks(
            settings.learn,
            data.train,
            data.validation,
            out,
            minutes * 60.0,
            trials,
            progress,
            data.weights,
        )
    console.show_lines(table.splitlines()[:14])
    console.wrote(out / "sweep.md", out / "trials.csv")
