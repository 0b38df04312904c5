"""Synthetic roads: centre line, lane lines, road furniture, and the ground truth that follows from them."""
