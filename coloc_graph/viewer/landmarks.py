"""Landmarks in the viewer: their meshes, covariances and sightings."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import trimesh

from coloc_graph.exchange.landmarks import LandmarkRow
from coloc_graph.measurements import Range, Sighting
from coloc_graph.run import Stance
from coloc_graph.team import Landmark, Team
from coloc_graph.viewer.links import links_of
from coloc_graph.viewer.meshes import LED, LED_RADIUS, cylinder, painted
from coloc_graph.viewer.scene import NO_LANDMARKS, Landmarks

POST = 0.012  # m, radius of a post
FOOT = 0.07  # m, radius of its foot
BOARD = 0.012  # m, thickness of a tag's board
TALL = 0.2  # m, height of the post of a point landmark
_STEEL = (120, 126, 134)
_AMBER = (214, 160, 30)
_WHITE = (244, 244, 244)
_BLACK = (24, 26, 30)


def landmarks_in(
    rows: Sequence[LandmarkRow],
    ends: Iterable[tuple[str, int, str]],
    robots: Sequence[str],
    stances: Sequence[Stance],
) -> Landmarks:
    """Landmarks of rows of `landmarks.csv`, sighted as (observer, stance, landmark)."""
    if not rows:
        return NO_LANDMARKS
    names = tuple(row.name for row in rows)
    sigmas = np.array([(row.x_sigma, row.y_sigma) for row in rows])
    covariance = sigmas[:, :, None] * sigmas[:, None]
    covariance[:, 0, 1] *= [row.xy_correlation for row in rows]
    covariance[:, 1, 0] = covariance[:, 0, 1]
    return Landmarks(
        names,
        np.array([(row.x, row.y) for row in rows]),
        np.deg2rad([row.yaw_deg for row in rows]),
        covariance,
        np.deg2rad([row.yaw_sigma_deg for row in rows]),
        links_of([((robot, k), (name, k)) for robot, k, name in ends], robots, stances, seen=names),
    )


def sighted_in(measurements: Iterable[object], landmarks: Mapping[str, object]) -> list[tuple[str, int, str]]:
    """Return the sightings and ranges of landmarks among measurements: (observer, stance, landmark)."""
    found = ((one.ends[0], one.ends[1][0]) for one in measurements if isinstance(one, Sighting | Range))
    return [(robot, stance, name) for (robot, stance), name in found if name in landmarks]


def landmark_of(team: Team | None, name: str) -> Landmark | None:
    """Return a landmark of the team by name; None where there is none."""
    return None if team is None else next((one for one in team.landmarks if one.name == name), None)


def landmark_mesh(landmark: Landmark | None) -> trimesh.Trimesh:
    """Make the mesh of a landmark in its frame: a foot, a post, and a tag's board or markers on a bar."""
    markers = None if landmark is None else landmark.seen_as
    height = TALL if markers is None else markers.height
    is_tag = landmark is not None and landmark.tag is not None
    behind = (-BOARD - POST if is_tag else 0.0, 0.0)
    parts = [painted(cylinder(FOOT, 0.0, 0.012), _AMBER), painted(cylinder(POST, 0.0, height, behind), _STEEL)]
    if landmark is not None and landmark.tag is not None:
        size = landmark.tag.size
        for side, thickness, colour in ((1.4 * size, BOARD, _WHITE), (size, 0.6 * BOARD, _BLACK)):
            board = trimesh.creation.box((thickness, side, side))
            board.apply_translation((thickness / 2 if colour is _BLACK else -BOARD / 2, 0.0, height))
            parts.append(painted(board, colour))
    elif markers is not None:
        positions = markers.p_body
        bar = trimesh.creation.cylinder(0.008, segment=positions[:2], sections=16)
        parts.append(painted(bar, _AMBER))
        for position in positions:
            led = trimesh.creation.icosphere(2, 1.3 * LED_RADIUS)
            led.apply_translation(position)
            parts.append(painted(led, LED))
    else:
        top = trimesh.creation.icosphere(2, 0.03)
        top.apply_translation((0.0, 0.0, height))
        parts.append(painted(top, _AMBER))
    mesh = trimesh.util.concatenate(parts)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh
