"""Synthetic drives with exact truth: tracks, a fisheye renderer, a car with errors, a scripted driver."""
