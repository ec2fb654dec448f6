"""What the observers see of the mover while it drives: whether it is in their views, and whether it is enough."""

import math
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from coloc_graph.frontend import FrontendOptions, StanceTracks, measure_pair
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.se2 import Planar, compose, inverse, wrap
from coloc_graph.online.mission import MissionOptions
from coloc_graph.run import Detections, Image, OdometrySample, Planes, Recorded, Stance
from coloc_graph.team import Team
from coloc_graph.team.shared_view import View

Array = NDArray[np.float64]

#: A light this near to where a marker should be is taken for it [px]; places are known by wheels alone.
GATE = 60.0
#: The mover is in a view where so many of the images of this time [s] show all its markers.
SHARE = 0.5
LOOKED_AT = 0.7
#: Two lights are a mover's whose distance is its markers' to this share, and that are so far from all who stand [m].
ALIKE = 0.15
CLEAR = 0.3
#: A mover is no further from where its wheels have it than this [m], [rad].
ASTRAY = 0.8
TURNED = 1.3
#: Two observers that have the mover further apart than this do not both stand where they should [m].
DISPLACED = 0.1


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
        self._standing = dict(observers)
        self._seen: dict[str, deque[tuple[float, bool]]] = defaultdict(deque)
        self._newest: dict[str, Detections] = {}

    def take(self, seen: Detections, mover: Planar) -> bool:
        """Take in an image of one observer while the mover is thought to be there; whether it shows its markers."""
        view = self.views.get(seen.robot)
        if view is None:
            return False
        self._newest[seen.robot] = seen
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

    def find(self, seen: Detections, expected: Planar) -> Planar | None:
        """Where an image of one observer has the mover, not too far from where it is expected; None where it does not,
        or leaves a choice. Two lights as far apart as its markers, and away from all who stand, are taken for it."""
        view = self.views.get(seen.robot)
        if view is None or len(self._p_markers) < 2 or len(seen.uv) < 2:
            return None
        places = _on_plane(view, seen.uv, float(self._p_markers[0, 2]))
        model, first, second = self._p_markers[:2, :2], *np.triu_indices(len(places), 1)
        arms = places[second] - places[first]
        with np.errstate(invalid="ignore"):
            alike = np.abs(np.hypot(*arms.T) / math.dist(*model) - 1) < ALIKE
        arms, middles = arms[alike], (places[first] + places[second])[alike] / 2
        # whichever of the two is the first marker
        arms, middles = np.concatenate([arms, -arms]), np.concatenate([middles, middles])
        along = model[1] - model[0]
        yaw = np.arctan2(arms[:, 1], arms[:, 0]) - math.atan2(along[1], along[0])
        off = wrap(yaw - expected[2])
        c, s, (mx, my) = np.cos(yaw), np.sin(yaw), model.mean(axis=0)
        xy = middles - np.stack([c * mx - s * my, s * mx + c * my], axis=1)
        away = np.hypot(*(xy - expected[:2]).T)
        others = [place[:2] for name, place in self._standing.items() if name != seen.robot]
        clear = np.all([np.hypot(*(xy - place).T) > CLEAR for place in others], axis=0) if others else True
        fits = np.flatnonzero((away < ASTRAY) & (np.abs(off) < TURNED) & clear)
        if not len(fits):
            return None
        cost = away[fits] + 0.3 * np.abs(off[fits])
        best = fits[np.argmin(cost)]
        if len(fits) > 1 and np.partition(cost, 1)[1] < 2 * cost.min():
            return None
        return float(xy[best, 0]), float(xy[best, 1]), expected[2] + float(off[best])

    def displaced(self, mover: Planar) -> dict[str, Planar]:
        """Observers whose newest image shows the mover, which stands, plainly elsewhere than another's does, and where
        they must be; the one that has it nearest to where it is thought to be, by its wheels, is taken at its word."""
        found = {name: self.find(seen, mover) for name, seen in self._newest.items()}
        places = {name: place for name, place in found.items() if place is not None}
        if len(places) < 2:
            return {}
        right = min(places.values(), key=lambda place: _apart(place, mover))
        return {
            name: compose(compose(right, inverse(place)), self._standing[name])
            for name, place in places.items()
            if _apart(place, right) > DISPLACED
        }

    def missing(self) -> list[str]:
        """The observers whose newest images do not show the mover; those that have sent none are among them."""
        return [
            name
            for name in self.views
            if not self._seen[name] or np.mean([shows for _, shows in self._seen[name]]) < SHARE
        ]


def _apart(a: Planar, b: Planar) -> float:
    """How far two places are from each other, a radian as much as 0.3 m [m]."""
    return math.dist(a[:2], b[:2]) + 0.3 * abs(wrap(a[2] - b[2]))


def _on_plane(view: View, uv: Array, height: float) -> Array:
    """Places (n, 2) [m] in the world of pixels (n, 2), at a height above the floor [m]; NaN where the ray never is."""
    rays = np.column_stack([view.camera.normalise(uv), np.ones(len(uv))]) @ view.T_world_camera[:3, :3].T
    down = np.where(rays[:, 2] < -1e-3, rays[:, 2], np.nan)
    reach = (height - view.T_world_camera[2, 3]) / down
    return np.asarray(view.T_world_camera[:2, 3] + reach[:, None] * rays[:, :2])


@dataclass(frozen=True)
class Precision:
    """How well a stance, as it is so far, measures its pairs: points of the poorest, and standard deviations, with the
    mounts taken as stated, of place [m] and heading [rad]; `why` where it does not measure them at all."""

    points: int
    place: float
    heading: float
    why: str = ""

    def suffices(self, options: MissionOptions) -> bool:
        """Whether a mission asks for no more."""
        return (
            self.points >= options.least_points
            and self.place <= options.place_sigma
            and self.heading <= math.radians(options.heading_sigma_deg)
        )


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
        robots.append(new(robot, mount_if_any=mount, markers=markers))
    floor = team.floor and new(team.floor, tilt_sigma_deg=0.0, height_sigma=0.0)
    return new(team, robots=tuple(robots), floor=floor)


def precision(
    record: Recorded, stance: Stance, options: FrontendOptions | None = None, tracks: StanceTracks | None = None
) -> Precision:
    """What a stance that may go on measures so far."""
    source = _Exact(record, exact(record.team))
    points, place, heading, why = 10**9, 0.0, 0.0, ""
    for i, j in combinations(stance.observers, 2):
        one = measure_pair(source, stance, i, j, options or FrontendOptions(), tracks)
        points = min(points, len(one.correspondences) if one.correspondences is not None else 0)
        if one.relative_pose is None:
            why = one.homography.unusable or "no relative pose"
            place = heading = math.inf
            continue
        sigmas = np.sqrt(np.diag(one.relative_pose.covariance))
        place, heading = max(place, *map(float, sigmas[3:5])), max(heading, float(sigmas[2]))
    return Precision(points, place, heading, why)
