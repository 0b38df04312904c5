"""Eight ``map`` runs into one folder at once."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from lanenet.data.maps.folder import check_map_files

SUPPORT = Path(__file__).resolve().parents[1] / "support"
#: Eight processes map into one folder, each begun a little later; the mapping is a stand-in, the lock and the
#: writing are real. Prints what became of each, a line of JSON.
PROGRAM = """
import json, os, sys, time
from pathlib import Path
import numpy as np
sys.path.insert(0, sys.argv[2])
from small_map import small_map
from datagen import pipeline
from datagen.settings import MapSettings
from lanenet.data.files import atomic_folder, write_text
from lanenet.data.maps.folder import check_map_files, write_map
from lanenet.errors import LanenetError

out, rng = Path(sys.argv[1]), np.random.default_rng(int(sys.argv[3]))
waits_s = rng.uniform(0.0, 0.03, (8, 3))

def mapping(attempt, out, *_):
    time.sleep(waits_s[k, 1])
    with atomic_folder(out, "map", check_map_files) as folder:
        write_text(folder / "settings.yaml", "seed: 0\\n")
        time.sleep(waits_s[k, 2])
        write_map(folder, small_map(), {"frame": np.arange(3)}, {"process": os.getpid()}, "given")

pipeline._map_drive = mapping
for k in range(8):
    if os.fork() == 0:
        said = ""
        try:
            pipeline.map_drive(pipeline.MapRequest(Path("drive"), 40.0), MapSettings(), out)
        except LanenetError as error:
            said = str(error)
        os.write(1, (json.dumps([os.getpid(), said]) + "\\n").encode())
        os._exit(0)
    time.sleep(waits_s[k, 0])
for _ in range(8):
    os.wait()
"""


@pytest.mark.slow
def test_one_writes_and_the_others_are_told_who(tmp_path: Path) -> None:
    out = tmp_path / "maps" / "one"
    counts: Counter[str] = Counter()
    for seed in range(4):
        words = [sys.executable, "-c", PROGRAM, str(out), str(SUPPORT), str(seed)]
        done = subprocess.run(words, capture_output=True, text=True, check=True)
        said = dict(json.loads(line) for line in done.stdout.splitlines())
        assert len(said) == 8
        wrote = [process for process, refusal in said.items() if not refusal]
        for refusal in filter(None, said.values()):
            assert str(out) in refusal and "process" in refusal, refusal
        assert json.loads((out / "report.json").read_text())["process"] in wrote
        check_map_files(out)
        assert [path.name for path in out.parent.iterdir()] == ["one"]
        counts.update(wrote=len(wrote), refused=8 - len(wrote))
    assert counts["refused"] >= 4, "they did not overlap"
