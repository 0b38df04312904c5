"""What the car installs: detection works, there is no torch, it is small, and Arm has wheels for it."""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest

import lanenet

ROOT = Path(__file__).resolve().parents[2]
CHECKPOINT = ROOT / "checkpoints" / "small"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
COMPILED = PROJECT["tool"]["setuptools"]["ext-modules"]


def pinned(version=f"3.{sys.version_info.minor}"):
    """The packages of a car with this Python."""
    return ROOT / "contrib" / "car" / f"requirements-{version}.txt"


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """Folder with what ``make release`` builds."""
    folder = tmp_path_factory.mktemp("dist")
    environment = os.environ | {"PYTHON": sys.executable}
    subprocess.run([ROOT / "contrib" / "release", folder], check=True, timeout=600, env=environment)
    return folder


def interpreter(version):
    """A Python of this version on this machine, also one of pyenv that is not switched on; None if none."""
    if version == f"3.{sys.version_info.minor}":
        return sys.executable
    of_pyenv = Path(os.environ.get("PYENV_ROOT", "~/.pyenv")).expanduser() / "versions"
    named = [shutil.which(f"python{version}"), *sorted(of_pyenv.glob(f"{version}.*/bin/python{version}"))]
    works = (p for p in named if p and not subprocess.run([p, "-c", ""], capture_output=True).returncode)
    return next(works, None)


@pytest.mark.slow
@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_the_wheel_detects_in_an_empty_environment(tmp_path, release, version, monkeypatch):
    """One wheel for each kind of processor, and all versions of Python."""
    if (found := interpreter(version)) is None:
        pytest.skip(f"this machine has no Python {version}")
    environment = tmp_path / "env"
    subprocess.run([found, "-m", "venv", environment], check=True)
    monkeypatch.delenv("PYTHONPATH", raising=False)  # the clone would count as installed
    python, (wheel,) = environment / "bin" / "python", release.glob("lanenet-*.whl")
    for words in (["--require-hashes", "-r", pinned(version)], ["--no-deps", wheel]):
        subprocess.run([python, "-m", "pip", "install", "-q", *words], check=True, timeout=300)
    said = subprocess.run([environment / "bin" / "lanenet", "--version"], capture_output=True, cwd=tmp_path)
    assert said.stdout.decode().strip() == f"lanenet {lanenet.__version__}"
    compiled = [module["name"].rpartition(".")[0] for module in COMPILED]
    in_use = "from lanenet.perception.edges.compiled import loops_of; "
    in_use += f"assert all(loops_of(package) for package in {compiled})"
    subprocess.run([python, "-c", in_use], check=True, cwd=tmp_path)
    out = tmp_path / "lanes.csv"
    words = ["detect", CHECKPOINT / "example.jpg", "--out", out]
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
def test_the_source_archive_installs(tmp_path, release):
    (archive,) = release.glob("lanenet-*.tar.gz")
    assert archive.name == f"lanenet-{lanenet.__version__}.tar.gz"
    with tarfile.open(archive) as opened:
        names = {Path(*Path(name).parts[1:]).as_posix() for name in opened.getnames()}
    assert {
        "LICENSE",
        "CHANGELOG.md",
        "CITATION.cff",
        *(s for module in COMPILED for s in module["sources"]),
    } <= names
    words = ["install", "-q", "--no-deps", "--target", tmp_path / "there", archive]
    subprocess.run([sys.executable, "-m", "pip", *words], check=True, timeout=300)
    # The copy that was installed, with the packages of this environment.
    run = "import lanenet.__main__, datagen.pipeline, sys; print(lanenet.__file__); lanenet.__main__.main()"
    said = subprocess.run(
        [sys.executable, "-c", run, "--version"],
        check=True,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "there")},
    )
    place, version = said.stdout.splitlines()
    assert place.startswith(str(tmp_path / "there")) and version == f"lanenet {lanenet.__version__}"


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
    expected = {"numpy", "onnxruntime", "opencv-python-headless", "simplejpeg", "smbus2", "pyserial"}
    assert expected <= set(wheels)
    assert all(url.endswith(("_aarch64.whl", "-none-any.whl")) for url in wheels.values())
    assert "torch" not in wheels and "scipy" not in wheels


def pins(path):
    """Version by package, of a file of requirements."""
    lines = (line.split(" ")[0] for line in path.read_text().splitlines() if "==" in line)
    return {re.sub("[-_.]+", "-", name).lower(): version for name, version in (x.split("==") for x in lines)}


@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13"])
def test_the_car_installs_the_versions_of_the_constraints(version):
    project = [*PROJECT["project"]["dependencies"], *PROJECT["project"]["optional-dependencies"]["car"]]
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
