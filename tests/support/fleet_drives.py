"""Short drives for a fleet: simulated, cut out of real tubs, and as people record those."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

from datagen.fleet.task import FleetDrive
from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings

#: Width of the lane in each real tub, [cm], as a user would give it.
TUBS_CM = {"donkey_circuit": 59.0, "usi_mat": 37.0, "garage_tape": 60.0, "blue_tape": 45.0}
#: Drives of each kind, and frames of each.
SIMULATED, CUTS, WITH_GAPS, FRAMES = 44, 8, 8, 80
_SIMULATED_CM = 40.0


def short_drive(seed: int, folder: Path, frames: int = 70) -> Path:
    """Simulate a drive that is just long enough."""
    camera = {"width": 160, "height": 120, "field_of_view_rad": math.radians(120.0), "height_cm": 17.0}
    track = {"left": {}, "right": {}, "interruptions_per_m": 0.0}
    settings = {"seed": seed, "frames": frames, "camera": camera, "track": track}
    return simulate_drive(SimulationSettings.model_validate(settings), folder)


def cut_tub(tub: Path, out: Path, first: int, frames: int) -> Path:
    """Write some rows of a tub as another tub."""
    head = [line for line in (tub / "manifest.json").read_text().splitlines() if line.strip()]
    state = json.loads(head[-1])
    lines = [line for name in state["paths"] for line in (tub / name).read_text().splitlines()]
    rows = sorted((json.loads(line) for line in lines if line.strip("\0 ")), key=lambda row: row["_index"])
    kept = rows[first : first + frames]
    assert len(kept) == frames, f"{tub}: {len(rows)} rows"
    (out / "images").mkdir(parents=True)
    for row in kept:
        shutil.copy(tub / "images" / row["cam/image_array"], out / "images")
    (out / "catalog_0.catalog").write_text("".join(json.dumps(row) + "\n" for row in kept))
    state |= {"paths": ["catalog_0.catalog"], "current_index": kept[-1]["_index"] + 1, "deleted_indexes": []}
    (out / "manifest.json").write_text("\n".join([*head[:-1], json.dumps(state)]) + "\n")
    return out


def simulated_drives(count: int, folder: Path) -> list[FleetDrive]:
    """Simulate drives below a folder."""
    return [
        FleetDrive(f"sim-{k}", str(short_drive(k, folder / f"sim-{k}")), "", _SIMULATED_CM)
        for k in range(1, count + 1)
    ]


def sixty_drives(shared_data: Path, folder: Path) -> list[FleetDrive]:
    """Write simulated and real drives below a folder."""
    drives = simulated_drives(SIMULATED, folder)
    for tub, width_cm in TUBS_CM.items():
        with_gaps = folder / f"{tub}-with-gaps"
        program = shared_data.parent / "tools" / "as_people_record.py"
        subprocess.run(
            [sys.executable, program, shared_data / tub, with_gaps], check=True, capture_output=True
        )
        sources = [(tub, shared_data / tub, CUTS, 170), (f"{tub}-gaps", with_gaps, WITH_GAPS, 80)]
        for name, source, count, step in sources:
            for k in range(count // len(TUBS_CM)):
                cut = cut_tub(source, folder / f"{name}-{k}", step * k, FRAMES)
                drives.append(FleetDrive(cut.name, str(cut), "", width_cm))
        shutil.rmtree(with_gaps)
    return drives
