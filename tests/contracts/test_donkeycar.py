"""lanenet in a real Donkeycar: its own package, vehicle loop, page, and a drive train without hardware."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from datagen.world.simulate import simulate_drive
from datagen.world.world import SimulationSettings
from lanenet.config import load_settings
from lanenet.data.drives import open_drive
from lanenet.onboard.donkey import CvLaneController

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).parent
CHECKPOINT = ROOT / "checkpoints" / "small"
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
detector: {{kind: network, model: {CHECKPOINT / "model.onnx"}, any_camera: true}}
control: {{steering: {{wheelbase_cm: 17, look_ahead_cm: 30}}}}
"""
#: A stretch with bends to both sides, most of them to the right.
FIRST, FRAMES = 200, 200
#: Counts of Donkeycar's default drive train: channel, at -1, at rest, at 1.
STEERING, THROTTLE = (1, 460, 375, 290), (0, 220, 370, 500)
#: The vehicle turns 20 times a second; chosen: ten turns, on a busy machine.
PROMPT_S = 0.5

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def python() -> Path:
    """Python of an environment that holds donkeycar 5.3, which pins NumPy below 2, and lanenet."""
    folder = Path(os.environ.get("LANENET_DONKEYCAR", ROOT / ".venv-donkeycar"))
    if not (folder / "bin" / "python").exists():
        pytest.skip(f"no donkeycar at {folder}: make donkeycar")
    return folder / "bin" / "python"


def test_one_environment_holds_both(python):
    done = subprocess.run([python, "-m", "pip", "check"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_parts_in_donkeycars_vehicle_loop(python, shared_data, tmp_path):
    # A copy: Donkeycar's tubs write when they are closed.
    tub = shutil.copytree(shared_data / "donkey_circuit", tmp_path / "tub")
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "pilot.yaml").write_text(PILOT)
    words = [tub, tmp_path / "pilot.yaml", tmp_path / "camera.yaml", str(FIRST), str(FRAMES)]
    words.append(tmp_path / "out.json")
    subprocess.run([python, HERE / "donkeycar_loop.py", *words], check=True, timeout=120, cwd=tmp_path)

    told = json.loads((tmp_path / "out.json").read_text())
    rows = told["rows"]
    assert len(rows) == FRAMES, "Donkeycar's loop ends quietly when a part fails"
    assert told["shapes"] == {"cv": [120, 160, 3], "view": [120, 160, 3]}
    assert told["versions"]["donkeycar"].startswith("5.3") and told["versions"]["numpy"].startswith("1.26")
    assert all(-1.0 <= angle <= 1.0 and 0.0 <= throttle <= 0.4 for _, angle, throttle, _, _ in rows)
    # A pilot that doubts all the time would pass what follows.
    assert sum(throttle > 0.0 for _, _, throttle, _, _ in rows) > 0.8 * FRAMES
    # The part and the controller see the same frames, so they steer alike; on a busy machine a turn comes
    # late for one of them.
    assert np.quantile([abs(row[1] - row[3]) for row in rows], 0.95) < 0.2
    # Left is left: where both turn the wheels, the pilot mostly turns them as the driver did.
    both = [user * angle for user, angle, *_ in rows if abs(user) > 0.2 and abs(angle) > 0.05]
    same = sum(product > 0 for product in both)
    assert len(both) > 30 and same > 2 * (len(both) - same)


class Session:
    """What a browser at Donkeycar's page saw, and what reached the chip of the drive train meanwhile."""

    def __init__(self, car: Path, out: Path) -> None:
        self.car, self.out = car, out
        self.told: dict[str, Any] = json.loads((out / "told.json").read_text())
        self.steps = {step["name"]: step for step in self.told["steps"]}
        lines = [line.split() for line in (car / "pulses.txt").read_text().splitlines()]
        self.pulses = [(float(t), int(channel), int(counts)) for t, channel, counts in lines]

    def commands(self, name: str, output: tuple[int, int, int, int], after_s: float = PROMPT_S) -> np.ndarray:
        """Commands that an output held in a step from some time after its begin, in order."""
        channel, low, middle, high = output
        begin_s, end_s = self.steps[name]["begin_s"] + after_s, self.steps[name]["end_s"]
        mine = [(t, counts) for t, c, counts in self.pulses if c == channel and t < end_s]
        held = [counts for (_, counts), (until_s, _) in pairwise([*mine, (end_s, 0)]) if until_s > begin_s]
        return np.interp(held, *zip(*sorted([(low, -1.0), (middle, 0.0), (high, 1.0)]), strict=True))

    def image(self, name: str) -> np.ndarray:
        return cv2.imread(str(self.out / f"{name}.jpg"))


@pytest.fixture(scope="module")
def film(tmp_path_factory) -> Path:
    """A simulated drive, for Donkeycar's camera that shows images of a folder."""
    folder = tmp_path_factory.mktemp("drive")
    settings = load_settings(SimulationSettings, ROOT / "configs" / "drives" / "example.yaml")
    return simulate_drive(settings, folder / "drive")


@pytest.fixture(scope="module")
def session(python, film, tmp_path_factory) -> Session:
    """A car made by ``donkey createcar`` and the lines of the document, driven from the page for 15 s."""
    folder = tmp_path_factory.mktemp("donkeycar")
    car, out = folder / "mycar", folder / "out"
    out.mkdir()
    words = [python.parent / "donkey", "createcar", "--path", car, "--template", "cv_control"]
    subprocess.run(words, check=True, timeout=60, capture_output=True)
    for name in ("Adafruit_PCA9685.py", "Adafruit_GPIO.py"):
        shutil.copy(HERE / "donkeycar_chip.py", car / name)
    shutil.copy(CHECKPOINT / "camera.yaml", car)
    pilot = (ROOT / "configs" / "donkeycar" / "pilot.yaml").read_text()
    (car / "lanenet.yaml").write_text(
        pilot.replace("../../checkpoints/small/camera.yaml", "camera.yaml").replace("../../", f"{ROOT}/")
    )
    for k, image in enumerate(sorted((film / "images").iterdir())):
        (folder / f"{k}_.jpg").symlink_to(image)
    with (car / "myconfig.py").open("a") as file:
        file.write(documented_lines().replace("/home/pi/mycar", str(car)))
        file.write(f'\nCAMERA_TYPE = "IMAGE_LIST"\nPATH_MASK = "{folder}/*.jpg"\n')
    done = subprocess.run(
        [python, HERE / "donkeycar_page.py", car, out], timeout=120, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr + (car / "log.txt").read_text()
    return Session(car, out)


def drawn_share(image: np.ndarray, film: Path) -> float:
    """Share of the pixels that differ from the most similar image of the film by more than JPEG does."""
    few = np.s_[::3, ::3]
    images = (cv2.imread(str(path))[few].astype(np.int16) for path in (film / "images").iterdir())
    return min(float((np.abs(image[few] - other).max(axis=2) > 60).mean()) for other in images)


def documented_lines() -> str:
    """The block for myconfig.py in the document."""
    text = (ROOT / "docs" / "raspberry_pi.md").read_text()
    block = text.partition("\n## In a Donkeycar\n")[2].partition("```python\n")[2].partition("```")[0]
    assert "CvLaneController" in block
    return block


def test_the_page_is_there_and_the_vehicle_ends_well(session):
    for part in ("mode_select", "record_button", "brake_button", 'src="/video"', 'value="local_angle"'):
        assert part in session.told["page"]
    assert session.told["code"] == 0 and "Traceback" not in (session.car / "log.txt").read_text()
    # Ctrl-C sets the motor to rest.
    assert [counts for _, channel, counts in session.pulses if channel == 0][-1] == 370


def test_a_person_drives_in_mode_user(session):
    assert session.commands("user", STEERING) == pytest.approx(0.5, abs=0.02)
    assert session.commands("user", THROTTLE) == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize("name", ["stop", "stop of the pilot"])
def test_stop_sets_the_motor_to_rest(session, name):
    assert (session.commands(name, THROTTLE) == 0.0).all()
    assert (session.commands(name, STEERING) == 0.0).all()
    assert {"driveMode": "user", "recording": False} in session.told["heard"]


def test_the_pilot_steers_in_auto_steer_and_the_person_has_the_throttle(session):
    assert session.commands("local_angle", THROTTLE) == pytest.approx(0.2, abs=0.02)
    assert (session.commands("local_angle at rest", THROTTLE) == 0.0).all()
    assert len(set(session.commands("local_angle", STEERING))) > 5


def test_the_pilot_drives_in_full_auto_and_begins_gently(session):
    assert (session.commands("local", THROTTLE) > 0.1).all()
    begin = session.commands("local", THROTTLE, after_s=0.0)
    # By 1 per second at most, so by 0.05 in a turn, or by 0.1 where a turn takes twice its time.
    assert begin[0] == 0.0 and begin.max() < 0.26 and np.diff(begin).max() < 0.12
    assert len(set(session.commands("local", STEERING))) > 5


def test_the_page_that_is_closed_stops_nothing(session):
    """What Donkeycar does, and the document warns of."""
    assert (session.commands("page closed", THROTTLE) > 0.1).all()


def test_the_lane_is_drawn_into_the_stream_in_every_mode(session, film):
    for name, step in session.steps.items():
        assert 0.002 < drawn_share(session.image(name), film) < 0.05, f"{name}: lines on the camera's image"
        assert step["images"] > 10


def test_recordings_are_read_with_what_moved_the_car(session, film):
    """The tub has the camera's images, without lines, and the pilot's own steering beside each."""
    drive = open_drive(session.car / "data")
    assert not drive.problems and drive.commands.angle is not None and drive.commands.throttle is not None
    first_s = json.loads((session.car / "data" / "catalog_0.catalog").read_text().split("\n")[0])
    t_s = drive.t_s + first_s["_timestamp_ms"] / 1000.0
    rows = {
        name: np.flatnonzero((t_s > step["begin_s"] + PROMPT_S) & (t_s < step["end_s"]))
        for name, step in session.steps.items()
    }
    assert all(len(rows[name]) >= 10 for name in ("record", "local_angle", "local_angle at rest", "local"))
    assert not any(len(rows[name]) for name in ("user", "stop", "stop of the pilot", "local again"))
    assert drive.commands.angle[rows["record"]] == pytest.approx(0.5)
    assert drive.commands.throttle[rows["record"]] == pytest.approx(0.3)
    assert drive.commands.throttle[rows["local_angle"]] == pytest.approx(0.2)

    assert drawn_share(drive.image(int(rows["local"][0])), film) < 0.001

    auto = np.flatnonzero(
        (t_s > session.steps["local_angle"]["begin_s"]) & (t_s < session.steps["local"]["end_s"])
    )
    cfg = SimpleNamespace(LANENET_CONFIG=str(session.car / "lanenet.yaml"))
    alone = CvLaneController(None, cfg)
    steered = []
    for k in auto:
        alone.pilot._clock = lambda k=k: float(drive.t_s[k])
        mode = "local" if t_s[k] > session.steps["local"]["begin_s"] else "local_angle"
        before = drive.commands.angle[k - 1], drive.commands.throttle[k - 1]
        steered.append(alone.run(drive.image(int(k))[..., ::-1], mode, *before)[0])
    off = np.abs(np.array(steered) - drive.commands.angle[auto])
    assert np.median(off) < 0.05 and np.abs(steered).max() > 0.2
