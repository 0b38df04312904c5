from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from lanenet.onboard.cameras.jpeg import decode_jpeg

ROOT = Path(__file__).resolve().parents[3]


def picture() -> np.ndarray:
    return cv2.imread(str(ROOT / "checkpoints" / "small" / "example.jpg"))


def jpeg(image: np.ndarray, quality: int) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


@pytest.mark.parametrize("quality", [30, 50, 75, 95])
@pytest.mark.parametrize("size", [(320, 240), (160, 120), (100, 75), (641, 479)])
def test_whole_images_are_those_of_opencv(size, quality) -> None:
    data = jpeg(cv2.resize(picture(), size), quality)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.array_equal(decode_jpeg(data), expected)
    # A driver's buffer is longer than its image.
    assert np.array_equal(decode_jpeg(data + bytes(500)), expected)


@pytest.mark.parametrize("level", [0, 127, 128, 129, 255])
def test_an_even_image_is_whole_unless_it_is_cut(level) -> None:
    data = jpeg(np.full((240, 320, 3), level, np.uint8), 50)
    assert decode_jpeg(data) is not None
    if level != 128:
        # What is missing of an image that is gray itself is gray: nothing is lost.
        assert decode_jpeg(data[:-60] + data[-2:]) is None


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff\xd9", b"\xff\xd9", b"noise" * 40])
def test_noise_is_no_image(data) -> None:
    assert decode_jpeg(data) is None


@pytest.mark.parametrize("cut", [1, 2, 300, 2000])
def test_an_image_without_its_end_is_none(cut) -> None:
    assert decode_jpeg(jpeg(picture(), 75)[:-cut]) is None
