"""Verbs for experiments: synthetic worlds, closed-loop contests, comparisons with real drives, searches."""
