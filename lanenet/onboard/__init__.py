"""What runs a detector: over recorded sources, and on the car."""
