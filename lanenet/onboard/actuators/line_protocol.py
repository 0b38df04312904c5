r"""The lines between the computer and a microcontroller that makes the pulses; version 1.

ASCII at 115200 baud, 8N1. A line is a letter, whole numbers joined by commas, ``*``, a checksum and a line
feed: ``S1500,1500*49``. The checksum is the CRC-8 of all before the ``*`` (polynomial 0x07, start 0, as SMBus
has it), as two hexadecimal digits in capitals. A line whose checksum or form is wrong is dropped and counted;
so is a number beyond what the line may hold.

From the computer:

    V                          asks who is there
    N<steering_us>,<throttle_us>    pulses of straight wheels and of a standing motor; the board goes there
    S<steering_us>,<throttle_us>    pulses to put out now

From the board:

    V<version>                 answers V, and is sent once after the board has started
    A<accepted>,<rejected>,<driving>,<steering_us>,<throttle_us>    every 50 ms: counts of lines modulo 65536,
                               1 while commands arrive and 0 in neutral, and the pulses that are put out

The board goes to its neutral pulses when 100 ms pass without a valid ``S``. It drives only after an ``N``
since it was started, so that a board that restarted by itself stands until the computer has noticed.

The same protocol stands in C++ in ``firmware/lanenet_uno/protocol.h``; the tests let the two talk.
"""

from __future__ import annotations

from dataclasses import dataclass

VERSION = 1
BAUD = 115200
#: The board is in neutral this long after the last valid command.
WATCHDOG_S = 0.1
#: Time between two reports of the board.
REPORT_S = 0.05
#: The longest line, its end included.
MAX_LINE = 40
_POLYNOMIAL = 0x07


@dataclass(frozen=True)
class Line:
    """One line with a right checksum.

    Attributes:
        letter: What it says.
        numbers: Its numbers.
    """

    letter: str
    numbers: tuple[int, ...]


def crc8(data: bytes) -> int:
    """Return the CRC-8 of bytes: x^8 + x^2 + x + 1, start 0, not reflected (CRC-8/SMBUS)."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = ((crc << 1) ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
    return crc


def encode(letter: str, *numbers: int) -> bytes:
    """Return a line with its checksum and its end."""
    text = (letter + ",".join(str(n) for n in numbers)).encode("ascii")
    return text + f"*{crc8(text):02X}\n".encode("ascii")


def decode(line: bytes) -> Line | None:
    """Read a line without its end; None if its form or its checksum is wrong."""
    text, star, checksum = line.rstrip(b"\r").rpartition(b"*")
    if not star or len(checksum) != 2 or checksum != f"{crc8(text):02X}".encode("ascii"):
        return None
    letter, fields = text[:1], text[1:].split(b",") if len(text) > 1 else []
    if not (letter.isalpha() and all(field.isdigit() and len(field) <= 5 for field in fields)):
        return None
    return Line(letter.decode("ascii"), tuple(int(field) for field in fields))


class LineReader:
    """Puts bytes together to lines, wherever they were cut."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Line]:
        """Return the valid lines that end in ``data``; others are dropped."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        # Noise without an end does not pile up.
        self._rest = self._rest[-MAX_LINE:]
        return [line for line in map(decode, lines) if line is not None]
