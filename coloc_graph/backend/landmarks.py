"""Static nodes of the graph: landmarks, and the map that some of them are on."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.measurements import Node
from coloc_graph.team import Landmark, Team

Array = NDArray[np.float64]

MAP = "/map"  # name of the map's node: no robot and no landmark can have it
ALWAYS = -1  # stance of a node that is the same at all stances
MIN_SIGMA = 1e-5  # m, rad: sigma of a position on the map that is stated as exact


@dataclass(frozen=True, eq=False)
class OnMap:
    """Stated pose of a landmark on the map.

    Parameters
    ----------
    landmark : str
        Its name.
    T_map_landmark : (4, 4) float
        Its pose on the map.
    covariance : (3, 3) float
        Of heading [rad], x, y [m].

    Notes
    -----
    The map is a frame of its own, whose pose in the world is estimated: one landmark says nothing of the robots, two
    give their relative pose.
    """

    landmark: str
    T_map_landmark: Array
    covariance: Array

    @property
    def ends(self) -> tuple[Node, Node]:
        """The two nodes that it relates, the map first."""
        return (MAP, ALWAYS), (self.landmark, ALWAYS)

    @property
    def T_i_j(self) -> Array:
        """Pose (4, 4) of the second end in the first."""
        return self.T_map_landmark

    def __str__(self) -> str:
        return f"position of {self.landmark} on the map"


@dataclass(frozen=True, eq=False)
class StaticPose:
    """Estimated pose of something that never moves.

    Parameters
    ----------
    T_world_body : gtsam.Pose3
        Its pose in the world.
    covariance : (6, 6) float
        In GTSAM's tangent: rotation [rad] first, then translation [m], in its own frame.
    has_heading : bool
        False of a point, as a landmark that was ranged: its rotation means nothing.
    """

    T_world_body: gtsam.Pose3
    covariance: Array
    has_heading: bool = True

    @property
    def planar(self) -> tuple[float, float, float]:
        """Position x, y [m] and yaw [rad] in the world."""
        T = self.T_world_body
        return float(T.x()), float(T.y()), float(T.rotation().yaw())

    @property
    def covariance_xy_yaw(self) -> Array:
        """Covariance (3, 3) of x, y [m] and yaw [rad], along the world's axes."""
        R = self.T_world_body.rotation().matrix()
        turned = np.zeros((3, 6))
        turned[:2, 3:], turned[2, :3] = R[:2], R[2]
        return np.asarray(turned @ self.covariance @ turned.T)


def landmarks_of(team: Team) -> dict[str, Landmark]:
    """Return the landmarks of a team, by name."""
    return {landmark.name: landmark for landmark in team.landmarks}


def map_positions(landmarks: Mapping[str, Landmark]) -> tuple[OnMap, ...]:
    """Return the stated poses of the landmarks that are on the map."""
    return tuple(map(_on_map, (one for one in landmarks.values() if one.on_map)))


def positions_of(on_map: Iterable[OnMap], seen: Iterable[str]) -> tuple[OnMap, ...]:
    """Return the stated poses of the landmarks in `seen`."""
    names = set(seen)
    return tuple(one for one in on_map if one.landmark in names)


def _on_map(landmark: Landmark) -> OnMap:
    assert landmark.position is not None and landmark.yaw_deg is not None
    x, y = landmark.position
    sigmas = np.array([np.deg2rad(landmark.yaw_sigma_deg), landmark.position_sigma, landmark.position_sigma])
    T_map_landmark = floor_pose(x, y, np.deg2rad(landmark.yaw_deg))
    return OnMap(landmark.name, T_map_landmark, np.diag(np.maximum(sigmas, MIN_SIGMA) ** 2))
