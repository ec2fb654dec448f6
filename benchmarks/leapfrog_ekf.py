"""A centralised EKF on a leap-frog, beside the paper's chain and the graph, on the very same measurements.

    python benchmarks/leapfrog_ekf.py [--seeds 40] [--stances 40] [--points 250] [--json]

The filter is that of the paper's reference [15] (Tully, Kantor, Choset: Leap-Frog Path Design for Multi-Robot
Cooperative Localization): one state of all robots' poses, two of which stand while one moves. Wheels predict a robot's
next pose, its last one is marginalised out, and the stance's measurements update all poses. These are relative poses
and sightings, as `smooth` has them, or, with mounts, markers and clocks in the state, homographies and pixels, as
`joint` has them. An update is iterated (Bell and Cathey, 1993), a plain one is not. A run is measured once for all
methods but the paper's, which measures in its own way.

The hallway at depth tracks, 0.3 px: as the team says, and with mounts off by 1 deg and 5 mm, or 3 deg and 2 cm, spans
by 0.1 mm and the floor by 0.1 deg (one sigma each). Seconds are CPU time without the front end.
"""

import argparse
import json
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from copy import copy
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `coloc` does, before numpy is there

import gtsam
import numpy as np
from monte_carlo import MemoryRun, anees_interval, over_seeds, simulated, truth_of
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from whole_graph import replay

from coloc_graph.backend import Estimate, Method, PoseGraph, chain, joint, smooth
from coloc_graph.backend.calibration import is_calibration
from coloc_graph.backend.estimate import make_estimate
from coloc_graph.backend.factors import factors_for
from coloc_graph.backend.graph import Link, pose_of
from coloc_graph.evaluation import align, evaluate, nees_of
from coloc_graph.evaluation.nees import PLANAR
from coloc_graph.measurements import Odometry
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.simulation import Imperfections, World

Array = NDArray[np.float64]

FIELDS = {
    "as the team says": Imperfections(),
    "mounts off by 1 deg": Imperfections(mount_sigma_deg=1.0, height_sigma=5e-3, span_sigma=1e-4, floor_sigma_deg=0.1),
    "mounts off by 3 deg": Imperfections(mount_sigma_deg=3.0, height_sigma=2e-2, span_sigma=1e-4, floor_sigma_deg=0.1),
}
#: An update is iterated until a step is far within what is known, at most so often.
STEPS = 10
FAR_WITHIN = 1e-3
#: Rounds of an update in which mounts turn out to be far from where they were thought to be.
ANCHORINGS = 4


class Filter:
    """A Gaussian about `values`, in square-root information form: |R xi|^2, xi in the tangents of `values`.

    Algebraically the EKF with a covariance; what is not known yet is a column of zeros instead of a large number.
    """

    def __init__(self) -> None:
        self.values = gtsam.Values()
        self._at: dict[int, NDArray[np.int64]] = {}  # columns of each key
        self._R: Array = np.zeros((0, 0))

    def __contains__(self, key: int) -> bool:
        return key in self._at

    def enter(self, key: int, start: gtsam.Pose3 | Array) -> None:
        """A variable of which nothing is known; `start` is where it is linearised first."""
        self.values.insert(key, start)
        columns = 6 if isinstance(start, gtsam.Pose3) else len(start)
        self._at[key] = self._R.shape[1] + np.arange(columns)
        self._R = np.pad(self._R, ((0, 0), (0, columns)))

    def take(self, factors: Iterable[gtsam.NonlinearFactor], steps: int = 1) -> None:
        """Update by factors on variables in the state, linearised anew at each step."""
        before, factors = self.values, list(factors)
        self.values = gtsam.Values(before)  # a copy of the filter keeps its own
        for _ in range(steps):
            moved = np.zeros(self._R.shape[1])
            for key, at in self._at.items():
                old, new = _of(before, key), _of(self.values, key)
                moved[at] = new - old if is_calibration(key) else old.localCoordinates(new)
            rows, right = [self._R], [-self._R @ moved]
            for factor in factors:
                linear = factor.linearize(self.values)
                A, b = linear.jacobian()
                H = np.zeros((len(b), self._R.shape[1]))
                H[:, np.concatenate([self._at[key] for key in linear.keys()])] = A  # noqa: SIM118  GTSAM's own
                rows.append(H)
                right.append(b)
            Q, R = np.linalg.qr(np.concatenate(rows))
            step = np.linalg.lstsq(R, Q.T @ np.concatenate(right), rcond=None)[0]
            for key, at in self._at.items():
                old = _of(self.values, key)
                self.values.update(key, old + step[at] if is_calibration(key) else old.retract(step[at]))
            if np.linalg.norm(R @ step) < FAR_WITHIN:
                break
        self._R = R

    def drop(self, key: int) -> tuple[gtsam.Pose3, Array]:
        """Marginalise a pose out; what was thought of it, and its covariance (6, 6)."""
        pose, C, gone = self.values.atPose3(key), self.covariance(key), self._at.pop(key)
        kept = np.setdiff1d(np.arange(self._R.shape[1]), gone)
        self._R = np.asarray(np.linalg.qr(self._R[:, [*gone, *kept]], mode="r"))[len(gone) :, len(gone) :]
        self._at = {other: np.searchsorted(kept, at) for other, at in self._at.items()}
        self.values.erase(key)
        return pose, C

    def covariance(self, key: int) -> Array:
        """The covariance of one variable, in its tangent."""
        half = np.linalg.inv(self._R)[self._at[key]]
        return np.asarray(half @ half.T)


def _of(values: gtsam.Values, key: int) -> Any:
    return values.atVector(key) if is_calibration(key) else values.atPose3(key)


def ekf(graph: PoseGraph, method: Method = "joint", steps: int = STEPS) -> Estimate:
    """The filter over a run: poses are what is thought of them when they are left, at the end where they are not."""
    state, factors_of = Filter(), factors_for(method, graph)
    found, covariances = gtsam.Values(), {}
    links: dict[int, list[Link]] = defaultdict(list)
    for link in graph.links:
        links[max(stance for _, stance in link.ends)].append(link)
    standing: dict[str, int] = {}
    state.enter(graph.reference_key, gtsam.Pose3())
    state.take([factors_of.gauge(graph.reference_key)])
    for stance in graph.stances:
        ways = [link for link in links[stance.index] if isinstance(link, Odometry)]
        seen = [link for link in links[stance.index] if not isinstance(link, Odometry)]
        for link in (*ways, *seen):  # a pose starts where wheels say, or else cameras
            i, j = map(graph.pose_keys.key, link.ends)
            for known, new, T in ((i, j, pose_of(link)), (j, i, pose_of(link).inverse())):
                if known in state and new not in state:
                    state.enter(new, factors_of.start(state.values.atPose3(known).compose(T)))
                    state.take(factors_of.of_pose(new))
        state.take(factors_of.of_link(link, *map(graph.pose_keys.key, link.ends)) for link in ways)
        now = {robot: graph.key(robot, k) for robot, k in graph.nodes if k == stance.index}
        for robot, key in now.items():
            if robot in standing and standing[robot] != key:
                pose, covariances[standing[robot]] = state.drop(standing[robot])
                found.insert(standing[robot], pose)
        standing |= now
        for _ in range(ANCHORINGS):
            factors = [factors_of.of_link(link, *map(graph.pose_keys.key, link.ends)) for link in seen]
            for key in {key for factor in factors for key in factor.keys()[2:]}:
                if key not in state:
                    state.enter(key, factors_of.nominal(key))
                    state.take([factors_of.calibration_prior(key)])
            updated = copy(state)
            updated.take(factors, steps)
            if steps == 1 or factors_of.is_anchored(updated.values):
                break
            factors_of = factors_for(method, graph, updated.values)  # spans are taken apart for mounts as they are
        state = updated
    for key in map(int, state.values.keys()):
        covariances[key] = state.covariance(key)
        found.insert(key, _of(state.values, key))
    return make_estimate(method, graph, found, covariances, variables=factors_of.variables)


PAPER = "the paper's chain"
BEST = "joint (the default)"
METHODS: dict[str, Callable[[PoseGraph], Estimate]] = {
    PAPER: chain,
    "EKF of poses": partial(ekf, method="smooth"),
    "smoothed": smooth,
    "EKF with mounts, plain": partial(ekf, method="joint", steps=1),
    "EKF with mounts": partial(ekf, method="joint"),
    "joint, incremental": lambda graph: replay(graph, "joint")[0],
    BEST: joint,
}


def of_seed(seed: int, imperfections: Imperfections, points: int, stances: int) -> dict[str, dict[str, list[float]]]:
    """Figures of one run by each method.

    Length errors and end position errors of A and B [% of their path], the larger of their heading errors at the end
    [deg], NEES of all poses and of A's last, CPU time [s].
    """
    world = simulated("hallway", seed, points=points, stances=stances, imperfections=imperfections)
    run: Any = MemoryRun(world)
    paper, graph = (solve(run, SolveOptions(method)).estimate.graph for method in ("chain", "joint"))
    found = {}
    for name, method in METHODS.items():
        started = time.process_time()
        estimate = method(paper if name == PAPER else graph)
        found[name] = _figures(estimate, world, time.process_time() - started)
    return found


def _figures(estimate: Estimate, world: World, seconds: float) -> dict[str, list[float]]:
    true = align(estimate.trajectories, truth_of(world), world.team.reference, on_floor=True)
    accuracy = evaluate(estimate.trajectories, true, on_floor=True)
    pair = [row for row in accuracy.robots if row.robot in world.scenario.pair]
    return {
        "length": [100 * row.length_error / row.true_length for row in pair],
        "end": [100 * row.end_position_error / row.true_length for row in pair],
        "heading": [max(row.heading_error_deg for row in pair)],
        "anees": [accuracy.anees or float("nan")],
        "last": [float(nees_of(estimate.trajectories["A"], true["A"], PLANAR)[-1])],
        "seconds": [seconds],
    }


def rms(values: Array, others: Array | None = None) -> list[float]:
    """RMS of (runs, n), or its ratio to that of others, and its 95 % interval by a bootstrap over runs."""
    squares = np.stack([(values**2).mean(axis=1), np.ones(len(values)) if others is None else (others**2).mean(axis=1)])
    drawn = np.random.default_rng(0).integers(len(values), size=(4000, len(values)))
    (mean, other), (means, those) = squares.mean(axis=1), squares[:, drawn].mean(axis=2)
    return [float(one) for one in np.sqrt([mean / other, *np.quantile(means / those, [0.025, 0.975])])]


def summary(runs: list[dict[str, list[float]]], best: list[dict[str, list[float]]]) -> dict[str, Any]:
    """A method over its runs, also against the best; NEES on average, with its standard error; seconds, the median."""
    of = {name: np.array([run[name] for run in runs]) for name in runs[0]}
    return {
        "length_error_percent": rms(of["length"]),
        "end_error_percent": rms(of["end"]),
        "end_error_of_joint": rms(of["end"], np.array([run["end"] for run in best])),
        "heading_deg": rms(of["heading"])[0],
        "anees": [float(of["anees"].mean()), float(of["anees"].std() / np.sqrt(max(len(runs) - 1, 1)))],
        "nees_last": float(of["last"].mean()),
        "seconds": float(np.median(of["seconds"])),
    }


def print_table(title: str, table: dict[str, dict[str, Any]]) -> None:
    """One field's table."""
    print(f"\n{title}; RMS of A and B (95 %), NEES of all poses and of A's last")
    print(f"{'':24}{'length error [%]':>24}{'end [%]':>24}{'end / of joint':>24}{'heading':>12}{'NEES':>16}{'last':>8}")
    for name, row in table.items():
        cells = "".join(f"{'{:.3f} ({:.3f}-{:.3f})'.format(*row[key]):>24}" for key in list(row)[:3])
        honesty = "{:9.2f} +-{:4.2f}{:8.2f}".format(*row["anees"], row["nees_last"])
        print(f"{name:24}{cells}{row['heading_deg']:8.2f} deg{honesty}{row['seconds']:8.2f} s")


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in (("--seeds", 40), ("--stances", 40), ("--points", 250)):
        parser.add_argument(name, type=int, default=default)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    tables = {}
    for field, imperfections in FIELDS.items():
        work = partial(of_seed, imperfections=imperfections, points=args.points, stances=args.stances)
        runs = over_seeds(work, range(args.seeds))
        tables[field] = {name: summary([r[name] for r in runs], [r[BEST] for r in runs]) for name in METHODS}
        if not args.json:
            print_table(f"{field}: {args.stances} stances, {args.points} points, {args.seeds} seeds", tables[field])
    low, high = anees_interval(args.seeds, 3)
    honest = f"NEES of A's last pose, where covariances are honest: {low:.2f}-{high:.2f} (95 %)"
    print(json.dumps(tables, indent=2) if args.json else honest)
    return 0


if __name__ == "__main__":
    sys.exit(main())
