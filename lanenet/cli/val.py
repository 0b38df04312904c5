"""``lanenet val``: a thin shell over :mod:`lanenet.evaluation.comparison`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lanenet.cli.shared import console
from lanenet.cli.shared.options import (
    AnyCameraOption,
    MarkingOption,
    check_beside,
    check_not_source,
    lock_outputs,
    path_or_hub,
)
from lanenet.cli.shared.own_drive import learned_from
from lanenet.cli.shared.standing import next_on_car
from lanenet.cli.shared.viewing import NO_VIEWS, Views, view_answers, with_viewers
from lanenet.errors import ConfigError
from lanenet.evaluation.comparison import SeenSource, default_names, evaluate
from lanenet.evaluation.sources import Opened, open_source
from lanenet.perception.network.model_file import find_model, is_model
from lanenet.perception.registry import compared_names, kind_of, listed

if TYPE_CHECKING:
    from lanenet.evaluation.comparison import Comparison

app = typer.Typer()

#: Ends of the names of the files that --out writes, the first of them always.
_ENDINGS = (
    *(".html", ".json", ".md", ".png", "-breakdown.png", "-worst.jpg", "-plain.jpg"),
    *("-robust.md", "-robust.json"),
)


@app.command(epilog="Example: lanenet val checkpoints/small runs/drive7 runs/my_map --out runs/errors")
@with_viewers
def val(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="[MODEL] SOURCE...",
            parser=path_or_hub,
            help="Model (.onnx) or checkpoint folder; simulated drives, maps, or label sets (.parquet). On "
            "the Hugging Face Hub: hf:owner/name, and hf:datasets/owner/name.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="Also write the report under this name: .html, .md, .json, .png, -breakdown.png, "
            "-worst.jpg, -plain.jpg."
        ),
    ] = None,
    detectors: Annotated[
        str | None,
        typer.Option(
            help=f"Which to compare, as in network,painter; all: {', '.join(compared_names())}. Default: the "
            "network; without a model, with --all or --out, all that the sources allow."
        ),
    ] = None,
    show_all: Annotated[
        bool, typer.Option("--all", help="Also run the other detectors, and print all tables.")
    ] = False,
    no_baselines: Annotated[bool, typer.Option("--no-baselines", help="The network only.")] = False,
    marking: MarkingOption = None,
    any_camera: AnyCameraOption = False,
    also: Annotated[
        list[Path] | None,
        typer.Option(help="Another model or checkpoint for the same tables; may be given again."),
    ] = None,
    trained_on: Annotated[
        list[Path] | None,
        typer.Option(
            help="Label set that MODEL has learned from; may be given again. Errors on the same map are also "
            "shown by the distance from it."
        ),
    ] = None,
    robust: Annotated[
        bool,
        typer.Option(
            "--robust",
            help="Also change the frames: lines missing, clutter, unknown objects, a wrong calibration.",
        ),
    ] = False,
    views: Views = NO_VIEWS,
) -> None:
    """Show errors in cm of a model, in a sentence and a table; with --all beside the other detectors.

    With --out the files hold all tables, with the other detectors. Simulated drives are compared with their
    truth, maps and their label sets with the map. Label sets hold no frames, so that only detectors that work
    on edge points can be run on them. Without the network no MODEL is needed.
    """
    from datagen.labels.truth import truth_labels
    from lanenet.data.files import json_text, write_bytes
    from lanenet.data.label_set import read_labels
    from lanenet.evaluation.answers import Compared
    from lanenet.evaluation.model_page import model_page
    from lanenet.evaluation.report import report_files
    from lanenet.perception.network.model_file import read_model_meta

    model, source_paths = _split_paths(paths)
    more = _more_models(also or [])
    if out is not None:
        page, *others = (Path(f"{out}{end}") for end in _ENDINGS)
        for source in source_paths:
            check_not_source(source, page, *others)
        check_beside(out, *others, first=page)
    lock_outputs(out)
    views.check(source_paths[0] if len(source_paths) == 1 else None)
    meta = None if model is None else read_model_meta(model)
    window, perception = (None, None) if meta is None else (meta.window, meta.perception)
    sources = [open_source(path, window, perception, truth_labels) for path in source_paths]
    alone = model is not None and detectors is None and not show_all
    names = _chosen(detectors, no_baselines or (alone and out is None), model, sources)
    if detectors is None and names != ("network",) and any(source.frames is None for source in sources):
        left_out = listed(compared_names(lambda kind: not kind.on_label_sets))
        console.show_problems([f"label sets hold no frames: {left_out} are left out"])
    if "network" in names:
        console.show_problems([says for source in sources if (says := source.without_camera)])
    if robust:
        _check_robust(model, sources)
    networks = more if model is None or "network" not in names else {"network": model, **more}
    for path in networks.values():
        widths_cm = [source.lane_width_cm for source in sources]
        console.show_problems(read_model_meta(path).untrained_widths(widths_cm, str(path)))
    with console.progress_bar("val") as progress:
        comparison, seen = evaluate(
            sources,
            Compared(names, ({} if model is None else {"network": model}) | more, marking, any_camera),
            [read_labels(path) for path in trained_on or []],
            os.cpu_count() or 1,
            progress,
        )
    networks_only = [name for name in comparison.tables if name in networks] if alone else None
    where = _where(sources, model)
    show(comparison, seen, where, networks_only, show_all)
    if views:
        view_answers(views, sources, seen)
    robustness = _robustness({"network": model, **more}, sources) if robust and model is not None else None
    if out is not None:
        judged = comparison.first if model is None else model.resolve().parent.name
        html = model_page(f"How good {judged} is", comparison, seen, where)
        files = {".html": html, ".json": json_text(comparison.as_dict()), **report_files(comparison, seen)}
        if robustness is not None:
            files |= {"-robust.md": robustness[0], "-robust.json": json_text(robustness[1])}
        for ending, content in files.items():
            path = Path(f"{out}{ending}")
            write_bytes(path, content.encode() if isinstance(content, str) else content)
            console.wrote(path)
        if ".png" not in files:
            console.show_problems(["no plot of the errors without Matplotlib: pip install 'lanenet[viz]'"])
    best = min(comparison.tables.items(), key=lambda item: item[1].all.median_cm)[0]
    shown = "network" if "network" in names else best
    if alone:
        console.say("the other detectors and more tables: --all" if out is None else "all tables: --all")
    words = _next_words(sources, shown, networks.get(shown), marking, any_camera)
    if words:
        console.next_command(*words)
    else:
        next_on_car()


def show(
    comparison: Comparison,
    seen: Sequence[SeenSource],
    where: str,
    names: Sequence[str] | None = None,
    show_all: bool = False,
) -> None:
    """Print the verdict on the first detector, and the table of errors or all tables.

    Args:
        comparison: The figures.
        seen: What the first detector answers on frames.
        where: On what it was measured.
        names: The detectors of the one table; None for all.
        show_all: Print all tables.
    """
    from lanenet.evaluation.tables import lay_out, main_tables
    from lanenet.evaluation.verdict import verdict_sentence

    console.say(f"verdict: {verdict_sentence(comparison, seen, where)}")
    chosen = list(comparison.tables) if names is None else names
    for table in lay_out(comparison) if show_all else main_tables(comparison, chosen):
        console.show_rich(table.as_rich())


def _where(sources: Sequence[Opened], model: Path | None) -> str:
    """Say on what a model is measured, and whether it has learned from that."""
    where = f"on {sources[0].path}" if len(sources) == 1 else f"on {len(sources)} sources"
    file = None if model is None else model.parent / "run.yaml"
    if file is None or not file.is_file():
        return where
    learned = learned_from(file)
    known = [source for source in sources if source.drive.resolve() in learned]
    if not known:
        return where
    each = "" if len(known) == len(sources) else f"{len(known)} of "
    return f"{where}, {each}which it has learned from in part,"


def _next_words(
    sources: Sequence[Opened], shown: str, model: Path | None, marking: float | None, any_camera: bool
) -> list[str | Path]:
    """A command that runs as it stands: the lanes that a detector finds in the first source with frames.

    Empty if no source has frames.
    """
    with_frames = [source for source in sources if source.frames is not None]
    if not with_frames:
        return []
    source, detector = with_frames[0], kind_of("network" if model is not None else shown)
    is_map = source.drive != source.path
    options = {
        "--detector": detector.name if model is None else None,
        "--model": model,
        "--camera": source.path / "camera.yaml" if is_map else None,
        "--lane-width": f"{source.lane_width_cm:g}" if is_map and detector.takes_lane_width else None,
        "--marking": marking if detector.takes_marking else None,
        "--any-camera": any_camera and model is not None,
        "--out": "runs/lanes.csv",
    }
    return ["detect", source.drive, *console.given(options)]


def _more_models(paths: Sequence[Path]) -> dict[str, Path]:
    """Models by the names that they get in the tables: those of their folders or files."""
    models: dict[str, Path] = {}
    for path in paths:
        if path.is_file() and not is_model(path):
            raise ConfigError(f"--also {path}: expected a model (.onnx) or a checkpoint folder")
        model = find_model(path)
        name = path.resolve().stem
        if path.is_dir() or name == "model":
            # A checkpoint's file is called as every other one's.
            name = model.resolve().parent.name
        if name in models or name in compared_names():
            raise ConfigError(f"--also {path}: the name {name!r} is taken, expected another one")
        models[name] = model
    return models


def _check_robust(model: Path | None, sources: Sequence[Opened]) -> None:
    if model is None:
        raise ConfigError("--robust: expected a model before the sources (lanenet val MODEL SOURCE --robust)")
    without = [source.path for source in sources if source.labels is None]
    if without:
        raise ConfigError(
            f"--robust: {without[0]} is a map; expected simulated drives or label sets (lanenet label)"
        )


def _robustness(models: Mapping[str, Path], sources: Sequence[Opened]) -> tuple[str, dict[str, object]]:
    """Measure, show and return the table as Markdown and as plain values."""
    from lanenet.evaluation.answers import RasterModel
    from lanenet.evaluation.robustness import as_dict, measure_robustness, robust_table

    opened = {name: RasterModel(path) for name, path in models.items()}
    label_sets = [source.labels for source in sources if source.labels is not None]
    with console.progress_bar("robust") as progress:
        rows = measure_robustness(opened, label_sets, [str(source.path) for source in sources], progress)
    table = robust_table(rows)
    console.show_rich(table.as_rich())
    return table.as_markdown(), as_dict(rows)


def _split_paths(paths: list[Path]) -> tuple[Path | None, list[Path]]:
    """The model, if the first path is one, and the sources."""
    first, *sources = paths
    misplaced = next((path for path in sources if path.exists() and is_model(path)), None)
    if misplaced is not None:
        raise ConfigError(
            f"{misplaced}: is a model, expected a simulated drive, map or label set; the model comes first "
            "(lanenet val MODEL SOURCE), more of them with --also"
        )
    if not is_model(first):
        return None, paths
    if not sources:
        raise ConfigError(f"{first}: expected a SOURCE after the model: a simulated drive, map or label set")
    return find_model(first), sources


def _chosen(
    text: str | None, no_baselines: bool, model: Path | None, sources: Sequence[Opened]
) -> tuple[str, ...]:
    from lanenet.evaluation.answers import choose_names

    if no_baselines and text is not None:
        raise ConfigError("--no-baselines: is the same as --detectors network, expected one of the two")
    names = default_names(sources, model is not None) if text is None else choose_names(text)
    names = ("network",) if no_baselines else names
    without = [name for name in names if kind_of(name).needs_model and model is None]
    if without:
        raise ConfigError(
            f"detector {without[0]}: expected a model before the sources (lanenet val MODEL SOURCE)"
        )
    without_frames = [source.path for source in sources if source.frames is None]
    refused = [name for name in names if without_frames and not kind_of(name).on_label_sets]
    if refused:
        raise ConfigError(
            f"detector {refused[0]}: needs frames, but {without_frames[0]} is a label set; give the "
            "simulated drive or the map that it was made of"
        )
    return names
