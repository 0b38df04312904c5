"""Closed-loop judging: detectors drive synthetic roads, and how they do is measured."""
