"""What the car installs: detection works, and there is no torch."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CHECKPOINT = ROOT / "checkpoints" / "small"


@pytest.mark.slow
def test_detect_in_an_empty_environment(tmp_path):
    environment = tmp_path / "env"
    subprocess.run([sys.executable, "-m", "venv", environment], check=True)
    python = environment / "bin" / "python"
    subprocess.run([python, "-m", "pip", "install", "-q", ROOT], check=True, timeout=300)
    out = tmp_path / "lanes.csv"
    words = ["detect", CHECKPOINT / "example.jpg", "--detector", "network", "--out", out]
    words += ["--model", CHECKPOINT / "model.onnx", "--camera", CHECKPOINT / "camera.yaml"]
    subprocess.run([environment / "bin" / "lanenet", *words], check=True, timeout=60, cwd=tmp_path)
    header, row = out.read_text().splitlines()
    assert header.split(",")[2] == "left_0_cm" and float(row.split(",")[2]) < 0.0
    for package in ("torch", "numba", "scipy", "matplotlib"):
        found = subprocess.run([python, "-c", f"import {package}"], capture_output=True, cwd=tmp_path)
        assert found.returncode != 0, f"{package} is part of the base installation"
