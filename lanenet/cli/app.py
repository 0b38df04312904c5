"""The command ``lanenet``: puts the verbs together, and turns errors of the input into one line.

A module of verbs has a Typer ``app`` and stands in ``_VERBS`` in the order of the help. Verbs import
``datagen`` and ``lanenet.learn`` inside their functions, since the car has neither torch nor numba.
"""

from __future__ import annotations

from importlib import metadata
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from lanenet.cli import calibrate, detect, export, label, map, sweep, train, val
from lanenet.cli.car import analyse, bench, doctor, drive, stop
from lanenet.cli.research import judge, localise, reality, simulate, worlds
from lanenet.cli.shared import console
from lanenet.cli.shared.options import held_to_the_end
from lanenet.errors import LanenetError

_VERBS = (
    *(simulate, map, label, train, sweep, calibrate, detect, bench, analyse, doctor, drive, stop, export),
    *(localise, val, worlds, judge, reality),
)
#: The extra that brings a package, for the message when the package is missing.
_EXTRA_OF = {
    **dict.fromkeys(("torch", "torchvision", "onnx", "onnxscript", "safetensors", "tensorboard"), "train"),
    **dict.fromkeys(("scipy", "numba", "pyarrow"), "data"),
    "matplotlib": "viz",
    "optuna": "sweep",
    **dict.fromkeys(("smbus2", "serial"), "car"),
}


class _Group(TyperGroup):
    """Turns errors of the input into one line and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        try:
            with held_to_the_end():
                return super().invoke(ctx)
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
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
    help="Drive two laps, get a lane network. Every command has --help with an example.",
)
for _verb in _VERBS:
    app.add_typer(_verb.app)


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
