"""Where each robot of a team is, from nothing but cheap cameras and LED markers.

The road: `team` says who the robots are, `run` what they recorded, `frontend` makes homography measurements
of images, `backend` makes an estimate of measurements, `pipeline.solve` is the whole road.
"""

from coloc_graph._version import __version__

__all__ = ["__version__"]
