"""Pentek's lane painter: contrast, V channel, Canny, trapezoid, Hough lines; then windows and curves."""
