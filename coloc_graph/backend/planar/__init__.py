"""Ranging runs: poses on the floor by odometry, ranges and bearings to other robots and to landmarks.

`filter_forward` is an EKF, `optimise_keyframes` all of it in batch, `IncrementalKeyframes` as it happens.
"""

from coloc_graph.backend.planar.batch import optimise_keyframes
from coloc_graph.backend.planar.filter import NONE_LOCATED, UNLOCATED, Filter, filter_forward, unlocated
from coloc_graph.backend.planar.incremental import LAG, UPDATE_PERIOD, IncrementalKeyframes, Latest

__all__ = [
    "LAG",
    "NONE_LOCATED",
    "UNLOCATED",
    "UPDATE_PERIOD",
    "Filter",
    "IncrementalKeyframes",
    "Latest",
    "filter_forward",
    "optimise_keyframes",
    "unlocated",
]
