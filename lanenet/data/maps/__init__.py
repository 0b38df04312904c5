"""Maps on disk: the folder, its lane lines, the lane of each frame, and the labels that follow."""
