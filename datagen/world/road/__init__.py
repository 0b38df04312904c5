"""Synthetic roads: centre line, lane lines, furniture, and the truth that follows from them."""
