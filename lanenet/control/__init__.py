"""From a lane to a steering target."""
