"""Teams that drive all the time: poses on the floor by odometry, ranges and bearings to each other and to landmarks.

`filter_forward` is an EKF, `optimise_drive` the most likely of all in batch, `IncrementalDrive` as it happens.
"""

from coloc_graph.backend.planar.batch import optimise_drive
from coloc_graph.backend.planar.estimate import DriveEstimate, PlacedLandmark
from coloc_graph.backend.planar.filter import Filtered, filter_forward
from coloc_graph.backend.planar.incremental import IncrementalDrive, Latest

__all__ = [
    "DriveEstimate",
    "Filtered",
    "IncrementalDrive",
    "Latest",
    "PlacedLandmark",
    "filter_forward",
    "optimise_drive",
]
