"""Stops a car, whatever drives it: neutral first, then the end of the process that owns the actuator.

Reads the section ``actuator`` of the car's file and imports little of lanenet: the car drives on
meanwhile. A drive that still starts owns nothing yet; it is known by a lock on its car's file, and by its
command line, should an editor have replaced the file.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from lanenet.config import Settings, apply_overrides, check_settings, read_yaml
from lanenet.errors import ConfigError, HardwareError, LanenetError, printable
from lanenet.onboard.actuators import ActuatorSettings, make_actuator
from lanenet.onboard.actuators.pca9685 import PCA9685
from lanenet.onboard.actuators.serial_board import SerialBoardSettings
from lanenet.onboard.i2c import GUARD_MODULE, describe_process, lock_owners, words_of

#: A guard that is asked to end is in neutral within a turn of 15 ms and gone some milliseconds later; chosen
#: ample, since neutral is repeated meanwhile.
_END_S = 0.5
#: Neutral again this often until the owner has ended; a drive sends about 30 commands a second.
_AGAIN_S = 0.01
#: Where actuators are, if no file says it: I2C buses and serial lines.
_DEVICES = Path("/dev")
_NAMES = ("i2c-*", "ttyACM*", "ttyUSB*", "ttyAMA*", "ttyS*", "ttyTHS*")


class _Car(Settings):
    """The part of a car's file that says how to stop it."""

    actuator: ActuatorSettings


def read_actuator(path: Path, overrides: Sequence[str] = ()) -> ActuatorSettings:
    """Read the actuator of a car's file; its other sections may be wrong.

    Raises:
        ConfigError: Naming the file, the key, what was found and what was expected.
    """
    data = apply_overrides(read_yaml(path), list(overrides))
    if data.get("actuator") is None:
        raise ConfigError(f"{path}: key 'actuator' is missing: there is no motor to stop")
    return check_settings(_Car, {"actuator": data["actuator"]}, str(path)).actuator


def stop_car(path: Path, overrides: Sequence[str] = ()) -> list[str]:
    """Put a car into neutral, end the process that drives it, and the drives of its file that still start.

    These are ended even if the file cannot be used or the actuator does not answer. If the file cannot be
    used, it is not known which actuator is meant, and the guard of each one is ended.

    Args:
        path: The car's file.
        overrides: ``key=value`` after it, as for ``drive``.

    Returns:
        What was done, a sentence each.

    Raises:
        ConfigError: If the file does not describe an actuator.
        HardwareError: If the actuator does not answer, or its owner cannot be ended.
        MissingExtraError: If its driver is not installed.
    """
    try:
        done = _stop_actuator(path, overrides)
    except LanenetError as error:
        done = _end_drives(path)
        if isinstance(error, ConfigError):
            done += _end_guards()
        if not done:
            # A name that was mistyped in a hurry.
            done = [f"{describe_process(pid)} drives" for pid in _drives()]
        if not done:
            raise
        raise type(error)("; ".join([str(error), *done])) from None
    return [*done, *_end_drives(path)]


def _stop_actuator(path: Path, overrides: Sequence[str]) -> list[str]:
    settings = read_actuator(path, overrides)
    if isinstance(settings, SerialBoardSettings):
        return _stop_board(settings)
    actuator = make_actuator(settings)
    if not isinstance(actuator, PCA9685):
        return [f"an actuator of kind {settings.kind} has no motor"]
    try:
        actuator.force_neutral()
        owner = actuator.owner()
        if not owner:
            return ["neutral; nothing of lanenet was driving"]
        return [f"neutral; ended {_end(owner, actuator.owner, actuator.neutral)}"]
    finally:
        actuator.release()


def _stop_board(settings: SerialBoardSettings) -> list[str]:
    """End the owner of a serial line: the board goes to neutral by its own watchdog."""

    def owner() -> int:
        return next(iter(lock_owners(Path(settings.port).stat())), 0)

    try:
        first = owner()
    except OSError as error:
        raise HardwareError(f"{settings.port}: {error.strerror or error}; is the board plugged in?") from None
    if not first:
        return ["nothing was driving: the board is in neutral by its own watchdog"]
    return [f"ended {_end(first, owner, lambda: None)}; the board is in neutral by its own watchdog"]


def _end(pid: int, owner: Callable[[], int], neutral: Callable[[], None]) -> str:
    """End the owner of a device, politely and then by force; returns its description."""
    text = describe_process(pid)
    if pid < 0:
        raise HardwareError(f"{text} still drives, which cannot be seen from here; disconnect the battery")
    for number in (signal.SIGTERM, signal.SIGKILL):
        _tell(pid, number)
        end_s = time.monotonic() + _END_S
        while time.monotonic() < end_s:
            neutral()
            if owner() != pid:
                neutral()
                return text
            time.sleep(_AGAIN_S)
    raise HardwareError(f"{text} cannot be ended; disconnect the battery")


def _tell(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        try:
            os.kill(pid, number)
            # A stopped process takes no other signal.
            os.kill(pid, signal.SIGCONT)
        except PermissionError:
            text = describe_process(pid)
            raise HardwareError(f"{text} of another user still drives; end it with sudo") from None


def _end_drives(path: Path) -> list[str]:
    """Ask the drives of a car's file to end, which is in neutral; returns a sentence each."""
    found = {pid for pid, files in _drives().items() if path.resolve() in files}
    with contextlib.suppress(OSError):
        # Other programs lock files, too: editors.
        found |= {pid for pid in lock_owners(path.stat()) if "drive" in words_of(pid)}
    drives = {pid: describe_process(pid) for pid in sorted(found)}
    for pid in drives:
        _tell(pid, signal.SIGTERM)
    return [f"told {text} to end" for text in drives.values()]


def _drives() -> dict[int, list[Path]]:
    """Return the processes that run ``lanenet drive``, and what each word after it would be as a file."""
    drives = {}
    for folder in Path("/proc").glob("[0-9]*"):
        words = words_of(int(folder.name))
        at = words.index("drive") if "drive" in words else 0
        # Not the terminal, shell or ssh that it was started from.
        own = words[0].startswith(("python", "lanenet"))
        if not own or not any(Path(word).name == "lanenet" for word in words[:at]):
            continue
        # Of another user, or gone.
        with contextlib.suppress(OSError):
            here = (folder / "cwd").readlink()
            drives[int(folder.name)] = [(here / word).resolve() for word in words[at + 1 :]]
    return drives


def _end_guards() -> list[str]:
    """End the guards of all actuators, which is in neutral; returns a sentence each."""
    done = []
    for device in sorted(path for name in _NAMES for path in _DEVICES.glob(name)):
        for pid in _guards_of(device):
            owner = partial(_owner_if, device, pid)
            try:
                done.append(f"ended {_end(pid, owner, lambda: None)}, which had {device}")
            except HardwareError as error:
                done.append(str(error))
    return done


def _guards_of(device: Path) -> list[int]:
    try:
        found = device.stat()
    except OSError:
        # Unplugged since.
        return []
    owners = [*lock_owners(found), *lock_owners(found, range(0x80))]
    return [pid for pid in owners if GUARD_MODULE in words_of(pid)]


def _owner_if(device: Path, pid: int) -> int:
    return pid if pid in _guards_of(device) else 0


def prepare_drive(words: Sequence[str]) -> None:
    """Prepare a drive before its imports: ``lanenet stop`` finds it, and its car is in neutral; never raises.

    The car's file stays locked until this process ends. A car that another process drives is left alone.

    Args:
        words: After ``drive`` on the command line.
    """
    if {"--dry-run", "--help"} & set(words):
        return
    # Whatever is wrong is said by the drive itself.
    with contextlib.suppress(Exception):
        path = next(path for path in map(Path, words) if path.is_file())
        fcntl.flock(os.open(path, os.O_RDONLY), fcntl.LOCK_SH | fcntl.LOCK_NB)
        overrides = [word for word in words if "=" in word and not word.startswith("-") and word != str(path)]
        actuator = make_actuator(read_actuator(path, overrides))
        if isinstance(actuator, PCA9685):
            actuator.open()
            actuator.close()


def main(words: Sequence[str]) -> int:
    """Run ``lanenet stop`` without the command line's other verbs; returns the exit code."""
    try:
        lines = stop_car(Path(words[0]), words[1:])
    except LanenetError as error:
        sys.stderr.write(f"error: {printable(str(error))}\n")
        return 1
    sys.stdout.writelines(f"{printable(line)}\n" for line in lines)
    return 0
