"""From lane estimates to steering and speed."""
