"""The unit that starts lanenet at boot."""

import configparser
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bus_wire import BUS, SETTINGS, Wire
from typer.testing import CliRunner

from lanenet.cli.app import app
from lanenet.errors import MotorMayRunError
from lanenet.onboard.neutral import PATIENCE_S
from lanenet.onboard.stop import CLOSE_S

ROOT = Path(__file__).resolve().parents[2]
UNIT = ROOT / "contrib" / "lanenet.service"


@pytest.fixture
def service():
    parser = configparser.ConfigParser(interpolation=None, strict=False)
    parser.optionxform = str
    parser.read_string(UNIT.read_text())
    return parser["Service"]


def test_it_touches_little(tmp_path):
    tool = shutil.which("systemd-analyze")
    if tool is None:
        pytest.skip("no systemd-analyze on this machine")
    words = [tool, "security", "--offline=true", "--threshold=20", "--no-pager", str(UNIT)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30)
    if "unrecognized option" in done.stderr:
        pytest.skip("this systemd-analyze judges no files")
    # 89 without any of the lines that confine it, 11 with them; the threshold allows for other versions.
    assert done.returncode == 0, done.stdout[-300:]


def test_it_never_arms_the_motor(service):
    starts = [value for key, value in service.items() if key.startswith("Exec")]
    assert starts and not any("--arm" in value for value in starts)


def test_its_command_is_one_of_lanenets(service):
    program, verb, *words = shlex.split(service["ExecStart"])
    assert Path(program).name == "lanenet" and verb == "drive" and words == ["car.yaml"]
    assert shlex.split(service["ExecStopPost"]) == [program, "stop", *words]
    # The same words with a real car's file, without its camera: it gets as far as the missing device.
    car = str(ROOT / "configs" / "car" / "replay.yaml")
    done = CliRunner().invoke(app, [verb, car, "source.path=/nowhere", "--dry-run"])
    assert done.exit_code == 1 and "replay: /nowhere: no such drive" in done.output


def test_systemd_finds_nothing_wrong_with_it(tmp_path):
    tool = shutil.which("systemd-analyze")
    if tool is None:
        pytest.skip("no systemd-analyze on this machine")
    # User, folder and program are those of a car; here they are only checked for their form.
    text = UNIT.read_text().replace("/home/pi/lanenet-env/bin/lanenet", "/bin/true")
    unit = tmp_path / "lanenet.service"
    unit.write_text(text)
    done = subprocess.run([tool, "verify", str(unit)], capture_output=True, text=True, timeout=30)
    complaints = [line for line in done.stderr.splitlines() if "lanenet.service" in line]
    assert complaints == []


@pytest.fixture
def in_systemd(tmp_path):
    """Starts the unit, with an emulated bus, in a systemd of its own; ends with it."""
    settings = SETTINGS.model_dump_json(exclude_unset=True).replace('"', '\\"')
    lines = {
        "ExecStart": f'{sys.executable} {ROOT / "tests" / "sim" / "neutral_times.py"} "{settings}"',
        "ExecStopPost": f"{sys.executable} -m lanenet stop {tmp_path / 'car.yaml'}",
        "WorkingDirectory": str(tmp_path),
    }
    (tmp_path / "car.yaml").write_text("actuator: {kind: pca9685}\n")
    # What is left out is for the user and devices of a car, or needs a manager of the system.
    kept = ("Type", "KillSignal", "KillMode", "TimeoutStopSec", "RestartPreventExitStatus", *lines)
    unit = [
        f"{key}={lines.get(key, value)}"
        for key, value in (line.split("=", 1) for line in UNIT.read_text().splitlines() if "=" in line)
        if key in kept
    ]
    path = os.pathsep.join([str(BUS), str(ROOT)])
    unit += [f"Environment=PYTHONPATH={path} LANENET_TEST_BUS={tmp_path}"]
    (tmp_path / "units").mkdir()
    for name in ("basic", "shutdown"):
        (tmp_path / "units" / f"{name}.target").write_text("[Unit]\nDefaultDependencies=no\n")

    def run(*strikes, restart=False):
        """Strike the driving car; returns when it was struck, the processes, and how the unit ended."""
        more = ["Restart=on-failure"] if restart else []
        assert not restart or more[0] in UNIT.read_text()
        (tmp_path / "units" / "car.service").write_text("\n".join(["[Service]", *unit, *more, ""]))
        words = ["bash", str(ROOT / "tests" / "support" / "in_systemd.sh"), str(tmp_path)]
        words += [sys.executable, str(Path(__file__)), str(tmp_path), *strikes]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT / "tests" / "support"), str(ROOT)]),
        }
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=environment)
        if done.returncode == 77:
            pytest.skip(f"no systemd can be started here: {done.stderr[-200:] or 'not root, or no systemd'}")
        assert done.returncode == 0, done.stdout + done.stderr
        struck_s, car, guard, *end = done.stdout.split()
        return float(struck_s), int(car), int(guard), end

    return run


def strike_in_systemd(folder, strikes):
    """Beside that systemd: start the car, strike it, wait until the unit has ended."""

    def control(*words):
        words = ["systemctl", "--user", "--no-pager", *words]
        return subprocess.run(words, check=True, capture_output=True, text=True, timeout=60).stdout.strip()

    control("start", "car.service")
    guard = Wire(folder).wait(driving=True, after_s=0.0).process
    car = int(control("show", "car.service", "--property=MainPID", "--value"))
    time.sleep(0.3)
    struck_s = time.monotonic()
    for strike in strikes:
        if strike == "outage":
            (folder / "outage").write_text("inf fails")
        elif strike == "lanenet stop":
            environment = {**os.environ, "LANENET_TEST_BUS": str(folder)}
            environment["PYTHONPATH"] = os.pathsep.join([str(BUS), environment["PYTHONPATH"]])
            words = [sys.executable, "-m", *strike.split(), str(folder / "car.yaml")]
            subprocess.run(words, check=True, env=environment, capture_output=True)
        else:
            control(*strike.split(), "car.service")
    end_s = time.monotonic() + 60.0
    while control("show", "car.service", "--property=ActiveState", "--value") not in ("failed", "inactive"):
        assert time.monotonic() < end_s
        time.sleep(0.05)
    told = control("show", "car.service", "--property=ExecMainCode,ExecMainStatus,NRestarts")
    sys.stdout.write(f"{struck_s} {car} {guard} {told}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("strikes", "by_guard"),
    [
        (["stop"], True),
        (["kill --kill-whom=main --signal=KILL"], True),
        # Stopped first, or the guard sees the loop die before it dies itself.
        (["kill --signal=STOP", "kill --signal=KILL"], False),
    ],
    ids=["stopped", "loop killed", "all killed"],
)
def test_it_ends_in_neutral_under_systemd(in_systemd, tmp_path, strikes, by_guard):
    struck_s, car, guard, _ = in_systemd(*strikes)
    wire = Wire(tmp_path)
    neutral = [write for write in wire.throttles(driving=False) if write.t_s >= struck_s]
    assert max(write.t_s for write in wire.throttles(driving=True)) < neutral[0].t_s
    # The guard was not killed before it had done its work, and ExecStopPost has done it again.
    assert (neutral[0].process == guard) == by_guard
    assert neutral[-1].process not in (car, guard)


def test_a_drive_that_was_stopped_on_purpose_is_not_started_again(in_systemd, tmp_path):
    struck_s, _, _, end = in_systemd("lanenet stop", restart=True)
    assert {"ExecMainStatus=0", "NRestarts=0"} <= set(end)
    assert not [write for write in Wire(tmp_path).throttles(driving=True) if write.t_s > struck_s + 0.5]


@pytest.mark.slow
@pytest.mark.parametrize("strikes", [["outage"], ["outage", "stop"]], ids=["it ends itself", "stopped"])
def test_a_neutral_that_is_not_confirmed_ends_with_its_code_and_no_new_drive(in_systemd, strikes):
    *_, end = in_systemd(*strikes, restart=True)
    # CLD_EXITED: it was not killed by the time limit.
    assert {"ExecMainCode=1", f"ExecMainStatus={MotorMayRunError.exit_code}", "NRestarts=0"} == set(end)


def test_the_time_to_stop_is_longer_than_the_patience_and_the_code_is_known(service):
    assert float(service["TimeoutStopSec"]) > PATIENCE_S + CLOSE_S
    assert int(service["RestartPreventExitStatus"]) == MotorMayRunError.exit_code


if __name__ == "__main__":
    signal.alarm(100)
    strike_in_systemd(Path(sys.argv[1]), sys.argv[2:])
