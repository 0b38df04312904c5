"""Which views of a chessboard can take part in a calibration at all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from lanenet.calibration.chessboard import BoardView
from lanenet.errors import CalibrationError

MIN_VIEWS = 5
#: Two views whose corners differ by less than this share of the diagonal are one view.
_SAME_VIEW = 0.01


def usable_views(views: Sequence[BoardView], dropped: dict[str, str]) -> list[BoardView]:
    """Return the complete views of the size that most have, each place of the board once.

    Args:
        views: Views of one camera.
        dropped: Receives the name of each other view, with the reason.
    """
    return _distinct(_of_one_size(_finite(views, dropped), dropped), dropped)


def _finite(views: Sequence[BoardView], dropped: dict[str, str]) -> list[BoardView]:
    kept = []
    for view in views:
        if np.isfinite(view.corners_px).all() and len(view.corners_px) == len(view.points_cm) >= 9:
            kept.append(view)
        else:
            dropped[view.name] = "its corners are incomplete"
    return kept


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
