"""Learning: network, training, quality on held-out frames, export; the only room with torch."""
