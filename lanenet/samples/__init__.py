"""Samples: label sets in memory, rasters drawn from them, and seeded augmentation, in NumPy and Numba.

:mod:`lanenet.learn` trains on them, and :mod:`lanenet.evaluation` measures robustness with them.
"""
