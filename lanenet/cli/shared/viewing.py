"""The options of the viewers, for every verb that sees frames."""

from __future__ import annotations

import functools
import inspect
import math
import shlex
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import check_not_source, lock_outputs
from lanenet.errors import ConfigError
from lanenet.viewers.registry import VIEWERS

if TYPE_CHECKING:
    from lanenet.evaluation.comparison import SeenSource
    from lanenet.evaluation.sources import Opened
    from lanenet.viewers.recording import BackgroundRecording, Recording
    from lanenet.viewers.seen import Scene


@dataclass(frozen=True)
class Views:
    """The viewers that a command was asked for.

    Attributes:
        targets: File or address by the viewer's name; empty for none.
    """

    targets: dict[str, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.targets)

    def check(self, source: Path | None = None) -> None:
        """Refuse, before the work, what cannot be shown or written; lock the files.

        Args:
            source: What the command reads.

        Raises:
            LanenetError: Names the option.
        """
        if not self:
            return
        from lanenet.viewers.recording import check_targets

        files = check_targets(self.targets)
        if source is not None:
            check_not_source(source, *files)
        lock_outputs(*files)

    def record(self, scene: Scene, part: str = "") -> AbstractContextManager[Recording]:
        """Record what is seen; ``part`` tells several recordings of one command apart."""
        from lanenet.viewers.recording import record

        return record(self.targets, scene, part)

    def in_background(self, scene: Scene) -> AbstractContextManager[BackgroundRecording]:
        """Record what is seen in a thread of its own."""
        from lanenet.viewers.recording import record_in_background

        return record_in_background(self.targets, scene)

    @property
    def files(self) -> list[Path]:
        """The files among the targets."""
        return [Path(target) for name, target in self.targets.items() if VIEWERS[name].is_file(target)]


#: What a verb has that nobody asked for viewers.
NO_VIEWS = Views()


def with_viewers(verb: Callable[..., None]) -> Callable[..., None]:
    """Give a verb an option for each viewer; it gets them as its argument ``views``."""
    signature, hints = inspect.signature(verb), get_type_hints(verb, include_extras=True)
    options = [
        inspect.Parameter(
            kind.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[
                str | None, typer.Option(f"--{kind.name}", metavar=kind.metavar, help=kind.help)
            ],
        )
        for kind in VIEWERS.values()
    ]

    @functools.wraps(verb)
    def run(**given: Any) -> None:
        targets = {name: given.pop(name) for name in VIEWERS}
        views = Views({name: target for name, target in targets.items() if target is not None})
        verb(**given, views=views)
        for name, target in views.targets.items():
            # A command that makes several recordings adds to the name.
            if VIEWERS[name].is_file(target) and Path(target).is_file():
                console.say("to look at it: " + VIEWERS[name].to_look.format(file=shlex.quote(target)))

    kept = [
        parameter.replace(annotation=hints[name])
        for name, parameter in signature.parameters.items()
        if name != "views"
    ]
    # Typer reads both.
    vars(run)["__signature__"] = signature.replace(parameters=[*kept, *options])
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in [*kept, *options]}
    return run


def view_answers(views: Views, sources: Sequence[Opened], seen: Sequence[SeenSource]) -> None:
    """Show what the first detector answers beside the labels; several sources are recordings of their own.

    Args:
        views: The viewers.
        sources: All sources of the comparison.
        seen: The answers to those of them that have frames.

    Raises:
        ConfigError: If none has frames.
    """
    from lanenet.viewers.mapped import MapToSee
    from lanenet.viewers.seen import Lane, LaneName, Scene, Seen, error_cm

    with_frames = [source for source in sources if source.frames is not None]
    if not with_frames:
        raise ConfigError(f"--{next(iter(views.targets))}: label sets hold no frames to show, expected a map")
    for source, answers in zip(with_frames, seen, strict=True):
        frames = answers.frames
        mapped = MapToSee(source.path) if frames.reference == "map" else None
        part = source.path.resolve().name if len(seen) > 1 else ""
        scene = Scene(frames.name, frames.camera, frames.perception) if mapped is None else mapped.scene
        with views.record(scene, part) as recording, console.progress_bar(f"viewers {part}") as progress:
            for i, frame in enumerate(frames.frames.tolist()):
                lanes: dict[LaneName, Lane] = {"detected": Lane(answers.answers_cm[i])}
                if mapped is None:
                    lanes["reference"] = Lane(frames.points_cm[i])
                values = {name: float(column[i]) for name, column in answers.values.items()}
                values["error_cm"] = error_cm(answers.answers_cm[i], frames.points_cm[i])
                t_s = math.nan if frames.t_s is None else float(frames.t_s[i])
                plain = Seen(frame, t_s, frames.image(i), lanes, values)
                recording.add(plain if mapped is None else mapped.add_to(plain))
                progress(i + 1, len(frames))
