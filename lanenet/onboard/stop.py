"""Stops a car, whatever drives it: neutral until it is confirmed, and the end of what drives.

Works where the computer is busy: the drives of the car's file and their guards are told to end before
anything slow is imported, and the process asks for a better priority. Of the file only the section
``actuator`` is read. A drive that still starts owns nothing yet; it is known by a lock on its car's file, and
by its command line, should an editor have replaced the file.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lanenet.errors import ConfigError, HardwareError, LanenetError, MotorMayRunError, printable
from lanenet.onboard.car_file import with_full_paths
from lanenet.onboard.i2c import (
    GUARD_MODULE,
    I2CChip,
    describe_process,
    lock_owners,
    words_of,
)
from lanenet.onboard.neutral import AGAIN_S, HOLD_S, PATIENCE_S, Neutral, reach_neutral, settle, undisturbed
from lanenet.reading import MEBIBYTE, read_text

log = logging.getLogger(__name__)

if TYPE_CHECKING:
    from lanenet.onboard.actuators import ActuatorSettings
    from lanenet.onboard.actuators.serial_board import SerialBoard

#: A guard that is asked to end is in neutral within a turn of 15 ms and gone some milliseconds later; chosen
#: ample, since neutral is repeated meanwhile.
_END_S = 0.5
#: A drive whose motor is in neutral closes its camera within 3 s and its recording within 10 s; one that
#: takes longer hangs, for example in a network.
CLOSE_S = 15.0
#: Better priorities than the usual, [nice]; the second is what the service allows.
_PRIORITIES = (-20, -10)
#: Where actuators are, if no file says it: I2C buses and serial lines.
_DEVICES = Path("/dev")
_NAMES = ("i2c-*", "ttyACM*", "ttyUSB*", "ttyAMA*", "ttyS*", "ttyTHS*")


def read_actuator(path: Path, overrides: Sequence[str] = ()) -> ActuatorSettings:
    """Read the actuator of a car's file; its other sections may be wrong.

    Raises:
        ConfigError: Naming the file, the key, what was found and what was expected.
    """
    from lanenet.config import apply_overrides, read_yaml
    from lanenet.onboard.actuators import check_actuator

    data = apply_overrides(with_full_paths(read_yaml(path), path), list(overrides))
    if data.get("actuator") is None:
        raise ConfigError(f"{path}: key 'actuator' is missing: there is no motor to stop")
    return check_actuator(data["actuator"], str(path))


def stop_car(
    path: Path, overrides: Sequence[str] = (), say: Callable[[str], None] = lambda _: None
) -> list[str]:
    """Put a car into neutral, end the process that drives it, and the drives of its file that still start.

    These are ended even if the file cannot be used or the actuator does not answer. If the file cannot be
    used, it is not known which actuator is meant, and the guard of each one is ended.

    Args:
        path: The car's file.
        overrides: ``key=value`` after it, as for ``drive``.
        say: Gets each sentence of the answer as soon as it is known: neutral before drives have ended.

    Returns:
        What was done, a sentence each.

    Raises:
        ConfigError: If the file does not describe an actuator.
        HardwareError: If its owner cannot be ended.
        MotorMayRunError: If neutral was not confirmed.
        MissingExtraError: If its driver is not installed.
    """
    told = _tell_drives(path)
    elsewhere = any(override.startswith("actuator") for override in overrides)
    owner = "" if elsewhere else _tell_owner(path)
    try:
        with undisturbed():
            done = _stop_actuator(path, overrides)
    except LanenetError as error:
        if isinstance(error, MotorMayRunError):
            # Ending the drives takes longer.
            log.critical("%s", error)
        done = _end_drives(path, told)
        if isinstance(error, ConfigError):
            done += _end_guards(error)
        if not done:
            # A name that was mistyped in a hurry.
            done = [f"NOT STOPPED: {describe_process(pid)} drives" for pid in _drives()]
        if not done:
            done = ["no drive of lanenet was found"]
        raise type(error)("; ".join([str(error), *done])) from None
    say(done[0])
    # A process that ends has no words any more.
    if owner and not any(" ".join(owner.split()[:2]) in line for line in done):
        done.append(f"ended {owner}")
    done += _end_drives(path, told)
    if len(done) == 1:
        done.append("nothing of lanenet was driving")
    for line in done[1:]:
        say(line)
    return done


def hurry() -> None:
    """Ask for a better priority of this process, beside other work."""
    for priority in _PRIORITIES:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, priority)
            return


def _tell_drives(path: Path) -> dict[int, str]:
    """Ask the drives of a car's file and their guards to end; returns what the drives are."""
    drives = {pid: describe_process(pid) for pid in _drives_of(path)}
    for pid in drives:
        # What cannot be ended is named later.
        with contextlib.suppress(HardwareError):
            _tell(pid, signal.SIGTERM)
            for guard in _children(pid):
                if GUARD_MODULE in words_of(guard):
                    _tell(guard, signal.SIGTERM)
    return drives


def _tell_owner(path: Path) -> str:
    """Ask the owner of the file's device to end: it is in neutral before the settings are checked.

    Returns:
        What it is; empty if there is none, or it is not known yet.
    """
    import yaml

    # What is wrong with the file, or cannot be ended, is said later.
    with contextlib.suppress(Exception):
        data = yaml.safe_load(read_text(path, ConfigError, MEBIBYTE))["actuator"]
        if data["kind"] == "serial":
            pid = next(iter(lock_owners(Path(data["port"]).stat())), 0)
        else:
            # A Donkeycar's myconfig.py may name another chip.
            chip = I2CChip(
                data["bus"] if "myconfig" in data else data.get("bus", 1), data.get("address", 0x40)
            )
            chip.open()
            pid = chip.owner()
            chip.close()
        text = describe_process(pid)
        if pid > 0 and pid != os.getpid():
            _tell(pid, signal.SIGTERM)
            return text
    return ""


def _children(pid: int) -> list[int]:
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except (OSError, ValueError):
        return []


def _stop_actuator(path: Path, overrides: Sequence[str]) -> list[str]:
    """Bring the actuator of a car's file into neutral and end its owner; returns what was done."""
    from lanenet.onboard.actuators import make_actuator
    from lanenet.onboard.actuators.pca9685 import PCA9685
    from lanenet.onboard.actuators.serial_board import SerialBoard

    settings = read_actuator(path, overrides)
    actuator = make_actuator(settings)
    if isinstance(actuator, SerialBoard):
        port = Path(actuator.port)
        if not port.exists():
            raise MotorMayRunError(
                Neutral(False, f"{port}: no such device; is the board plugged in?").may_run
            )

        def owner() -> int:
            with contextlib.suppress(OSError):
                # This process holds the line while it asks the board.
                return next((pid for pid in lock_owners(port.stat()) if pid != os.getpid()), 0)
            return 0

        return _confirm(partial(_ask_board, actuator, owner), owner)
    if not isinstance(actuator, PCA9685):
        return [f"an actuator of kind {settings.kind} has no motor"]
    try:
        try:
            actuator.attach()
        except HardwareError as error:
            raise MotorMayRunError(Neutral(False, str(error)).may_run) from None
        return _confirm(actuator.neutral, actuator.owner)
    finally:
        actuator.release()


def _ask_board(board: SerialBoard, owner: Callable[[], int]) -> Neutral | None:
    """Ask a board for neutral; its line has one owner at a time."""
    if owner():
        return Neutral(False, f"{board.port}: its owner has not ended")
    try:
        board.open()
        return board.neutral()
    except HardwareError as error:
        return Neutral(False, str(error))
    finally:
        # Others may need the line meanwhile: a drive that takes over from its guard.
        board.close()


def _confirm(neutral: Callable[[], Neutral | None], owner: Callable[[], int]) -> list[str]:
    """Repeat neutral until it is confirmed while nobody owns the device.

    A drive whose guard has ended writes nothing but neutral, and may be deaf: it is not waited for.

    Returns:
        What was done.

    Raises:
        HardwareError: If the owner cannot be ended.
        MotorMayRunError: If neutral was not confirmed.
    """
    ending = _Ending(owner)
    left = settle(neutral, ending.turn, hold_s=HOLD_S) or Neutral(False, "the device is not open")
    if left.confirmed is False:
        raise MotorMayRunError(left.may_run)
    return [left.text, *(f"ended {text}" for text in ending.ended)]


class _Ending:
    """Ends the owner of a device between attempts at neutral, politely and then by force.

    Attributes:
        ended: Descriptions of those that are gone.
        forced: Whether one of them had to be killed.
    """

    def __init__(self, owner: Callable[[], int], patience_s: float = _END_S) -> None:
        self.ended: list[str] = []
        self.forced = False
        self._owner, self._patience_s = owner, patience_s
        self._pid, self._text, self._since_s = 0, "", 0.0
        self._signals = [signal.SIGKILL, signal.SIGTERM]

    def turn(self) -> bool:
        """Take one step; returns whether nobody owns the device any more.

        Raises:
            MotorMayRunError: If the owner cannot be ended.
        """
        pid, now_s = self._owner(), time.monotonic()
        if pid != self._pid:
            if self._pid:
                self.ended.append(self._text)
            self._pid, self._text, self._since_s = pid, describe_process(pid), -1.0
            self._signals = [signal.SIGKILL, signal.SIGTERM]
        if not pid:
            return True
        if pid < 0:
            raise MotorMayRunError(
                f"{self._text} still drives, which cannot be seen from here; disconnect the battery"
            )
        if self._since_s < 0.0 or now_s - self._since_s > self._patience_s:
            if not self._signals:
                raise MotorMayRunError(f"{self._text} cannot be ended; disconnect the battery")
            self.forced = len(self._signals) == 1
            _tell(pid, self._signals.pop())
            self._since_s = now_s
        return False


def _tell(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        try:
            os.kill(pid, number)
            # A stopped process takes no other signal.
            os.kill(pid, signal.SIGCONT)
        except PermissionError:
            text = describe_process(pid)
            raise MotorMayRunError(f"{text} of another user still drives; end it with sudo") from None


def _drives_of(path: Path) -> set[int]:
    """Return the processes that drive by a car's file."""
    found = {pid for pid, files in _drives().items() if path.resolve() in files}
    with contextlib.suppress(OSError):
        # Other programs lock files, too: editors.
        found |= {pid for pid in lock_owners(path.stat()) if "drive" in words_of(pid)}
    return found - {os.getpid()}


def _end_drives(path: Path, told: dict[int, str]) -> list[str]:
    """End the drives of a car's file, whose motor is in neutral; by force if they are deaf.

    Args:
        path: The car's file.
        told: Those that were asked to end already.

    Returns:
        A sentence each.
    """
    drives = told | {pid: describe_process(pid) for pid in _drives_of(path) - told.keys()}
    done = {pid: f"ended {text}" for pid, text in sorted(drives.items())}

    def tell(pid: int, number: signal.Signals) -> None:
        try:
            _tell(pid, number)
        except HardwareError as error:
            done[pid] = str(error)

    for pid in drives.keys() - told.keys():
        tell(pid, signal.SIGTERM)
    left, end_s = set(drives), time.monotonic() + CLOSE_S
    while (left := {pid for pid in left if _runs(pid, drives[pid])}) and time.monotonic() < end_s:
        time.sleep(AGAIN_S)
    for pid in left:
        done[pid] = f"killed {drives[pid]}"
        tell(pid, signal.SIGKILL)
    return list(done.values())


def _runs(pid: int, text: str) -> bool:
    """Tell whether a described process is there, and not just waiting for its parent to notice its end."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(") ")[2][:1]
    except OSError:
        return False
    return state not in "ZX" and describe_process(pid) == text


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


def _end_guards(error: LanenetError) -> list[str]:
    """End the guards of all actuators, which go to neutral themselves; returns a sentence each.

    Raises:
        MotorMayRunError: If one had to be killed: nobody knows how to go on for it. ``error`` is why.
    """
    done = []
    for device in sorted(path for name in _NAMES for path in _DEVICES.glob(name)):
        for pid in _guards_of(device):
            ending = _Ending(partial(_owner_if, device, pid), PATIENCE_S + 1.0)
            try:
                while not ending.turn():
                    time.sleep(AGAIN_S)
                done += [f"ended {text}, which had {device}" for text in ending.ended]
            except HardwareError as problem:
                done.append(str(problem))
            if ending.forced:
                why = Neutral(False, f"its guard was killed, which had {device}")
                raise MotorMayRunError(f"{why.may_run}; {error}; {'; '.join(done)}") from None
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
    """Prepare a drive before its imports: ``lanenet stop`` finds it, and its car is in neutral.

    The car's file stays locked until this process ends. A car that another process drives is left alone.

    Args:
        words: After ``drive`` on the command line.

    Raises:
        MotorMayRunError: If the actuator is there and did not confirm neutral; nothing else.
    """
    if {"--dry-run", "--help"} & set(words):
        return
    left = None
    # Whatever is wrong is said by the drive itself.
    with contextlib.suppress(Exception):
        path = next(path for path in map(Path, words) if path.is_file())
        fcntl.flock(os.open(path, os.O_RDONLY), fcntl.LOCK_SH | fcntl.LOCK_NB)
        overrides = [word for word in words if "=" in word and not word.startswith("-") and word != str(path)]
        left = _first_neutral(read_actuator(path, overrides))
    if left is not None and left.confirmed is False:
        raise MotorMayRunError(left.may_run)


def _first_neutral(settings: ActuatorSettings) -> Neutral | None:
    """Bring a PCA9685 into neutral, which goes on with its last pulse whatever happened before."""
    from lanenet.onboard.actuators import make_actuator
    from lanenet.onboard.actuators.pca9685 import PCA9685

    actuator = make_actuator(settings)
    if not isinstance(actuator, PCA9685):
        return None
    with undisturbed():
        left = settle(partial(reach_neutral, actuator))
    if left is None or left.confirmed is not False:
        actuator.close()
    return left


def main(words: Sequence[str]) -> int:
    """Run ``lanenet stop`` without the command line's other verbs; returns the exit code."""
    hurry()
    try:
        stop_car(Path(words[0]), words[1:], lambda line: _print(1, [line]))
    except LanenetError as error:
        return fail(error)
    return 0


def fail(error: LanenetError) -> int:
    """Say an error in one line; returns the exit code."""
    _print(2, [f"error: {error}"])
    return error.exit_code


def _print(stream: int, lines: Sequence[str]) -> None:
    """Write lines past Python's buffers: on a full disk they are lost, and the exit code still tells."""
    with contextlib.suppress(OSError):
        os.write(stream, "".join(f"{printable(line)}\n" for line in lines).encode())
