"""Frames, cameras, the bird's-eye grid and parabolas; NumPy only."""
