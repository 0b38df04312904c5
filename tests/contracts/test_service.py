"""The unit that starts lanenet at boot."""

import configparser
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lanenet.cli.app import app

ROOT = Path(__file__).resolve().parents[2]
UNIT = ROOT / "contrib" / "lanenet.service"


@pytest.fixture
def service():
    parser = configparser.ConfigParser(interpolation=None)
    parser.optionxform = str
    parser.read_string(UNIT.read_text())
    return parser["Service"]


def test_it_never_arms_the_motor(service):
    starts = [value for key, value in service.items() if key.startswith("Exec")]
    assert starts and not any("--arm" in value for value in starts)


def test_its_command_is_one_of_lanenets(service):
    program, verb, *words = shlex.split(service["ExecStart"])
    assert Path(program).name == "lanenet" and verb == "drive" and words == ["car.yaml"]
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
