"""From a frame to edge points on the road, and the detectors that turn them into a lane."""
