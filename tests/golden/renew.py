"""Do the golden runs again and replace what is expected of them; prints what changed, for the commit message.

On purpose only: ``make golden-renew``, or ``python tests/golden/renew.py [simulated] [recorded]``. The
real drive is one of those in LANENET_SHARED_DATA, and its run is left as it is without.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import golden_runs
import yaml
from comparison import compare, table
from tolerances import TOLERANCES


def main(names: list[str]) -> None:
    """Renew some runs, or all."""
    shared = Path(os.environ.get("LANENET_SHARED_DATA") or "nowhere")
    manifest = json.loads(golden_runs.MANIFEST.read_text()) if golden_runs.MANIFEST.exists() else {}
    for name in names or list(golden_runs.RUNS):
        inputs = [shared] if name == "recorded" else []
        if inputs and not (shared / "donkey_circuit").is_dir():
            print(f"{name}: left as it is, no donkey_circuit in {shared} (LANENET_SHARED_DATA)")  # noqa: T201
            continue
        with tempfile.TemporaryDirectory() as folder:
            work = Path(folder)
            found = golden_runs.RUNS[name](work, *inputs)
            if (golden_runs.HERE / f"{name}.npz").exists():
                fine = golden_runs.fine_lines(work / "map")
                rows = compare(golden_runs.load_results(name), found, fine, TOLERANCES[name])
                print(f"{name}: old -> new\n{table(rows)}")  # noqa: T201
            golden_runs.save_results(name, found)
            manifest[name] = _origin(name, work)
    golden_runs.MANIFEST.write_text(json.dumps(manifest, indent=2, sort_keys=True) + "\n")


def _origin(name: str, work: Path) -> dict[str, object]:
    """What the results of a run come from."""

    def git(*words: str) -> str:
        return subprocess.check_output(["git", "-C", str(golden_runs.ROOT), *words], text=True).strip()

    settings = {"simulate": work / "drive" / "simulation.yaml", "map": work / "map" / "settings.yaml"}
    seeds = {
        verb: yaml.safe_load(path.read_text())["seed"] for verb, path in settings.items() if path.exists()
    }
    return {
        "commit": git("rev-parse", "HEAD"),
        "changed_since": bool(git("status", "--porcelain", "--", "lanenet", "datagen")),
        "config": f"tests/golden/{name}.yaml",
        "seeds": seeds,
        "python": platform.python_version(),
        **golden_runs.machine(),
    }


if __name__ == "__main__":
    main(sys.argv[1:])
