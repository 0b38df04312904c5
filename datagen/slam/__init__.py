"""Poses and one map of lane edges from frames and commands alone, without encoders."""
