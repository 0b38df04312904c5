"""A folder for Hugging Face ``datasets``: pictures with a table of their labels, which the Hub shows.

Source: https://huggingface.co/docs/datasets/image_dataset (ImageFolder), docs/hub/datasets-cards.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from lanenet.data.exports.pictures import Pictures
from lanenet.data.files import require
from lanenet.data.tables import float_array, write_parquet
from lanenet.geometry.lane import POINT_NAMES

#: The folder of the only split: how to divide laps is for those who train to say.
SPLIT = "train"
#: The label set itself, from which lanenet trains. It lies outside the split, so that ``datasets`` passes it
#: over.
LABELS_FILE = "labels.parquet"

READING = f"""```python
from datasets import load_dataset

frames = load_dataset("THIS_FOLDER", split="{SPLIT}")
```

Columns: `image`, `drive`, `frame`, `t_s`, `lap`, the pose `x_cm`, `y_cm`, `heading_rad` of the rear axle
in the map, the six labels `left_0_cm` to `right_30_cm` (null where masked), the same points in the
picture as `left_0_u_px`, `left_0_v_px` and so on (pixel centres at integers; null outside the picture, as
those at y = 0 under the bumper mostly are), and `quality`, 0 to 1. `{LABELS_FILE}` is the whole label
set, with edge points and lane lines, for `lanenet train` and `lanenet val`. To test, keep whole laps
apart: neighbouring frames are nearly the same picture."""


def fill(folder: Path, pictures: Pictures) -> int:
    """Write the pictures, ``metadata.parquet`` and the label set; returns the number of labels."""
    arrow = require("pyarrow", "data")
    (folder / SPLIT).mkdir()
    names, rows, points_px = [], [], []
    for picture in pictures:
        (folder / SPLIT / picture.name).write_bytes(picture.data)
        names.append(picture.name)
        rows.append(picture.row)
        points_px.append(picture.points_px)
    labels, pixels = pictures.labels.subset(np.array(rows, np.int64)), np.array(points_px).reshape(-1, 6, 2)
    arrays = {
        "file_name": arrow.array(names, type=arrow.string()),
        "drive": arrow.array(labels.drive, type=arrow.string()),
        "frame": arrow.array(labels.frame),
        "t_s": float_array(labels.t_s),
        "lap": arrow.array(labels.lap),
        **{name: float_array(labels.poses[:, k]) for k, name in enumerate(("x_cm", "y_cm", "heading_rad"))},
        **{name: float_array(labels.points_cm[:, k]) for k, name in enumerate(POINT_NAMES)},
        **{
            f"{name.removesuffix('_cm')}_{axis}_px": float_array(pixels[:, k, j])
            for k, name in enumerate(POINT_NAMES)
            for j, axis in enumerate("uv")
        },
        "quality": float_array(labels.quality),
    }
    write_parquet(folder / SPLIT / "metadata.parquet", arrays, {})
    shutil.copyfile(pictures.path, folder / LABELS_FILE)
    return int(np.isfinite(labels.points_cm).sum())


def card_header(pictures: Pictures, frames: int) -> dict[str, object]:
    """Return the YAML at the head of the data set's card."""
    size = next(text for most, text in _SIZES if frames < most)
    return {
        "pretty_name": f"Lanes of {pictures.drive.name}",
        "task_categories": ["keypoint-detection"],
        "tags": ["lane-detection", "autonomous-driving", "donkeycar", "lanenet"],
        "size_categories": [size],
        "configs": [
            {
                "config_name": "default",
                "drop_labels": True,
                "data_dir": ".",
                "data_files": [{"split": SPLIT, "path": f"{SPLIT}/**"}],
            }
        ],
    }


#: The Hub's classes of size.
_SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (float("inf"), "100K<n<1M"))
