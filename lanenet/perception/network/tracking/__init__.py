"""The lane from frame to frame, on the network's lines and the edges that confirm them."""
