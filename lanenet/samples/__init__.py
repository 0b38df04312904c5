"""Training samples: label sets in memory, rasters drawn from them, and seeded augmentation.

NumPy and Numba only; :mod:`lanenet.learn` trains on these samples, and :mod:`lanenet.evaluation` measures
robustness with them.
"""
