"""Possible marker planes of a camera whose tilt differs from its stated mount within the tolerance."""

from dataclasses import replace

import numpy as np

from coloc_graph.measurements import Plane
from coloc_graph.team import Mount

TILTS = (0.0, -1.0, 1.0, -2.0, 2.0, -3.0, 3.0)  # tilts of the camera that are tried, in standard deviations


def tilted(plane: Plane, tilt: float) -> Plane:
    """Return the plane in the frame of a camera that looks down by `tilt` [rad] more than stated."""
    c, s = np.cos(tilt), np.sin(tilt)
    return replace(plane, N=np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ plane.N)


def plausible_planes(plane: Plane, mount: Mount) -> tuple[Plane, ...]:
    """Return the possible marker planes within the tolerance of the mount's tilt, the stated one first."""
    if not plane.normal_from_mount or mount.tilt_sigma_deg == 0:
        return (plane,)
    return tuple(tilted(plane, n * np.deg2rad(mount.tilt_sigma_deg)) for n in TILTS)
