from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import HEIGHT, WIDTH, lap, write_recording

from lanenet.data.drives import open_drive
from lanenet.data.library.fingerprint import HASH_BYTES, Fingerprint, checksum, hash_image, take_fingerprint
from lanenet.data.library.overlap import LEAST_FRAMES, Overlap, Recording, find_overlaps


def _taken(pictures: list[np.ndarray], name: str = "", first: int = 0) -> Recording:
    """As if each picture had been encoded anew: no two have the same bytes."""
    rng = np.random.default_rng()
    digests = rng.integers(1, 2**63, len(pictures)).astype(np.uint64)
    hashes = np.array([hash_image(picture) for picture in pictures])
    return Recording(name, Fingerprint(np.arange(len(pictures)) + first, digests, hashes))


def _again(pictures: list[np.ndarray], quality: int = 40, scale: float = 1.0) -> list[np.ndarray]:
    """Pictures that were scaled and encoded again."""
    small = [cv2.resize(p, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for p in pictures]
    coded = [cv2.imencode(".jpg", p, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for p in small]
    return [cv2.imdecode(data, cv2.IMREAD_COLOR) for data in coded]


def _only(found: list[Overlap], frames: tuple[int, int], other: tuple[int, int], within: int = 3) -> Overlap:
    assert len(found) == 1, found
    ends = np.array([found[0].frames, found[0].other_frames])
    assert np.abs(ends - np.array([frames, other])).max() <= within, found
    return found[0]


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    return lap(1)


@pytest.fixture(scope="module")
def whole(pictures: list[np.ndarray]) -> Recording:
    return _taken(pictures)


@pytest.mark.parametrize(("quality", "scale"), [(30, 1.0), (80, 0.5), (60, 1.7)])
def test_a_copy_that_was_encoded_again_is_found(
    pictures: list[np.ndarray], whole: Recording, quality: int, scale: float
) -> None:
    found = _only(find_overlaps(whole, _taken(_again(pictures, quality, scale))), (0, 149), (0, 149), 0)
    assert not found.same_bytes and found.difference < 0.01 and found.matched > 100


@pytest.mark.parametrize("step", [1, 2, 3])
def test_a_cut_is_found_at_its_frames_whatever_was_left_out(
    pictures: list[np.ndarray], whole: Recording, step: int
) -> None:
    cut = _taken(_again(pictures[31:139:step]), first=500)
    last = 31 + step * (len(cut.fingerprint) - 1)
    ends = (500, 500 + len(cut.fingerprint) - 1)
    _only(find_overlaps(whole, cut), (31, last), ends)
    _only(find_overlaps(cut, whole), ends, (31, last))


def test_two_drives_that_overlap_share_only_that(pictures: list[np.ndarray]) -> None:
    one, other = _taken(pictures[:100]), _taken(_again(pictures[40:]))
    _only(find_overlaps(one, other), (40, 99), (0, 59))


def test_other_laps_of_the_same_track_are_no_copies(whole: Recording) -> None:
    for seed in range(2, 6):
        assert find_overlaps(whole, _taken(lap(seed))) == []


def test_a_car_that_stands_where_another_drive_began_is_no_copy() -> None:
    rng = np.random.default_rng(0)
    still = lap(1, 1)[0].astype(np.float32)

    def waits(seed: int) -> list[np.ndarray]:
        noisy = [np.clip(still + 2.0 * rng.standard_normal(still.shape), 0, 255) for _ in range(200)]
        return [picture.astype(np.uint8) for picture in noisy] + lap(seed, 40)

    one, other = _taken(waits(1)), _taken(waits(2))
    assert find_overlaps(one, other) == []
    assert len(one.moved) < 50


def test_the_run_goes_on_over_a_stop(pictures: list[np.ndarray]) -> None:
    stops = [*pictures[:80], *[pictures[80]] * 60, *pictures[80:]]
    _only(find_overlaps(_taken(stops), _taken(_again(stops))), (0, 209), (0, 209), 0)


def test_a_run_below_the_least_length_is_passed_over(pictures: list[np.ndarray], whole: Recording) -> None:
    short = _taken(_again(pictures[50 : 50 + LEAST_FRAMES // 2]) + lap(9, 100, track=9))
    assert find_overlaps(whole, short) == []


def test_pictures_that_show_nothing_are_like_no_other() -> None:
    black = [np.zeros((HEIGHT, WIDTH, 3), np.uint8)] * 100
    assert not hash_image(black[0]).any()
    assert find_overlaps(_taken(black), _taken(black)) == []


def test_the_same_bytes_are_found_though_frames_were_left_out(pictures: list[np.ndarray]) -> None:
    one = _taken(pictures)
    f = one.fingerprint
    kept = np.sort(np.random.default_rng(0).permutation(150)[:60])
    other = Recording("", Fingerprint(np.arange(60), f.digests[kept], f.hashes[kept]))
    assert find_overlaps(one, other) == [
        Overlap((int(kept[0]), int(kept[-1])), (0, 59), 60, same_bytes=True, difference=0.0)
    ]
    turned = Recording("", Fingerprint(np.arange(60), f.digests[kept[::-1]], f.hashes[kept[::-1]]))
    assert find_overlaps(one, turned) == [
        Overlap((int(kept[0]), int(kept[-1])), (0, 59), 60, same_bytes=True, difference=0.0)
    ]
    few = Recording("", Fingerprint(np.arange(7), f.digests[:7], f.hashes[:7]))
    assert find_overlaps(one, few) == []


def test_a_copy_that_holds_some_images_as_they_were_is_found_whole(pictures: list[np.ndarray]) -> None:
    one, coded = _taken(pictures), _taken(_again(pictures[50:])).fingerprint
    for kept in (slice(0, 20), slice(40, 60)):
        digests = coded.digests.copy()
        digests[kept] = one.fingerprint.digests[50:][kept]
        found = find_overlaps(one, Recording("", Fingerprint(coded.frames, digests, coded.hashes)))
        assert not _only(found, (50, 149), (0, 99)).same_bytes
    # What is the same byte by byte and no more is exact to its ends.
    other = _taken([*pictures[50:100], *lap(9, 60, track=9)]).fingerprint
    other.digests[:50] = one.fingerprint.digests[50:100]
    found = _only(find_overlaps(one, Recording("", other)), (50, 99), (0, 49), 0)
    assert found.same_bytes


def test_images_that_cannot_be_read_are_no_match(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    for name in ("a", "b"):
        path = write_recording(tmp_path / name, pictures[:20])
        for image in path.glob("images/*"):
            if image.stem != "0000":
                image.write_bytes(b"damaged")
    found = [take_fingerprint(open_drive(tmp_path / name))[0] for name in ("a", "b")]
    assert not found[0].digests[1:].any() and not found[0].hashes[1:].any()
    assert find_overlaps(Recording("a", found[0]), Recording("b", found[1])) == []


def test_a_hash_does_not_change_with_brightness_contrast_and_size() -> None:
    picture = lap(3, 1)[0]
    paler = (40.0 + 0.6 * picture).astype(np.uint8)
    larger = cv2.resize(picture, None, fx=3, fy=3, interpolation=cv2.INTER_LINEAR)
    for changed in (paler, larger):
        both = np.unpackbits(hash_image(picture)), np.unpackbits(hash_image(changed))
        strong = (both[0] & both[1])[256:].astype(bool)
        assert strong.sum() > 170
        assert np.mean((both[0] ^ both[1])[:256][strong]) < 0.01


def test_a_fingerprint_survives_its_bytes(whole: Recording) -> None:
    data = whole.fingerprint.to_bytes()
    assert len(data) == 150 * (16 + HASH_BYTES)
    again = Fingerprint.from_bytes(data)
    for name in ("frames", "digests", "hashes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole.fingerprint, name))


def test_the_checksum_is_that_of_images_and_commands(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    path = write_recording(tmp_path / "a", pictures[:5])
    calls: list[tuple[int, int]] = []
    before = take_fingerprint(open_drive(path), lambda *done: calls.append(done))[1]
    assert before == checksum(open_drive(path)) and calls == [(k, 5) for k in range(1, 6)]
    table = path / "frames.csv"
    text = table.read_text()
    table.write_text(text.replace("0.150,", "0.160,"))
    assert checksum(open_drive(path)) == before
    table.write_text(text.replace(",0.002", ",0.009"))
    assert checksum(open_drive(path)) != before
    table.write_text(text)
    (path / "images" / "0002.jpg").write_bytes((path / "images" / "0003.jpg").read_bytes())
    assert checksum(open_drive(path)) != before


def test_a_cut_of_a_real_tub_is_found_and_its_laps_are_not(shared_data: Path) -> None:
    # Dim, and driven by a hand that repeats itself: the laps that are most alike.
    drive = open_drive(shared_data / "garage_tape").subset(slice(0, 1000))
    f = take_fingerprint(drive)[0]

    def part(first: int, last: int) -> Recording:
        rows = slice(first, last)
        return Recording("", Fingerprint(f.frames[rows], f.digests[rows], f.hashes[rows]))

    cut = _taken(_again([drive.image(i) for i in range(300, 600)], 40, 0.5))
    ends = (int(f.frames[300]), int(f.frames[599]))
    _only(find_overlaps(part(0, 1000), cut), ends, (0, 299))
    assert find_overlaps(part(0, 500), part(500, 1000)) == []
