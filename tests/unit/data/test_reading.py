"""The front door for files: what comes in, how large it may be, and how large an image is by its header."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from lanenet.errors import ConfigError, DriveFormatError
from lanenet.image_header import image_size
from lanenet.reading import FolderFiles, parsing, read_bytes, read_image

WIDTH, HEIGHT = 37, 21


@pytest.mark.parametrize("ending", [".jpg", ".png", ".bmp", ".webp", ".tiff", ".ppm", ".pgm"])
def test_the_header_says_what_is_decoded(tmp_path, ending):
    picture = np.full((HEIGHT, WIDTH, 1 if ending == ".pgm" else 3), 90, np.uint8)
    ok, data = cv2.imencode(ending, picture)
    assert ok and image_size(data.tobytes()) == (WIDTH, HEIGHT)
    (tmp_path / "a").write_bytes(data.tobytes())
    assert read_image(tmp_path / "a", ConfigError).shape == (HEIGHT, WIDTH, 3)


def test_headers_that_opencv_does_not_write():
    # WebP, extended and lossless; TIFF of the other byte order; a comment in a Netpbm file.
    assert image_size(b"RIFF\0\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0\x24\0\0\x14\0\0") == (WIDTH, HEIGHT)
    bits = (WIDTH - 1) | (HEIGHT - 1) << 14
    assert image_size(b"RIFF\0\0\0\0WEBPVP8L\0\0\0\0\x2f" + struct.pack("<I", bits)) == (WIDTH, HEIGHT)
    entries = struct.pack(">HHII", 256, 4, 1, WIDTH) + struct.pack(">HHIHH", 257, 3, 1, HEIGHT, 0)
    assert image_size(b"MM\0*" + struct.pack(">IH", 8, 2) + entries) == (WIDTH, HEIGHT)
    assert image_size(b"P6\n# 1 2\n37 21\n255\n") == (WIDTH, HEIGHT)
    # JPEG with filling bytes; and one of nothing but markers.
    frame = b"\xc0\0\x0b\x08" + struct.pack(">HH", HEIGHT, WIDTH)
    assert image_size(b"\xff\xd8\xff\xe0\0\x04ab\xff\xff\xff" + frame) == (WIDTH, HEIGHT)
    assert image_size(b"\xff\xd8" * 2**20) is None


@pytest.mark.parametrize(
    "start", [b"", b"\xff\xd8", b"\xff\xd8\xff\xe0\0\0", b"BM", b"II*\0", b"P6", b"GIF89a"]
)
def test_a_damaged_header_has_no_size(start):
    assert image_size(start) is None and image_size(start + b"\xff" * 9) is None


def test_a_file_may_be_as_large_as_it_may_be_and_no_larger(tmp_path):
    (tmp_path / "a").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a", ConfigError, 5) == b"12345"
    with pytest.raises(ConfigError, match="a: has"):
        read_bytes(tmp_path / "a", ConfigError, 4)


@pytest.mark.parametrize("name", ["a\0b", "x" * 5000, "gone", "."])
def test_a_name_without_a_file_is_an_error(tmp_path, name):
    with pytest.raises(ConfigError):
        read_bytes(tmp_path / name, ConfigError, 4)


@pytest.mark.parametrize(
    "problem",
    [
        KeyError("k"),
        RecursionError(),
        MemoryError(),
        OverflowError("x"),
        UnicodeDecodeError("a", b"", 0, 1, "x"),
    ],
    ids=lambda problem: type(problem).__name__,
)
def test_what_a_parser_raises_names_the_file(problem):
    with pytest.raises(ConfigError, match=r"a\.yaml") as caught, parsing("a.yaml", ConfigError):
        raise problem
    assert caught.value.__cause__ is problem


def test_own_errors_and_faults_of_the_program_pass():
    for problem in (DriveFormatError("x"), AssertionError()):
        with pytest.raises(type(problem)), parsing("a.yaml", ConfigError):
            raise problem


@pytest.mark.parametrize("name", ["a", "b/c", "./b/../b/c"])
def test_files_in_a_folder(tmp_path, name):
    inside = FolderFiles(Path(os.path.relpath(tmp_path)))
    if ".." in name:
        with pytest.raises(ConfigError, match="drive"):
            inside.file(name, "drive", ConfigError)
    else:
        assert inside.file(name, "drive", ConfigError).resolve() == (tmp_path / name).resolve()
