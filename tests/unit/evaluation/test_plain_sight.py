from types import SimpleNamespace

import numpy as np
import pytest

from lanenet.evaluation.comparison import SeenSource
from lanenet.evaluation.plain_sight import count_off, in_plain_sight, off_markings

LABEL = np.array([-20.0, -20.0, -20.0, 20.0, 20.0, 20.0])


def borders(x_cm, polarity=1.0, width_cm=2.0, y_cm=None):
    """Edge points and normals of a straight tape."""
    y_cm = np.arange(0.0, 40.0) if y_cm is None else y_cm
    sides = [(x_cm + s * width_cm / 2, s * polarity) for s in (1.0, -1.0)]
    points = np.concatenate([np.stack([np.full(len(y_cm), x), y_cm], axis=1) for x, _ in sides])
    normals = np.concatenate([np.tile([n, 0.0], (len(y_cm), 1)) for _, n in sides])
    return points, normals


def joined(*tapes):
    return tuple(np.concatenate(part) for part in zip(*tapes, strict=True))


@pytest.mark.parametrize("polarity", [1.0, -1.0])
def test_two_tapes_are_in_plain_sight_light_or_dark(polarity):
    assert in_plain_sight(*joined(borders(-20.0, polarity), borders(20.0, polarity)), LABEL)


def test_what_hides_a_marking_takes_it_out_of_plain_sight():
    left, right = borders(-20.0), borders(20.0)
    assert not in_plain_sight(*left, LABEL)
    assert not in_plain_sight(*joined(left, borders(27.0)), LABEL)
    assert not in_plain_sight(*joined(left, borders(20.0, y_cm=np.arange(12.0, 18.0))), LABEL)
    # One border alone may be the edge of a carpet.
    half = tuple(part[: len(part) // 2] for part in right)
    assert not in_plain_sight(*joined(left, half), LABEL)
    unknown = LABEL.copy()
    unknown[0] = np.nan
    assert not in_plain_sight(*joined(left, right), unknown)


def test_answers_off_a_marking_are_counted_where_it_is_in_plain_sight():
    answers = np.tile(LABEL, (5, 1))
    answers[0, 4] += 3.5
    answers[1, 0] += 9.0
    answers[2] = np.nan
    answers[4, 1] -= 3.5
    labels, plain = np.tile(LABEL, (5, 1)), np.array([True, True, True, True, False])
    found = count_off(answers, labels, plain)
    assert (found.frames, found.answered, found.off) == (4, 3, 1)


def test_the_distance_is_measured_across_the_marking():
    steep = np.array([-20.0, -5.0, 10.0, 20.0, 35.0, 50.0])
    assert off_markings((steep + 4.0)[None], steep[None])[0] == pytest.approx(4.0 / np.sqrt(2.0))


def test_only_answers_off_a_marking_in_plain_sight_are_drawn():
    frames = SimpleNamespace(points_cm=np.tile(LABEL, (3, 1)))
    answers = frames.points_cm + [50.0, 4.0, 0.0, 0.0, 0.0, 0.0]
    answers[2] = LABEL
    drawn = SeenSource(frames, answers, np.array([True, False, True])).off_cm
    assert np.isfinite(drawn[0]).tolist() == [False, True, True, False, True, True]
    assert not np.isfinite(drawn[1:]).any()
