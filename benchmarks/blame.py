"""Share of drawn faults whose true cause is named, alone or among equals, and of innocent robots that are blamed.

    python benchmarks/blame.py [--worlds 34] [--first 1] [--variant NAME] [--healthy] [--json FILE]

Each world is a hallway, or a team of four, of 8 stances at depth tracks, and is solved once for each kind of fault,
with one drawn fault of the kind: a clock, an odometry jump, a lever arm of odometry, a robot that moved and is called
an anchor, a bump, or a wrong homography. `--healthy` solves worlds without a fault instead. A fault counts where it
moves a pose by more than 3 sigma, or leaves one without a pose, if nothing is named.

Variants: `wide` is a team of five, two of which move at once, with wider lanes and longer leaps; `images` has no wheel
odometry; in `two` each run has two faults, of two robots.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from monte_carlo import MemoryRun, simulated

from coloc_graph.backend import Estimate, PoseGraph, joint
from coloc_graph.backend.cause import Cause
from coloc_graph.backend.graph import StayPut
from coloc_graph.errors import ColocError
from coloc_graph.frontend import PairMeasurement
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.geometry.se2 import compose
from coloc_graph.measurements import Measurement, Odometry, RelativePose, Sighting
from coloc_graph.pipeline import batch
from coloc_graph.pipeline.batch import Solution, SolveOptions, solve
from coloc_graph.pipeline.clocks import CorrectedRun
from coloc_graph.pipeline.incremental import OdometryAndSightings, measure_stance
from coloc_graph.run import Detections, OdometrySample, Stance
from coloc_graph.simulation import Imperfections
from coloc_graph.simulation.scenarios import TEAM_GAIT, team_of
from coloc_graph.simulation.teams import build_team_world
from coloc_graph.simulation.world import stream

STANCES = 8  # stances of a run
POINTS = 100  # points of a stance of a hallway
TEAM_POINTS = 300  # points of a pair of a stance of a team
COUNTED = 3.0  # sigmas by which a fault that counts changes a pose
KINDS = ("clock", "jump", "arm", "moves", "bump", "homography")
SEEN_KINDS = ("clock", "moves", "bump", "homography")  # faults that no wheels tell
PAIRS = (("clock", "bump"), ("jump", "homography"), ("arm", "moves"), ("bump", "jump"), ("homography", "moves"))
VARIANTS = ("usual", "wide", "images", "two")


@dataclass(frozen=True)
class Fault:
    """A drawn fault of a `kind` of a robot, from a stance on; `size` is in m or s."""

    kind: str
    robot: str
    stance: int
    size: float
    T_before_after: np.ndarray


class Faulty:
    """A run with a fault."""

    def __init__(self, run: MemoryRun, fault: Fault) -> None:
        self._run, self.fault = run, fault
        self.stances = tuple(self._stances())
        self._since = run.stances[fault.stance].start

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)

    def changes_view(self, stance: int) -> bool:
        """Return whether the fault changes what cameras see in a stance."""
        return self.fault.kind == "clock" or (self.fault.kind == "homography" and stance == self.fault.stance)

    def _stances(self) -> Iterator[Stance]:
        for stance in self._run.stances:
            if self.fault.kind == "moves" and stance.index == self.fault.stance:
                stance = replace(stance, anchors=(*stance.anchors, self.fault.robot))
            yield stance

    def detections(self, robot: str, start: float, end: float) -> Iterator[Detections]:
        """As the camera sees it, with the fault."""
        fault, mine = self.fault, robot == self.fault.robot
        late = fault.size if mine and fault.kind == "clock" else 0.0
        last = self._run.stances[fault.stance].end
        for one in self._run.detections(robot, start - late, end - late):
            if mine and fault.kind == "homography" and self._since <= one.time <= last:
                one = self._moved(one)
            yield replace(one, time=one.time + late) if late else one

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """As the wheels say, with the fault."""
        fault = self.fault
        if robot != fault.robot or fault.kind not in ("clock", "jump", "arm"):
            yield from self._run.odometry(robot, start, end)
            return
        late = fault.size if fault.kind == "clock" else 0.0
        lower, upper = (None if one is None else one - late for one in (start, end))
        for one in self._run.odometry(robot, lower, upper):
            if fault.kind == "arm":
                x, y, yaw = one.pose
                yield replace(one, pose=np.array([*(x + fault.size * np.cos(yaw), y + fault.size * np.sin(yaw)), yaw]))
            elif fault.kind == "jump" and one.time >= self._since:
                T = fault.T_before_after
                by = (T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0]))
                yield replace(one, pose=np.array(compose(by, tuple(one.pose.tolist()))))
            else:
                yield replace(one, time=one.time + late)

    def _moved(self, one: Detections) -> Detections:
        robot = self._run.team[self.fault.robot]
        T_bc, camera = robot.mount.T_body_camera, robot.camera
        height = next(r.markers.height for r in self._run.team.robots if r.markers)
        rays = np.column_stack([camera.normalise(one.uv), np.ones(len(one.uv))]) @ T_bc[:3, :3].T
        p_body = T_bc[:3, 3] + rays * ((height - T_bc[2, 3]) / rays[:, 2])[:, None]
        T = self.fault.T_before_after @ T_bc
        return replace(one, uv=camera.project((p_body - T[:3, 3]) @ T[:3, :3])[0])


def bumped(run: MemoryRun, fault: Fault) -> MemoryRun:
    """The same run where a robot is displaced right before a stance, and drives on from there by its wheels."""
    world, at = run._world, run.stances[fault.stance].start - 1e-3
    path = world.paths[fault.robot]
    T_world_body = path.pose_at([at])[0]
    T = T_world_body @ fault.T_before_after @ np.linalg.inv(T_world_body)
    knots, c, s = path.knots.copy(), T[:2, :2], np.arctan2(T[1, 0], T[0, 0])
    later = path.times >= at
    here = path.planar_at([at, at])
    times = np.concatenate([path.times[~later], [at, at + 1e-6], path.times[later]])
    knots = np.concatenate([path.knots[~later], here, path.knots[later]])
    after = np.arange(len(knots)) > int((~later).sum())
    knots[after, :2] = knots[after, :2] @ c.T + T[:2, 3]
    knots[after, 2] += s
    captures = tuple(
        tuple(
            replace(one, view=replace(one.view, T_world_camera=T @ one.view.T_world_camera))
            if k >= fault.stance and one.robot == fault.robot
            else one
            for one in every
        )
        for k, every in enumerate(world.captures)
    )
    moved = replace(path, times=times, knots=knots)
    made = type(run)(replace(world, paths={**world.paths, fault.robot: moved}, captures=captures))
    made.bumped_before = fault.stance
    for robot in run.team.names:  # no wheel feels it
        made._odometry[robot] = list(run.odometry(robot))
    return made


def drawn(run: MemoryRun, kind: str, rng: np.random.Generator) -> Fault:
    """A fault of a kind that the run can have."""
    far, way = rng.uniform(0.08, 0.3), rng.uniform(0, 2 * np.pi)
    T = floor_pose(far * np.cos(way), far * np.sin(way), np.radians(rng.uniform(4, 15)) * rng.choice([-1, 1]))
    k = int(rng.integers(2, len(run.stances) - 2))
    stance = run.stances[k]
    if kind == "moves":
        moved = [(s.index, r) for a, s in zip(run.stances, run.stances[1:], strict=False)
                 for r in s.observers if r not in s.anchors and r in a.observers]  # fmt: skip
        inner = [one for one in moved if 1 < one[0] < len(run.stances) - 2] or moved
        if not inner:  # all who moved before a stance had moved within the one before it
            return drawn(run, "bump", rng)
        index, robot = inner[rng.integers(len(inner))]
        return Fault(kind, robot, index, far, T)
    if kind == "bump":
        return Fault(kind, str(rng.choice(stance.anchors)), k, far, T)
    if kind == "homography":
        return Fault(kind, str(rng.choice(stance.observers)), k, far, T)
    if kind == "clock":
        return Fault(kind, str(rng.choice(stance.observers)), 0, float(rng.choice([-1, 1]) * rng.uniform(0.1, 2.0)), T)
    driving = [name for name in run.team.names if any(True for _ in run.odometry(name))]
    return Fault(kind, str(rng.choice(driving)), k, 0.2 + far, T)


def accused(cause: Cause) -> Iterator[tuple[str, str]]:
    """A cause as (kind, robot), of each robot of which one is at fault."""
    link = cause.links[0]
    for robot in cause.robots:
        if isinstance(link, StayPut):
            yield "moved", robot
        elif isinstance(link, Odometry):
            yield "odometry", robot
        elif isinstance(link, RelativePose | Sighting):
            yield f"homography {link.stance}", robot


def accusations(solution: Solution) -> list[set[tuple[str, str]]]:
    """Every fault that is named as the causes that are said to explain it equally well: (kind, robot)."""
    said: list[set[tuple[str, str]]] = [
        {one for cause in (Cause((bump.stay_put,)), *bump.alternative) for one in accused(cause)}
        for bump in solution.estimate.bumped
    ]
    said += [
        {one for cause in (Cause((rejection.measurement,)), *rejection.alternative) for one in accused(cause)}
        for rejection in solution.estimate.rejected
    ]
    for sentence in solution.warnings:
        named = {
            (what, robot)
            for what in ("clock", "odometry")
            for robot in solution.run.team.names
            if f"{robot}'s {what}" in sentence or sentence.startswith(f"the {what} of {robot} ")
        }
        said += [named] if named else []
    return said


def verdict(solution: Solution, fault: Fault, guilty: Collection[str]) -> tuple[bool, bool]:
    """Return whether the right cause is named, and whether a sentence names none of the `guilty` robots."""
    kinds = {"clock": "clock", "jump": "odometry", "arm": "odometry", "moves": "moved", "bump": "moved"}
    right = (kinds.get(fault.kind, f"homography {fault.stance}"), fault.robot)
    said = accusations(solution)
    return any(right in one for one in said), any(all(robot not in guilty for _, robot in one) for one in said)


class Measured:
    """Measurements of the stances that no fault changes, made once for a world."""

    def __init__(self) -> None:
        self._measured: dict[int, list[PairMeasurement]] = {}

    def __call__(self, run: Any, stance: Stance, options: SolveOptions) -> Iterator[PairMeasurement]:
        """As `measure_stance`."""
        if not seen_as_it_is(run, stance.index):
            yield from measure_stance(run, stance, options)
            return
        if stance.index not in self._measured:
            self._measured[stance.index] = list(measure_stance(run, stance, options))
        yield from self._measured[stance.index]


def seen_as_it_is(run: Any, stance: int) -> bool:
    """Return whether nothing changes what cameras see in a stance, in a run or any that it is made of."""
    while run is not None:
        if isinstance(run, CorrectedRun) or (isinstance(run, Faulty) and run.changes_view(stance)):
            return False
        if isinstance(run, MemoryRun):
            return stance < vars(run).get("bumped_before", len(run.stances))
        run = vars(run).get("recorded", vars(run).get("_run"))
    return False


def effect(run: Any, healthy: Estimate, measure: Measured) -> float:
    """Largest change of a pose in its sigmas if nothing is doubted in a run; infinite where one has no pose."""
    motions = OdometryAndSightings(run.team)
    made = list[Measurement]()
    for stance in run.stances:
        pairs = list(measure(run, stance, SolveOptions().resolved()))
        made += [one.relative_pose for one in pairs if one.relative_pose is not None]
        made += motions.of_stance(run, stance, pairs)
    far = 0.0
    try:
        naive = joint(PoseGraph.of(run.team, run.stances, made), reject=False)
        for robot, stance in healthy.graph.nodes:
            if robot not in run.stances[stance].movers:  # whose pose is that at the time of an image
                off = healthy.pose(robot, stance).localCoordinates(naive.pose(robot, stance))[2:5]
                far = max(far, float(off @ np.linalg.solve(healthy.covariance(robot, stance)[2:5, 2:5], off)))
    except ColocError:
        return float("inf")
    return round(float(np.sqrt(far)), 1)


class Wheelless(MemoryRun):
    """A run without odometry."""

    def odometry(self, robot: str, start: float | None = None, end: float | None = None) -> Iterator[OdometrySample]:
        """As `Run`."""
        return iter(())


def world_of(seed: int, variant: str = "usual") -> MemoryRun:
    """A hallway, or a team of four; of `wide`, a team of five."""
    imperfections = Imperfections(mount_sigma_deg=0.3, height_sigma=0.002, floor_sigma_deg=0.1)
    made = Wheelless if variant == "images" else MemoryRun
    if variant == "wide":
        gait = replace(TEAM_GAIT, leap=1.15 * TEAM_GAIT.leap, abreast=1.1 * TEAM_GAIT.abreast)
        shape = team_of(5, 2, STANCES, stream(seed, "formation"), gait)
    elif seed % 2 == 0:
        return made(simulated("hallway", seed, points=POINTS, stances=STANCES, imperfections=imperfections))
    else:
        shape = team_of(4, 1, STANCES)
    return made(build_team_world(shape, seed=seed, points=TEAM_POINTS, imperfections=imperfections))


def healthy_world(number: int, variant: str) -> list[dict[str, Any]]:
    """Solve a world without a fault, and return its accusations and warnings as one row."""
    solution = solve(world_of(number, variant), SolveOptions())
    said = [sorted(one) for one in accusations(solution)]
    return [{"kind": "healthy", "world": number, "said": said, "innocent": bool(said), "warnings": solution.warnings}]


def faulty_world(number: int, variant: str) -> list[dict[str, Any]]:
    """Return one row for each fault of runs with one fault of each kind, or two, drawn in the same world."""
    world = world_of(number, variant)
    batch.measure_stance = measure = Measured()
    healthy = solve(world, SolveOptions()).estimate
    singles = [(kind,) for kind in (SEEN_KINDS if variant == "images" else KINDS)]
    return [row for kinds in (PAIRS if variant == "two" else singles)
            for row in faulted(world, healthy, measure, number, kinds)]  # fmt: skip


def faulted(
    world: MemoryRun, healthy: Estimate, measure: Measured, number: int, kinds: Sequence[str]
) -> list[dict[str, Any]]:
    """Solve a world with drawn faults of different robots, and return accusations, verdict and effect of each."""
    rng = np.random.default_rng((number, *(KINDS.index(kind) for kind in kinds)))
    faults: list[Fault] = []
    while len(faults) < len(kinds):
        one = drawn(world, kinds[len(faults)], rng)
        faults += [] if one.robot in [other.robot for other in faults] else [one]
    began = time.process_time()
    rows: list[dict[str, Any]] = []
    for fault in faults:
        row: dict[str, Any] = {"kind": fault.kind, "world": number, "robot": fault.robot, "stance": fault.stance}
        effect_alone = effect(with_faults(world, [fault]), healthy, measure)
        rows.append({**row, "size": round(fault.size, 3), "effect": effect_alone, "of": list(kinds)})
    try:
        solution = solve(with_faults(world, faults), SolveOptions())
    except Exception as error:  # one failure must not end the others
        return [{**row, "error": f"{type(error).__name__}: {error}"} for row in rows]
    said = [sorted(one) for one in accusations(solution)]
    seconds = round(time.process_time() - began, 2)
    shared = {"said": said, "seconds": seconds, "warnings": list(solution.warnings),
              "chi2": round(solution.estimate.chi2 / max(solution.estimate.dof, 1), 2)}  # fmt: skip
    for row, fault in zip(rows, faults, strict=True):
        right, innocent = verdict(solution, fault, [one.robot for one in faults])
        row.update(shared, right=right, innocent=innocent)
    return rows


def with_faults(run: MemoryRun, faults: Sequence[Fault]) -> Any:
    """The run with all of some faults."""
    faulty: Any = run
    for one in sorted(faults, key=lambda one: one.kind != "bump"):  # which changes the world itself
        faulty = bumped(faulty, one) if one.kind == "bump" else Faulty(faulty, one)
    return faulty


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=34, help="number of worlds (default: 34)")
    parser.add_argument("--first", type=int, default=1, help="first world (default: 1)")
    parser.add_argument(
        "--variant", choices=VARIANTS, default="usual", help="kind of worlds and faults (default: usual)"
    )
    parser.add_argument("--healthy", action="store_true", help="solve the worlds without a fault")
    parser.add_argument("--processes", type=int, default=2, help="number of processes (default: 2)")
    parser.add_argument("--json", metavar="FILE", type=Path, help="append every fault to a file, one a line")
    options = parser.parse_args()
    work = partial(healthy_world if options.healthy else faulty_world, variant=options.variant)
    worlds = range(options.first, options.first + options.worlds)
    rows = list[dict[str, Any]]()
    with ProcessPoolExecutor(options.processes, mp_context=get_context("spawn")) as pool:
        for every in pool.map(work, worlds):
            rows += every
            if options.json is not None:
                with options.json.open("a") as out:
                    out.writelines(json.dumps(row, default=str) + "\n" for row in every)
    counts: Counter[tuple[str, str]] = Counter()
    for row in rows:
        row["counted"] = row.get("effect", np.inf) > COUNTED
        counts[row["kind"], "drawn"] += 1
        for what in ("counted", "right", "innocent", "error"):
            counts[row["kind"], what] += bool(row["counted"] and row.get(what))
        counts[row["kind"], "named"] += bool(row.get("said"))
    print(
        f"{'fault':12} {'drawn':>6} {'counted':>8} {'named':>6} {'right':>6} {'innocent alone':>15} {'no result':>10}"
    )
    for kind in dict.fromkeys(row["kind"] for row in rows):
        cells = [counts[kind, what] for what in ("drawn", "counted", "named", "right", "innocent", "error")]
        print(f"{kind:12}" + "".join(f"{cell:15}" for cell in cells))


if __name__ == "__main__":
    main()
