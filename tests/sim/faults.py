"""The round of faults: outages of the bus, late and hanging cameras, settings that cannot be right; a table.

``python faults.py [REPETITIONS]``; fails if anything in the table does.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from pathlib import Path

import outages

TESTS = Path(__file__).resolve().parents[1]
#: What is tried by tests, and where they are.
GROUPS = {
    "drives with cameras at fault": ["sim/test_drive_faults.py", "-k", "camera"],
    "late frames and unknown ages": ["unit/onboard/test_frame_age.py", "unit/onboard/test_camera_delay.py"],
    "cameras that hang": ["unit/onboard/test_frame_check.py"],
    "drivers, damaged images": ["unit/onboard/test_cameras.py", "unit/onboard/test_camera_jpegs.py"],
    "the state of the chip": ["unit/onboard/test_pca9685.py"],
    "settings that constrain each other": ["unit/onboard/test_settings_that_constrain.py"],
    "myconfig.py": ["unit/onboard/test_myconfig.py", "contracts/test_myconfig_cases.py"],
    "the service": ["contracts/test_service.py"],
}


def run_group(words: list[str]) -> tuple[str, bool]:
    """Run tests; returns pytest's closing line and whether all is well: some ran, and none failed."""
    places = [str(TESTS / word) if word.endswith(".py") else word for word in words]
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", *places]
    done = subprocess.run(command, capture_output=True, text=True, cwd=TESTS.parent, check=False)
    counts = re.findall(r"\d+ (?:passed|failed|error|skipped)\w*", done.stdout)
    # Sentences of pytest's own end are no table.
    return ", ".join(counts) or done.stdout[-200:], done.returncode == 0 and "passed" in done.stdout


def main(words: list[str]) -> int:
    begun_s = time.monotonic()
    failed = outages.main(words) != 0
    for name, tests in GROUPS.items():
        text, well = run_group(tests)
        failed |= not well
        print(f"{name:36} {text}{'' if well else '  FAILED'}", flush=True)  # noqa: T201 (the table)
    print(f"{(time.monotonic() - begun_s) / 60.0:.1f} minutes")  # noqa: T201
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
