"""The command ``lanenet``: puts the verbs together, and turns errors of the input into one line.

A module of verbs has a Typer ``app`` and stands in ``_VERBS`` in the groups and the order of the help. Verbs
import ``datagen`` and ``lanenet.learn`` inside their functions, since the car has neither torch nor numba.
"""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from lanenet.cli import (
    calibrate,
    detect,
    drives,
    export,
    join,
    label,
    label_all,
    map,
    settings,
    sweep,
    train,
    val,
)
from lanenet.cli.car import analyse, bench, doctor, drive, stop
from lanenet.cli.research import judge, localise, reality, simulate, worlds
from lanenet.cli.shared import console, standing
from lanenet.cli.shared.options import held_to_the_end
from lanenet.errors import LanenetError

_VERBS = {
    "Your own drive": (map, join, label, train, val, detect, calibrate),
    "On the car": (doctor, bench, drive, stop, export),
    "Many drives": (drives, label_all),
    "Help": (settings,),
    "Research": (simulate, sweep, judge, worlds, reality, localise, analyse),
}
#: The extra that brings a package, for the message when the package is missing.
_EXTRA_OF = {
    **dict.fromkeys(("torch", "torchvision", "onnx", "onnxscript", "safetensors", "tensorboard"), "train"),
    **dict.fromkeys(("scipy", "numba", "pyarrow"), "data"),
    "matplotlib": "viz",
    "optuna": "sweep",
    **dict.fromkeys(("rerun", "mcap"), "viewers"),
    **dict.fromkeys(("smbus2", "serial"), "car"),
    **dict.fromkeys(("fsspec", "ray"), "cluster"),
}


#: Errors of the command line itself; Typer brings the class along, or takes that of the package click.
_UsageError: type[Any] = typer.BadParameter.__mro__[1]
_USAGE_CODE = 2


class _Group(TyperGroup):
    """Says where the user stands if no verb is given; turns errors of the input into one line and a code."""

    def make_context(self, *words: Any, **more: Any) -> Any:
        try:
            return super().make_context(*words, **more)
        except _UsageError as error:
            _refuse_usage(error)

    def invoke(self, ctx: Any) -> Any:
        code = LanenetError.exit_code
        hints: tuple[str, ...] = ()
        try:
            with held_to_the_end():
                answer = super().invoke(ctx)
                if ctx.invoked_subcommand is None:
                    standing.say_standing(Path())
                return answer
        except _UsageError as error:
            _refuse_usage(error)
        except (LanenetError, OSError) as error:
            message, code = str(error), getattr(error, "exit_code", code)
            hints = getattr(error, "hints", ())
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
        with console.told_or_lost():
            for line in (f"error: {message}", *(f"  {hint}" for hint in hints)):
                # A name may hold a line feed, too.
                console.say(line.replace("\n", "\\n"), err=True)
        raise SystemExit(code)


app = typer.Typer(
    cls=_Group,
    invoke_without_command=True,
    pretty_exceptions_show_locals=False,
    help="Drive two laps, get a lane network. Every command has --help with an example; without one, lanenet "
    "says what lies in this folder and what comes next.",
)
for _panel, _verbs in _VERBS.items():
    for _verb in _verbs:
        # Those of a group stand in the help of the group.
        if _verb not in (calibrate, drives):
            for _command in _verb.app.registered_commands:
                _command.rich_help_panel = _panel
        app.add_typer(_verb.app, rich_help_panel=_panel)


def main() -> None:
    """Run the command line; ``lanenet.__main__`` is the entry point of the package."""
    app()


def _refuse_usage(error: Any) -> NoReturn:
    """Say an error of the command line in the form of all others, and where its help is.

    A group of verbs without a verb, such as ``lanenet calibrate``, shows its help instead.
    """
    if type(error).__name__ == "NoArgsIsHelpError":
        raise error
    message = error.format_message().strip().removesuffix(".")
    # Typer says so of values that Python's own types refuse.
    message = message.replace("Value error, ", "").removeprefix("Invalid value for ")
    if option := re.match("'(-[^']+)': ", message):
        message = f"{option[1]}: {message[option.end() :]}"
    known = f"; see {error.ctx.command_path} --help" if error.ctx is not None else ""
    console.say(f"error: {message[:1].lower()}{message[1:]}{known}".replace("\n", "\\n"), err=True)
    raise SystemExit(_USAGE_CODE)


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
