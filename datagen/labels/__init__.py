"""From lane lines on the map to six numbers per frame, and how far they can be trusted."""
