"""Frames of a synthetic drive: floor, light, things, walls and sensor, pixel by pixel."""
