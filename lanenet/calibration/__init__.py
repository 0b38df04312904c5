"""Finding a camera: its lens from photos of a chessboard, its mounting from points on the ground."""
