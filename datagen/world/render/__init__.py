"""The renderer: what the camera of a simulated car sees of the floor, the road and what stands on it."""
