"""The parts in a real Donkeycar: its own package, its own vehicle loop, a real tub's frames."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: The tub's scale is not known. At this one the network is sure of the road, which it never saw.
CAMERA = """
format: lanenet-camera/1
model: fisheye
width: 160
height: 120
K: [[80.0, 0.0, 79.5], [0.0, 80.0, 59.5], [0.0, 0.0, 1.0]]
D: [-0.03, 0.0, 0.0, 0.0]
mounting: {height_cm: 10.0, pitch_down_rad: 0.262}
car: {wheelbase_cm: 17.0}
"""
PILOT = f"""
camera: camera.yaml
detector: {{kind: network, model: {ROOT / "checkpoints/small/model.onnx"}, any_camera: true}}
control: {{steering: {{wheelbase_cm: 17, look_ahead_cm: 30}}}}
"""
#: A stretch with bends to both sides, most of them to the right.
FIRST, FRAMES = 200, 200


@pytest.mark.slow
def test_parts_in_donkeycars_vehicle_loop(shared_data, tmp_path):
    """One environment holds both: donkeycar 5.3 pins numpy below 2 and Python 3.11."""
    python = shutil.which("python3.11")
    if python is None:
        pytest.skip("donkeycar 5.3 needs Python 3.11, which is not installed")
    environment = tmp_path / "env"
    subprocess.run([python, "-m", "venv", environment], check=True)
    install = [environment / "bin" / "python", "-m", "pip", "install", "-q", "donkeycar==5.3.*", ROOT]
    subprocess.run(install, check=True, timeout=600)
    check = subprocess.run([*install[:3], "check"], capture_output=True, text=True)
    assert check.returncode == 0, check.stdout

    # A copy: Donkeycar's tubs write when they are closed.
    tub = shutil.copytree(shared_data / "donkey_circuit", tmp_path / "tub")
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "pilot.yaml").write_text(PILOT)
    script = ROOT / "tests" / "contracts" / "donkeycar_loop.py"
    words = [tub, tmp_path / "pilot.yaml", tmp_path / "camera.yaml", str(FIRST), str(FRAMES)]
    words.append(tmp_path / "out.json")
    subprocess.run([environment / "bin" / "python", script, *words], check=True, timeout=120, cwd=tmp_path)

    told = json.loads((tmp_path / "out.json").read_text())
    rows = told["rows"]
    assert len(rows) == FRAMES, "Donkeycar's loop ends quietly when a part fails"
    assert told["shapes"] == {"cv": [120, 160, 3], "view": [120, 160, 3]}
    assert told["versions"]["donkeycar"].startswith("5.3") and told["versions"]["numpy"].startswith("1.26")
    assert all(-1.0 <= angle <= 1.0 and 0.0 <= throttle <= 0.4 for _, angle, throttle, _, _ in rows)
    # A pilot that doubts all the time would pass what follows.
    assert sum(throttle > 0.0 for _, _, throttle, _, _ in rows) > 0.8 * FRAMES
    # The part and the controller see the same frames, so they steer alike.
    assert max(abs(row[1] - row[3]) for row in rows) < 0.2
    # Left is left: where both turn the wheels, the pilot mostly turns them as the driver did.
    both = [user * angle for user, angle, *_ in rows if abs(user) > 0.2 and abs(angle) > 0.05]
    same = sum(product > 0 for product in both)
    assert len(both) > 30 and same > 2 * (len(both) - same)
