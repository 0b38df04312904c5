"""Sheets to print for a calibration, as PDF at true scale: a chessboard, and one that places it on the floor.

The PDF is written here, since nothing that the car installs writes one: two pages of rectangles, lines and
text in a font that every reader has (ISO 32000-1, sections 7.5, 8.5 and 9.6.2.2).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from lanenet.calibration.chessboard import Board
from lanenet.errors import ConfigError

#: PDF counts in 1/72 inch.
POINTS_PER_CM = 72.0 / 2.54
#: White around the squares, [cm]. Chosen: printers leave up to 0.6 cm blank, and the finder wants the outer
#: squares to end in white.
_MARGIN_CM = 1.2
#: From the near edge of the floor sheet to the front axle, [cm]. Chosen: room for the words below.
_AXLE_CM = 2.0
#: A length to be checked with a ruler, [cm], and how far text stands from the edge of the paper.
_RULER_CM, _TEXT_CM = 10.0, 0.75


class Paper(StrEnum):
    """Sizes of paper, on its long side."""

    A4 = "a4"
    LETTER = "letter"


#: Width and height, [cm] (ISO 216; ANSI Y14.1).
PAPER_CM: dict[Paper, tuple[float, float]] = {Paper.A4: (29.7, 21.0), Paper.LETTER: (27.94, 21.59)}


@dataclass
class _Page:
    """Drawing commands of one page; lengths in cm from its lower left corner."""

    drawn: list[str] = field(default_factory=list)

    def rectangle(self, x_cm: float, y_cm: float, width_cm: float, height_cm: float) -> None:
        lengths = (x_cm, y_cm, width_cm, height_cm)
        self.drawn.append(" ".join(f"{POINTS_PER_CM * length:.4f}" for length in lengths) + " re f")

    def line(self, from_cm: tuple[float, float], to_cm: tuple[float, float]) -> None:
        (x0, y0), (x1, y1) = ((POINTS_PER_CM * x, POINTS_PER_CM * y) for x, y in (from_cm, to_cm))
        self.drawn.append(f"0.5 w {x0:.4f} {y0:.4f} m {x1:.4f} {y1:.4f} l S")

    def text(self, x_cm: float, y_cm: float, text: str, size: int = 9) -> None:
        safe = text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        place = f"{POINTS_PER_CM * x_cm:.4f} {POINTS_PER_CM * y_cm:.4f}"
        self.drawn.append(f"BT /F1 {size} Tf {place} Td ({safe}) Tj ET")


def near_left_cm(board: Board, paper: Paper) -> tuple[float, float]:
    """Where the board's near left inner corner lies if the floor sheet touches the board's sheet.

    Args:
        board: The board.
        paper: The paper of both sheets.

    Returns:
        x to the right and y ahead, [cm], frame car, of a car whose front axle stands over the sheet's line.

    Raises:
        ConfigError: If the board does not fit on the paper.
    """
    _, height_cm = PAPER_CM[paper]
    _, bottom_cm = _lower_left(board, paper)
    return (
        -0.5 * (board.columns - 1) * board.square_cm,
        height_cm - _AXLE_CM + bottom_cm + board.square_cm,
    )


def calibration_pdf(board: Board, paper: Paper) -> bytes:
    """Draw the board and the floor sheet.

    Args:
        board: The board; its columns run along the paper's long side.
        paper: Size of the paper.

    Returns:
        A PDF of two pages: the board, and the sheet that lies between it and the car. The same arguments give
        the same bytes.

    Raises:
        ConfigError: If the board does not fit on the paper.
    """
    return _pdf([_board_page(board, paper), _floor_page(board, paper)], PAPER_CM[paper])


def _lower_left(board: Board, paper: Paper) -> tuple[float, float]:
    """The corner of the squares on the page, [cm]; they lie in its middle."""
    width_cm, height_cm = PAPER_CM[paper]
    across_cm, along_cm = ((n + 1) * board.square_cm for n in (board.columns, board.rows))
    left_cm, bottom_cm = 0.5 * (width_cm - across_cm), 0.5 * (height_cm - along_cm)
    if min(left_cm, bottom_cm) < _MARGIN_CM:
        raise ConfigError(
            f"a board of {board.columns}x{board.rows} inner corners and squares of {board.square_cm:g} cm is "
            f"{across_cm:g} x {along_cm:g} cm, expected at most {width_cm - 2 * _MARGIN_CM:g} x "
            f"{height_cm - 2 * _MARGIN_CM:g} cm on {paper.value} paper: choose a smaller --square"
        )
    return left_cm, bottom_cm


def _board_page(board: Board, paper: Paper) -> _Page:
    page = _Page()
    left_cm, bottom_cm = _lower_left(board, paper)
    for row in range(board.rows + 1):
        for column in range(row % 2, board.columns + 1, 2):
            corner = (left_cm + column * board.square_cm, bottom_cm + row * board.square_cm)
            page.rectangle(*corner, board.square_cm, board.square_cm)
    words = f"--board {board.columns}x{board.rows} --square {board.square_cm:g}"
    page.text(
        left_cm,
        _TEXT_CM,
        f"{words}   Print at 100 %, glue on something flat. On the floor, this side is near.",
    )
    _ruler(page, left_cm, PAPER_CM[paper][1] - _TEXT_CM)
    return page


def _floor_page(board: Board, paper: Paper) -> _Page:
    page = _Page()
    width_cm, height_cm = PAPER_CM[paper]
    x_cm, y_cm = near_left_cm(board, paper)
    page.line((0.0, _AXLE_CM), (width_cm, _AXLE_CM))
    page.line((0.5 * width_cm, 0.0), (0.5 * width_cm, height_cm))
    page.text(_TEXT_CM, _AXLE_CM - 0.6, "Front axle over this line, its middle over the other one.")
    # Left of the line along the sheet.
    lines = (
        "This edge touches the near edge of the board's sheet.",
        "The line along this sheet meets the middle of the board.",
        f"From the axle's line to the first inner corners: {y_cm:g} cm (check).",
    )
    for number, text in enumerate(lines):
        page.text(_TEXT_CM, height_cm - 1.5 - 0.6 * number, text)
    page.text(_TEXT_CM, 0.5 * height_cm + 2.0, f"--near-left {x_cm:g},{y_cm:g}", 14)
    _ruler(page, _TEXT_CM, 0.5 * height_cm)
    return page


def _ruler(page: _Page, x_cm: float, y_cm: float) -> None:
    page.line((x_cm, y_cm), (x_cm + _RULER_CM, y_cm))
    for k in range(int(_RULER_CM) + 1):
        page.line((x_cm + k, y_cm), (x_cm + k, y_cm - 0.2))
    page.text(x_cm + _RULER_CM + 0.3, y_cm - 0.2, f"{_RULER_CM:g} cm")


def _pdf(pages: list[_Page], size_cm: tuple[float, float]) -> bytes:
    """Put pages together; the catalogue asks the printer's dialogue not to scale."""
    box = " ".join(f"{POINTS_PER_CM * length:.4f}" for length in size_cm)
    numbers = [4 + 2 * k for k in range(len(pages))]
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{' '.join(f'{n} 0 R' for n in numbers)}] /Count {len(pages)} >>",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    for number, page in zip(numbers, pages, strict=True):
        content = "\n".join(page.drawn)
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {box}] /Resources << /Font << /F1 3 0 R >> >> "
            f"/Contents {number + 1} 0 R >>"
        )
        objects.append(f"<< /Length {len(content)} >>\nstream\n{content}\nendstream")
    text, offsets = "%PDF-1.7\n", []
    for number, each in enumerate(objects, 1):
        offsets.append(len(text))
        text += f"{number} 0 obj\n{each}\nendobj\n"
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    count = len(objects) + 1
    end = f"trailer\n<< /Size {count} /Root 1 0 R >>\nstartxref\n{len(text)}\n%%EOF\n"
    return f"{text}xref\n0 {count}\n0000000000 65535 f \n{table}{end}".encode("ascii")
