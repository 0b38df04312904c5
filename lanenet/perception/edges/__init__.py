"""From an image to edge points on the road; also other views of a frame, and the parts of the car in it."""
