"""Lane lines on the map: edges along the driven path -> tapes -> left and right line -> piecewise cubics."""
