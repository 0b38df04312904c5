from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.onboard.cameras.rpicam import JpegStream


def jpeg(value, quality=90, progressive=False):
    image = np.random.default_rng(value).integers(0, 255, (40, 56, 3), dtype=np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)]
    options += [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]
    return cv2.imencode(".jpg", image, options)[1].tobytes()


def with_thumbnail(outer, inner):
    """Put a whole JPEG into an APP1 segment, as cameras do with their thumbnails."""
    return outer[:2] + b"\xff\xe1" + (len(inner) + 2).to_bytes(2, "big") + inner + outer[2:]


IMAGES = [
    jpeg(1),
    jpeg(2, quality=20),
    jpeg(3, progressive=True),
    with_thumbnail(jpeg(4), jpeg(5, quality=5)),
    jpeg(6)[:2] + b"\xff\xff\xff" + jpeg(6)[3:],
]


@given(st.lists(st.integers(1, 4000), min_size=1, max_size=40))
def test_images_survive_every_cut(cuts):
    data, stream, images, at = b"".join(IMAGES), JpegStream(), [], 0
    for cut in [*cuts, len(data)]:
        images += stream.feed(data[at : at + cut])
        at += cut
    assert images == IMAGES


def test_byte_by_byte():
    stream, images = JpegStream(), []
    for byte in b"".join(IMAGES):
        images += stream.feed(bytes([byte]))
    assert images == IMAGES
    assert all(
        cv2.imdecode(np.frombuffer(i, np.uint8), cv2.IMREAD_COLOR).shape == (40, 56, 3) for i in images
    )


def test_noise_between_images_is_dropped():
    stream = JpegStream()
    assert stream.feed(b"\x00\xff\x00noise" + IMAGES[0] + b"more\xff" + IMAGES[1]) == IMAGES[:2]
    assert stream.feed(b"noise only \xff") == []
    assert stream.feed(b"\xd8" + IMAGES[2][2:]) == [IMAGES[2]]


@pytest.mark.parametrize("cut", [2, 3, 20, 200, 1000])
def test_after_an_image_cut_off_the_next_ones_come(cut):
    """At most one whole image is lost with the broken one."""
    stream = JpegStream()
    images = stream.feed(IMAGES[0][:-cut] + IMAGES[1] + IMAGES[2] + IMAGES[1])
    assert images[-2:] == [IMAGES[2], IMAGES[1]]


def test_endless_image_does_not_pile_up():
    stream = JpegStream(longest=10_000)
    head = IMAGES[0][:-2]
    for _ in range(50):
        assert stream.feed(head if _ == 0 else b"\x55" * 1000) == []
    assert len(stream._data) <= 10_000
    assert stream.feed(IMAGES[1] + IMAGES[2])[-1] == IMAGES[2]
