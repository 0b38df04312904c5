"""Lane lines on the map: edges along the driven path -> markings -> traced lines -> piecewise cubics."""
