"""Write the data sheet of a network that an earlier version trained, from what its checkpoint recorded.

    python contrib/data_sheet.py checkpoints/general --added 0b26523b02ab

``lanenet train`` writes the sheet itself, from the label sets. Where these are gone, the checkpoint has
its ``run.yaml``, ``metrics.json``, ``results.json`` and model card. The settings of its simulated drives
are drawn again, and the camera of the first test drive is compared with the one that the checkpoint kept.
What is in none of these stays "not recorded".
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

from datagen.datasets.jobs import ROLES
from datagen.datasets.settings import DataSettings
from datagen.datasets.sheet import FORMAT, Sheet, draw_jobs, simulated_facts
from datagen.datasets.sheet_text import sheet_files
from lanenet.cli.train import run_settings_schema
from lanenet.config import check_settings, read_yaml
from lanenet.data.camera_file import read_camera
from lanenet.data.files import write_text
from lanenet.errors import CheckpointError
from lanenet.reading import read_json

#: How a model card begins to say what the network learned from.
_LEARNED = re.compile(r"^(\d+) frames of (\d+) label sets", re.MULTILINE)

_NOTE = """## How this sheet was made

Afterwards, by `contrib/data_sheet.py`: the network is older than data sheets. Its simulated drives were
drawn again from `run.yaml`; the camera of the first test drive is that of `camera.yaml`, to the last digit.
Numbers of frames and drives are those of `metrics.json`, `results.json` and the model card; minutes are
those frames at {rate_hz:g} a second. Which of the drives that were asked for gave no labels was not kept, nor
how far they went, nor the commit that it was trained with; {came}."""


def sheet_of_checkpoint(folder: Path, added: str | None = None) -> Sheet:
    """Return the sheet of a checkpoint that learned from simulated drives alone.

    Args:
        folder: The checkpoint.
        added: Commit that brought its weights as they are into the repository; None if it is not known.

    Raises:
        CheckpointError: If it learned from recorded ones, or this version would draw other drives.
    """
    path = folder / "run.yaml"
    values = read_yaml(path)
    # The bounds by which maps are judged draw no drives, and are others in each version.
    values["data"]["map"].pop("verdict", None)
    run: Any = check_settings(run_settings_schema(), values, str(path))
    if run.data.drives or run.learn.start_from is not None:
        raise CheckpointError(f"{folder}: did not learn from simulated drives alone, expected such a network")
    check_draws(folder, run.data)
    metrics = read_json(folder / "metrics.json", CheckpointError)
    results = read_json(folder / "results.json", CheckpointError)
    card = _LEARNED.search((folder / "MODEL_CARD.md").read_text(encoding="utf-8"))
    made = dict[str, int | None].fromkeys(ROLES) | {"test": len(results["sources"])}
    if card is not None and int(card[1]) == metrics["train_frames"]:
        made["train"] = int(card[2])
    frames = {"train": metrics["train_frames"], "validation": metrics["val_frames"]}
    frames["test"] = sum(source["frames"] for source in results["sources"])
    jobs = draw_jobs(run.data, "train", Path())
    unknown = {"left_out": None, "made": made}
    rate_hz = run.data.synthetic.simulation.rate_hz
    came = f"its weights came with commit {added}" if added else "nor which one brought its weights"
    return {
        "format": FORMAT,
        "name": run.name,
        "made_by": {"lanenet": metrics["versions"]["lanenet"], "commit": None},
        "parts": {
            role: {
                "drives": made[role],
                "frames": frames[role],
                "minutes": frames[role] / rate_hz / 60.0,
                "km": None,
            }
            for role in ROLES
        },
        "simulated": simulated_facts(run.data, jobs, "asked for") | unknown,
        "recorded": [],
        "notes": [_NOTE.format(rate_hz=rate_hz, came=came)],
    }


def check_draws(folder: Path, data: DataSettings) -> None:
    """Refuse a checkpoint whose simulated drives this version would not draw as they were.

    Raises:
        CheckpointError: If the first test drive has another camera than the checkpoint.
    """
    first = draw_jobs(data, "test", Path())[0].simulation
    drawn, kept = first.camera.build(first.car.wheelbase_cm), read_camera(folder / "camera.yaml")
    same = drawn.mounting == kept.mounting and drawn.wheelbase_cm == kept.wheelbase_cm
    if not (same and np.array_equal(drawn.K, kept.K) and np.array_equal(drawn.D, kept.D)):
        raise CheckpointError(
            f"{folder}: camera.yaml is not the camera that run.yaml gives with this version"
        )


def main() -> None:
    """Write the two files."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--added", help="Commit that brought its weights as they are into the repository.")
    told = parser.parse_args()
    folder = told.checkpoint
    for name, text in sheet_files(sheet_of_checkpoint(folder, told.added)).items():
        write_text(folder / name, text)
        sys.stdout.write(f"wrote {folder / name}\n")


if __name__ == "__main__":
    main()
