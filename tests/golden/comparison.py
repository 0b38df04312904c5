"""Results of a run beside the expected ones: a table by field, with a tolerance for each."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatch

import numpy as np
from scipy.spatial import cKDTree

Results = dict[str, np.ndarray]

#: A point further along than this from the nearest point of a line lies beyond its end.
_BESIDE_CM = 1.0


@dataclass(frozen=True)
class Tolerance:
    """How far the values of a field may be from the expected ones.

    Attributes:
        rms: Root of their mean squared difference.
        largest: Largest difference of a single value.
        lone_share: Share of the values that may be there on one side only: where something was hardly seen,
            a rounding decides whether it was.
    """

    rms: float = 0.0
    largest: float = 0.0
    lone_share: float = 0.0


@dataclass(frozen=True)
class Row:
    """A field's comparison.

    Attributes:
        field: Its name.
        count: Values that both sides have.
        rms: Of the differences.
        largest: Of the differences.
        lone: Values that one side has and the other has not.
        tolerance: What would be fine.
        problem: Why it is not comparable; empty if it is.
    """

    field: str
    count: int
    rms: float
    largest: float
    lone: int
    tolerance: Tolerance
    problem: str = ""

    @property
    def passes(self) -> bool:
        """Whether the field is as expected."""
        lone_share = self.lone / max(self.count + self.lone, 1)
        limits = self.tolerance
        return not self.problem and (
            self.rms <= limits.rms and self.largest <= limits.largest and lone_share <= limits.lone_share
        )


def compare(
    expected: Results, found: Results, fine_lines: Results, tolerances: dict[str, Tolerance]
) -> list[Row]:
    """Compare field by field; maps once they lie on each other, since where a map begins is of no interest.

    Args:
        expected: Results that were saved.
        found: Results of today.
        fine_lines: Dense points of today's lane lines, by field. Where along a line a point lies is of no
            interest: what counts is its distance from the line.
        tolerances: By pattern of the field's name; the first that fits holds, and a field that none fits must
            be the same in every value.
    """
    rows = []
    found, fine_lines = _laid_on(expected, found, fine_lines)
    for field in sorted(expected.keys() | found.keys()):
        tolerance = next((limits for name, limits in tolerances.items() if fnmatch(field, name)), Tolerance())
        if field not in found or field not in expected:
            problem = "missing" if field in expected else "new"
            rows.append(Row(field, 0, 0.0, 0.0, 0, tolerance, problem))
        elif field in fine_lines:
            rows.append(_line_row(field, expected[field], found[field], fine_lines[field], tolerance))
        else:
            rows.append(_row(field, expected[field], found[field], tolerance))
    return rows


def table(rows: list[Row]) -> str:
    """Write the comparison for people; what is not as expected is marked."""
    width = max((len(row.field) for row in rows), default=5)
    head = f"  {'field':{width}}  {'values':>6}  {'rms':>9}  {'limit':>9}  {'largest':>9}  {'limit':>9}"
    lines = [f"{head}  one side only (limit)"]
    for row in rows:
        limits = row.tolerance
        lines.append(
            f"{' ' if row.passes else '*'} {row.field:{width}}  {row.count:6d}  {row.rms:9.2g}  "
            f"{limits.rms:9.2g}  {row.largest:9.2g}  {limits.largest:9.2g}  "
            f"{row.lone} ({limits.lone_share:.1%})  {row.problem}".rstrip()
        )
    return "\n".join(lines)


def _laid_on(expected: Results, found: Results, fine_lines: Results) -> tuple[Results, Results]:
    """Turn and shift today's map so that its poses come closest to the expected ones; its shape stays."""
    moved, lines = dict(found), fine_lines
    for field in ("map.position_cm", "map.open_loop_cm"):
        old, new = expected.get(field), found.get(field)
        if old is None or new is None or old.shape != new.shape:
            continue
        to_old, to_new = old - old.mean(axis=0), new - new.mean(axis=0)
        angle = np.arctan2(
            np.sum(to_new[:, 0] * to_old[:, 1] - to_new[:, 1] * to_old[:, 0]), np.sum(to_new * to_old)
        )
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        moved[field] = to_new @ turn + old.mean(axis=0)
        if field == "map.position_cm":
            moved["map.heading_rad"] = found["map.heading_rad"] + angle
            lines = {
                name: (points - new.mean(axis=0)) @ turn + old.mean(axis=0)
                for name, points in fine_lines.items()
            }
    return moved, lines


def _row(field: str, old: np.ndarray, new: np.ndarray, tolerance: Tolerance) -> Row:
    if old.shape != new.shape:
        return Row(field, 0, 0.0, 0.0, 0, tolerance, f"shape {old.shape} -> {new.shape}")
    if old.dtype.kind == "U":
        changed = int(np.sum(old != new))
        problem = f"{', '.join(old)} -> {', '.join(new)}" if changed else ""
        return Row(field, old.size, 0.0, 0.0, 0, tolerance, problem)
    both = np.isfinite(old) & np.isfinite(new)
    lone = int(np.sum(np.isfinite(old) != np.isfinite(new)))
    return _measured(field, (new - old)[both], lone, tolerance)


def _line_row(field: str, old: np.ndarray, new: np.ndarray, fine: np.ndarray, tolerance: Tolerance) -> Row:
    """Distances across the line; points where the other line has none count as one-sided."""
    nearest = cKDTree(fine).query(old)[1]
    inner = np.clip(nearest, 1, len(fine) - 2)
    tangent = fine[inner + 1] - fine[inner - 1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    offset = old - fine[nearest]
    across = tangent[:, 0] * offset[:, 1] - tangent[:, 1] * offset[:, 0]
    beyond = np.abs(np.sum(tangent * offset, axis=1)) > _BESIDE_CM
    lone = int(beyond.sum()) + max(len(new) - len(old), 0)
    return _measured(field, across[~beyond], lone, tolerance)


def _measured(field: str, differences: np.ndarray, lone: int, tolerance: Tolerance) -> Row:
    size = np.abs(differences.astype(np.float64))
    if not size.size:
        return Row(field, 0, 0.0, 0.0, lone, tolerance)
    return Row(field, size.size, float(np.sqrt(np.mean(size**2))), float(size.max()), lone, tolerance)
