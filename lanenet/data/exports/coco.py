"""COCO keypoints: the six labels of each picture.

Source: COCO data format, https://cocodataset.org/#format-data (keypoint detection).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from lanenet.data.exports.pictures import Pictures
from lanenet.data.files import write_text
from lanenet.geometry.lane import POINT_NAMES

LABELS_FILE = "annotations.json"
#: COCO's visibility: in sight, or not labelled.
_VISIBLE, _UNLABELLED = 2, 0
#: Keypoint by keypoint along each line, counted from 1.
_SKELETON = ((1, 2), (2, 3), (4, 5), (5, 6))

READING = f"""`{LABELS_FILE}` has one annotation for each picture in which a label can be seen: the car's
own lane with six keypoints, px, pixel centres at integers. Visibility is {_VISIBLE}, or {_UNLABELLED}
where a point is masked or lies outside the picture, as those at y = 0 under the bumper mostly do.
`points_cm`, which is not COCO's, has all six as x in cm, null where masked."""


def fill(folder: Path, pictures: Pictures) -> int:
    """Write the pictures and ``annotations.json``; returns the number of keypoints."""
    (folder / "images").mkdir()
    camera, labels = pictures.camera, pictures.labels
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    count = 0
    for picture in pictures:
        (folder / "images" / picture.name).write_bytes(picture.data)
        number = len(images) + 1
        images.append(
            {
                "id": number,
                "file_name": picture.name,
                "width": camera.width,
                "height": camera.height,
                "frame": int(labels.frame[picture.row]),
            }
        )
        seen = np.isfinite(picture.points_px[:, 0])
        if not seen.any():
            continue
        keypoints: list[float] = []
        for (u, v), visible in zip(picture.points_px.tolist(), seen.tolist(), strict=True):
            keypoints += [round(u, 3), round(v, 3), _VISIBLE] if visible else [0.0, 0.0, _UNLABELLED]
        corner, far = picture.points_px[seen].min(axis=0), picture.points_px[seen].max(axis=0)
        # A box has an area also around a single point.
        size = np.maximum(far - corner, 1.0)
        annotations.append(
            {
                "id": len(annotations) + 1,
                "image_id": number,
                "category_id": 1,
                "keypoints": keypoints,
                "num_keypoints": int(seen.sum()),
                "bbox": np.round([*corner, *size], 3).tolist(),
                "area": round(float(size.prod()), 3),
                "iscrowd": 0,
                "points_cm": [
                    None if x != x else round(x, 4) for x in labels.points_cm[picture.row].tolist()
                ],
            }
        )
        count += int(seen.sum())
    category = {
        "id": 1,
        "name": "lane",
        "supercategory": "road",
        "keypoints": list(POINT_NAMES),
        "skeleton": _SKELETON,
    }
    info = {"description": f"Lanes of {pictures.drive.name}", "version": "1"}
    content = {"info": info, "images": images, "annotations": annotations, "categories": [category]}
    # On one line, as COCO's own: a list a line would be several times as long.
    write_text(folder / LABELS_FILE, json.dumps({**content, "licenses": []}))
    return count
