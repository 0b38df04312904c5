"""How the renderer's loops are compiled.

numba's cache notices a change of the file that a function stands in, and not of one that it calls into: after
a change of a function that other files call, delete ``datagen/world/__pycache__``.
"""

from __future__ import annotations

from numba import njit

__all__ = ["compiled", "compiled_bare"]

#: Kept on disk; division by zero gives infinity.
compiled = njit(cache=True, error_model="numpy")
#: For functions that allocate nothing. Counting who holds an array costs more than a row of pixels does, and
#: these have no need of it: their callers hold everything that they are given.
compiled_bare = njit(cache=True, error_model="numpy", _nrt=False)
