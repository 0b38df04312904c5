"""Files on disk: cameras, drives and their sources, trajectories, label sets and tables of detections."""
