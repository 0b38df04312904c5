"""The tests check shapes and types at a sample of the calls: never fewer than the first ones."""

from __future__ import annotations

import jaxtyping
import numpy as np
import pytest
import sampled_checks
from beartype import beartype
from jaxtyping import Float
from sampled_checks import FIRST, ONE_OF, jaxtyped

WRONG = "not an array"


def test_the_first_calls_are_checked_and_then_one_of_so_many() -> None:
    @jaxtyped(typechecker=beartype)
    def twice(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        return x * 2

    found = []
    for k in range(1, 3 * ONE_OF):
        try:
            twice(WRONG)  # type: ignore[arg-type]
        except jaxtyping.TypeCheckError:
            found.append(k)
    assert found == [*range(1, FIRST + 1), ONE_OF, 2 * ONE_OF]


def test_answers_are_checked_and_functions_within_functions_count_together() -> None:
    def shorter() -> int:
        @jaxtyped(typechecker=beartype)
        def inner(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
            return x[1:]

        return len(inner(np.zeros(3)))

    for _ in range(FIRST):
        with pytest.raises(jaxtyping.TypeCheckError, match="return value"):
            shorter()
    assert shorter() == 2


def test_the_packages_are_checked(request: pytest.FixtureRequest) -> None:
    """By the import hook, which the targets of the Makefile switch on."""
    if not request.config.getoption("--jaxtyping-packages"):
        pytest.skip("runs with --jaxtyping-packages, as make test does")
    from lanenet.geometry.poses import path_lengths

    # Other tests of this process may have called it often.
    sampled_checks._calls[path_lengths.__wrapped__.__code__][0] = 0
    with pytest.raises(jaxtyping.TypeCheckError):
        path_lengths(WRONG)  # type: ignore[arg-type]
