"""Suto's lane line tracker: hue, horizontal Sobel, probabilistic Hough, a pair of lines, a steering angle."""
