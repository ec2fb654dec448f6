"""Ranging runs: poses on the floor by odometry, ranges and bearings to other robots and to landmarks.

`filter_forward` is an EKF, `optimise_keyframes` all of it in batch, `KeyframeEstimator` as it happens.
"""

from coloc_graph.backend.planar.batch import optimise_keyframes
from coloc_graph.backend.planar.filter import Filter, filter_forward, unlocated
from coloc_graph.backend.planar.incremental import LAG, UPDATE_PERIOD, KeyframeEstimator, Latest

__all__ = [
    "LAG",
    "UPDATE_PERIOD",
    "Filter",
    "KeyframeEstimator",
    "Latest",
    "filter_forward",
    "optimise_keyframes",
    "unlocated",
]
