"""Writes contrib/car/requirements-3.*.txt: all packages that a car installs, with their wheels' hashes.

    python contrib/car/pin.py        (needs the package index; a minute)

pip resolves the base installation and the extra `car` under constraints.txt, once for each Python and
processor below, without installing anything, and reports the wheels that it would take.
"""

import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PYTHONS = ("3.11", "3.12", "3.13")
#: A Raspberry Pi, and workstations, on which the file is tested.
PROCESSORS = ("aarch64", "x86_64")
LIBRARIES = ("manylinux2014", "manylinux_2_17", "manylinux_2_27", "manylinux_2_28")
#: The picamera2 of Raspberry Pi OS Bookworm, which has Python 3.11, is compiled for NumPy 1; OpenCV 5 is not.
BOOKWORM, BOOKWORM_PINS = "3.11", {"numpy": "1.26.4", "opencv-python-headless": "4.11.0.86"}
HEAD = """\
# What a car with Python {} installs: all packages, with the hashes of their wheels for 64-bit Arm and x86-64.
# Written by contrib/car/pin.py.
"""


def resolve(python: str, processor: str) -> dict[str, tuple[str, str]]:
    """Return version and SHA-256 of every wheel by its package."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [*project["project"]["dependencies"], *project["project"]["optional-dependencies"]["car"]]
    wanted += project["build-system"]["requires"]
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
    if python == BOOKWORM:
        pins |= BOOKWORM_PINS
    with tempfile.TemporaryDirectory() as folder:
        constraints, report = Path(folder) / "constraints.txt", Path(folder) / "report.json"
        constraints.write_text("".join(f"{name}=={version}\n" for name, version in pins.items()))
        words = ["install", "--dry-run", "--ignore-installed", "--quiet", "--target", f"{folder}/none"]
        words += ["--only-binary=:all:", "--implementation", "cp", "--python-version", python]
        for library in LIBRARIES:
            words += ["--platform", f"{library}_{processor}"]
        words += ["--report", str(report), "--constraint", str(constraints), *wanted]
        subprocess.run([sys.executable, "-m", "pip", *words], check=True)
        found = json.loads(report.read_text())["install"]
    return {
        item["metadata"]["name"].lower().replace("_", "-"): (
            item["metadata"]["version"],
            item["download_info"]["archive_info"]["hashes"]["sha256"],
        )
        for item in found
    }


def main() -> None:
    """Resolve for every Python and processor, and write a file for each Python."""
    for python in PYTHONS:
        hashes: dict[tuple[str, str], set[str]] = {}
        for processor in PROCESSORS:
            for name, (version, sha256) in resolve(python, processor).items():
                hashes.setdefault((name, version), set()).add(sha256)
        lines = [HEAD.format(python)]
        for (name, version), found in sorted(hashes.items()):
            lines.append(
                " \\\n    ".join([f"{name}=={version}", *(f"--hash=sha256:{h}" for h in sorted(found))])
                + "\n"
            )
        Path(__file__).with_name(f"requirements-{python}.txt").write_text("".join(lines))


if __name__ == "__main__":
    main()
