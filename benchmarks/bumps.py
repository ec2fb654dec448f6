"""Rates of pushed anchors named, healthy ones not named, and wrong homographies not taken for a push.

    python benchmarks/bumps.py [--seeds 60] [--json]

Each seed is a hallway of 10 stances with 100 points, and a push of 2 to 15 cm and 2 to 15 deg between two stances:
of an anchor, asked for after that stance; of nobody; and of what the homography alone says, asked for a stance later.
"""

import argparse
import json
from dataclasses import replace
from typing import Any

import numpy as np
from monte_carlo import MemoryRun, over_seeds, simulated

from coloc_graph.backend import Bump, joint
from coloc_graph.backend.batch import faults_of
from coloc_graph.backend.blame import bumps_of
from coloc_graph.geometry.lie import floor_pose
from coloc_graph.pipeline.incremental import IncrementalSolver
from coloc_graph.run import Detections
from coloc_graph.simulation import Imperfections

STANCES = 10
POINTS = 100
FAR = (0.02, 0.04, 0.08, 0.15)
TURNED = (2.0, 4.0, 8.0, 15.0)


class Pushed:
    """A run in which a robot stands elsewhere from some time on than its wheels say."""

    def __init__(self, run: MemoryRun, robot: str, since: float, T_before_after: np.ndarray) -> None:
        self._run, self._robot, self._since = run, robot, since
        camera, self._T_body_camera = run.team[robot].camera, run.team[robot].mount.T_body_camera
        markers = run.team["C"].markers
        assert camera is not None and markers is not None
        self._camera, self._height, self._T_before_after = camera, markers.height, T_before_after

    def __getattr__(self, name: str) -> Any:
        return getattr(self._run, name)

    def detections(self, robot: str, start: float, end: float) -> Any:
        """As the camera sees it from there."""
        for one in self._run.detections(robot, start, end):
            yield self._moved(one) if robot == self._robot and one.time >= self._since else one

    def _moved(self, one: Detections) -> Detections:
        T_bc = self._T_body_camera
        rays = np.column_stack([self._camera.normalise(one.uv), np.ones(len(one.uv))]) @ T_bc[:3, :3].T
        p_body = T_bc[:3, 3] + rays * ((self._height - T_bc[2, 3]) / rays[:, 2])[:, None]
        T = self._T_before_after @ T_bc
        return replace(one, uv=self._camera.project((p_body - T[:3, 3]) @ T[:3, :3])[0])


def one_seed(seed: int) -> dict[str, bool]:
    """Return the verdict on each of the three: right or not, and blamed on the other or not."""
    rng = np.random.default_rng(seed)
    run = MemoryRun(simulated("hallway", seed, points=POINTS, stances=STANCES, imperfections=Imperfections()))
    k = int(rng.integers(1, STANCES - 1))
    (anchor,) = run.stances[k].anchors
    far, way = rng.choice(FAR), rng.uniform(0, 2 * np.pi)
    turned = np.radians(rng.choice(TURNED)) * rng.choice([-1, 1])
    T = floor_pose(far * np.cos(way), far * np.sin(way), turned)
    pushed = Pushed(run, anchor, run.stances[k].start, T)

    def up_to(end: int) -> IncrementalSolver:
        solver = IncrementalSolver(run.team)
        for stance in run.stances[:end]:
            solver.enter(run, stance)
        return solver

    def bumps(solver: IncrementalSolver) -> tuple[Bump, ...]:
        return bumps_of(faults_of(solver.estimator.method, solver.estimator.graph), solver.estimator.graph)

    def named(solver: IncrementalSolver) -> bool:
        return any((b.stay_put.robot, b.stay_put.after) == (anchor, k) for b in bumps(solver))

    healthy = up_to(k + 1)
    bumped = up_to(k)
    said = bumped.enter(pushed, run.stances[k]).estimate
    wrong = up_to(k)
    good = wrong.measure(run, run.stances[k])
    bad = wrong.measure(pushed, run.stances[k])
    mixed = (replace(a, relative_pose=b.relative_pose, homography=b.homography) for a, b in zip(good, bad, strict=True))
    wrong.enter(run, run.stances[k], tuple(mixed))
    wrong.enter(run, run.stances[k + 1])
    found = joint(wrong.estimator.graph)
    return {
        "pushed anchors named": named(bumped),
        "pushed anchors that contradict": bool(said.rejected) or said.agreement.p_value() < 1e-4,
        "healthy anchors named": bool(bumps(healthy)),
        "wrong homographies refused": bool(found.rejected),
        "wrong homographies taken for a push": bool(found.bumped),
    }


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = over_seeds(one_seed, range(options.seeds))
    found = {what: sum(row[what] for row in rows) for what in rows[0]}
    if options.json:
        print(json.dumps({"seeds": options.seeds} | found))
        return
    for what, count in found.items():
        print(f"{what:36} {count:4} of {options.seeds}")


if __name__ == "__main__":
    main()
