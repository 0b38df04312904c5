"""Which views of a chessboard can take part in a calibration at all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from lanenet.calibration.chessboard import BoardView
from lanenet.errors import CalibrationError

MIN_VIEWS = 5
#: Two views whose corners differ by less than this share of the diagonal are one view.
_SAME_VIEW = 0.01
#: A grid read the other way round that is shorter by this share is the right one.
_TURNED_SHARE = 0.7


def usable_views(views: Sequence[BoardView], dropped: dict[str, str]) -> list[BoardView]:
    """Return the complete views of the size that most have, each place of the board once.

    Args:
        views: Views of one camera.
        dropped: Receives the name of each other view, with the reason.

    Raises:
        CalibrationError: If most views number their corners for a board that lies across.
    """
    return _distinct(_of_one_size(_in_rows(_finite(views, dropped), dropped), dropped), dropped)


def _finite(views: Sequence[BoardView], dropped: dict[str, str]) -> list[BoardView]:
    kept = []
    for view in views:
        if np.isfinite(view.corners_px).all() and len(view.corners_px) == len(view.points_cm) >= 9:
            kept.append(view)
        else:
            dropped[view.name] = "its corners are incomplete"
    return kept


def _in_rows(views: list[BoardView], dropped: dict[str, str]) -> list[BoardView]:
    """Views whose corners come row by row, as the board's points do."""
    turned: dict[str, str] = {}
    for view in views:
        columns, rows = (len(np.unique(view.points_cm[:, axis].round(6))) for axis in (0, 1))
        if columns * rows == len(view.corners_px) and (
            _grid_length(view.corners_px, columns, rows)
            < _TURNED_SHARE * _grid_length(view.corners_px, rows, columns)
        ):
            turned[view.name] = f"come in the order of a {rows}x{columns} board, expected {columns}x{rows}"
    if 2 * len(turned) > len(views):
        name, what = next(iter(turned.items()))
        raise CalibrationError(
            f"the views do not fit one board: the corners of {len(turned)} of {len(views)} views, {name} "
            f"among them, {what} (columns x rows)"
        )
    dropped.update({name: f"its corners {what}" for name, what in turned.items()})
    return [view for view in views if view.name not in turned]


def _grid_length(corners_px: Float[np.ndarray, "n 2"], rows: int, columns: int) -> float:
    """Length of all edges of the corners' grid; the true order has by far the shortest."""
    grid = corners_px.reshape(rows, columns, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2) for axis in (0, 1)]
    return float(sum(step.sum() for step in steps))


def _of_one_size(views: list[BoardView], dropped: dict[str, str]) -> list[BoardView]:
    sizes = Counter((view.width, view.height) for view in views)
    if not sizes:
        return []
    width, height = sizes.most_common(1)[0][0]
    for view in views:
        if (view.width, view.height) != (width, height):
            dropped[view.name] = f"{view.width}x{view.height} px, most pictures have {width}x{height}"
    return [view for view in views if (view.width, view.height) == (width, height)]


def _distinct(views: list[BoardView], dropped: dict[str, str]) -> list[BoardView]:
    kept: list[BoardView] = []
    for view in views:
        limit = _SAME_VIEW * np.hypot(view.width, view.height)
        for other in kept:
            if view.corners_px.shape == other.corners_px.shape:
                shift = np.abs(view.corners_px - other.corners_px).max()
                if shift < limit:
                    dropped[view.name] = f"shows the board where {other.name} does"
                    break
        else:
            kept.append(view)
    return kept


def check_count(views: Sequence[BoardView], dropped: dict[str, str]) -> None:
    """Refuse fewer views than a lens needs.

    Raises:
        CalibrationError: Naming the first views that were left out, with their reasons.
    """
    if len(views) >= MIN_VIEWS:
        return
    shown = [f"{name}: {reason}" for name, reason in list(dropped.items())[:3]]
    why = f" (left out: {'; '.join(shown)})" if shown else ""
    raise CalibrationError(
        f"{len(views)} usable view(s) of the board, expected at least {MIN_VIEWS}, better 12 to 20, with the "
        f"board tilted and in all parts of the image{why}"
    )
