"""Self-calibration: a coarse camera from the images, then camera and poses adjusted together."""
