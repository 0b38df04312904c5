"""Images that are read once."""

from __future__ import annotations

import numpy as np
import pytest

from datagen.prepare import KeptImages
from lanenet.errors import DriveFormatError


class _Counting:
    """Makes an image of each row, but for row 9, and counts."""

    def __init__(self) -> None:
        self.reads: list[int] = []

    def read(self, row: int) -> np.ndarray:
        self.reads.append(row)
        if row == 9:
            raise DriveFormatError("row 9: no such image")
        return np.full((4, 5, 3), row, np.uint8)


def test_an_image_is_read_once_and_stays_as_it_was():
    source = _Counting()
    images = KeptImages(source)
    for row in (3, 1, 3, 1, 3):
        np.testing.assert_array_equal(images.read(row), np.full((4, 5, 3), row))
    assert source.reads == [3, 1]
    with pytest.raises(ValueError, match="read-only"):
        images.read(3)[0, 0] = 0


def test_what_does_not_fit_is_read_again():
    source = _Counting()
    images = KeptImages(source, most_bytes=2 * 60 + 59)
    for _ in range(2):
        for row in (0, 1, 2):
            assert images.read(row)[0, 0, 0] == row
    assert source.reads == [0, 1, 2, 2]


def test_an_image_that_cannot_be_read_is_not_kept():
    source = _Counting()
    images = KeptImages(source)
    for _ in range(2):
        with pytest.raises(DriveFormatError, match="row 9"):
            images.read(9)
    assert source.reads == [9, 9]
