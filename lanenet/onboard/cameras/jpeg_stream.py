"""Whole JPEG images out of a stream of bytes that may be cut anywhere.

Source: ITU-T T.81, annex B: markers and segments; in entropy-coded data FF is followed by 00 or RST0-RST7.
"""

from __future__ import annotations

_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
#: Markers without a length: TEM and RST0 to RST7.
_ALONE = frozenset({0x01, *range(0xD0, 0xD8)})


class JpegStream:
    """Collects bytes and hands out complete images; what lies between them is dropped."""

    def __init__(self, longest: int = 8_000_000) -> None:
        """Start empty.

        Args:
            longest: A longer image is noise: it is dropped, and the next start looked for.
        """
        self._longest = longest
        self._data = bytearray()
        #: Where reading goes on: 0 while no start was found, else a marker or entropy-coded data.
        self._at = 0
        self._in_scan = False

    def feed(self, data: bytes) -> list[bytes]:
        """Return the images that are complete with these bytes, oldest first."""
        self._data += data
        images: list[bytes] = []
        while True:
            end = self._find_end()
            if end is None:
                if len(self._data) > self._longest:
                    self._drop(2)
                    continue
                return images
            if end > 0:
                images.append(bytes(self._data[:end]))
            self._drop(max(end, 0))

    def _drop(self, count: int) -> None:
        del self._data[:count]
        self._at, self._in_scan = 0, False

    def _find_end(self) -> int | None:
        """Return the end of the image at the start of the data; None if more bytes are needed.

        A broken image is cut off where it breaks, and 0 is returned: the search starts again there.
        """
        data = self._data
        if self._at == 0:
            start = data.find(b"\xff\xd8")
            # Half a start may be the last byte.
            keep = len(data) - (1 if data[-1:] == b"\xff" else 0) if start < 0 else start
            del data[:keep]
            if start < 0:
                return None
            self._at = 2
        while True:
            if self._in_scan:
                mark = data.find(b"\xff", self._at)
                if mark < 0 or mark + 1 >= len(data):
                    self._at = len(data) if mark < 0 else mark
                    return None
                code = data[mark + 1]
                if code == 0x00 or code in _ALONE:
                    self._at = mark + 2
                    continue
                self._at, self._in_scan = mark, False
            if self._at + 1 >= len(data):
                return None
            if data[self._at] != 0xFF or data[self._at + 1] == _SOI:
                # Bytes were lost. The next image may start right here.
                del data[: self._at]
                self._at = 0
                return 0
            code = data[self._at + 1]
            if code == 0xFF:
                self._at += 1
            elif code == _EOI:
                return self._at + 2
            elif code in _ALONE:
                self._at += 2
            elif self._at + 3 >= len(data):
                return None
            else:
                self._at += 2 + int.from_bytes(data[self._at + 2 : self._at + 4], "big")
                self._in_scan = code == _SOS
