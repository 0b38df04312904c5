"""Checks of shapes and types (jaxtyping) at a sample of the calls: at all of them they take half the time."""

from __future__ import annotations

import functools
from collections import defaultdict
from types import CodeType, FunctionType
from typing import Any

import jaxtyping

#: Calls of a function that are checked in each process: the first ones, and then one of so many. Chosen:
#: inner loops are called hundreds of thousands of times, most functions less often than this by a test.
FIRST, ONE_OF = 20, 101
#: Number of calls so far, by code: a function within another one is made anew at each call of that.
_calls: defaultdict[CodeType, list[int]] = defaultdict(lambda: [0])
_check_all = jaxtyping.jaxtyped


def jaxtyped(function: Any = None, *, typechecker: Any) -> Any:
    """Do as ``jaxtyping.jaxtyped``, at a sample of the calls; what is no function is always checked."""
    if function is None:
        return functools.partial(jaxtyped, typechecker=typechecker)
    if not isinstance(function, FunctionType):
        return _check_all(function, typechecker=typechecker)
    calls, checked = _calls[function.__code__], None

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        calls[0] += 1
        if calls[0] > FIRST and calls[0] % ONE_OF:
            return function(*args, **kwargs)
        # Compiled when it is needed: most functions are not called by the tests of one process.
        checked = checked or _check_all(function, typechecker=typechecker)
        return checked(*args, **kwargs)

    return call


def install() -> None:
    """Make the import hook of ``pytest --jaxtyping-packages`` use the sample, in modules imported later."""
    jaxtyping.jaxtyped = jaxtyped  # type: ignore[assignment]
