"""The back end against bare GTSAM programs with the same factors: batch, incremental, memory; and wrong homographies.

    python benchmarks/backend.py                the table, and 100,000 stances
    python benchmarks/backend.py --quick        smaller runs
    python benchmarks/backend.py --data DIR     also sphere2500.g2o and input_M3500_g2o.g2o in DIR

Times are of one thread's processor, so that a machine's other work does not count, and the two programs take turns.
"""

import argparse
import resource
import statistics
import time
from collections import defaultdict
from pathlib import Path

import gtsam
import numpy as np

from coloc_graph.backend import Estimator, PoseGraph, smooth
from coloc_graph.backend.solver import isam_parameters, lm_parameters, optimise, with_stack
from coloc_graph.exchange.g2o import read_g2o
from coloc_graph.measurements import Odometry
from coloc_graph.simulation.measured import MeasuredTeam, measured_team
from coloc_graph.team import Floor

FLOOR = Floor(tilt_sigma_deg=0.1)
#: How many stances about a length an update's time is the median of.
WINDOW = 50


def paper_team(stances: int, *, floor: Floor | None = FLOOR) -> MeasuredTeam:
    """Three robots that leap-frog as in the paper: homographies, and odometry where there is a floor."""
    return measured_team(3, stances, np.random.default_rng(0), floor=floor, rotating=False, sightings=False)


def graph_of(team: MeasuredTeam) -> PoseGraph:
    """The team's graph."""
    return PoseGraph(team.robots[0], team.robots, team.stances, team.measurements, team.floor)


class Bare:
    """A program with GTSAM alone: the keys are known, nothing is checked, gated, logged or diagnosed."""

    def __init__(self, floor: Floor | None) -> None:
        self.floor = floor
        self.tilt = 1e-6 if floor is None else np.deg2rad(floor.tilt_sigma_deg)
        self.level = gtsam.noiseModel.Gaussian.SqrtInformation(np.diag([1 / self.tilt, 1 / self.tilt, 0.0]), False)
        self.on_floor = gtsam.noiseModel.Diagonal.Precisions(np.array([0, 0, (self.tilt * 0.25) ** -2]))
        self.up = np.array([0.0, 0.0, 1.0])

    def pose(self, factors, key):
        """The priors of a pose."""
        if self.floor is not None:
            # AttitudeFactorPose3 would make sigmas of headings too small: `Factors.of_pose`
            factors.add(gtsam.MagPoseFactorPose3(key, self.up, 1.0, self.up, np.zeros(3), self.level))
            factors.add(gtsam.PoseTranslationPrior3D(key, np.zeros(3), self.on_floor))

    def gauge(self, factors, key):
        """The prior that holds the world."""
        sigmas = np.array([self.tilt, self.tilt, 1e-6, 1e-6, 1e-6, 1e-6 if self.floor is None else self.tilt * 0.25])
        factors.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))

    def between(self, factors, i, j, measured):
        """The factor of a measurement."""
        if isinstance(measured, Odometry):
            R = np.zeros((6, 6))
            R[2:5, 2:5] = np.linalg.cholesky(np.linalg.inv(measured.covariance)).T
            noise = gtsam.noiseModel.Gaussian.SqrtInformation(R)
        else:
            noise = gtsam.noiseModel.Gaussian.Covariance(measured.covariance)
        factors.add(gtsam.BetweenFactorPose3(i, j, gtsam.Pose3(measured.T_i_j), noise))

    def start(self, pose):
        """Return the initial pose."""
        if self.floor is None:
            return pose
        return gtsam.Pose3(gtsam.Rot3.Yaw(pose.rotation().yaw()), np.array([pose.x(), pose.y(), 0.0]))


def bare_batch(team, keyed, reference, covariances):
    """LM with QR over all, as many covariances as wanted."""
    bare, factors, values = Bare(team.floor), gtsam.NonlinearFactorGraph(), gtsam.Values()
    poses = {reference: gtsam.Pose3()}
    bare.gauge(factors, reference)
    for measured, i, j in sorted(keyed, key=lambda one: isinstance(one[0], Odometry)):
        if j not in poses:
            poses[j] = bare.start(poses[i].compose(gtsam.Pose3(measured.T_i_j)))
            bare.pose(factors, j)
        elif i not in poses:
            poses[i] = bare.start(poses[j].compose(gtsam.Pose3(measured.T_i_j).inverse()))
            bare.pose(factors, i)
        bare.between(factors, i, j, measured)
    for key, pose in poses.items():
        values.insert(key, pose)
    result = gtsam.LevenbergMarquardtOptimizer(factors, values, lm_parameters()).optimize()
    if covariances:
        isam = gtsam.ISAM2(isam_parameters())
        isam.update(factors, result)
        for key in poses:
            isam.marginalCovariance(key)
    return result


def keyed_measurements(team):
    """Measurements with their keys, and the reference's."""
    graph = graph_of(team)
    return [(m, *map(graph.pose_keys.key, m.ends)) for m in team.measurements], graph.reference_key


def clocked(work):
    """Its result, and the processor seconds of the process it took."""
    started = time.process_time()
    result = work()
    return result, time.process_time() - started


def batch(stances: int, repeats: int) -> None:
    """Poses and covariances of a whole run, in turns."""
    team = paper_team(stances)
    keyed, reference = keyed_measurements(team)
    ours, bare = [], []
    for _ in range(repeats):
        _, seconds = clocked(lambda: with_stack(stances, lambda: bare_batch(team, keyed, reference, True)))
        bare.append(seconds)
        estimate, seconds = clocked(lambda: smooth(graph_of(team)))
        ours.append(seconds)
    ratio = statistics.median(a / b for a, b in zip(ours, bare, strict=True))
    print(
        f"batch, {stances} stances, poses and all covariances: ours {min(ours):.2f} s, bare GTSAM {min(bare):.2f} s, "
        f"ratio {ratio:.2f} (chi2/dof {estimate.chi2 / estimate.dof:.3f})"
    )


def incremental(lengths: list[int], floor: Floor | None) -> None:
    """The time of an update at some lengths of a run, in turns."""
    team = paper_team(max(lengths), floor=floor)
    keyed, reference = keyed_measurements(team)
    of_stance = defaultdict(list)
    for measured, i, j in keyed:
        of_stance[max(stance for _, stance in measured.ends)].append((measured, i, j))
    bare, isam, known = Bare(floor), gtsam.ISAM2(isam_parameters()), set()
    estimator = Estimator(team.robots[0], team.robots, floor)
    ours, theirs = [], []
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for stance in team.stances:
        here = of_stance[stance.index]
        started = time.thread_time()
        factors, values, new = gtsam.NonlinearFactorGraph(), gtsam.Values(), {}
        if not known:
            new[reference] = gtsam.Pose3()
            bare.gauge(factors, reference)
        for measured, i, j in sorted(here, key=lambda one: isinstance(one[0], Odometry)):
            for a, b, T in ((i, j, gtsam.Pose3(measured.T_i_j)), (j, i, gtsam.Pose3(measured.T_i_j).inverse())):
                if b not in known and b not in new and (a in known or a in new):
                    at = new[a] if a in new else isam.calculateEstimatePose3(a)
                    new[b] = bare.start(at.compose(T))
                    bare.pose(factors, b)
            bare.between(factors, i, j, measured)
        for key, pose in new.items():
            values.insert(key, pose)
        isam.update(factors, values)
        known |= new.keys()
        for key in {key for _, i, j in here[-1:] for key in (i, j)}:
            isam.calculateEstimatePose3(key)
            isam.marginalCovariance(key)
        theirs.append(time.thread_time() - started)
        made = [measured for measured, _, _ in here]
        started = time.thread_time()
        estimator.add(stance, made)
        ours.append(time.thread_time() - started)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 1024
    on = "on a floor, with odometry" if floor else "without floor and odometry"
    for n in lengths:
        a, b = (1000 * statistics.median(of[max(0, n - WINDOW) : n]) for of in (ours, theirs))
        print(f"update at stance {n}, {on}: ours {a:.2f} ms, bare ISAM2 {b:.2f} ms, ratio {a / b:.2f}")
    print(
        f"  all {max(lengths)} stances: ours {sum(ours):.1f} s, bare {sum(theirs):.1f} s; both together {grown:.0f} MB"
    )


def huge(stances: int) -> None:
    """A run that is too long for GTSAM's recursion on an ordinary stack."""
    team = paper_team(stances, floor=None)
    started = time.perf_counter()
    estimate = smooth(graph_of(team))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    last = max(estimate.trajectories["A"].stances)
    off = np.linalg.norm(estimate.pose("A", int(last)).translation() - team.T_world_body["A", int(last)][:3, 3])
    sigma = np.sqrt(np.trace(estimate.covariance("A", int(last))[3:, 3:]))
    print(
        f"{stances} stances in batch with all covariances: {time.perf_counter() - started:.0f} s, peak {peak:.1f} GiB; "
        f"the end is off by {off:.0f} m of {last * 0.45:.0f} m, promised {sigma:.0f} m"
    )


def wrong(seeds: int) -> None:
    """Ten per cent of the homographies of six robots replaced by wrong ones."""
    found, total, false, squares = 0, 0, 0, []
    for seed in range(seeds):
        spoilt = measured_team(6, 20, np.random.default_rng(seed), floor=FLOOR, wrong=0.1)
        clean = measured_team(6, 20, np.random.default_rng(seed), floor=FLOOR)
        a, b = smooth(graph_of(spoilt)), smooth(graph_of(clean))
        refused, bad = {id(one.measurement) for one in a.rejected}, set(map(id, spoilt.wrong))
        found, total, false = found + len(refused & bad), total + len(bad), false + len(refused - bad)
        squares.append([_square(estimate, clean) for estimate in (a, b)])
    mean = np.mean(squares, axis=0)
    rng = np.random.default_rng(0)
    resampled = [np.mean(rng.choice(squares, len(squares)), axis=0) for _ in range(2000)]
    low, high = np.quantile([np.sqrt(one[0] / one[1]) for one in resampled], [0.025, 0.975])
    print(
        f"wrong homographies, 6 robots, {seeds} seeds: {found} of {total} found, {false} right ones refused; "
        f"ATE {100 * np.sqrt(mean[0]):.2f} cm, clean {100 * np.sqrt(mean[1]):.2f} cm, "
        f"ratio {np.sqrt(mean[0] / mean[1]):.3f} ({low:.3f}-{high:.3f})"
    )


def crowds(sizes: list[tuple[int, int]]) -> None:
    """Ten per cent of the homographies of large teams replaced by wrong ones."""
    for robots, stances in sizes:
        team = measured_team(robots, stances, np.random.default_rng(0), floor=FLOOR, wrong=0.1)
        estimate, seconds = clocked(lambda team=team: smooth(graph_of(team)))
        rejected, bad = {id(one.measurement) for one in estimate.rejected}, set(map(id, team.wrong))
        print(
            f"{robots} robots, {stances} stances, {len(team.measurements)} measurements: {seconds:.1f} s, "
            f"{len(rejected & bad)} of {len(bad)} wrong ones found, {len(rejected - bad)} right ones rejected"
        )


def forgetting(lengths: list[int]) -> None:
    """The time of an update of an estimator that forgets what is older than its lag, and its memory."""
    team = paper_team(max(lengths))
    of_stance = defaultdict(list)
    for measured in team.measurements:
        of_stance[max(stance for _, stance in measured.ends)].append(measured)
    estimator, seconds = Estimator(team.robots[0], team.robots, FLOOR, forgets=True), []
    for stance in team.stances:
        started = time.thread_time()
        estimator.add(stance, of_stance.pop(stance.index, ()))
        seconds.append(time.thread_time() - started)
        if stance.index + 1 in lengths:
            median = 1000 * statistics.median(seconds[-WINDOW:])
            pages = int(Path("/proc/self/statm").read_text().split()[1])  # of Linux
            megabytes = pages * resource.getpagesize() / 1e6
            print(
                f"forgetting, update at stance {stance.index + 1}: {median:.2f} ms, the process has {megabytes:.0f} MB"
            )


def _square(estimate, team) -> float:
    off = [estimate.pose(*node).translation() - T[:3, 3] for node, T in team.T_world_body.items()]
    return float(np.mean(np.sum(np.square(off), axis=1)))


def files(folder: Path) -> None:
    """Other people's graphs: the final error against GTSAM's own LM from the same start."""
    for name, solid in (("sphere2500.g2o", True), ("input_M3500_g2o.g2o", False)):
        graph = read_g2o(folder / name)
        values, _ = optimise(graph.factors, graph.values)
        theirs, start = gtsam.readG2o(str(folder / name), solid)
        theirs.push_back(_only(graph.factors, 0))
        error = theirs.error(gtsam.LevenbergMarquardtOptimizer(theirs, start).optimize())
        print(
            f"{name}: error {theirs.error(values):.6f}, GTSAM's LM {error:.6f}, {theirs.error(values) / error - 1:+.1e}"
        )


def _only(factors, index):
    one = gtsam.NonlinearFactorGraph()
    one.add(factors.at(index))
    return one


def main() -> None:
    """Everything that the arguments ask for."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--quick", action="store_true")
    arguments.add_argument("--data", type=Path)
    args = arguments.parse_args()
    batch(1000 if args.quick else 10_000, 3)
    incremental([100, 1000] if args.quick else [100, 1000, 10_000], FLOOR)
    incremental([100, 1000] if args.quick else [100, 1000, 10_000], None)
    forgetting([100, 1000] if args.quick else [100, 1000, 10_000])
    wrong(5 if args.quick else 40)
    crowds([(10, 30), (20, 30)] if args.quick else [(10, 30), (20, 30), (30, 30), (50, 30), (10, 100), (50, 100)])
    if args.data:
        files(args.data)
    if not args.quick:
        huge(100_000)


if __name__ == "__main__":
    main()
