"""From an image to edge points on the road: pixels, sub-pixel positions, the bird's-eye plane."""
