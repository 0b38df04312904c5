"""The belief about the lane's width: its compiled loops have the bytes of the C library and NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lanenet.perception import lane_width
from lanenet.perception.lane_width import WidthBelief

compiled = pytest.mark.skipif(lane_width._kernels is None, reason="installed without a C++ compiler")


def believe(widths_cm, asked_cm, sigma):
    belief = WidthBelief((20.0, 80.0))
    for width_cm in widths_cm:
        belief.learn(width_cm)
    return belief, np.array([belief.mean_cm, belief.sigma, *belief.match(np.array(asked_cm), sigma)])


@compiled
@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.floats(5.0, 300.0), max_size=30),
    st.lists(st.floats(0.1, 1000.0), min_size=1, max_size=9),
    st.sampled_from([0.05, 0.2]),
)
def test_widths_are_weighed_alike(widths_cm, asked_cm, sigma):
    _, found = believe(widths_cm, asked_cm, sigma)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lane_width, "_kernels", None)
        _, expected = believe(widths_cm, asked_cm, sigma)
    assert found.tobytes() == expected.tobytes()


def test_the_likeliest_width_has_the_rate_of_one():
    belief, _ = believe([40.0] * 60, [40.0], 0.2)
    rates = belief.match(np.array([[30.0, belief.mean_cm], [60.0, 4.0]]), 0.2)
    assert rates.shape == (2, 2) and rates[0, 1] == pytest.approx(1.0, abs=2e-3)
    # The density of a width is a normal one, blurred by another: their variances add up.
    expected = np.exp(-0.5 * np.log(30.0 / belief.mean_cm) ** 2 / (0.2**2 + belief.sigma**2))
    assert rates[0, 0] == pytest.approx(expected, rel=0.02)


@compiled
def test_memory_beyond_the_arguments_is_not_read():
    nats, kernel, widths = np.zeros(5), np.zeros(9), np.ones(2)
    for arguments in ((nats[:4], nats, nats, nats.copy()), (nats, nats, nats[:3], nats.copy())):
        with pytest.raises(ValueError, match="differ"):
            lane_width._kernels.learn(*arguments, 3.0, 0.1, 1.0, 0.1, 0.9, 4.0)
    for arguments in (
        (nats, kernel[:8], nats),
        (nats, kernel, nats[:4]),
        (np.zeros(2000), np.zeros(3999), nats),
    ):
        with pytest.raises(ValueError, match="differ"):
            lane_width._kernels.match(*arguments, widths, 0.1)
