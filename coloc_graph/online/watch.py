"""What the observers see of the mover while it drives: whether it is in their views, and whether it is enough."""

import math
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import msgspec
import numpy as np

from coloc_graph.common_view import View
from coloc_graph.frontend import FrontendOptions, measure_pair
from coloc_graph.lie import floor_pose
from coloc_graph.online.formation import Planar
from coloc_graph.run import Detections, Image, OdometrySample, Planes, Recorded, Stance
from coloc_graph.team import Team

#: A light this near to where a marker should be is taken for it [px]; places are known by wheels alone.
GATE = 60.0
#: The mover is in a view where so many of the images of this time [s] show all its markers.
SHARE, LOOKED_AT = 0.5, 0.7


class InView:
    """Whether the observers' images show a mover's markers where they should be."""

    def __init__(self, team: Team, mover: str, observers: Mapping[str, Planar]) -> None:
        markers = team[mover].markers
        assert markers is not None
        self._p_markers = markers.p_body
        self.views = {
            name: View(team[name].camera, floor_pose(*place) @ team[name].mount.T_body_camera)
            for name, place in observers.items()
        }
        self._seen: dict[str, deque[tuple[float, bool]]] = defaultdict(deque)

    def take(self, seen: Detections, mover: Planar) -> bool:
        """Take in an image of one observer while the mover is thought to be there; whether it shows its markers."""
        view = self.views.get(seen.robot)
        if view is None:
            return False
        T = floor_pose(*mover)
        uv, inside = view.project(self._p_markers @ T[:3, :3].T + T[:3, 3])
        shows = bool(inside.all() and len(seen.uv) >= len(uv))
        if shows:
            away = np.linalg.norm(uv[:, None] - seen.uv[None], axis=2)
            shows = bool((away.min(axis=1) < GATE).all())
        looked = self._seen[seen.robot]
        looked.append((seen.time, shows))
        while looked[0][0] < seen.time - LOOKED_AT:
            looked.popleft()
        return shows

    def missing(self) -> list[str]:
        """The observers whose newest images do not show the mover; those that have sent none are among them."""
        return [
            name
            for name in self.views
            if not self._seen[name] or np.mean([shows for _, shows in self._seen[name]]) < SHARE
        ]


@dataclass(frozen=True)
class Precision:
    """How well a stance, as it is so far, measures its pairs: points of the poorest, and standard deviations, with the
    mounts taken as stated, of place [m] and heading [rad]; `why` where it does not measure them at all."""

    points: int
    place: float
    heading: float
    why: str = ""


@dataclass(frozen=True, eq=False)
class _Exact:
    """A record as of a team whose mounts and floor are exact: what is left is what the points leave open."""

    record: Recorded
    team: Team

    @property
    def path(self) -> Path:
        return self.record.path

    @property
    def planes(self) -> dict[int, Planes]:
        return self.record.planes

    def has_detections(self, robot: str) -> bool:
        return self.record.has_detections(robot)

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        return self.record.detections(robot, start, end)

    def images(self, robot: str, start: float, end: float) -> Iterator[Image]:
        return self.record.images(robot, start, end)

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        return self.record.odometry(robot, start, end)


def exact(team: Team) -> Team:
    """A team without tolerances."""
    new = msgspec.structs.replace
    robots = []
    for robot in team.robots:
        mount = new(robot.mount, height_sigma=0.0, tilt_sigma_deg=0.0, roll_sigma_deg=0.0)
        markers = robot.markers and new(robot.markers, span_sigma=0.0, height_sigma=0.0)
        robots.append(new(robot, mount=mount, markers=markers))
    floor = team.floor and new(team.floor, tilt_sigma_deg=0.0, height_sigma=0.0)
    return new(team, robots=tuple(robots), floor=floor)


def precision(record: Recorded, stance: Stance, options: FrontendOptions | None = None) -> Precision:
    """What a stance that may go on measures so far."""
    source = _Exact(record, exact(record.team))
    points, place, heading, why = 10**9, 0.0, 0.0, ""
    for i, j in combinations(stance.observers, 2):
        one = measure_pair(source, stance, i, j, options or FrontendOptions())
        points = min(points, len(one.correspondences) if one.correspondences is not None else 0)
        if one.relative_pose is None:
            why = one.homography.unusable or "no relative pose"
            place = heading = math.inf
            continue
        sigmas = np.sqrt(np.diag(one.relative_pose.covariance))
        place, heading = max(place, *map(float, sigmas[3:5])), max(heading, float(sigmas[2]))
    return Precision(points, place, heading, why)
