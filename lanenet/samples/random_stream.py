"""Random numbers from a counter, for compiled loops: one stream per sample, the same on every machine.

A stream is an array of one unsigned number, which every draw advances. Making a NumPy generator takes longer
than changing a whole sample.

Source:
    Steele, Lea and Flood 2014, "Fast splittable pseudorandom number generators" (SplitMix64).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1, _MIX_2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_30, _27, _31, _11, _16 = (np.uint64(n) for n in (30, 27, 31, 11, 16))
_LOW_16 = np.uint64(0xFFFF)
_UNIT = 2.0**-53
#: Sum of four numbers from 0 to 65535: its mean, and the inverse of its standard deviation.
_BELL_MEAN = 2.0 * 65535.0
_BELL_SCALE = (4.0 * (65536.0**2 - 1.0) / 12.0) ** -0.5


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function of plain numbers and arrays, without the checks of shapes that tests wrap it in."""
    return njit(cache=True, error_model="numpy", nogil=True)(inspect.unwrap(function))


@kernel
def start_stream(stream, seed, epoch, number):
    """Start a stream from three integers."""
    stream[0] = np.uint64(seed)
    stream[0] = _next(stream) + np.uint64(epoch)
    stream[0] = _next(stream) + np.uint64(number)
    stream[0] = _next(stream)


@kernel
def next_uniform(stream):
    """Draw uniformly from [0, 1)."""
    return np.float64(_next(stream) >> _11) * _UNIT


@kernel
def next_between(stream, low, high):
    """Draw uniformly from ``low`` to ``high``."""
    return low + (high - low) * next_uniform(stream)


@kernel
def next_spread(stream, most, limit):
    """Draw uniformly from ``-most`` to ``most``; with ``limit`` one of the two ends."""
    draw = 2.0 * next_uniform(stream) - 1.0
    if limit:
        draw = -1.0 if draw < 0.0 else 1.0
    return most * draw


@kernel
def next_amount(stream, most, limit):
    """Draw uniformly from 0 to ``most``; with ``limit`` always ``most``."""
    draw = next_uniform(stream)
    return most if limit else draw * most


@kernel
def next_number(stream, most, limit):
    """Draw an integer from 0 to ``most``; with ``limit`` always ``most``."""
    draw = next_uniform(stream)
    return most if limit else int(draw * (most + 1))


@kernel
def next_bell(stream):
    """Draw from a bell curve of mean 0 and standard deviation 1: a sum of four uniform numbers.

    No draw lies beyond 3.5. A normal distribution would take a logarithm and a sine, and the noise of edges
    has no such tails.
    """
    bits = _next(stream)
    total = np.float64(bits & _LOW_16)
    for _ in range(3):
        bits >>= _16
        total += np.float64(bits & _LOW_16)
    return (total - _BELL_MEAN) * _BELL_SCALE


@kernel
def _next(stream):
    stream[0] += _GAMMA
    z = stream[0]
    z = (z ^ (z >> _30)) * _MIX_1
    z = (z ^ (z >> _27)) * _MIX_2
    return z ^ (z >> _31)
