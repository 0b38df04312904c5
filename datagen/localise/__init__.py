"""DP-SLAM while the car drives: poses are written as frames come, and memory stays bounded."""
