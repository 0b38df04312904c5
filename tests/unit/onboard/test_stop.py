from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import i2c_emulator
import pytest
from board_process import BoardProcess, build_host_board
from typer.testing import CliRunner

from lanenet import __main__
from lanenet.cli.app import app
from lanenet.errors import ConfigError, HardwareError, LanenetError, MotorMayRunError
from lanenet.onboard import neutral, stop
from lanenet.onboard.actuators.pca9685 import PCA9685
from lanenet.onboard.i2c import GUARD_MODULE, lock_owners

#: A drive that still starts, as far as others see.
STARTING = """
import fcntl, os, sys, time
fcntl.flock(os.open(sys.argv[3], os.O_RDONLY), fcntl.LOCK_SH)
print(flush=True)
time.sleep(60)
"""
#: Owns the chip, and ends as a guard does or, deaf, not at all by itself.
OWNER = """
import fcntl, signal, sys, time
if sys.argv[1] == "deaf":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
fcntl.lockf(0, fcntl.LOCK_EX, 1, 0x40)
print(flush=True)
time.sleep(60)
"""


@pytest.fixture
def bus(monkeypatch):
    bus = i2c_emulator.Bus(i2c_emulator.Chip())
    i2c_emulator.install(monkeypatch, bus)
    return bus


@pytest.fixture(autouse=True)
def hurried(monkeypatch):
    """Which priorities were asked for; the tests keep theirs."""
    asked = []
    monkeypatch.setattr(os, "setpriority", lambda *words: asked.append(words[-1]))
    return asked


@pytest.fixture
def car(tmp_path):
    # Only the actuator counts: whoever needs to stop a car does not want to hear of its camera file.
    path = tmp_path / "car.yaml"
    path.write_text("camera: nowhere.yaml\nactuator: {kind: pca9685}\ncontrol: 3\n")
    return path


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(neutral, "PATIENCE_S", 0.6)


def drive(bus):
    """Leave the chip as a killed drive would."""
    for data in ("0030", "fe65", "060000f401", "0a00007701", "0020"):
        bus.chip.write(bytes.fromhex(data))
    assert bus.chip.counts(0) == 500


def test_a_chip_that_nobody_drives_any_more(bus, car):
    drive(bus)
    assert stop.stop_car(car) == ["neutral", "nothing of lanenet was driving"]
    assert bus.chip.counts(0) == 370 and not bus.chip.asleep and bus.closed
    # The motor first, and without a moment of sleep in which there are no pulses.
    written = [data[0] for data in bus.wire if len(data) > 1]
    assert written == [0x06, 0x0A] * (len(written) // 2)


def test_a_chip_that_sleeps_is_started_in_neutral(bus, car):
    stop.stop_car(car)
    assert bus.chip.pulses == [(0, 370), (1, 375)]


def test_neutral_is_that_of_the_file(bus, car):
    drive(bus)
    stop.stop_car(car, ["actuator.throttle_stopped_us=1469", "actuator.frequency_hz=50"])
    assert bus.chip.pulse_us(0) == pytest.approx(1469, abs=3) and bus.chip.registers[0xFE] == 121


@pytest.mark.parametrize("manner", ["polite", "deaf", "stopped"])
def test_the_owner_is_ended(bus, car, manner, monkeypatch):
    monkeypatch.setattr(stop, "_END_S", 0.2)
    words = [sys.executable, "-ISc", OWNER, manner]
    owner = subprocess.Popen(words, stdin=bus.fd, stdout=subprocess.PIPE)
    try:
        owner.stdout.readline()
        if manner == "stopped":
            os.kill(owner.pid, signal.SIGSTOP)
        drive(bus)
        state, line = stop.stop_car(car)
        assert state == "neutral" and f"process {owner.pid}" in line and bus.chip.counts(0) == 370
        assert owner.wait(5.0) == -(signal.SIGKILL if manner == "deaf" else signal.SIGTERM)
    finally:
        owner.kill()
        owner.communicate()


@pytest.mark.parametrize("fault", ["", "broken file", "replaced file", "removed file", "lost chip"])
def test_a_drive_that_still_starts_is_ended(bus, car, fault, impatient):
    words = [sys.executable, "-ISc", STARTING, "lanenet", "drive", car.name]
    options = {"stdout": subprocess.PIPE, "cwd": car.parent}
    started = [subprocess.Popen(words, **options) for _ in range(2)]
    editor = subprocess.Popen([*words[:4], "edit", car], **options)
    try:
        for process in (*started, editor):
            process.stdout.readline()
        bus.broken = fault == "lost chip"
        if fault in ("replaced file", "removed file"):
            # As many editors save.
            car.rename(car.with_name("before.yaml"))
        if fault in ("broken file", "replaced file"):
            car.write_text("control: [\n")
        if fault:
            with pytest.raises(LanenetError, match=r"car\.yaml|0x40") as caught:
                stop.stop_car(car)
            text = str(caught.value)
        else:
            text = " ".join(stop.stop_car(car))
        assert all(f"process {process.pid} " in text for process in started)
        assert [process.wait(5.0) for process in started] == [-signal.SIGTERM] * 2
        assert editor.poll() is None
    finally:
        for process in (*started, editor):
            process.kill()
            process.communicate()


def test_a_mistyped_name_is_told_what_drives(car):
    words = [sys.executable, "-ISc", STARTING, "lanenet", "drive", car]
    drive = subprocess.Popen(words, stdout=subprocess.PIPE)
    try:
        drive.stdout.readline()
        with pytest.raises(ConfigError, match=rf"(?s)cra\.yaml.*process {drive.pid} ") as caught:
            stop.stop_car(car.with_name("cra.yaml"))
        assert "drives" in str(caught.value) and drive.poll() is None
    finally:
        drive.kill()
        drive.communicate()


def test_the_terminal_of_a_drive_is_left_alone(tmp_path, car):
    terminal = tmp_path / "tmux"
    terminal.symlink_to(sys.executable)
    words = [terminal, "-ISc", "print(flush=True); input()", "lanenet", "drive", car]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        process.stdout.readline()
        assert process.pid not in stop._drives()
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("lock", ["lockf(bus, fcntl.LOCK_EX, 1, 0x40)", "flock(bus, fcntl.LOCK_EX)"])
def test_without_a_usable_file_every_guard_is_ended(tmp_path, monkeypatch, lock):
    monkeypatch.setattr(stop, "_DEVICES", tmp_path)
    device = tmp_path / ("i2c-7" if "lockf" in lock else "ttyACM3")
    device.touch()
    take = f"import fcntl, sys, time; bus = open(sys.argv[2], 'r+'); fcntl.{lock}"
    code = f"{take}; print(flush=True); time.sleep(60)"
    words = [[sys.executable, "-ISc", code, name, device] for name in (GUARD_MODULE, "something.else")]
    guard = subprocess.Popen(words[0], stdout=subprocess.PIPE)
    try:
        guard.stdout.readline()
        with pytest.raises(ConfigError, match=rf"no such file.*process {guard.pid}.*{device.name}"):
            stop.stop_car(tmp_path / "car.yaml")
        assert guard.wait(5.0) == -signal.SIGTERM
    finally:
        guard.kill()
        guard.communicate()
    other = subprocess.Popen(words[1], stdout=subprocess.PIPE)
    try:
        other.stdout.readline()
        with pytest.raises(ConfigError):
            stop.stop_car(tmp_path / "car.yaml")
        assert other.poll() is None
    finally:
        other.kill()
        other.communicate()


def test_the_owner_of_a_serial_line_is_ended_and_the_board_asked(tmp_path):
    pytest.importorskip("serial", reason="pyserial is not installed")
    board = BoardProcess([build_host_board(tmp_path)], tmp_path)
    port = f"serial.Serial({board.port!r}, exclusive=True)"
    words = [sys.executable, "-c", f"import serial; port = {port}; print(flush=True); input()"]
    owner = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    car = tmp_path / "car.yaml"
    car.write_text(f"actuator: {{kind: serial, port: {board.port}}}\n")
    try:
        owner.stdout.readline()
        state, line = stop.stop_car(car)
        assert state == "neutral" and f"process {owner.pid}" in line
        assert owner.wait(5.0) == -signal.SIGTERM
        assert stop.stop_car(car) == ["neutral", "nothing of lanenet was driving"]
    finally:
        owner.kill()
        owner.communicate()
        board.stop()


def test_a_silent_board_is_not_called_neutral(tmp_path, impatient):
    pytest.importorskip("serial", reason="pyserial is not installed")
    master, slave = os.openpty()
    car = tmp_path / "car.yaml"
    car.write_text(f"actuator: {{kind: serial, start_s: 0.1, port: {os.ttyname(slave)}}}\n")
    with pytest.raises(MotorMayRunError, match=r"disconnect the battery.*no answer"):
        stop.stop_car(car)
    os.close(master)
    os.close(slave)


def test_a_chip_that_comes_back_is_waited_for(bus, car):
    drive(bus)
    bus.broken = True
    back = threading.Timer(0.4, lambda: setattr(bus, "broken", False))
    back.start()
    assert stop.stop_car(car)[0] == "neutral" and bus.chip.counts(0) == 370
    back.join()


def test_a_bus_that_hangs_does_not_hold_up_the_start_of_a_drive(bus, car, impatient):
    over = threading.Event()
    bus.before_transfer = lambda _: over.wait(20.0)
    begun_s = time.monotonic()
    with pytest.raises(MotorMayRunError, match="disconnect the battery"):
        stop.prepare_drive(["--arm", str(car)])
    assert time.monotonic() - begun_s < 5.0
    over.set()


def test_a_chip_that_somebody_else_drives_is_sent_neutral_although_its_owner_stays(bus, car, monkeypatch):
    drive(bus)
    monkeypatch.setattr(PCA9685, "owner", lambda _: -1)
    with pytest.raises(MotorMayRunError, match="cannot be seen from here; disconnect the battery"):
        stop.stop_car(car)
    assert bus.chip.counts(0) == 370


def test_a_drive_that_is_deaf_is_killed(bus, car, monkeypatch):
    monkeypatch.setattr(stop, "CLOSE_S", 0.3)
    code = STARTING.replace("print", "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); print")
    words = [sys.executable, "-ISc", code, "lanenet", "drive", car]
    deaf = subprocess.Popen(words, stdout=subprocess.PIPE)
    try:
        deaf.stdout.readline()
        assert f"killed process {deaf.pid} " in stop.stop_car(car)[-1]
        assert deaf.wait(5.0) == -signal.SIGKILL
    finally:
        deaf.kill()
        deaf.communicate()


def test_bad_input_is_named(bus, car, tmp_path, impatient):
    with pytest.raises(MotorMayRunError, match=r"battery.*/dev/i2c-1 at 0x41: no PCA9685 answers"):
        stop.stop_car(car, ["actuator.address=0x41"])
    with pytest.raises(ConfigError, match=r"car\.yaml.*actuator\.steering_left'.*steering_left_us"):
        stop.stop_car(car, ["actuator.steering_left=3"])
    car.write_text("camera: nowhere.yaml\n")
    with pytest.raises(ConfigError, match=r"car\.yaml: key 'actuator'"):
        stop.stop_car(car)
    with pytest.raises(HardwareError, match="/nowhere: no such device"):
        stop.stop_car(car, ["actuator={kind: serial, port: /nowhere}"])


def test_names_cannot_command_the_terminal(capfd):
    assert stop.main(["\x1b[2Jcar.yaml"]) == 1
    assert "car.yaml: no such file" in (told := capfd.readouterr().err) and "\x1b" not in told


def test_the_verb(bus, car):
    """With an option, or from Python; `lanenet stop CAR` itself does not get as far as these imports."""
    drive(bus)
    done = CliRunner().invoke(app, ["stop", str(car), "actuator.frequency_hz=50"])
    assert done.exit_code == 0 and "neutral" in done.output
    assert bus.chip.pulse_us(0) == pytest.approx(1509.6, abs=3)


def test_it_waits_for_no_other_part_of_lanenet():
    code = "import sys, lanenet.onboard.stop; print(*sorted(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.partition(".")[0] for name in result.stdout.split()}
    slow = {"cv2", "numpy", "onnxruntime", "jaxtyping", "typer", "rich", "serial", "pydantic", "yaml"}
    assert not slow & loaded


def test_the_program_prepares_a_drive_before_it_imports_the_command_line(bus, car, monkeypatch):
    seen = []
    command_line = SimpleNamespace(main=lambda: seen.append((sys.argv[1], bus.chip.counts(0))))
    monkeypatch.setitem(sys.modules, "lanenet.cli.app", command_line)
    monkeypatch.setattr(sys, "path", list(sys.path))
    drive(bus)
    monkeypatch.setattr(sys, "argv", ["lanenet", "drive", str(car)])
    __main__.main()
    assert seen == [("drive", 370)]
    assert lock_owners(car.stat()) == [os.getpid()]


def test_the_program_stops_a_car_without_the_command_line(bus, car, monkeypatch, hurried):
    monkeypatch.setitem(sys.modules, "lanenet.cli.app", None)
    monkeypatch.setattr(sys, "path", list(sys.path))
    drive(bus)
    monkeypatch.setattr(sys, "argv", ["lanenet", "stop", str(car)])
    with pytest.raises(SystemExit) as ended:
        __main__.main()
    assert ended.value.code == 0 and bus.chip.counts(0) == 370 and hurried == [-20]


def test_drive_is_neutral_before_it_has_imported_the_rest(bus, car):
    drive(bus)
    stop.prepare_drive([str(car), "--dry-run"])
    assert bus.chip.counts(0) == 500 and lock_owners(car.stat()) == []
    stop.prepare_drive(["--arm", "--frames", "9", str(car), "source.path=nowhere"])
    assert bus.chip.counts(0) == 370
    # So that it is found while it owns nothing yet.
    assert lock_owners(car.stat()) == [os.getpid()]
    # What is wrong is left to the drive.
    stop.prepare_drive([str(Path("/nowhere/car.yaml"))])
