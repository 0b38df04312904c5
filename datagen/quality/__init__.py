"""How far a map can be trusted: residuals on held-out frames, local checks, the verdict and the report."""
