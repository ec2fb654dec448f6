"""The mover in the observers' views, and the precision of a stance so far; `InView`, `precision`."""

import math
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
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

GATE = 60.0  # distance of a light from a marker's predicted pixel within which it is that marker's [px]
SHARE = 0.5  # share of the newest images that must show all markers of the mover
LOOKED_AT = 0.7  # duration of these images [s]
ALIKE = 0.15  # relative difference between the distance of two lights and the mover's marker span
CLEAR = 0.3  # distance of the mover from robots that stand [m]
ASTRAY = 0.8  # largest distance of the mover from its tracked pose [m]
TURNED = 1.3  # the same of its heading [rad]
LEAPT_ASTRAY = 0.5  # largest distance of an observer that leapt from where its wheels have it [m]
LEAPT_TURNED = 0.4  # the same of its heading [rad]
BORDER = 4.0  # distance from the border of an image at which a marker is surely seen [px]
DISPLACED = 0.1  # two observers that see the mover further apart do not both stand where they should [m]


class InView:
    """The mover in the images of observers that stand.

    Parameters
    ----------
    team, mover
        The team, and the name of the mover, which has markers.
    observers
        Poses of the observers in the world.
    watching
        Those that are to see the mover, all by default; nothing is taken from the others.
    """

    def __init__(
        self, team: Team, mover: str, observers: Mapping[str, Planar], watching: Sequence[str] | None = None
    ) -> None:
        markers = team[mover].markers
        assert markers is not None
        self._p_markers = markers.p_body
        self.views = {
            name: View(team[name].camera, floor_pose(*place) @ team[name].mount.T_body_camera)
            for name, place in observers.items()
            if watching is None or name in watching
        }
        self._T_body_camera = {name: team[name].mount.T_body_camera for name in observers}
        self._standing = dict(observers)
        self._seen: dict[str, deque[tuple[float, bool]]] = defaultdict(deque)
        self._newest: dict[str, Detections] = {}

    def take(self, seen: Detections, mover: Planar) -> bool:
        """Take in an image of an observer; return whether it shows the markers of the mover at its pose `mover`."""
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
        """Find the mover in an image of an observer: two lights as far apart as its markers, clear of other robots.

        Returns
        -------
        tuple or None
            Its pose in the world near the `expected` one; None if there is none, or more than one.
        """
        view = self.views.get(seen.robot)
        if view is None or len(self._p_markers) < 2 or len(seen.uv) < 2:
            return None
        standing = [place[:2] for name, place in self._standing.items() if name != seen.robot]
        fits = _fits(view, seen.uv, self._p_markers, expected, (ASTRAY, TURNED), standing)
        if not fits or (len(fits) > 1 and fits[1].cost < 2 * fits[0].cost):
            return None
        return fits[0].pose

    def locate(self, observer: str, p_markers: Array, mover: Planar) -> Planar | None:
        """Find an observer that leapt in the newest image of another, beside the mover.

        Parameters
        ----------
        observer
            Name of the observer, sought near the pose with which the views were made.
        p_markers
            Its markers in its body frame, (n, 3) [m].
        mover
            Tracked pose of the mover, whose lights must be others.

        Returns
        -------
        tuple or None
            Its pose in the world; None if no image shows both, or one shows several that fit.
        """
        for name, seen in self._newest.items():
            if name == observer or len(p_markers) < 2 or len(seen.uv) < 4:
                continue
            standing = [place[:2] for other, place in self._standing.items() if other not in (name, observer)]
            view, bounds = self.views[name], (LEAPT_ASTRAY, LEAPT_TURNED)
            own = _fits(view, seen.uv, p_markers, self._standing[observer], bounds, standing)
            movers = _fits(view, seen.uv, self._p_markers, mover, (ASTRAY, TURNED), standing)
            both = [(one.cost + other.cost, one) for one in own for other in movers if not one.lights & other.lights]
            if not both:
                continue
            best, found = min(both, key=lambda each: each[0])
            if all(cost >= 2 * best for cost, one in both if one is not found):
                return found.pose
        return None

    def covers(self, observer: str, place: Planar, patrol: Array) -> bool:
        """Return whether an observer at `place` would see the mover at waypoints (n, 2) [m], however it is turned."""
        camera, T_body_camera = self.views[observer].camera, self._T_body_camera[observer]
        around = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
        reach = np.linalg.norm(self._p_markers[:, :2], axis=1).max() * np.column_stack([np.cos(around), np.sin(around)])
        points = (patrol[:, None] + reach).reshape(-1, 2)
        points = np.column_stack([points, np.full(len(points), self._p_markers[0, 2])])
        uv, inside = View(camera, floor_pose(*place) @ T_body_camera).project(points)
        size = np.array([camera.width, camera.height])
        return bool(inside.all() and (uv > BORDER).all() and (uv < size - BORDER).all())

    def displaced(self, mover: Planar) -> dict[str, Planar]:
        """Find observers whose newest image shows the standing mover elsewhere than another's does.

        The observer that sees it nearest to its tracked pose `mover` is taken to be right.

        Returns
        -------
        dict
            Corrected poses of the others in the world, by name.
        """
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
        """Return the observers whose newest images do not show the mover, or that have sent none."""
        return [
            name
            for name in self.views
            if not self._seen[name] or np.mean([shows for _, shows in self._seen[name]]) < SHARE
        ]


@dataclass(frozen=True)
class _Fit:
    """Two lights of an image that may be a robot's, and its pose in the world then."""

    cost: float
    pose: Planar
    lights: frozenset[int]


def _fits(
    view: View,
    uv: Array,
    p_markers: Array,
    expected: Planar,
    bounds: tuple[float, float],
    standing: Sequence[tuple[float, float]],
) -> list[_Fit]:
    """Find lights as far apart as a robot's markers, best first.

    The robot is near its `expected` pose, within `bounds` [m] and [rad], and clear of robots at `standing`.
    """
    places = _on_plane(view, uv, float(p_markers[0, 2]))
    model, first, second = p_markers[:2, :2], *np.triu_indices(len(places), 1)
    arms = places[second] - places[first]
    with np.errstate(invalid="ignore"):
        alike = np.abs(np.hypot(*arms.T) / math.dist(*model) - 1) < ALIKE
    arms, middles = arms[alike], (places[first] + places[second])[alike] / 2
    lights = [frozenset(pair) for pair in zip(first[alike].tolist(), second[alike].tolist(), strict=True)] * 2
    # whichever of the two is the first marker
    arms, middles = np.concatenate([arms, -arms]), np.concatenate([middles, middles])
    along = model[1] - model[0]
    yaw = np.arctan2(arms[:, 1], arms[:, 0]) - math.atan2(along[1], along[0])
    off = wrap(yaw - expected[2])
    c, s, (mx, my) = np.cos(yaw), np.sin(yaw), model.mean(axis=0)
    xy = middles - np.stack([c * mx - s * my, s * mx + c * my], axis=1)
    away = np.hypot(*(xy - expected[:2]).T)
    clear = np.all([np.hypot(*(xy - place).T) > CLEAR for place in standing], axis=0) if standing else True
    fits = np.flatnonzero((away < bounds[0]) & (np.abs(off) < bounds[1]) & clear)
    cost = away + 0.3 * np.abs(off)
    return [
        _Fit(float(cost[n]), (float(xy[n, 0]), float(xy[n, 1]), expected[2] + float(off[n])), lights[n])
        for n in sorted(fits.tolist(), key=lambda n: float(cost[n]))
    ]


def _apart(a: Planar, b: Planar) -> float:
    """Distance between two poses [m], in which a radian counts as 0.3 m."""
    return math.dist(a[:2], b[:2]) + 0.3 * abs(wrap(a[2] - b[2]))


def _on_plane(view: View, uv: Array, height: float) -> Array:
    """Project pixels (n, 2) onto a plane at a height above the floor [m]: (n, 2) [m], NaN above the horizon."""
    rays = view.camera.rays(uv) @ view.T_world_camera[:3, :3].T
    down = np.where(rays[:, 2] < -1e-3, rays[:, 2], np.nan)
    reach = (height - view.T_world_camera[2, 3]) / down
    return np.asarray(view.T_world_camera[:2, 3] + reach[:, None] * rays[:, :2])


@dataclass(frozen=True)
class Precision:
    """Precision of a stance so far, with mounts taken as stated.

    Attributes
    ----------
    points
        Number of correspondences of the pair that has fewest.
    place, heading
        Largest standard deviations of a pair's relative position [m] and heading [rad].
    why
        Reason for which a pair is not measured; empty if all are.
    """

    points: int
    place: float
    heading: float
    why: str = ""

    def __str__(self) -> str:
        known = "" if self.why else f", {1e3 * self.place:.1f} mm, {math.degrees(self.heading):.2f} deg"
        return f"{self.points} points{known}"

    def suffices(self, options: MissionOptions) -> bool:
        """Return whether the precision is what a mission asks for."""
        return (
            self.points >= options.least_points
            and self.place <= options.place_sigma
            and self.heading <= math.radians(options.heading_sigma_deg)
        )


@dataclass(frozen=True, eq=False)
class _Exact:
    """A record of a team whose mounts and floor are exact, so that only the points' noise is left."""

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
    """Return a team without its tolerances."""
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
    """Compute the precision of a stance from what is recorded so far."""
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
