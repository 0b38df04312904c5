"""Files on disk: cameras, drives, maps, label sets, detections and trajectories."""
