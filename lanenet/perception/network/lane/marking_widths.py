"""How wide the markings of the lane's two lines are, and whether they are light or dark."""

from __future__ import annotations

from lanenet.geometry.lane import SIDES
from lanenet.perception.rolling_median import RollingMedian

#: Frames that count, and how many make a width known. Chosen.
_LENGTH, _ENOUGH = 50, 10
#: Once both are known, they are measured without that knowledge every so many frames. Chosen.
_MEASURED_EVERY = 4


class MarkingWidths:
    """Widths of both lines' markings, [cm], negative for those that are darker than the floor."""

    def __init__(self) -> None:
        """Know nothing."""
        self.reset()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self._lines = [RollingMedian(_LENGTH) for _ in SIDES]
        self._frames = 0

    def usual_cm(self, side: int) -> float | None:
        """Return the width of a line's marking; None until enough frames showed it."""
        widths_cm = self._lines[side]
        return widths_cm.median if len(widths_cm) >= _ENOUGH else None

    def next_frame(self) -> bool:
        """Begin a frame; return whether markings are measured in it, without what was learned of them.

        Else a wrong belief would find itself confirmed in every frame.
        """
        self._frames += 1
        return self._frames % _MEASURED_EVERY == 0 or None in map(self.usual_cm, range(len(SIDES)))

    def learn(self, side: int, width_cm: float) -> None:
        """Take what was measured in a frame."""
        self._lines[side].append(width_cm)

    def cross(self, side: int) -> None:
        """The line of a side has become the other one: the car is in the lane beyond it."""
        self._lines[1 - side], self._lines[side] = self._lines[side], RollingMedian(_LENGTH)
