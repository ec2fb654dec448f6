"""Missions whose stances are planned anew after each one, from where robots really stopped, on floors with walls.

    python benchmarks/replanned.py --on L U --robots 4 --seeds 20     the share that arrives, and why others do not
    python benchmarks/replanned.py --on L --keep f.jsonl              a part, to which later ones add their seeds
    python benchmarks/replanned.py --on narrow --scattered            from random poses from which two share a view

A robot that leaps stops off by its slip: 1 cm, 1 cm a metre and 1 deg, or with --wheels by that of a Create; so does
the mover, from one fix by cameras to the next: on its way to its drive, and on its drive. The way of each robot is
checked every 2 cm against the others' bodies and the walls' rectangles.
"""

import argparse
import contextlib
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from planning import RADIUS, WRONG, dense
from planning_baselines import MOVER_START, Scene

from coloc_graph.errors import InputError
from coloc_graph.geometry.se2 import Planar
from coloc_graph.online.horizon_planner import CREATE
from coloc_graph.planning.beam import Decision
from coloc_graph.planning.belief import WHEELS, Belief
from coloc_graph.planning.floor_map import FloorMap
from coloc_graph.planning.horizon import Horizon
from coloc_graph.planning.leaps import TO_WALL
from coloc_graph.planning.plan import PlannedStance
from coloc_graph.planning.prediction import Predictor
from coloc_graph.planning.room import TO_ROBOT
from coloc_graph.planning.route import polyline_length, route
from coloc_graph.planning.slip import HEADING_SIGMA, WheelErrors, stop_sigma
from coloc_graph.simulation import reference_team
from coloc_graph.simulation.floor_plans import FLOOR_PLANS, FloorPlan
from coloc_graph.simulation.rig import stated_team
from coloc_graph.simulation.world import stream

MAX_STANCES = 60
STRETCH = 2.0  # length of the course over which scattered robots stand [m]
BEFORE = 1.0  # least way from there to the goal [m]
TURNED = 0.7  # heading of scattered robots against the course, at most [rad]
#: A corridor of 1.3 m with an end, besides the floors for planned missions.
FLOORS = {
    **FLOOR_PLANS,
    "narrow": FloorPlan(
        ((-1.8, -0.95, 7.3, -0.65), (-1.8, 0.65, 7.3, 0.95), (-1.8, -0.95, -1.5, 0.95), (7.0, -0.95, 7.3, 0.95)),
        ((5.4, 0.0),),
    ),
}


@dataclass(frozen=True)
class Outcome:
    """Outcome of a mission.

    Number of stances, the way that was left [m], the promised sigma of the last positions [m], least distances of
    robots' middles from each other and from walls [m], CPU time of the slowest decision [s], and why it `failed`.
    """

    stances: int
    left: float
    promised: float
    to_robot: float
    to_wall: float
    slowest: float
    failed: str = ""

    @property
    def collides(self) -> bool:
        """Return whether bodies touched."""
        return self.to_robot < 2 * RADIUS or self.to_wall < RADIUS


class Replanned:
    """A mission that is planned anew after each stance."""

    def __init__(
        self,
        scene: Scene,
        seed: int,
        wheels: WheelErrors | None,
        floor_map: FloorMap | None,
        *,
        scattered: bool = False,
    ) -> None:
        self._rng, self._wheels, self._walls = stream(seed, "formation"), wheels, scene.floor_plan
        self._predictor = Predictor(scene.team, scene.fps, wheels=wheels or WHEELS, floor_map=floor_map, anew=True)
        observers, mover = scene.observers, scene.mover
        self._horizon = Horizon(self._predictor, scene.course, observers, mover, scene.capture)
        self._mover, self._observers, self._left = mover, observers, scene.capture
        poses = {**self._horizon.starts(), mover: MOVER_START}
        self._belief = Belief.start(scene.team, poses)
        if scattered:
            self._belief = self._scattered(scene)
        self.to_robot, self.to_wall, self.slowest, self.stances = math.inf, math.inf, 0.0, 0

    def run(self) -> Outcome:
        """Run it."""
        failed, stood = "", []
        try:
            while self.stances < MAX_STANCES and not self._horizon.arrived(self._belief.poses):
                idle = self._horizon.require_progress(stood)
                began = time.process_time()
                decision = self._decide(idle)
                self.slowest = max(self.slowest, time.process_time() - began)
                self._follow(decision)
                stood.append({name: self._belief.poses[name] for name in self._observers})
                self.stances += 1
        except InputError as error:
            failed = str(error)
        left = self._horizon.remaining(self._belief.poses)
        promised = self._belief.position_sigma(self._observers)
        return Outcome(self.stances, left, promised, self.to_robot, self.to_wall, self.slowest, failed)

    def _scattered(self, scene: Scene) -> Belief:
        """Team in random poses along the course, clear of each other and of walls, in which two share a view."""
        course, names, rng = scene.course, (*self._observers, self._mover), self._rng
        assert self._walls is not None
        while True:
            begin = rng.uniform(0.0, course.length - BEFORE - STRETCH)
            ways = begin + STRETCH * rng.random(len(names))
            poses = {}
            for name, way in zip(names, [*ways[:-1], ways.max() + 0.5], strict=True):
                x, y, heading = course.at(float(way))
                aside = rng.uniform(-0.8, 0.8)
                yaw = (
                    heading
                    + rng.uniform(-TURNED, TURNED)
                    - (self._predictor.camera_yaw(name) if name != self._mover else 0.0)
                )
                poses[name] = x - aside * math.sin(heading), y + aside * math.cos(heading), float(yaw)
            at = np.array([pose[:2] for pose in poses.values()])
            apart = np.hypot(*np.moveaxis(at[:, None] - at, -1, 0)) + np.eye(len(at))
            if apart.min() < TO_ROBOT or self._walls.distance(at).min() < TO_WALL:
                continue
            belief = Belief.start(scene.team, poses)
            with contextlib.suppress(InputError):
                self._horizon.first(belief)
                return belief

    def _decide(self, idle: Sequence[Planar]) -> Decision:
        if not self.stances:
            return self._horizon.first(self._belief)
        return self._horizon.next(self._belief, max(self._left, 0.0), idle)

    def _follow(self, decision: Decision) -> None:
        """Drive as decided; robots stop off, and what is known grows by what the stance is expected to bring there."""
        stance, poses, free = decision.stance, self._belief.poses, self._predictor.free
        observers = [poses[name][:2] for name in self._observers]
        stance, to_start = self._approach(stance, observers)
        self._check(self._veered(to_start), observers)
        standing, belief = {}, self._belief
        for name, target in stance.standing.items():
            standing[name] = poses[name]
            if name in stance.anchors or target == poses[name]:
                continue
            others = [poses[other][:2] for other in self._observers if other != name]
            standing[name] = stop = self._stop(poses[name], target)
            way = [*route(poses[name][:2], target[:2], others, free, rooms=self._predictor.rooms)[:-1], stop[:2]]
            self._check([poses[name][:2], *way], others)
            belief = belief.after_leap(name, stop, self._predictor.wheels)
        self._check(self._veered(stance.waypoints), [one[:2] for one in standing.values()])
        came = replace(stance, standing=standing)
        promise = self._predictor.of_stance(belief, came)
        x, y = stance.waypoints[-1]
        poses = {**promise.belief.poses, **standing, self._mover: (x, y, 0.0)}
        self._belief = replace(promise.belief, poses=poses, leapt={})
        self._left -= stance.duration

    def _approach(
        self, stance: PlannedStance, observers: Sequence[Sequence[float]]
    ) -> tuple[PlannedStance, Sequence[Sequence[float]]]:
        """Return the stance driven from the end to which the mover has the shorter way, and that way."""
        start, found = self._belief.poses[self._mover][:2], []
        for drive in (stance.waypoints, stance.waypoints[::-1]):
            with contextlib.suppress(InputError):
                way = route(start, drive[0], observers, self._predictor.free, rooms=self._predictor.rooms)
                found.append((polyline_length([start, *way]), drive, [start, *way]))
        if not found:
            raise InputError(f"{self._mover} finds no way to its drive")
        _, drive, way = min(found, key=lambda each: each[0])
        return replace(stance, waypoints=drive), way

    def _stop(self, start: Sequence[float], target: Sequence[float]) -> tuple[float, float, float]:
        x, y, yaw = target
        leapt = math.dist(start[:2], target[:2])
        along, aside, turned = self._rng.standard_normal(3)
        if self._wheels is None:
            sigma = float(stop_sigma(leapt))
            return x + sigma * along, y + sigma * aside, yaw + HEADING_SIGMA * turned
        veer = math.hypot(self._wheels.turned, self._wheels.veer * math.sqrt(leapt)) * turned
        way = math.atan2(y - start[1], x - start[0])
        off = leapt * veer / math.sqrt(3)
        on = self._wheels.along * math.sqrt(leapt) * along
        return (
            x + on * math.cos(way) - off * math.sin(way),
            y + on * math.sin(way) + off * math.cos(way),
            yaw + veer + 0.01 * aside,
        )

    def _veered(self, way: Sequence[Sequence[float]]) -> Sequence[Sequence[float]]:
        """Return the mover's way as its wheels have it drive, from where cameras have told it where it is."""
        if self._wheels is None:
            return way
        points = np.array([point[:2] for point in way])
        length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        veer = math.hypot(self._wheels.turned, self._wheels.veer * math.sqrt(length)) / math.sqrt(3)
        angle = veer * float(self._rng.standard_normal())
        c, s = math.cos(angle), math.sin(angle)
        return [tuple(one) for one in (points[0] + (points - points[0]) @ [[c, s], [-s, c]]).tolist()]

    def _check(self, way: Sequence[Sequence[float]], others: Sequence[Sequence[float]]) -> None:
        at = dense(way)
        self.to_robot = min(self.to_robot, *(float(np.hypot(*(at - np.array(other)).T).min()) for other in others))
        if self._walls is not None:
            self.to_wall = min(self.to_wall, float(self._walls.distance(at).min()))


def outcome(seed: int, robots: int, floor: str, wheels: WheelErrors | None, *, scattered: bool = False) -> Outcome:
    """Outcome of a seed."""
    floor_plan: FloorPlan | None = FLOORS.get(floor)
    names = tuple("ABCDEF"[:robots])
    scene = Scene.of(stated_team(reference_team(names=names), WRONG), 10.0, 5.0, 7.2, floor_plan)
    return Replanned(scene, seed, wheels, floor_plan and floor_plan.floor_map(), scattered=scattered).run()


def main() -> int:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--on", nargs="*", choices=("straight", *FLOORS), default=["L", "U"])
    parser.add_argument("--robots", type=int, choices=range(3, 7), default=4, help="of the team; the last drives")
    parser.add_argument("--wheels", action="store_true", help="slip of a Create's wheels")
    parser.add_argument("--scattered", action="store_true", help="from random poses; not on the straight")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="outcomes of earlier parts, to which this one adds")
    args = parser.parse_args()
    kept = {}
    if args.keep and args.keep.exists():
        for row in map(json.loads, args.keep.read_text(encoding="utf-8").splitlines()):
            key = row.pop("on"), row.pop("seed")
            kept[key] = Outcome(**row)
    for floor in args.on:
        found = []
        for seed in range(args.first, args.first + args.seeds):
            one = kept.get((floor, seed)) or outcome(
                seed, args.robots, floor, CREATE if args.wheels else None, scattered=args.scattered
            )
            if args.keep and (floor, seed) not in kept:
                with args.keep.open("a", encoding="utf-8") as file:
                    file.write(json.dumps({"on": floor, "seed": seed, **asdict(one)}) + "\n")
            found.append(one)
            print(f"  {floor} {seed}: {one}", file=sys.stderr, flush=True)
        arrived = [one for one in found if not one.failed]
        print(
            f"{floor}: {len(arrived)} of {len(found)} arrive, {sum(one.collides for one in found)} collide "
            f"(least distances {min(one.to_robot for one in found):.3f} m and {min(one.to_wall for one in found):.3f} m"
            f" from walls); slowest decision {max(one.slowest for one in found):.1f} s of CPU"
            + (
                f"; {np.mean([one.stances for one in arrived]):.1f} stances, promised "
                f"{1e3 * math.sqrt(np.mean([one.promised**2 for one in arrived])):.1f} mm"
                if arrived
                else ""
            ),
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
