"""What was seen on a drive, for the viewers of others: Rerun, and MCAP files for Foxglove and ROS 2.

A verb tells a recording what stays the same (``Scene``) and, frame by frame, what was seen (``Seen``); from
these one drawing is made for all viewers. Each format is a module with its ``KIND``, and a line in
``registry.py``.
"""
