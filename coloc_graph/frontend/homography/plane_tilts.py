"""Marker planes of a camera that looks down more or less than its mount is stated to, within the tolerance."""

from dataclasses import replace

import numpy as np

from coloc_graph.measurements import Plane
from coloc_graph.team import Mount

TILTS = (0.0, -1.0, 1.0, -2.0, 2.0, -3.0, 3.0)  # tilts of the camera that are tried, in standard deviations


def tilted(plane: Plane, tilt: float) -> Plane:
    """Return a plane as a camera sees it that looks down by `tilt` [rad] more than stated."""
    c, s = np.cos(tilt), np.sin(tilt)
    return replace(plane, N=np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ plane.N)


def plausible_planes(plane: Plane, mount: Mount) -> tuple[Plane, ...]:
    """Return the planes that a marker plane may be within the mount's tolerance, the plane as stated first."""
    if not plane.normal_from_mount or mount.tilt_sigma_deg == 0:
        return (plane,)
    return tuple(tilted(plane, n * np.deg2rad(mount.tilt_sigma_deg)) for n in TILTS)
