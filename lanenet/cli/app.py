"""The command ``lanenet``: puts the verbs together, and turns errors of the input into one line.

A module of verbs has a Typer ``app`` and stands in ``_VERBS`` in the groups and the order of the help. Verbs
import ``datagen`` and ``lanenet.learn`` inside their functions, since the car has neither torch nor numba.
"""

from __future__ import annotations

from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from lanenet.cli import calibrate, detect, export, label, map, sweep, train, val
from lanenet.cli.car import analyse, bench, doctor, drive, stop
from lanenet.cli.research import judge, localise, reality, simulate, worlds
from lanenet.cli.shared import console, standing
from lanenet.cli.shared.options import held_to_the_end
from lanenet.errors import LanenetError

_VERBS = {
    "Your own drive": (map, label, train, val, detect, calibrate),
    "On the car": (doctor, bench, drive, stop, export),
    "Research": (simulate, sweep, judge, worlds, reality, localise, analyse),
}
#: The extra that brings a package, for the message when the package is missing.
_EXTRA_OF = {
    **dict.fromkeys(("torch", "torchvision", "onnx", "onnxscript", "safetensors", "tensorboard"), "train"),
    **dict.fromkeys(("scipy", "numba", "pyarrow"), "data"),
    "matplotlib": "viz",
    "optuna": "sweep",
    **dict.fromkeys(("smbus2", "serial"), "car"),
}


class _Group(TyperGroup):
    """Says where the user stands if no verb is given; turns errors of the input into one line and a code."""

    def invoke(self, ctx: Any) -> Any:
        try:
            with held_to_the_end():
                answer = super().invoke(ctx)
                if ctx.invoked_subcommand is None:
                    standing.say_standing(Path())
                return answer
        except (LanenetError, OSError) as error:
            message = str(error)
        except MemoryError as error:
            message = f"out of memory{f' ({error})' if str(error) else ''}"
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package not in _EXTRA_OF:
                raise
            message = (
                f"this command needs the package {package}, which is not installed: "
                f"pip install 'lanenet[{_EXTRA_OF[package]}]'"
            )
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise SystemExit(130) from None
        # One line: a name may hold a line feed, too.
        console.say("error: " + message.replace("\n", "\\n"), err=True)
        raise SystemExit(1)


app = typer.Typer(
    cls=_Group,
    invoke_without_command=True,
    pretty_exceptions_show_locals=False,
    help="Drive two laps, get a lane network. Every command has --help with an example; without one, lanenet "
    "says what lies in this folder and what comes next.",
)
for _panel, _verbs in _VERBS.items():
    for _verb in _verbs:
        # Those of a group, such as calibrate, stand in the help of the group.
        if _verb is not calibrate:
            for _command in _verb.app.registered_commands:
                _command.rich_help_panel = _panel
        app.add_typer(_verb.app, rich_help_panel=_panel)


def main() -> None:
    """Run the command line; ``lanenet.__main__`` is the entry point of the package."""
    app()


def _show_version(wanted: bool) -> bool:
    if wanted:
        typer.echo(f"lanenet {metadata.version('lanenet')}")
        raise typer.Exit
    return wanted


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    pass
