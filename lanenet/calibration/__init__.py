"""Finding a camera: its lens from pictures of a chessboard, its mounting from points of the ground."""
