"""The lane from frame to frame: one filter over a few hypotheses of where it is."""
