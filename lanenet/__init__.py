"""Lane perception, learning and driving for 1:10 cars.

In Python :func:`load` gives a network as a function of an image; :func:`map`, :func:`label`, :func:`train`
and :func:`detect` do what the commands of these names do.
"""

from lanenet.api import detect, label, load, map, train

__all__ = ["detect", "label", "load", "map", "train"]

__version__ = "1.0.0"
