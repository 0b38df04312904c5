"""An I2C bus whose chips have one owner each; imports little, since the first neutral waits for it.

Who writes to a chip holds a record lock on the bus device, at the chip's address. The kernel releases it with
the process, and tells who has it; it needs no file of its own, and works between root and other users.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from pathlib import Path
from typing import Any

from lanenet.errors import HardwareError, MissingExtraError

#: What a guard's process runs.
GUARD_MODULE = "lanenet.onboard.guard_process"
#: Motors disturb the bus now and then; a transfer without acknowledgement is repeated.
_TRIES = 3
#: A bus whose clock is held low gives a transfer back after this time, in units of 10 ms, and not after the
#: second that most adapters wait. Chosen: the frame of a display that shares the bus takes 92 ms.
#: Source: Linux, ``include/uapi/linux/i2c-dev.h``.
_I2C_TIMEOUT, _TIMEOUT_10_MS = 0x0702, 10


class I2CChip:
    """One chip on a bus."""

    def __init__(self, bus: int, address: int) -> None:
        """Prepare; nothing is opened.

        Args:
            bus: Number of the bus.
            address: Of the chip.
        """
        self.path = Path(f"/dev/i2c-{bus}")
        self._number, self._address = bus, address
        self._bus: Any = None
        self._message: Any = None

    @property
    def name(self) -> str:
        """Bus and address, for messages."""
        return f"{self.path} at 0x{self._address:02x}"

    def open(self) -> None:
        """Open the bus; the chip is not touched.

        Raises:
            HardwareError: If the bus cannot be opened.
            MissingExtraError: If smbus2 is not installed.
        """
        try:
            import smbus2
        except ImportError as error:
            raise MissingExtraError(
                f"the package smbus2 is needed here and cannot be imported ({error}); install it with: "
                "pip install 'lanenet[car]'"
            ) from None
        try:
            self._bus = smbus2.SMBus(self._number)
        except OSError as error:
            raise HardwareError(
                f"{self.path}: cannot be opened ({error.strerror or error}); switch I2C on (sudo "
                "raspi-config, Interface Options) and join its group (sudo usermod -aG i2c $USER)"
            ) from None
        self._message = smbus2.i2c_msg
        # Not every adapter can be told.
        with contextlib.suppress(OSError):
            fcntl.ioctl(self._bus.fd, _I2C_TIMEOUT, _TIMEOUT_10_MS)

    def own(self) -> None:
        """Become the chip's only owner, until ``close`` or the end of this process.

        Raises:
            HardwareError: If another process owns it; names the process.
        """
        try:
            fcntl.lockf(self._bus.fd, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, self._address)
        except OSError:
            raise driven_already(self.name, self.owner()) from None

    def owner(self) -> int:
        """Return the id of the process that owns the chip; 0 if none does, as :func:`lock_owners` sees it."""
        return next(iter(lock_owners(os.fstat(self._bus.fd), self._address)), 0)

    def write(self, data: bytes) -> None:
        """Send bytes to the chip.

        Raises:
            OSError: If it does not answer.
        """
        self._transfer(self._message.write(self._address, data))

    def read(self, register: int, count: int) -> bytes:
        """Read registers of the chip, which has to count them up by itself.

        Raises:
            OSError: If it does not answer.
        """
        answer = self._message.read(self._address, count)
        self._transfer(self._message.write(self._address, [register]), answer)
        return bytes(answer)

    def _transfer(self, *messages: Any) -> None:
        for left in reversed(range(_TRIES)):
            try:
                self._bus.i2c_rdwr(*messages)
                return
            except OSError:
                if not left:
                    raise

    def close(self) -> None:
        """Release bus and ownership; harmless if it is not open."""
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()


def lock_owners(device: os.stat_result, at: int | range | None = None) -> list[int]:
    """Return the processes that have a lock on a device or file; the kernel hides those of other containers.

    Args:
        device: What ``os.stat`` says of it.
        at: Byte of a record lock, or several; None for a lock on the whole file (flock).

    Returns:
        Their ids; -1 for one that cannot be named.
    """
    owners = []
    places = range(at, at + 1) if isinstance(at, int) else at
    place = f"{os.major(device.st_dev):02x}:{os.minor(device.st_dev):02x}:{device.st_ino}"
    for line in Path("/proc/locks").read_text(encoding="ascii").splitlines():
        fields = line.split()
        # "1: POSIX ADVISORY WRITE pid place first last"; one that waits has an arrow in the second field.
        if len(fields) != 8 or fields[5] != place:
            continue
        if fields[1] == "FLOCK" if places is None else fields[1] == "POSIX" and int(fields[6]) in places:
            owners.append(int(fields[4]) or -1)
    return owners


def driven_already(name: str, pid: int) -> HardwareError:
    """Return the error of a device that another process drives."""
    return HardwareError(
        f"{name}: is driven by {describe_process(pid)} already; end that first, or stop the car with: "
        "lanenet stop CAR.yaml"
    )


def describe_process(pid: int) -> str:
    """Return a process's id and command, for messages; of a guard also the process that it guards."""
    if pid <= 0:
        return "another process"
    words = words_of(pid)
    text = f"process {pid} ({' '.join(words)[:60]})"
    if GUARD_MODULE not in words:
        return text
    # It may have ended since.
    parent = _parent_of(pid)
    if not parent:
        return text
    return f"process {pid}, the guard of process {parent} ({' '.join(words_of(parent))[:60]})"


def _parent_of(pid: int) -> int:
    """Return the parent of a process; 0 if it is gone."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return 0
    # "pid (name) state parent ..."; the name may hold anything.
    return int(status.rpartition(")")[2].split()[1])


def words_of(pid: int) -> list[str]:
    """Return the words of a process's command line without the program's folder; none if it is gone."""
    try:
        text = Path(f"/proc/{pid}/cmdline").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ["gone"]
    program, *words = text.split("\0")
    return [Path(program).name, *filter(None, words)]
