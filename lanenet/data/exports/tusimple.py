"""TuSimple's lines of JSON: per picture the x of each lane line at given rows, and -2 where it has none.

Source: https://github.com/TuSimple/tusimple-benchmark, doc/lane_detection.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lanenet.data.exports.pictures import Pictures, line_pixels

LABELS_FILE = "label_data.json"
ABSENT = -2
#: TuSimple's pictures of 720 rows have a sample each 10 rows.
_ROWS_PER_SAMPLE = 72

READING = f"""Each line of `{LABELS_FILE}` is a picture: `raw_file`, `h_samples` (rows, px) and `lanes`,
the left and the right line of the car's own lane as x at these rows, px, pixel centres at integers;
{ABSENT} where a line has none. Other lanes are not labelled. A line that crosses a row twice has the
crossing that is nearer to the car. The tip of a corner that lies between two rows is cut off, by up to a
pixel of x."""


def fill(folder: Path, pictures: Pictures) -> int:
    """Write the pictures and ``label_data.json``; returns the number of points."""
    (folder / "images").mkdir()
    height = pictures.camera.height
    rows = np.arange(0, height, max(1, height // _ROWS_PER_SAMPLE))
    count = 0
    with (folder / LABELS_FILE).open("w", encoding="utf-8") as stream:
        for picture in pictures:
            (folder / "images" / picture.name).write_bytes(picture.data)
            lines = pictures.labels.lines[picture.row]
            lanes = [at_rows(line_pixels(line.astype(np.float64), picture.camera), rows) for line in lines]
            count += sum(int(np.isfinite(lane).sum()) for lane in lanes)
            line = {
                "lanes": [[ABSENT if x != x else round(x, 3) for x in lane.tolist()] for lane in lanes],
                "h_samples": rows.tolist(),
                "raw_file": f"images/{picture.name}",
            }
            stream.write(json.dumps(line) + "\n")
    return count


def at_rows(line_px: Float[np.ndarray, "n 2"], rows: np.ndarray) -> Float[np.ndarray, "_"]:
    """Return x where a line in pixels first crosses each row, [px]; NaN where it does not."""
    result = np.full(len(rows), np.nan)
    if len(line_px) < 2:
        return result
    u, v = line_px[:, 0], line_px[:, 1]
    low, high = np.minimum(v[:-1], v[1:]), np.maximum(v[:-1], v[1:])
    for k, row in enumerate(rows.tolist()):
        crossings = np.flatnonzero((low <= row) & (high >= row))
        if crossings.size:
            i = crossings[0]
            share = 0.0 if v[i + 1] == v[i] else (row - v[i]) / (v[i + 1] - v[i])
            result[k] = u[i] + share * (u[i + 1] - u[i])
    return result
