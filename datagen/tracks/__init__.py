"""Several drives: tracks recognised by their maps and joined, cameras compared.

Two maps are laid over each other by the shape of their lane lines, and the join is refused where the shape
leaves more than one way. Joined drives share one map frame and one set of lines; each keeps its own camera.
"""
