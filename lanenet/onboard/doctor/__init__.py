"""Checks of an installation, a camera file and a whole car, each with what to do about a problem."""
