"""Learning: network, loader, training, evaluation, export; the only package with torch."""
