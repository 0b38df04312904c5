"""A library of drives: one SQLite file that says which drives there are, of which car and track, and where.

It knows a drive again by its content, under any name. Drives stay where they are, or are copied beside the
file.
"""

from lanenet.data.library.entry import Entry
from lanenet.data.library.library import DEFAULT_LIBRARY, Library

__all__ = ["DEFAULT_LIBRARY", "Entry", "Library"]
