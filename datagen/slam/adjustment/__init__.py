"""Bundle adjustment: all poses, each frame's tilt and the camera together, residuals in pixels."""
