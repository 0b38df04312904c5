"""The printed sheets: their geometry, read back from the PDF, in centimetres on paper."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from lanenet.calibration.chessboard import Board, find_view
from lanenet.calibration.ground import calibrate_ground, points_of_floor_board
from lanenet.calibration.printed import PAPER_CM, Paper, calibration_pdf, near_left_cm
from lanenet.cli.app import app
from lanenet.errors import ConfigError
from lanenet.geometry.camera import Camera, Mounting

BOARD = Board(9, 6, 2.5)
POINT_CM = 2.54 / 72.0
REPO = Path(__file__).resolve().parents[3]


def pages_of(pdf: bytes) -> list[tuple[np.ndarray, str]]:
    """Size in cm and drawing commands of each page, by way of the table of objects at the end."""
    start = int(re.search(rb"startxref\n(\d+)", pdf)[1])
    lines = pdf[start:].decode("ascii").splitlines()
    assert lines[0] == "xref"
    count = int(lines[1].split()[1])
    offsets = [int(line.split()[0]) for line in lines[3 : 2 + count]]
    objects = {}
    for number, offset in enumerate(offsets, 1):
        head = f"{number} 0 obj\n".encode()
        assert pdf[offset : offset + len(head)] == head
        objects[number] = pdf[offset + len(head) : pdf.index(b"\nendobj", offset)].decode("ascii")
    pages = []
    for text in objects.values():
        box = re.search(r"/MediaBox \[0 0 (\S+) (\S+)\]", text)
        if box is not None:
            content = objects[int(re.search(r"/Contents (\d+)", text)[1])]
            length, drawn = re.fullmatch(
                r"<< /Length (\d+) >>\nstream\n(.*)\nendstream", content, re.DOTALL
            ).groups()
            assert int(length) == len(drawn)
            pages.append((POINT_CM * np.array(box.groups(), dtype=float), drawn))
    return pages


def squares_cm(drawn: str) -> np.ndarray:
    found = re.findall(r"(\S+) (\S+) (\S+) (\S+) re f", drawn)
    return POINT_CM * np.array(found, dtype=float)


def scanned(size_cm: np.ndarray, drawn: str, px_per_cm: float = 20.0) -> np.ndarray:
    """The page as a scanner sees it."""
    width, height = np.round(size_cm * px_per_cm).astype(int)
    page = np.full((height, width), 255, np.uint8)
    for x, y, w, h in squares_cm(drawn) * px_per_cm:
        page[round(height - y - h) : round(height - y), round(x) : round(x + w)] = 0
    return page


@pytest.mark.parametrize(
    ("board", "paper"),
    [(BOARD, Paper.A4), (BOARD, Paper.LETTER), (Board(7, 5, 3.0), Paper.A4), (Board(10, 7, 1.8), Paper.A4)],
)
def test_the_printed_board_has_its_size(board: Board, paper: Paper) -> None:
    (size_cm, drawn), _ = pages_of(calibration_pdf(board, paper))
    np.testing.assert_allclose(size_cm, PAPER_CM[paper], atol=1e-4)
    squares = squares_cm(drawn)
    np.testing.assert_allclose(squares[:, 2:], board.square_cm, atol=1e-4)
    px_per_cm = 20.0
    view = find_view("scan", scanned(size_cm, drawn, px_per_cm), board)
    assert not isinstance(view, str), view
    corners_cm = view.corners_px.reshape(board.rows, board.columns, 2) / px_per_cm
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(corners_cm, axis=1), axis=2), board.square_cm, atol=0.03
    )
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(corners_cm, axis=0), axis=2), board.square_cm, atol=0.03
    )
    # In the middle, with white around it.
    assert squares[:, :2].min() >= 1.2 and (squares[:, :2] + squares[:, 2:] <= size_cm - 1.2).all()


def test_the_rulers_are_ten_centimetres_long() -> None:
    for _, drawn in pages_of(calibration_pdf(BOARD, Paper.A4)):
        lines = POINT_CM * np.array(re.findall(r"w (\S+) (\S+) m (\S+) (\S+) l S", drawn), dtype=float)
        level = lines[np.isclose(lines[:, 1], lines[:, 3])]
        assert np.isclose(level[:, 2] - level[:, 0], 10.0, atol=1e-4).any()


def test_the_floor_sheet_places_the_board_where_it_says() -> None:
    (size_cm, board_drawn), (_, floor_drawn) = pages_of(calibration_pdf(BOARD, Paper.A4))
    x_cm, y_cm = near_left_cm(BOARD, Paper.A4)
    assert f"--near-left {x_cm:g},{y_cm:g}" in floor_drawn
    lines = POINT_CM * np.array(re.findall(r"w (\S+) (\S+) m (\S+) (\S+) l S", floor_drawn), dtype=float)
    whole = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1]) > 15.0
    (axle,) = lines[whole & np.isclose(lines[:, 1], lines[:, 3])]
    (along,) = lines[whole & np.isclose(lines[:, 0], lines[:, 2])]
    squares = squares_cm(board_drawn)
    corner = squares[:, :2].min(axis=0) + BOARD.square_cm
    # The board's sheet lies beyond the far edge of the floor sheet.
    assert corner[0] - along[0] == pytest.approx(x_cm, abs=1e-3)
    assert size_cm[1] - axle[1] + corner[1] == pytest.approx(y_cm, abs=1e-3)


def test_a_photo_of_the_sheets_gives_the_mounting() -> None:
    K = np.array([[300.0, 0.0, 319.5], [0.0, 300.0, 239.5], [0.0, 0.0, 1.0]])
    mounting = Mounting(18.0, 0.45, 0.02, -0.03, -3.0, 1.0)
    camera = Camera("pinhole", 640, 480, K, np.zeros(5), mounting, 26.0)
    (size_cm, drawn), _ = pages_of(calibration_pdf(BOARD, Paper.A4))
    px_per_cm = 40.0
    sheet = scanned(size_cm, drawn, px_per_cm)
    y_near = near_left_cm(BOARD, Paper.A4)[1] - squares_cm(drawn)[:, 1].min() - BOARD.square_cm
    height, width = sheet.shape
    # Of pixel centres: the left lower, right lower, left upper and right upper corner of the sheet.
    on_sheet = np.array([[0, height], [width, height], [0, 0], [width, 0]], dtype=np.float32) - 0.5
    half = 0.5 * size_cm[0]
    far = y_near + size_cm[1]
    on_floor = np.array([[-half, y_near], [half, y_near], [-half, far], [half, far]])
    seen = camera.project_ground(on_floor).astype(np.float32)
    warp = cv2.getPerspectiveTransform(on_sheet, seen)
    size = (camera.width, camera.height)
    photo = cv2.warpPerspective(sheet, warp, size, flags=cv2.INTER_AREA, borderValue=200)
    view = find_view("photo", cv2.GaussianBlur(photo, (0, 0), 0.7), BOARD)
    assert not isinstance(view, str), view
    points_cm, pixels_px = points_of_floor_board(view, BOARD, near_left_cm(BOARD, Paper.A4))
    found = calibrate_ground(camera, points_cm, pixels_px).camera.mounting
    assert found.height_cm == pytest.approx(18.0, abs=0.2)
    assert found.pitch_down_rad == pytest.approx(0.45, abs=0.01)


def test_a_board_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"30 x 21 cm, expected at most 27\.3 x 18\.6 cm on a4"):
        calibration_pdf(Board(9, 6, 3.0), Paper.A4)


@pytest.mark.parametrize("paper", list(Paper))
def test_the_sheets_of_the_documents_are_those_of_the_command(paper: Paper, tmp_path: Path) -> None:
    out = tmp_path / "board.pdf"
    result = CliRunner().invoke(app, ["calibrate", "print", "--paper", paper.value, "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert "--near-left" in result.output
    assert out.read_bytes() == (REPO / "docs" / "print" / f"board-{paper.value}.pdf").read_bytes()
