"""From a drive to labels: synthetic worlds, mapping without encoders, lane lines, labels."""
