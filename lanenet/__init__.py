"""Lane perception, learning and driving for 1:10 cars."""

__version__ = "0.1.0"
