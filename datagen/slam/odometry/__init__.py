"""Motion from image to image: edge points of each frame, and the motion that carries one onto the next."""
