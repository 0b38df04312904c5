"""Closed-loop contests: detectors drive synthetic roads, and their runs are measured."""
