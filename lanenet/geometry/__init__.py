"""Frames of reference, poses, cameras, the bird's-eye window, and the label contract; NumPy only."""
