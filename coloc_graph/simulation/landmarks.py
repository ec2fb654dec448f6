"""The landmarks of the scenario `landmarks`: as they are said to be, as they are, and who can see them."""

import math
from collections.abc import Iterable

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from coloc_graph.geometry.lie import floor_pose
from coloc_graph.simulation.paths import tilt_rotation
from coloc_graph.simulation.scenarios import Pose, Scenario
from coloc_graph.team import Landmark, Markers, Tag, Team
from coloc_graph.team.shared_view import View

Array = NDArray[np.float64]

# depth tracks: two coloured LEDs on a bar; depth images: a tag
BAR = 0.4  # m, distance between the LEDs
HEIGHT = 0.15  # m, above the floor
HUE_DEG = 120.0
TAG = 0.2
#: Who surveys them knows where they stand to so much [m, deg].
SURVEYED = 0.005
SURVEYED_DEG = 0.5
MAX_LANDMARK_DISTANCE = 3.0  # m, largest distance at which a landmark is recorded
ASIDE = math.radians(70.0)  # rad, largest angle to the direction it faces


def with_landmarks(team: Team, scenario: Scenario, *, tags: bool) -> Team:
    """The team with the scenario's landmarks, surveyed: on a map that is the floor, with tolerances."""
    if not scenario.landmarks:
        return team
    return replace(team, landmarks=tuple(_landmark(n, pose, tags) for n, pose in enumerate(scenario.landmarks, 1)))


def _landmark(number: int, pose: Pose, tags: bool) -> Landmark:
    x, y, yaw = pose
    y_left = BAR / 2
    return Landmark(
        name=f"L{number}",
        tag=Tag(id=number, size=TAG, height=HEIGHT) if tags else None,
        markers=None if tags else Markers(height=HEIGHT, positions=((0.0, y_left), (0.0, -y_left)), hue_deg=HUE_DEG),
        position=(x, y),
        yaw_deg=math.degrees(yaw),
        position_sigma=SURVEYED,
        yaw_sigma_deg=SURVEYED_DEG,
    )


def drawn(landmarks: Iterable[Landmark], rng: np.random.Generator) -> tuple[Landmark, ...]:
    """Landmarks as they are: drawn from the tolerances of what is said of them."""
    return tuple(_drawn(landmark, rng) for landmark in landmarks)


def _drawn(landmark: Landmark, rng: np.random.Generator) -> Landmark:
    assert landmark.position is not None and landmark.yaw_deg is not None
    (x, y), off = landmark.position, rng.standard_normal(3)
    return replace(
        landmark,
        position=(x + landmark.position_sigma * float(off[0]), y + landmark.position_sigma * float(off[1])),
        yaw_deg=landmark.yaw_deg + landmark.yaw_sigma_deg * float(off[2]),
        position_sigma=0.0,
        yaw_sigma_deg=0.0,
    )


def unsurveyed(team: Team) -> Team:
    """The team that does not know where its landmarks are."""
    return replace(
        team,
        landmarks=tuple(
            replace(one, position=None, yaw_deg=None, position_sigma=0.0, yaw_sigma_deg=0.0) for one in team.landmarks
        ),
    )


def standing_landmarks(true: Team, floor_sigma: float, rng: np.random.Generator) -> dict[str, Array]:
    """T_world_landmark (4, 4) of each, tilted as the floor is, by `floor_sigma` [rad] in roll and in pitch."""
    found = {}
    for landmark in true.landmarks:
        assert landmark.position is not None and landmark.yaw_deg is not None
        T = floor_pose(*landmark.position, math.radians(landmark.yaw_deg))
        T[:3, :3] = T[:3, :3] @ tilt_rotation(*(floor_sigma * rng.standard_normal(2)))
        found[landmark.name] = T
    return found


def in_view(view: View, true: Team, T_world_landmark: dict[str, Array]) -> tuple[str, ...]:
    """The landmarks that a camera records: those before it, near enough, that face it."""
    eye = view.T_world_camera[:3, 3]
    names = []
    for landmark in true.landmarks:
        markers, T = landmark.seen_as, T_world_landmark[landmark.name]
        assert markers is not None
        toward = T[:3, :3].T @ (eye - T[:3, 3])
        near = (
            math.hypot(toward[0], toward[1]) < MAX_LANDMARK_DISTANCE and abs(math.atan2(toward[1], toward[0])) < ASIDE
        )
        if near and view.sees(markers.p_body @ T[:3, :3].T + T[:3, 3], 1.0).all():
            names.append(landmark.name)
    return tuple(names)
