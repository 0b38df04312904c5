"""``lanenet train SOURCE``: from a drive, a map or a label set of one's own to the config that trains on it.

Imports ``datagen`` and ``lanenet.learn`` inside the functions, since the car has neither torch nor numba.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lanenet.config import apply_overrides, read_yaml
from lanenet.data.drives import find_format, formats_text, meant_instead, open_drive
from lanenet.errors import ConfigError, DriveFormatError, LanenetError
from lanenet.reading import is_folder, is_regular, natural_key

#: Steps of the training, and samples of each. From configs/finetune.yaml, whose 60 epochs on the early laps
#: of garage_tape are 1,600 steps.
_STEPS, _BATCH = 1600, 32
#: Share of the frames that is learned from: that of the split along time, and three of five laps.
TRAIN_SHARE = 0.6
#: Epochs at least and at most. Chosen: each frame is seen often enough, and none too often.
_EPOCHS = (20, 100)
#: Driven between the parts of a split, as in configs/finetune.yaml.
_GAP_CM = 100.0
#: The network that the training starts from, in the working folder or beside the package.
_GENERAL = Path("checkpoints") / "general"


@dataclass(frozen=True)
class Measured:
    """What was measured on the car and its road; None for what was not.

    Attributes:
        lane_width_cm: Between the middles of the lane's two lines.
        camera: Camera file, or an earlier map of the same car.
        wheelbase_cm, camera_height_cm, tape_width_cm: As for ``lanenet map``.
        frames: First and last number of the frames to map.
    """

    lane_width_cm: float | None = None
    camera: Path | None = None
    wheelbase_cm: float | None = None
    camera_height_cm: float | None = None
    tape_width_cm: float | None = None
    frames: tuple[int, int] | None = None

    @property
    def given(self) -> dict[str, Any]:
        """What was measured, as a config has it."""
        known = {key: value for key, value in asdict(self).items() if value is not None}
        if self.camera is not None:
            known["camera"] = str(self.camera.resolve())
        if self.frames is not None:
            known["frames"] = list(self.frames)
        return known

    @property
    def options(self) -> list[str]:
        """The options with which it was given."""
        return [f"--{name.removesuffix('_cm').replace('_', '-')}" for name in self.given]


def own_config(
    name: str, paths: Sequence[Path], measured: Measured, overrides: Sequence[str], runs: Path
) -> dict[str, Any]:
    """Return the config of a training on one's own drives; it names them by their full paths.

    Args:
        name: Of the checkpoint.
        paths: Drives, folders of drives, maps or label sets.
        measured: What is known of the drives that are not mapped yet.
        overrides: ``KEY=VALUE``, settings that replace those that are chosen here.
        runs: Folder in which maps and runs lie.

    Raises:
        LanenetError: If a source is none, cannot be read, or lacks its lane width; or if there is no
            checkpoint to start from.
        ConfigError: If an override does not fit.
    """
    from lanenet.learn.config import LearnSettings
    from lanenet.learn.export import CONFIG_NAME, read_network

    replaced = apply_overrides({}, list(overrides))
    start = Path(replaced.get("learn", {}).get("start_from") or _general())
    meta = read_network(start)[1]
    network = LearnSettings.model_validate(read_yaml(start / CONFIG_NAME)).network
    sources = [source for path in paths for source in sources_in(path)]
    if measured.options and all(map(_is_finished, sources)):
        raise ConfigError(
            f"{measured.options[0]}: is for a drive to be mapped, but {sources[0]} is finished"
            f"{_rescale_instead(sources[0], measured)}"
        )
    folder = Path(replaced.get("work_dir") or runs / name).resolve()
    drives, counts = zip(*(_recording(source, measured, folder, runs) for source in sources), strict=True)
    config: dict[str, Any] = {
        "name": name,
        "data": {
            "drives": list(drives),
            "window": asdict(meta.window),
            "colour_weight": meta.perception.edges.colour_weight,
        },
        "learn": {
            "start_from": str(start.resolve()),
            "epochs": epochs_of(sum(counts)),
            "batch_size": _BATCH,
            "balance": "drive" if len(drives) > 1 else "none",
            "augment": {"preset": "own_road"},
            "network": network.model_dump(mode="json", exclude_none=True),
        },
    }
    return apply_overrides(config, list(overrides))


def untrained_widths(settings: Any) -> list[str]:
    """Warn of lanes unlike those of the network that a training starts from, as ``lanenet detect`` does.

    Args:
        settings: Of the run, see :func:`lanenet.cli.train.run_settings_schema`.
    """
    from lanenet.learn.export import read_network

    start = settings.learn.start_from
    widths_cm = [drive.lane_width_cm for drive in settings.data.drives]
    return [] if start is None else read_network(start)[1].untrained_widths(widths_cm, str(start))


def _rescale_instead(source: Path, measured: Measured) -> str:
    """Say how a finished map gets another lane width: the end of a sentence."""
    if measured.lane_width_cm is None or not (source / "map.yaml").is_file():
        return ""
    from lanenet.data.maps.folder import read_map_meta

    return f"; to {read_map_meta(source).width_command(source, measured.lane_width_cm)}"


def epochs_of(frames: int) -> int:
    """Return how often the frames are shown: about as many steps for any number of frames."""
    epochs = round(_STEPS * _BATCH / max(1.0, TRAIN_SHARE * frames))
    return min(max(epochs, _EPOCHS[0]), _EPOCHS[1])


def sources_in(path: Path) -> list[Path]:
    """Return what a path names: a drive, a map, a label set; or the drives and maps that a folder holds.

    A folder in it that cannot be looked into counts as a drive, which its reader refuses.

    Raises:
        DriveFormatError: If it is none of these.
    """
    if not path.exists():
        raise DriveFormatError(f"{path}: no such drive, map, label set or config{meant_instead(path)}")
    if _is_source(path):
        return [path]
    entries = sorted(path.iterdir(), key=natural_key) if path.is_dir() else []
    inside = [each for each in entries if _is_closed(each) or _is_source(each)]
    inside = [each for each in inside if each.suffix != ".parquet"]
    if not inside:
        raise DriveFormatError(
            f"{path}: expected {formats_text()}, a folder of them, a map, a label set (.parquet) or a config "
            f"(.yaml){meant_instead(path)}"
        )
    return inside


def _is_source(path: Path) -> bool:
    return _is_finished(path) or find_format(path) is not None


def _is_finished(path: Path) -> bool:
    """Tell whether a path is a map or a label set."""
    return is_regular(path / "map.yaml") or (path.suffix == ".parquet" and is_regular(path))


def _is_closed(path: Path) -> bool:
    return is_folder(path) and not os.access(path, os.R_OK | os.X_OK)


def _recording(path: Path, measured: Measured, folder: Path, runs: Path) -> tuple[dict[str, Any], int]:
    """Return the settings of a recorded drive, and how many frames it has."""
    from lanenet.data.label_set import read_labels
    from lanenet.data.maps.folder import read_map

    known: dict[str, Any] = {"path": str(path.resolve())}
    if not _is_finished(path):
        drive = open_drive(path)
        drive = drive if measured.frames is None else drive.numbered(*measured.frames)
        count, width_cm = len(drive), measured.lane_width_cm or drive.lane_width_cm
        if width_cm is None:
            raise ConfigError(
                f"{path}: expected --lane-width: the distance in cm between the middles of the lane's two "
                "lines"
            )
        known |= {**measured.given, "lane_width_cm": width_cm}
        found = finished_map(known, folder, runs)
        if found is not None:
            known = {"path": str(found.resolve()), "lane_width_cm": width_cm}
    elif path.is_file():
        labels = read_labels(path)
        count, known["lane_width_cm"] = len(labels), labels.meta.lane_width_cm
    else:
        drive_map = read_map(path)
        count, known["lane_width_cm"] = len(drive_map.frames), drive_map.meta.lane_width_cm
    return {**known, "split": "auto", "gap_cm": _GAP_CM}, count


def finished_map(drive: dict[str, Any], folder: Path, runs: Path) -> Path | None:
    """Return a map that an earlier command made of a drive with the same settings; None if there is none.

    The run's own one is left to the run, which knows it again.

    Args:
        drive: Settings of a recorded drive.
        folder: Folder of the run.
        runs: Folder in which maps and runs lie.
    """
    from datagen.datasets.build import recorded_jobs
    from datagen.datasets.jobs import finished_maps
    from datagen.datasets.settings import DataSettings
    from datagen.made import Output

    (job,) = recorded_jobs(DataSettings.model_validate({"drives": [drive]}), folder)
    own = job.map_output
    if own.done:
        return None
    return next((one for one in finished_maps(runs) if Output(one / "map.yaml", own.key).done), None)


def check_name(checkpoint: Path, config: Path, drives: Iterable[Path]) -> None:
    """Refuse to replace a network, or the config of a run, of other drives.

    Args:
        checkpoint: Folder to write; may be missing.
        config: The run's config; may be missing.
        drives: The recorded drives that are to be learned from.

    Raises:
        LanenetError: Names the other drives.
    """
    own = set(map(_drive_behind, drives))
    for taken, written in ((checkpoint, checkpoint / "run.yaml"), (config, config)):
        others = learned_from(written)
        # A network of simulated drives alone has none.
        if taken.exists() and own != others and own.isdisjoint(others):
            found = ", ".join(sorted(map(str, others))) or "simulated drives"
            raise LanenetError(
                f"{taken}: the name is taken by a network of {found}; choose another --name (name=... with a "
                "config), or replace what is there with --force"
            )


def learned_from(config: Path) -> set[Path]:
    """Return the recorded drives that a training's config names, by their full paths.

    A map stands for its drive. Simulated drives have no path, and an unreadable config names none.
    """
    try:
        drives = read_yaml(config)["data"]["drives"]
        paths = [Path(str(drive["path"])) for drive in drives]
    except (ConfigError, KeyError, TypeError):
        return set()
    return set(map(_drive_behind, paths))


def _drive_behind(path: Path) -> Path:
    """Return the full path of a recording, or of the one that a map was made from."""
    from lanenet.evaluation.sources import Opened

    try:
        return Opened(path).drive.resolve()
    except (LanenetError, KeyError):  # a map that cannot be read stands for itself
        return path.resolve()


def _general() -> Path:
    """The network that training on one's own drives starts from."""
    places = [_GENERAL, Path(__file__).resolve().parents[3] / _GENERAL]
    found = next((place for place in places if place.is_dir()), None)
    if found is None:
        raise ConfigError(
            f"{_GENERAL}: is neither here nor beside the package, but the training starts from it: copy it "
            "here from lanenet's repository, or name another network with learn.start_from=CHECKPOINT"
        )
    return found


def parts_of(words: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Tell sources from settings among the words of a command; ``KEY=VALUE`` is no path that exists."""
    settings = [word for word in words if "=" in word and not Path(word).exists()]
    return [Path(word) for word in words if word not in settings], settings


def is_config(path: Path) -> bool:
    """Tell whether a word names a config."""
    return path.suffix.lower() in (".yaml", ".yml")


def check_paths(config: Path, paths: Iterable[Path | None]) -> None:
    """Refuse a config whose relative paths lead nowhere from the working folder, but do from one above it.

    Args:
        config: Its file.
        paths: What it reads; None for nothing.

    Raises:
        ConfigError: Names the folder to go to.
    """
    missing = [path for path in paths if path is not None and not path.is_absolute() and not path.exists()]
    file = config.resolve()
    found = {above: [path for path in missing if (above / path).exists()] for above in file.parents}
    folder = max(found, key=lambda above: len(found[above]))
    if found[folder]:
        words = shlex.join(["lanenet", "train", str(file.relative_to(folder))])
        raise ConfigError(
            f"{config}: its paths count from the folder in which the command runs, and {found[folder][0]} is "
            f"not in {Path.cwd()}: type cd {shlex.quote(str(folder))} && {words}"
        )
