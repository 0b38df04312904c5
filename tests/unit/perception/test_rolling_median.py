import statistics
from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanenet.perception.rolling_median import RollingMedian


@given(
    st.integers(1, 9), st.lists(st.sampled_from([-0.1, 0.3, 0.7]) | st.floats(allow_nan=False), min_size=1)
)
def test_it_is_the_median_of_the_last_values(length, values):
    found, last = RollingMedian(length), deque(maxlen=length)
    for value in values:
        found.append(value)
        last.append(value)
        assert len(found) == len(last)
        assert found.median == pytest.approx(statistics.median(last), rel=0.0, abs=0.0, nan_ok=True)
    found.clear()
    assert len(found) == 0
    found.append(2.0)
    assert found.median == 2.0
