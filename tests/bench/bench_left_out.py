"""What a network is worth on a real road that it has not seen, and on one that it has: ``make left-out``.

Each real drive in turn is left out: the general network learns on, from synthetic drives of its config and
the other real ones, and is then compared with the classical detectors on the whole drive that was left out;
beside it the network that it started from, which saw no real drive at all. Then the same start is fine-tuned
to each drive of tests/configs/tubs.yaml, and to all of them, and compared on their later laps. What is done
is kept in a table in the folder, so that a run that was killed goes on where it stopped.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.datasets.build import prepare
from datagen.datasets.jobs import RecordedJob
from datagen.datasets.settings import DataSettings, RecordedSettings
from datagen.labels.truth import truth_labels
from lanenet.cli.train import run_settings_schema
from lanenet.config import load_settings, read_yaml
from lanenet.data.files import write_text
from lanenet.errors import ConfigError, LanenetError
from lanenet.evaluation.answers import Compared
from lanenet.evaluation.comparison import SHARED_ROWS, evaluate
from lanenet.evaluation.errors import ErrorStats, error_stats
from lanenet.evaluation.sources import Opened, open_source, open_tests
from lanenet.evaluation.tables import TextTable, show_cm, show_share
from lanenet.geometry.lane import ROWS_CM, SIDES
from lanenet.learn.checkpoint import check_start, hash_of_start, hash_run
from lanenet.learn.config import LearnSettings
from lanenet.learn.export import CONFIG_NAME
from lanenet.learn.train import train
from lanenet.perception.network.model_file import find_model
from lanenet.samples.dataset import compile_kernels

BASELINES = ("hough", "hough-value", "lane-filter", "painter")
LEFT_OUT, START = "left out", "start"
TUNED, ALL = "fine-tuned", "one for all"
#: Beside the drives of the config, with lane widths that are assumed: nobody has measured them. The lens of
#: blue_tape does not follow from the drive, so that its map is refused so far.
MORE = {"blue_tape": 40.0}
#: What differs from the general network's config where it learns on with real drives.
LEARN_ON = (
    # Many of its synthetic drives, so that it keeps what it knows: those that `make general` has made.
    "work_dir=runs/my_general",
    "data.synthetic.train=240",
    # Some 80,000 samples each: five minutes on one core.
    "learn.epochs=4",
    # A third of the usual, so that what is known is kept. Chosen, like the number of epochs; synthetic drives
    # choose the best of them.
    "learn.learning_rate=0.001",
    # Three real lanes are few: together they become lanes of 25 to 71 cm.
    "learn.augment.scale=0.2",
)
#: Synthetic drives that a real one counts as: together the real ones are a fifth of the samples. Each of
#: their frames is shown some 15 times.
COUNTS_AS = 15
#: Passes over the early laps of one drive, as in configs/finetune.yaml.
TUNE_EPOCHS = 60
GROUPS = {"all": tuple(range(len(ROWS_CM))), **SHARED_ROWS}
COLUMNS = (
    "start", "what", "drive", "detector", "rows", "points", "answered", "rmse_cm", "median_cm", "p95_cm",
    "shared", "shared_rmse_cm", "shared_median_cm", "shared_p95_cm", "network_rmse_cm", "network_median_cm",
    "network_p95_cm", "within_1", "within_2", "plain", "off",
)  # fmt: skip
Row = dict[str, Any]


@dataclass(frozen=True)
class Bench:
    """What all parts of the experiment share.

    Attributes:
        folder: Maps, label sets, trainings and the table.
        start: Checkpoint that every training starts from.
        rows: The table.
    """

    folder: Path
    start: Path
    rows: list[Row]

    @property
    def table(self) -> Path:
        """File of the rows."""
        return self.folder / "left-out.csv"

    @property
    def start_hash(self) -> str:
        """Tells rows of this start from those of another one."""
        return hash_of_start(self.start)[:8]

    def mine(self, what: str) -> list[Row]:
        """Rows of an experiment with this start."""
        return [row for row in self.rows if row["start"] == self.start_hash and row["what"] == what]

    def done(self, what: str, drive: str) -> bool:
        """Whether the table has the rows of an experiment."""
        return any(row["drive"] == drive for row in self.mine(what))

    def learn(self, settings: LearnSettings, training: Sequence[Path], validation: Sequence[Path]) -> Path:
        """Train from the start; goes on where it stopped. Returns the model."""
        network = load_settings(LearnSettings, self.start / CONFIG_NAME).network
        learn = settings.model_copy(update={"start_from": self.start, "network": network})
        name = hash_run(learn, training, validation)
        return train(learn, training, validation, self.folder / f"train-{name}", show_epoch).model_path

    def compare(self, source: Opened, drive: str, models: Mapping[str, Path]) -> None:
        """Compare networks, by what they show, with the baselines on a source, and keep the rows."""
        # The first network has the name of its kind.
        names = dict(zip(models, ("network", *tuple(models)[1:]), strict=True))
        compared = Compared(
            ("network", *BASELINES), {names[what]: path for what, path in models.items()}, any_camera=True
        )
        comparison, _ = evaluate([source], compared)
        assert source.frames is not None
        labelled, found = np.isfinite(source.frames.points_cm), []
        for what, network in names.items():
            for detector in (network, *BASELINES):
                for group, at in GROUPS.items():
                    columns = [side * len(ROWS_CM) + row for side in range(len(SIDES)) for row in at]
                    own, first = (comparison.errors_cm[name][:, columns] for name in (detector, network))
                    both = np.isfinite(own) & np.isfinite(first)
                    truth = labelled[:, columns]
                    alone = error_stats(own, np.isfinite(own), truth)
                    row: Row = {"start": self.start_hash, "what": what, "drive": drive, "rows": group}
                    row |= {"detector": "network" if detector == network else detector}
                    row |= {"points": alone.truth_count, "answered": alone.coverage} | values("", alone)
                    shared = error_stats(own, both, truth)
                    row |= {"shared": shared.coverage} | values("shared_", shared)
                    row |= values("network_", error_stats(first, both, truth))
                    sigma, plain = comparison.breakdown.sigma.get(detector), comparison.plain.get(detector)
                    if group == "all" and sigma is not None:
                        row |= {"within_1": sigma.coverage["68"], "within_2": sigma.coverage["95"]}
                    if group == "all" and plain is not None:
                        row |= {"plain": plain.answered, "off": plain.off}
                    found.append(dict.fromkeys(COLUMNS, "") | row)
        self.keep(found)

    def keep(self, rows: Sequence[Row]) -> None:
        """Add the rows of a comparison to the table, at once, and show them."""
        self.rows.extend(rows)
        with self.table.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            if not file.tell():
                writer.writeheader()
            writer.writerows(rows)
        for row in rows:
            figures = (row[name] for name in COLUMNS)
            texts = (f"{value:.3g}" if isinstance(value, float) else str(value) for value in figures)
            sys.stdout.write(" ".join(texts) + "\n")
        sys.stdout.flush()


def values(prefix: str, stats: ErrorStats) -> Row:
    """Return the figures of a row."""
    return {f"{prefix}{name}_cm": getattr(stats, f"{name}_cm") for name in ("rmse", "median", "p95")}


def show_epoch(epoch: int, epochs: int, train_cm: float, val_cm: float, rate: float) -> None:
    """Show how a training goes."""
    sys.stdout.write(f"epoch {epoch} of {epochs}: {train_cm:.2f} cm, {val_cm:.2f} cm, {rate:.0f} samples/s\n")
    sys.stdout.flush()


def check_synthetic(start: Path) -> None:
    """Refuse a start that has seen real drives: on them it would be no stranger.

    Raises:
        ConfigError: Says what it has learned from.
    """
    run = read_yaml(start / "run.yaml")
    if run["data"]["drives"] or run["learn"]["start_from"] is not None:
        raise ConfigError(
            f"{start}: has learned from real drives or from another checkpoint, see its run.yaml"
        )


def with_maps(
    drives: Sequence[RecordedSettings], data: DataSettings, folder: Path
) -> tuple[dict[str, tuple[RecordedSettings, Path]], dict[str, str]]:
    """Map and label whole drives, once.

    Returns:
        By name the settings of a drive, with its map instead of the recording, and its label set; and by name
        why another one cannot be used.
    """
    mapped, refused = {}, {}
    for drive in drives:
        name, note = drive.path.name, folder / f"{drive.path.name}.refused.txt"
        if not drive.path.exists():
            refused[name] = "is not there"
        elif note.exists():
            refused[name] = note.read_text(encoding="utf-8")
        else:
            job = RecordedJob(drive.model_copy(update={"split": "none"}), data, folder / "drives")
            try:
                labels = job.run()[0].labels
            except LanenetError as error:
                refused[name] = str(error)
                write_text(note, refused[name])
                continue
            mapped[name] = drive.model_copy(update={"path": job.frames}), labels
    return mapped, refused


def real_drives(data: DataSettings, folder: Path) -> list[RecordedSettings]:
    """List the drives of a config, below a folder, and those that are no part of it."""
    whole = {"split": "train", "counts_as": COUNTS_AS, "gap_cm": 0.0}
    drives = [drive.model_copy(update={**whole, "path": folder / drive.path}) for drive in data.drives]
    first = drives[0]
    return drives + [
        first.model_copy(update={"path": folder / name, "lane_width_cm": width_cm, "map": data.map})
        for name, width_cm in MORE.items()
    ]


def leave_out(
    bench: Bench, settings: Any, labels: Mapping[str, tuple[RecordedSettings, Path]], names: Mapping[str, str]
) -> None:
    """Train without each drive, and compare on it."""
    todo = [name for name in labels if not bench.done(LEFT_OUT, names[name])]
    if not todo:
        return
    synthetic = settings.data.synthetic.model_copy(update={"test": 0})
    data = settings.data.model_copy(update={"synthetic": synthetic, "drives": ()})
    made = prepare(data, settings.work_folder, last=compile_kernels)
    for left in todo:
        real = [
            path for name, (drive, path) in labels.items() if name != left for _ in range(drive.counts_as)
        ]
        model = bench.learn(settings.learn, [*made.train, *real], made.validation)
        source = open_source(labels[left][0].path, data.window, None, truth_labels)
        bench.compare(source, names[left], {LEFT_OUT: model, START: find_model(bench.start)})


def fine_tune(bench: Bench, settings: Any, drives: Mapping[str, RecordedSettings], epochs: int) -> None:
    """Train on the early laps of each drive, and of all together; compare on the later ones."""
    for what, chosen in [*((TUNED, [name]) for name in drives), (ALL, list(drives))]:
        todo = [name for name in chosen if not bench.done(what, name)]
        if not todo:
            continue
        data = settings.data.model_copy(update={"drives": tuple(drives[name] for name in chosen)})
        made = prepare(data, bench.folder / "tuned")
        learn = settings.learn.model_copy(update={"epochs": epochs}) if what == TUNED else settings.learn
        model = bench.learn(learn, made.train, made.validation)
        for name, part in zip(chosen, made.of("test"), strict=True):
            if name in todo:
                bench.compare(open_tests([part.labels], [part.frames])[0], name, {what: model})


def accuracy(title: str, rows: Sequence[Row], note: str) -> TextTable:
    """Lay out all points of some experiments; classical detectors stand once for each drive."""
    lines, shown = [], set()
    for row in sorted(rows, key=lambda row: str(row["drive"])):
        cell = "network" if row["detector"] == "network" else row["detector"]
        seen = (row["drive"], cell, row["what"] if cell == "network" else "")
        if row["rows"] != "all" or seen in shown:
            continue
        shown.add(seen)
        name = f"network, {row['what']}" if cell == "network" else cell
        figures = [show_cm(number(row[f"{name}_cm"])) for name in ("rmse", "median", "p95")]
        within = [show_share(number(row[f"within_{k}"])) for k in (1, 2)]
        plain, off = number(row["plain"]), number(row["off"])
        per_1000 = f"{1000.0 * off / plain:.1f}" if plain > 0.0 else "-"
        share = show_share(number(row["answered"]))
        frames = f"{plain:.0f}" if plain >= 0.0 else "-"
        lines.append(
            [str(row["drive"]), name, str(row["points"]), share, *figures, *within, frames, per_1000]
        )
    header = [
        "drive",
        "detector",
        "points",
        "answered",
        "RMSE",
        "median",
        "p95",
        "within 1 sigma",
        "within 1.96",
    ]
    return TextTable(title, [*header, "in plain sight", "off per 1000"], lines, note, texts=2)


def against(title: str, rows: Sequence[Row]) -> TextTable:
    """Lay out each network and each classical detector on the points that both answer."""
    lines = []
    for row in sorted(rows, key=lambda row: (str(row["drive"]), str(row["what"]))):
        if row["detector"] == "network":
            continue
        figures = [
            show_cm(number(row[f"{who}_{name}_cm"]))
            for name in ("rmse", "median", "p95")
            for who in ("network", "shared")
        ]
        texts = (row["drive"], row["what"], row["detector"], row["rows"])
        lines.append([*map(str, texts), show_share(number(row["shared"])), *figures])
    header = ["drive", "network", "detector", "rows", "shared"]
    header += [f"{name}: {who}" for name in ("RMSE", "median", "p95") for who in ("network", "detector")]
    return TextTable(title, header, lines, "shared: of the labelled points", texts=4)


def number(text: Any) -> float:
    """Read a figure of the table; NaN where there is none."""
    return float("nan") if text == "" else float(text)


def report(bench: Bench, conditions: Sequence[str], refused: Mapping[str, str]) -> str:
    """Write everything that is known."""
    left = [row for what in (LEFT_OUT, START) for row in bench.mine(what)]
    tuned = [row for what in (TUNED, ALL) for row in bench.mine(what)]
    plain = (
        "in plain sight: answered frames with both markings in plain sight; off: more than 3 cm beside one"
    )
    tables = []
    for rows, title in ((left, "Whole drives that were left out"), (tuned, "Later laps, after fine-tuning")):
        if rows:
            tables += [accuracy(f"{title}: all labelled points, in cm", rows, plain)]
            tables += [against(f"{title}: the points that both answer, in cm", rows)]
    head = ["# One real drive left out, and fine-tuned to real drives", "\n".join(conditions)]
    missing = [f"Not tested: `{name}` ({reason.splitlines()[0]})" for name, reason in refused.items()]
    return "\n\n".join([*head, *missing, *(table.as_markdown() for table in tables)])


def main() -> None:
    """Measure, print and write the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--folder", type=Path, required=True, help="maps, trainings and the table are kept here"
    )
    parser.add_argument(
        "--start", type=Path, default=Path("checkpoints/general"), help="synthetic drives only"
    )
    parser.add_argument("--config", type=Path, default=Path("configs/general.yaml"))
    parser.add_argument("--tubs", type=Path, default=Path("tests/configs/tubs.yaml"), help="the real drives")
    parser.add_argument("--data", type=Path, required=True, help="folder of the real drives")
    parser.add_argument("--epochs", type=int, default=TUNE_EPOCHS, help="of the fine-tuning to one drive")
    parser.add_argument(
        "--map", action="append", default=[], metavar="NAME=FOLDER", help="finished map of a whole drive"
    )
    parser.add_argument("--out", type=Path, default=Path("docs/results/left-out.md"))
    parser.add_argument("overrides", nargs="*", help="of the config, as in learn.epochs=1")
    args = parser.parse_args()
    check_synthetic(args.start)
    args.folder.mkdir(parents=True, exist_ok=True)
    settings: Any = load_settings(run_settings_schema(), args.config, [*LEARN_ON, *args.overrides])
    tubs: Any = load_settings(run_settings_schema(), args.tubs)
    bench = Bench(args.folder, args.start, [])
    if bench.table.exists():
        with bench.table.open(newline="") as file:
            bench.rows.extend(csv.DictReader(file))
    drives = real_drives(tubs.data, args.data)
    start_network = load_settings(LearnSettings, args.start / CONFIG_NAME).network
    learn = settings.learn.model_copy(update={"start_from": args.start, "network": start_network})
    check_start(learn, settings.data.window, settings.data.perceptions)
    given = dict(text.split("=", 1) for text in args.map)
    names = {Path(given.get(d.path.name, d.path)).name: d.path.name for d in drives}
    drives = [d.model_copy(update={"path": Path(given.get(d.path.name, d.path))}) for d in drives]
    mapped, refused = with_maps(drives, settings.data, args.folder)
    refused = {names[name]: reason for name, reason in refused.items()}
    widths = ", ".join(f"`{names[n]}` {drive.lane_width_cm:g}" for n, (drive, _) in mapped.items())
    options = " ".join(["", *args.overrides])
    conditions = [
        f"Command: `make left-out` (start {args.start}; {args.config}{options}; {args.tubs})",
        "",
        f"Conditions: the start (weights {bench.start_hash}) learned from synthetic drives alone; then "
        f"{settings.data.synthetic.train} synthetic drives and the other real ones, {settings.learn.epochs} "
        f"epochs (fine-tuning: {args.epochs}; all together {tubs.learn.epochs}). Synthetic drives choose the "
        "epoch of a network that leaves a drive out, middle laps that of a fine-tuned one. Lane widths in "
        f"cm, all of them assumed: {widths}; errors scale with them. The network as `detect` answers, with "
        "memory, the lane width given; errors against the drive's own map.",
    ]
    leave_out(bench, settings, mapped, names)
    write_text(args.out, report(bench, conditions, refused))
    by_name = {names[n]: drive for n, (drive, _) in mapped.items()}
    tuned = {
        d.path.name: d.model_copy(update={"path": by_name[d.path.name].path})
        for d in tubs.data.drives
        if d.path.name in by_name
    }
    fine_tune(bench, tubs, tuned, args.epochs)
    write_text(args.out, report(bench, conditions, refused))
    sys.stdout.write(f"wrote {args.out}\n")


if __name__ == "__main__":
    main()
