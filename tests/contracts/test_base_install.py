"""What the car installs: detection works, there is no torch, it is small, and Arm has wheels for it."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CHECKPOINT = ROOT / "checkpoints" / "small"


def pinned(version=f"3.{sys.version_info.minor}"):
    """The packages of a car with this Python."""
    return ROOT / "contrib" / "car" / f"requirements-{version}.txt"


@pytest.mark.slow
def test_detect_in_an_empty_environment(tmp_path):
    environment = tmp_path / "env"
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    python = environment / "bin" / "python"
    for words in (["--require-hashes", "-r", pinned()], ["--no-deps", "--no-build-isolation", ROOT]):
        subprocess.run([python, "-m", "pip", "install", "-q", *words], check=True, timeout=300)
    out = tmp_path / "lanes.csv"
    words = ["detect", CHECKPOINT / "example.jpg", "--detector", "network", "--out", out]
    words += ["--model", CHECKPOINT / "model.onnx", "--camera", CHECKPOINT / "camera.yaml"]
    subprocess.run([environment / "bin" / "lanenet", *words], check=True, timeout=60, cwd=tmp_path)
    header, row = out.read_text().splitlines()
    assert header.split(",")[2] == "left_0_cm" and float(row.split(",")[2]) < 0.0
    # Only what lanenet brings: every environment has pip, and some setuptools.
    packages = next((environment / "lib").glob("python*")) / "site-packages"
    others = ("pip", "setuptools", "pkg_resources", "_distutils_hack")
    files = [p for p in packages.rglob("*") if p.is_file() and p.relative_to(packages).parts[0] not in others]
    size_mb = sum(p.stat().st_size for p in files) / 2**20
    assert 100.0 < size_mb <= 350.0, f"the base installation takes {size_mb:.0f} MB"
    for package in ("torch", "numba", "scipy", "matplotlib"):
        found = subprocess.run([python, "-c", f"import {package}"], capture_output=True, cwd=tmp_path)
        assert found.returncode != 0, f"{package} is part of the base installation"


@pytest.mark.slow
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_wheels_for_a_raspberry_pi(tmp_path, version):
    """Python of Raspberry Pi OS Bookworm (3.11) and Trixie (3.13), 64 bit: nothing has to be compiled."""
    words = ["install", "--dry-run", "--ignore-installed", "--target", tmp_path / "none"]
    words += ["--only-binary=:all:", "--implementation", "cp", "--python-version", version]
    for platform in ("manylinux2014", "manylinux_2_27", "manylinux_2_28"):
        words += ["--platform", f"{platform}_aarch64"]
    words += ["--report", tmp_path / "report.json", "-q", "--require-hashes", "-r", pinned(version)]
    subprocess.run([sys.executable, "-m", "pip", *words], check=True, timeout=300)
    report = json.loads((tmp_path / "report.json").read_text())
    wheels = {i["metadata"]["name"].lower(): i["download_info"]["url"] for i in report["install"]}
    assert {"numpy", "onnxruntime", "opencv-python-headless", "smbus2", "pyserial"} <= set(wheels)
    assert all(url.endswith(("_aarch64.whl", "-none-any.whl")) for url in wheels.values())
    assert "torch" not in wheels and "scipy" not in wheels


def pins(path):
    """Version by package, of a file of requirements."""
    lines = (line.split(" ")[0] for line in path.read_text().splitlines() if "==" in line)
    return {re.sub("[-_.]+", "-", name).lower(): version for name, version in (x.split("==") for x in lines)}


@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_the_car_installs_the_versions_of_the_constraints(version):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project = [*project["project"]["dependencies"], *project["project"]["optional-dependencies"]["car"]]
    car, all_pins = pins(pinned(version)), pins(ROOT / "constraints.txt")
    assert {re.split("[<>=]", wanted)[0].lower() for wanted in project} < set(car)
    # Bookworm's picamera2 and Donkeycar need NumPy 1, and OpenCV 5 does not work with it.
    others = {"numpy", "opencv-python-headless"} if version == "3.11" else set()
    assert {name for name in car if car[name] != all_pins[name]} == others
    assert version != "3.11" or car["numpy"].startswith("1.")
    blocks = pinned(version).read_text().replace("\\\n", " ").splitlines()
    assert all("--hash=sha256:" in block for block in blocks if "==" in block)


@pytest.mark.parametrize("path", ["docs/raspberry_pi.md", "contrib/arm/prove"])
def test_the_car_is_installed_from_pinned_packages(path):
    text = (ROOT / path).read_text()
    assert "--require-hashes" in text and "contrib/car/requirements-" in text
