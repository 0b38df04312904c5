"""Whether it is known in which lane a car is: not on a line, nor just beyond one, nor after it lost its lane.

A line under the car is out of view, and a single line in sight may be the left one of a lane as well as the
right one of the next. An answer that takes one for the other is half a lane off or more, whatever its sigma.
"""

from __future__ import annotations

#: Nothing is answered while the front axle's middle is within this share of the lane's width of a line.
#: Tried: 0.02 to 0.12.
_ASTRIDE = 0.02
#: Within this share of the lane's width of a line nothing is answered while the network does not see that
#: line, nor, after the car has come over it, before the lane beyond has shown both of its lines. On 264
#: simulated drives of eleven seeds 0.3 % fewer points are answered for it, and their RMSE is 1.31 instead of
#: 1.46 cm. Tried: 0.15, 0.2 and 0.3 gave 1.43, 1.32 and 1.30 cm, 96.4, 96.3 and 96.0 %. After a crossing at
#: any distance: 0.3 % fewer points, the same RMSE.
_NEAR_LINE = 0.25
#: After so many frames in a row in which nothing was known of it a lane counts as lost; what is known
#: afterwards is the car's lane when both of its lines are shown, or after so many frames more. Of 35 times
#: that a lane was found again beside a single line on 216 simulated drives of nine seeds, seven were 8 to
#: 40 cm off (RMSE); the 35 were 0.6 % of the points, and 27 % of the squared errors. Tried: lost after 2
#: frames, found after 6, 8 or 25 more; see docs/studies.md.
_LOST_FRAMES, _SOUGHT_FRAMES = 3, 12


class WhichLane:
    """Follows whether it is known in which lane the car is."""

    def __init__(self) -> None:
        """Begin in the lane that the first frames show."""
        self.reset()

    def reset(self) -> None:
        """Forget what earlier frames showed."""
        self._entered = self._was_known = False
        self._unknown = self._sought = 0

    def enter(self) -> None:
        """The car has come over a line into the next lane."""
        self._entered = True

    def arrive(self, beside: float, shown: bool) -> None:
        """End a change of lane, once the new one has shown both of its lines, or the crossed one is far.

        Args:
            beside: Distance of the front axle's middle from the nearest line, in lane widths.
            shown: Whether the network and the edges show both of the lane's lines.
        """
        if shown or beside >= _NEAR_LINE:
            self._entered = False

    def is_a_guess(self, beside: float, seen: bool) -> bool:
        """Return whether nothing tells on which side of a line the front axle's middle is.

        Args:
            beside: As above.
            seen: Whether the network sees that line.
        """
        return self._entered or beside < _ASTRIDE or (beside < _NEAR_LINE and not seen)

    def keep(self, known: bool) -> None:
        """Take a frame in which the lane is known without its lines, or in which nothing is known.

        A lane that was never known is not lost.
        """
        self._was_known |= known
        self._unknown = 0 if known else self._unknown + self._was_known
        self._sought = max(0, self._sought - 1)

    def find(self, shown: bool) -> bool:
        """Take a frame in which a lane is known; return whether it is the car's, also after it was lost.

        Args:
            shown: Whether the edges show both of its lines, whatever the network sees of them: one that was
                trained with another camera sees less.
        """
        is_lost = self._unknown >= _LOST_FRAMES and not self._sought
        self.keep(True)
        if shown:
            self._sought = 0
        elif is_lost:
            self._sought = _SOUGHT_FRAMES
        return self._sought == 0
