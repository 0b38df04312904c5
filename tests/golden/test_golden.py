"""Golden runs: two drives give the map, labels and detections that they gave before.

They guard changes that are meant to change nothing. What a change of algorithm does is shown by
``make golden-renew``, and belongs into its commit message.
"""

import json

import golden_runs
import pytest
from comparison import compare, table
from tolerances import EXACT, TOLERANCES

# One test a run, with all that it compares: tests of one module may be spread over several processes, and
# each of them would do the run again.
pytestmark = pytest.mark.slow


def check(name, found, work):
    origin = json.loads(golden_runs.MANIFEST.read_text())[name]
    # The same processor and versions compute the same to the last digit that the file has.
    exact = all(origin[key] == value for key, value in golden_runs.machine().items())
    limits = {"*": EXACT} if exact else TOLERANCES[name]
    rows = compare(golden_runs.load_results(name), found, golden_runs.fine_lines(work / "map"), limits)
    changed = [row.field for row in rows if not row.passes]
    if changed:
        where = "the processor and versions of the manifest" if exact else "another processor or version"
        head = f"{name} run, on {where}: {len(changed)} of {len(rows)} fields changed (*)"
        pytest.fail(f"{head}\n{table(rows)}", pytrace=False)


def test_simulated_drive_gives_what_it_gave(tmp_path):
    check("simulated", golden_runs.simulated_run(tmp_path), tmp_path)


def test_recorded_drive_gives_what_it_gave(tmp_path, shared_data):
    if not (shared_data / "donkey_circuit").is_dir():
        pytest.skip(f"no donkey_circuit in {shared_data}")
    check("recorded", golden_runs.recorded_run(tmp_path, shared_data), tmp_path)
