"""Copies and cuts of real tubs are found in a library, and unlike tubs share nothing."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import pytest

from lanenet.data.drives import open_drive
from lanenet.data.drives.folder import DriveWriter
from lanenet.data.library import Library
from lanenet.errors import SameRecordingError

TUBS = ("garage_tape", "usi_mat", "donkey_circuit", "blue_tape")


def _again(source: Path, out: Path, rows: slice, *, quality: int = 95, scale: float = 1.0) -> Path:
    """Write frames of a tub as a drive folder, encoded anew and scaled."""
    drive = open_drive(source)
    with DriveWriter(out, None, lane_width_cm=40.0, notes="", jpeg_quality=quality) as writer:
        for number, row in enumerate(range(len(drive))[rows]):
            image = cv2.resize(drive.image(row), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            writer.add(image, 0.05 * number, speed_cm_s=60.0, steering_rad=0.0)
    return out


def _as_png(drive: Path) -> Path:
    for image in sorted(drive.glob("images/*.jpg")):
        cv2.imwrite(str(image.with_suffix(".png")), cv2.imread(str(image)))
        image.unlink()
    table = drive / "frames.csv"
    table.write_text(table.read_text().replace(".jpg", ".png"))
    return drive


@pytest.fixture(scope="module")
def library(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Library:
    made = Library.open(tmp_path_factory.mktemp("library") / "drives.sqlite", create=True)
    for name in TUBS:
        made.add(shared_data / name, track=name)
    return made


def test_unlike_tubs_share_no_frames(library: Library) -> None:
    assert [entry.name for entry in library.entries()] == sorted(TUBS)
    assert library.all_relations() == {}


@pytest.mark.parametrize("name", ["garage_tape", "donkey_circuit"])
def test_a_duplicate_is_known_under_another_name(
    library: Library, shared_data: Path, tmp_path: Path, name: str
) -> None:
    shutil.copytree(shared_data / name, tmp_path / "mine")
    with pytest.raises(SameRecordingError, match=f"same recording as {name} of the library"):
        library.add(tmp_path / "mine")


@pytest.mark.parametrize(
    ("name", "how"),
    [
        ("garage_tape", {"quality": 40}),
        pytest.param("garage_tape", {"quality": 90, "scale": 0.5}, marks=pytest.mark.slow),
        pytest.param("blue_tape", {"quality": 60, "scale": 1.5}, marks=pytest.mark.slow),
        pytest.param("donkey_circuit", {"png": True}, marks=pytest.mark.slow),
    ],
)
def test_a_copy_that_was_encoded_again_is_found(
    library: Library, shared_data: Path, tmp_path: Path, name: str, how: dict[str, float]
) -> None:
    png, how = how.get("png"), {key: value for key, value in how.items() if key != "png"}
    copy = _again(shared_data / name, tmp_path / "copy", slice(None), **how)  # type: ignore[arg-type]
    library.add(_as_png(copy) if png else copy)
    (said,) = library.relation_sentences("copy")
    frames = open_drive(shared_data / name).frames
    library.remove("copy")
    assert said.startswith(
        f"copy is a re-encoded copy of {name}: its frames 0 to {len(frames) - 1} are {frames[0]} to "
        f"{frames[-1]} of {name} (encoded again: of "
    )


def test_cuts_that_overlap_are_found(library: Library, shared_data: Path, tmp_path: Path) -> None:
    tub = shared_data / "usi_mat"
    library.add(_again(tub, tmp_path / "early", slice(200, 700), quality=70))
    library.add(_again(tub, tmp_path / "late", slice(500, 1100), quality=50))
    found = library.all_relations()
    said = library.relation_sentences("late")
    for name in ("early", "late"):
        library.remove(name)
    frames = open_drive(tub).frames
    overlaps = {(one, other): overlap for one, all_ in found.items() for other, overlap in all_}
    assert set(overlaps) == {
        (a, b) for a in ("early", "late", "usi_mat") for b in ("early", "late", "usi_mat") if a != b
    }
    # The ends of a run are known to a few frames where the car stands or turns slowly.
    for key, expected in {
        ("late", "early"): ((0, 199), (300, 499)),
        ("late", "usi_mat"): ((0, 599), (frames[500], frames[1099])),
    }.items():
        ends = (*overlaps[key].frames, *overlaps[key].other_frames)
        assert all(abs(a - b) <= 3 for a, b in zip(ends, (*expected[0], *expected[1]), strict=True)), ends
    assert said[0].startswith("late overlaps with early: both are cuts of one recording")
    assert said[1].startswith("late is a cut of usi_mat")
