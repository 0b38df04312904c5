"""The corners of a chessboard in images, also of one that the image cuts off."""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from lanenet.errors import CalibrationError, ConfigError
from lanenet.image_header import orientation
from lanenet.processes import in_threads
from lanenet.reading import MAX_IMAGE, natural_key, read_bytes, read_image

PICTURE_ENDINGS = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
#: Fewest rows and columns of corners of a board that is cut off. Chosen: 16 corners for the six numbers of a
#: pose.
_MIN_SIDE = 4
#: Smallest photo. Chosen: the smallest board, 3 x 3 corners, then has squares of 10 px.
_MIN_PICTURE_PX = 40
#: Widths at which a photo is searched as well: enlarged if it is small, reduced if it is large. Chosen: the
#: sizes at which OpenCV's finder is fast and still sees boards held far away.
_SEARCH_WIDTHS_PX = (640, 1280)
_SB_FLAGS = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
_PLAIN_FLAGS = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK


@dataclass(frozen=True)
class Board:
    """A chessboard.

    Attributes:
        columns: Inner corners along a row.
        rows: Rows of inner corners.
        square_cm: Side of a square.
    """

    columns: int
    rows: int
    square_cm: float = 2.5

    def points_cm(self) -> Float[np.ndarray, "n 2"]:
        """Corners row by row, [cm], frame of the board: x along a row, y from row to row."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return self.square_cm * np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


@dataclass(frozen=True)
class BoardView:
    """One image's corners.

    Attributes:
        name: The image.
        width: Its width, [px].
        height: Its height, [px].
        points_cm: Corners on the board.
        corners_px: The same corners in the image.
        complete: Whether the whole board was seen.
    """

    name: str
    width: int
    height: int
    points_cm: Float[np.ndarray, "n 2"]
    corners_px: Float[np.ndarray, "n 2"]
    complete: bool = True


def parse_board(text: str, square_cm: float = 2.5) -> Board:
    """Read a board's size, such as ``9x6`` (inner corners).

    Raises:
        ConfigError: If the text is no size, or the board is too small to be found.
    """
    match = re.fullmatch(r"\s*(\d{1,3})\s*[xX]\s*(\d{1,3})\s*", text)
    if match is None:
        raise ConfigError(f"--board {text!r}: expected inner corners as COLUMNSxROWS, for example 9x6")
    columns, rows = int(match[1]), int(match[2])
    if min(columns, rows) < 3 or max(columns, rows) > 60:
        raise ConfigError(f"--board {text}: expected 3 to 60 inner corners in each direction")
    if not square_cm > 0.0:
        raise ConfigError(f"--square {square_cm:g}: expected a length above 0 cm")
    return Board(columns, rows, square_cm)


def list_pictures(words: Sequence[str]) -> list[Path]:
    """Turn files, folders and patterns into image files, each once, in the order of their names.

    Raises:
        CalibrationError: If a word names nothing, or a folder holds no image.
    """
    found: list[Path] = []
    for word in words:
        path = Path(word)
        if path.is_dir():
            inside = [p for p in path.iterdir() if p.suffix.lower() in PICTURE_ENDINGS and p.is_file()]
            if not inside:
                raise CalibrationError(f"{path}: no images in this folder ({', '.join(PICTURE_ENDINGS)})")
        elif path.is_file():
            inside = [path]
        else:
            anchor = Path(path.anchor) if path.anchor else Path()
            pattern = str(path.relative_to(anchor)) if path.anchor else word
            inside = [p for p in anchor.glob(pattern) if p.is_file()] if any(c in word for c in "*?[") else []
            if not inside:
                raise CalibrationError(f"{word}: no such image, folder or pattern")
        found += sorted(inside, key=natural_key)
    return list(dict.fromkeys(found))


def read_picture(path: Path, turn: int | None = None) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image as BGR, as it is shown, like all images; ``turn`` as for :func:`read_image`.

    Raises:
        CalibrationError: If it cannot be read as an image.
    """
    return read_image(path, CalibrationError, turn=turn)


def common_turn(paths: Sequence[Path]) -> int:
    """Return the orientation of Exif that the most images have.

    Photos of one lens are turned alike, whichever way the camera was held: the lens does not turn in it.
    """
    turns: Counter[int] = Counter()
    for path in paths:
        with contextlib.suppress(CalibrationError):
            turns[orientation(read_bytes(path, CalibrationError, MAX_IMAGE))] += 1
    return turns.most_common(1)[0][0] if turns else 1


def find_view(name: str, image: np.ndarray, board: Board) -> BoardView | str:
    """Find the board in an image.

    Args:
        name: Names the image in messages.
        image: Gray or BGR, uint8.
        board: The board.

    Returns:
        The corners, or the reason why there are none.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or image.shape[2:] not in ((), (1,), (3,)):
        return f"expected a gray or BGR image of uint8, found {image.dtype} of shape {image.shape}"
    height, width = image.shape[:2]
    if min(height, width) < _MIN_PICTURE_PX:
        return f"only {width}x{height} px, too small for a board"
    gray = (
        cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.shape[2:] == (3,) else image.reshape(height, width)
    )
    if int(gray.max()) - int(gray.min()) < 16:
        return "an even surface without contrast"
    corners = _find_complete(gray, board)
    if corners is not None:
        return BoardView(name, width, height, board.points_cm(), corners)
    part = _find_part(gray, board)
    if part is not None:
        columns, rows, corners = part
        seen = Board(columns, rows, board.square_cm)
        return BoardView(name, width, height, seen.points_cm(), corners, complete=False)
    return f"no board with {board.columns}x{board.rows} inner corners found"


def find_views(
    paths: Sequence[Path], board: Board, progress: Callable[..., Any] | None = None
) -> tuple[list[BoardView], dict[str, str]]:
    """Find the board in image files.

    Args:
        paths: The images.
        board: The board.
        progress: Called with images done and their number.

    Returns:
        The views, and for each other image the reason why it is none.

    Raises:
        CalibrationError: If no image shows the whole board; says which other board the first ones show.
    """
    views: list[BoardView] = []
    left_out: dict[str, str] = {}
    turn = common_turn(paths)

    def find(path: Path) -> BoardView | str:
        try:
            return find_view(str(path), read_picture(path, turn), board)
        except CalibrationError as error:
            return str(error).removeprefix(f"{path}: ")

    for path, answer in zip(paths, in_threads(find, paths), strict=True):
        if isinstance(answer, BoardView):
            views.append(answer)
        else:
            left_out[str(path)] = answer
        if progress is not None:
            progress(len(views) + len(left_out), len(paths))
    if not any(view.complete for view in views):
        raise CalibrationError(
            f"none of {len(paths)} images shows a whole board with {board.columns}x{board.rows} inner "
            f"corners{_hint(paths, board)}"
        )
    return views, left_out


def _find_complete(gray: UInt8[np.ndarray, "h w"], board: Board) -> Float[np.ndarray, "n 2"] | None:
    size = (board.columns, board.rows)
    for find, flags in (
        (cv2.findChessboardCornersSB, _SB_FLAGS),
        (cv2.findChessboardCorners, _PLAIN_FLAGS),
    ):
        for scaled, scale in _scales(gray):
            found, corners = find(scaled, size, flags=flags)
            if found and len(corners) == board.columns * board.rows:
                first = _checked(_unscaled(corners, scale), gray, size)
                return None if first is None else _checked(_refined(gray, first, size), gray, size)
    return None


def _find_part(
    gray: UInt8[np.ndarray, "h w"], board: Board
) -> tuple[int, int, Float[np.ndarray, "n 2"]] | None:
    """A board that the image cuts off: any rectangle of its corners is a board as well."""
    least = (min(_MIN_SIDE, board.columns), min(_MIN_SIDE, board.rows))
    found, corners, meta = cv2.findChessboardCornersSBWithMeta(gray, least, _SB_FLAGS | cv2.CALIB_CB_LARGER)
    if not found or meta is None:
        return None
    rows, columns = np.asarray(meta).shape[:2]
    long, short = max(board.columns, board.rows), min(board.columns, board.rows)
    if len(corners) != rows * columns or max(rows, columns) > long or min(rows, columns) > short:
        return None
    checked = _checked(_unscaled(corners, 1.0), gray, (columns, rows))
    return None if checked is None else (columns, rows, _refined(gray, checked, (columns, rows)))


def _scales(gray: UInt8[np.ndarray, "h w"]) -> list[tuple[UInt8[np.ndarray, "sh sw"], float]]:
    scales = [1.0] + [width / gray.shape[1] for width in _SEARCH_WIDTHS_PX]
    wanted = [s for k, s in enumerate(scales) if k == 0 or abs(np.log(s)) > 0.2]
    enlarge = {True: cv2.INTER_CUBIC, False: cv2.INTER_AREA}
    return [
        (gray if s == 1.0 else cv2.resize(gray, None, fx=s, fy=s, interpolation=enlarge[s > 1.0]), s)
        for s in wanted
    ]


def _unscaled(corners: np.ndarray, scale: float) -> Float[np.ndarray, "n 2"]:
    # Pixel centres lie at integers, so that a scaled image's centres are shifted by half a pixel.
    return (corners.reshape(-1, 2).astype(np.float64) + 0.5) / scale - 0.5


def _refined(
    gray: UInt8[np.ndarray, "h w"], corners_px: Float[np.ndarray, "n 2"], size: tuple[int, int]
) -> Float[np.ndarray, "n 2"]:
    # A window that reaches the next corner pulls towards it.
    half = int(np.clip(0.35 * _spacing(corners_px, size), 2, 11))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    start = np.ascontiguousarray(corners_px[:, None], np.float32)
    return np.asarray(cv2.cornerSubPix(gray, start, (half, half), (-1, -1), criteria), np.float64).reshape(
        -1, 2
    )


def _spacing(corners_px: Float[np.ndarray, "n 2"], size: tuple[int, int]) -> float:
    """Smallest distance between neighbouring corners, [px]."""
    grid = corners_px.reshape(size[1], size[0], 2)
    along = np.linalg.norm(np.diff(grid, axis=1), axis=2)
    across = np.linalg.norm(np.diff(grid, axis=0), axis=2)
    return float(min(along.min(), across.min()))


def _checked(
    corners_px: Float[np.ndarray, "n 2"], gray: UInt8[np.ndarray, "h w"], size: tuple[int, int]
) -> Float[np.ndarray, "n 2"] | None:
    """None for corners that cannot be a board: outside the image, or on top of each other."""
    height, width = gray.shape
    inside = (corners_px > -0.5).all() and (corners_px < [width - 0.5, height - 0.5]).all()
    return corners_px if inside and _spacing(corners_px, size) > 2.0 else None


def _hint(paths: Sequence[Path], board: Board) -> str:
    for path in paths[:3]:
        try:
            gray = cv2.cvtColor(read_picture(path), cv2.COLOR_BGR2GRAY)
        except CalibrationError:
            continue
        if min(gray.shape) < _MIN_PICTURE_PX:
            continue
        part = _find_part(gray, Board(60, 60))
        if part is not None and (part[0], part[1]) not in (
            (board.columns, board.rows),
            (board.rows, board.columns),
        ):
            return f"; {path} seems to show one with {part[0]}x{part[1]}"
    return "; count the corners where four squares meet, not the squares"
