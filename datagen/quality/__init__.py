"""How far a map can be trusted: residuals on held-out frames, local checks, verdict and report."""
