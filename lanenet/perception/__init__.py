"""From a frame to the lane: edge points on the road, and the detectors that find a lane in them.

Every detector answers with a :class:`lanenet.perception.estimate.LaneEstimate` and is built through
:mod:`lanenet.perception.registry`.
"""
