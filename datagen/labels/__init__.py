"""Label sets: from lane lines on a map, or from a simulator's ground truth, to six labels per frame.

The rule for one frame is :func:`lanenet.data.maps.mapped_drive.label_frame`.
"""
