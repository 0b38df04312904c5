"""Stands in for smbus2 in other processes: an I2C bus with a PCA9685, and a GPIO line, whose wire is a file.

A folder (``LANENET_TEST_BUS``) holds the chip's registers, which is also the bus device that is locked, and
the wire: a line ``time process register bytes`` for every write, and ``time process beat`` for every pulse of
the heartbeat. A file ``outage`` there, with the time of its end and "fails" or "hangs", is an outage of the
bus: transfers fail at once, or come back when it is over.
"""

import errno
import fcntl
import os
import struct
import time
from pathlib import Path

FOLDER = Path(os.environ["LANENET_TEST_BUS"])
ADDRESS = 0x40
#: As they are after power-on: asleep, 200 Hz.
POWER_ON = bytes([0x11, 0x04]) + bytes(0xFC) + bytes([30]) + bytes(1)
GET_LINE, SET_VALUES = 0xC250B407, 0xC010B40F
_ioctl = fcntl.ioctl


def _outage():
    try:
        end_s, manner = (FOLDER / "outage").read_text().split()
    except OSError:
        return
    left_s = float(end_s) - time.monotonic()
    if left_s > 0.0 and manner == "fails":
        raise OSError(errno.EREMOTEIO, "Remote I/O error")
    time.sleep(min(max(left_s, 0.0), 3600.0))


def _note(text):
    with open(FOLDER / "wire", "ab", buffering=0) as file:
        file.write(f"{time.monotonic()!r} {os.getpid()} {text}\n".encode())


def _gpio(handle, request, argument=0, mutate_flag=True):
    """The GPIO device is any file; the line that it gives is the wire."""
    if request == GET_LINE:
        struct.pack_into(
            "=i", argument, 588, os.open(FOLDER / "wire", os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        )
        return 0
    if request == SET_VALUES:
        if struct.unpack("=QQ", argument)[0]:
            _note("beat")
        return argument
    return _ioctl(handle, request, argument, mutate_flag)


fcntl.ioctl = _gpio


class i2c_msg:  # noqa: N801 (the package's name)
    def __init__(self, address, data, length):
        self.address, self.data, self.length = address, data, length

    @classmethod
    def write(cls, address, data):
        return cls(address, bytes(data), None)

    @classmethod
    def read(cls, address, length):
        return cls(address, b"", length)

    def __iter__(self):
        return iter(self.data)


class SMBus:
    def __init__(self, number):
        if number != 1:
            raise FileNotFoundError(errno.ENOENT, "No such file or directory", f"/dev/i2c-{number}")
        self.fd = os.open(FOLDER / "registers", os.O_RDWR | os.O_CREAT, 0o666)
        if os.fstat(self.fd).st_size == 0:
            os.pwrite(self.fd, POWER_ON, 0)
        self._pointer = 0

    def i2c_rdwr(self, *messages):
        _outage()
        for message in messages:
            if message.address != ADDRESS:
                raise OSError(errno.EREMOTEIO, "Remote I/O error")
            if message.length is not None:
                message.data = os.pread(self.fd, message.length, self._pointer)
                continue
            self._pointer = message.data[0]
            if len(message.data) > 1:
                # RESTART never reads as what was written.
                values = message.data[1:] if self._pointer else bytes([message.data[1] & 0x7F])
                os.pwrite(self.fd, values, self._pointer)
                _note(f"{self._pointer:02x} {message.data[1:].hex()}")

    def close(self):
        os.close(self.fd)
