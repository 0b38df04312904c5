"""Lines that were laid anew between two drives, and the labels that they withhold."""

from __future__ import annotations

import numpy as np
import pytest
from track_shapes import LANE_CM, bean, track

from datagen.tracks.relaid import masked_lines, relaid_places
from datagen.tracks.shape import SampledLine, TrackShape, sample_line
from lanenet.data.maps.line import LaneLine

AT_CM = np.array([197.0, 60.0])


def moved_by(x_cm: float):
    def bend(xy: np.ndarray) -> np.ndarray:
        moved = xy.copy()
        moved[np.hypot(*(xy - AT_CM).T) < 40.0] += [x_cm, 0.0]
        return moved

    return bend


def named(shape: TrackShape, name: str) -> TrackShape:
    return TrackShape(name, LANE_CM, shape.lines, shape.path_cm, shape.marks_cm, shape.mark_normals)


@pytest.mark.parametrize(("x_cm", "seen"), [(4.0, True), (30.0, False)])
def test_a_piece_of_tape_that_was_moved_is_found_with_its_distance(x_cm, seen):
    places = relaid_places([track(bean()), named(track(bean(), bend=moved_by(x_cm)), "later")])
    assert places
    for place in places:
        assert np.hypot(*(place.at_cm - AT_CM)) < 50.0
    apart = [place.apart_cm for place in places if place.drives[0] == "known"]
    if seen:
        assert 2.0 < max(apart) <= 4.1
        assert "cm between" in places[0].text
    else:
        assert None in apart
        assert any("saw none" in place.text for place in places)


def test_maps_that_agree_have_no_such_places():
    def wavy(xy: np.ndarray) -> np.ndarray:
        return xy + 0.4 * np.sin(xy[:, ::-1] / 40.0)

    assert relaid_places([track(bean()), named(track(bean(), 0.3, opposite=True, bend=wavy), "later")]) == []


def circle(radius_cm: float) -> LaneLine:
    """A closed line, as cubics fit it."""
    from scipy.interpolate import make_interp_spline

    period = 2.0 * np.pi * 150.0
    s = np.linspace(0.0, period, 101)
    at = s / 150.0
    xy = radius_cm * np.stack([np.cos(at), np.sin(at)], axis=1)
    xy[-1] = xy[0]
    spline = make_interp_spline(s, xy, 3, bc_type="periodic")
    whole = np.array([[0.0, period]])
    return LaneLine("left", spline.t, spline.c, whole, 0.1, period_cm=period)


def test_places_are_withheld_from_the_line_that_they_are_of_across_the_seam_too():
    inner, outer = circle(130.0), circle(170.0)
    line: SampledLine = sample_line(outer, np.array([0.0, 10.0]))
    shape = TrackShape("a", 40.0, (line,), line.xy_cm, np.empty((0, 2)), np.empty((0, 2)))
    shift = np.where(np.abs(line.xy_cm[:, 1:]) < 15.0, [4.0, 0.0], 0.0) * (line.xy_cm[:, :1] > 0.0)
    other = SampledLine(0, line.xy_cm + shift, line.tangent, line.known, True, line.sigma_cm)
    places = relaid_places([shape, TrackShape("b", 40.0, (other,), line.xy_cm, *2 * [np.empty((0, 2))])])
    kept = masked_lines([inner, outer], places, 40.0)
    assert not len(kept[0].contradicted_cm)
    assert len(kept[1].contradicted_cm) >= 1
    # The place lies about the seam, where x is largest.
    assert kept[1].contradicted(np.array([0.0, 5.0, outer.period_cm - 5.0])).all()
    assert not kept[1].contradicted(np.array([200.0, 470.0])).any()
    assert masked_lines([inner, outer], [], 40.0) == [inner, outer]
