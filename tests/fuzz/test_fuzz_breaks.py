"""Recordings that fall apart: a map or an error of one line, whatever of the drive nothing ties to the rest.

Short simulated drives get breaks, pauses, blank images and stretches in reverse. A case is a seed:
``pytest -m slow tests/fuzz/test_fuzz_breaks.py -k "[17]"`` runs one.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from datagen.pipeline import map_drive
from datagen.prepare import MapRequest
from datagen.settings import MapSettings
from datagen.slam.settings import GuessSettings
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.data.maps.folder import read_map
from lanenet.errors import LanenetError

#: Cases, of four seconds each. Chosen: each kind of damage comes about ten times. 35 of them give a map.
CASES = 48
#: Frames of a drive: of the quick one a lap and a bit, so that its loop closes.
FRAMES = 170
LANE_CM = 40.0
_TRACK = {"closed": True, "length_cm": 440, "lane_width_cm": LANE_CM}
_CAMERA = {"width": 160, "height": 120}
#: Speeds, [cm/s]: 0.15 and 0.05 camera heights per frame; at the second the car is tracked by keyframes.
_SPEEDS = {"quick": 60.0, "slow": 20.0}

Rows = list[dict[str, str]]
Images = dict[str, np.ndarray]


def _gap(rows: Rows, at: int, seconds: float) -> None:
    for row in rows[at:]:
        row["t_s"] = f"{float(row['t_s']) + seconds:.4f}"


def _alone(rows: Rows, images: Images, rng: np.random.Generator) -> None:
    """One to three frames between two breaks, anywhere, the first and the last ones too."""
    first, count = int(rng.integers(0, len(rows))), int(rng.integers(1, 4))
    _gap(rows, first, rng.uniform(3.0, 300.0))
    _gap(rows, first + count, rng.uniform(3.0, 300.0))


def _breaks(rows: Rows, images: Images, rng: np.random.Generator) -> None:
    """Parts of one length, from single frames to half of the drive."""
    for at in range(int(rng.integers(1, 5)), len(rows), int(rng.choice([1, 2, 3, 5, 10, 40, 80]))):
        _gap(rows, at, rng.uniform(3.0, 30.0))


def _pauses(rows: Rows, images: Images, rng: np.random.Generator) -> None:
    """Throttle in pulses: the recording pauses for 3 to 40 frames, again and again."""
    at = 0
    while (at := at + int(rng.integers(2, 25))) < len(rows):
        _gap(rows, at, 0.05 * int(rng.integers(3, 40)))


def _blank(rows: Rows, images: Images, rng: np.random.Generator) -> None:
    """A run of images without an edge, black, gray or white; sometimes all of them, or every other one."""
    first, count = int(rng.integers(0, len(rows))), int(rng.choice([1, 5, 30, 90, len(rows)]))
    level, step = int(rng.choice([0, 128, 255])), int(rng.choice([1, 1, 2]))
    for row in rows[first : first + count : step]:
        images[row["file"]] = np.full((120, 160, 3), level, np.uint8)


def _blank_part(rows: Rows, images: Images, rng: np.random.Generator) -> None:
    """A run of blank images between two breaks."""
    first, count = int(rng.integers(0, len(rows) - 20)), int(rng.choice([1, 2, 4, 12, 40]))
    for row in rows[first : first + count]:
        images[row["file"]] = np.full((120, 160, 3), 90, np.uint8)
    _gap(rows, first, 10.0)
    _gap(rows, first + count, 10.0)


def _noise(rows: Rows, images: Images, rng: np.random.Generator) -> None:
    """Images of noise: edges that meet no other image."""
    first, count = int(rng.integers(0, len(rows))), int(rng.choice([1, 10, 60]))
    for row in rows[first : first + count]:
        images[row["file"]] = rng.integers(0, 256, (120, 160, 3)).astype(np.uint8)


def _reverse(rows: Rows, images: Images, rng: np.random.Generator) -> None:
    """Two stretches in reverse with one to three frames between them."""
    first, count = int(rng.integers(0, len(rows) - 30)), int(rng.integers(1, 4))
    for row in [*rows[first : first + 8], *rows[first + 8 + count : first + 16 + count]]:
        row.update({"speed_cm_s": "-60"} if "speed_cm_s" in row else {})


def _stand(rows: Rows, images: Images, rng: np.random.Generator) -> None:
    """A run in which the car is commanded to stand though it rolls on, with blank images in some cases."""
    first, count = int(rng.integers(0, len(rows))), int(rng.choice([3, 20, len(rows)]))
    blank = rng.random() < 0.5
    for row in rows[first : first + count]:
        row.update({"speed_cm_s": "0"} if "speed_cm_s" in row else {})
        if blank:
            images[row["file"]] = np.full((120, 160, 3), 60, np.uint8)


def _no_commands(rows: Rows, images: Images, rng: np.random.Generator) -> None:
    """No speed was recorded, and in half of the cases no steering."""
    names = ("speed_cm_s", "steering_rad") if rng.random() < 0.5 else ("speed_cm_s",)
    for row in rows:
        for name in names:
            row.pop(name, None)


_DAMAGES: tuple[Callable[[Rows, Images, np.random.Generator], None], ...] = (
    _alone, _breaks, _pauses, _blank, _blank_part, _noise, _reverse, _stand, _no_commands,
)  # fmt: skip


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A quick and a slow drive round a small loop."""
    made = {}
    for name, speed_cm_s in _SPEEDS.items():
        settings = SimulationSettings.model_validate(
            {
                "seed": 5,
                "frames": FRAMES,
                "track": _TRACK,
                "camera": _CAMERA,
                "driver": {"speed_cm_s": speed_cm_s},
            }
        )
        made[name] = tmp_path_factory.mktemp("drives") / name
        simulate_drive(settings, made[name])
    return made


def damage(drive: Path, out: Path, rng: np.random.Generator) -> None:
    """Copy a drive with one to three damages."""
    shutil.copytree(drive, out)
    with (out / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    images: Images = {}
    for k in rng.choice(len(_DAMAGES), int(rng.integers(1, 4)), replace=False):
        _DAMAGES[k](rows, images, rng)
    with (out / "frames.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    for name, image in images.items():
        cv2.imwrite(str(out / name), image)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(CASES))
def test_a_drive_that_falls_apart_gives_a_map_or_an_error_of_one_line(
    drives: dict[str, Path], tmp_path: Path, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    drive, out = tmp_path / "drive", tmp_path / "map"
    # Each fourth drive has no camera, and each third is slow.
    name, known = ("slow" if seed % 3 == 2 else "quick"), seed % 4 != 3
    damage(drives[name], drive, rng)
    if not known:
        text = (drive / "drive.yaml").read_text()
        (drive / "drive.yaml").write_text(text.replace("camera: camera.yaml\n", ""))
    settings = MapSettings(guess=GuessSettings(focal_px=(55,), pitch_deg=(25,)))
    try:
        report = map_drive(MapRequest(drive, LANE_CM), settings, out, pictures=False)
    except LanenetError as error:
        assert "\n" not in str(error)
        assert str(drive) in str(error) or str(out) in str(error)
        assert not (out / "map.yaml").exists()
        return
    assert all("\n" not in line and "nan" not in line.split() for line in report.lines)
    drive_map = read_map(out)
    assert np.isfinite(drive_map.poses).all()
    assert np.isfinite(drive_map.tilt_rad).all()
    assert all(
        np.isfinite(line.coefficients_cm).all() for lines in drive_map.lines.values() for line in lines
    )
    for file in ("camera.yaml", "map.yaml", "trajectory.tum", "open_loop.tum"):
        words = set((out / file).read_text().lower().replace(",", " ").split())
        assert not {"nan", ".nan", "inf", "-inf", ".inf", "-.inf"} & words, file
