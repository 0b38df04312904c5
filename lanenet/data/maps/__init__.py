"""Maps on disk: their folder, the lane lines in it, and the lane of each frame that follows from them."""
