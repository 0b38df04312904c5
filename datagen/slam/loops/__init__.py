"""Loop closure: frames that show the same place, which of them to believe, and the pose graph."""
