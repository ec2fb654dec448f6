"""MR.CLAM datasets: batch and incremental against a centralised EKF, with and without the map and the other robots.

    python benchmarks/mrclam.py --data DIR      DIR holds Barcodes.dat, Robot1_Odometry.dat, ...

The EKF is that of `coloc_graph.backend.planar` (robots, landmarks, what is off of wheels and sensors, in one state),
and the same without calibration, as filters on these data usually are. What is thought at the time is compared at the
same instants: where the incremental estimate has just taken in what was measured. Seconds are of one processor, from
the run on disk to the estimate (of the EKF without reading).

NEES of the batch is by robot, of positions and of headings, with 95 % intervals by a bootstrap of blocks of 60 s. The
true heading of R1 steps by 5 deg and more from one frame of the motion capture to the next: NEES of headings is also
given without the blocks in which the truth does so.
"""

import argparse
import tempfile
import time
from collections.abc import Mapping
from dataclasses import replace as with_new
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from coloc_graph.backend.floor_poses import trajectory
from coloc_graph.backend.landmarks import StaticPose
from coloc_graph.backend.planar import filter_forward
from coloc_graph.evaluation import align, evaluate
from coloc_graph.exchange.mrclam import import_mrclam
from coloc_graph.frontend.keyframes import keyframes_of
from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.geometry.trajectory import Trajectory
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.run import Run, open_run, read_truth

BLOCK = 60.0  # s
DRAWS = 4000
MIN_STEP = float(np.deg2rad(5.0))  # rad, of a true heading within a frame or two
MAX_GAP, AROUND = 0.2, 0.3  # s, between the frames of a step, and on both sides of it
MIN_FRAMES = 6  # on each side of a step


def uncalibrated(run: Run) -> Run:
    """The run of a team that takes wheels and sensors for exact."""
    robots = tuple(
        replace(
            robot,
            ranging=replace(
                robot.ranging,
                **dict.fromkeys(("offset_sigma", "scale_sigma", "bearing_offset_sigma_deg"), 0.0),
                **dict.fromkeys(("depth_sigma", "robot_offset_sigma", "place_sigma"), 0.0),
            ),
            wheels=replace(robot.wheels, delay=0.0, scale_sigma=0.0, turn_scale_sigma=0.0, delay_sigma=0.0),
        )
        for robot in run.team.robots
    )
    return with_new(run, team=replace(run.team, robots=robots))


def filtered(run: Run, between_robots: bool, at: Mapping[str, Trajectory]) -> tuple[dict[str, Trajectory], float]:
    """Run the EKF; return its estimates at the instants of other trajectories, and its time [s]."""
    keyframes = keyframes_of(run, between_robots=between_robots)
    started = time.process_time()
    found = filter_forward(run.team, keyframes)
    seconds = time.process_time() - started
    out = {}
    for n, name in enumerate(keyframes.robots):
        wanted = np.isin(keyframes.times[n], at[name].times) & np.isfinite(found.poses[n][:, 0])
        poses, C = found.poses[n][wanted], found.covariances[n][wanted].copy()
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        R = np.zeros((len(poses), 3, 3))
        R[:, 0, 0], R[:, 0, 1], R[:, 1, 0], R[:, 1, 1], R[:, 2, 2] = c, s, -s, c, 1.0
        out[name] = trajectory(name, keyframes.times[n][wanted], poses, R @ C @ R.mT)
    return out, seconds


def report(label: str, trajectories: Mapping[str, Trajectory], run: Run, on_map: bool, seconds: float) -> np.ndarray:
    """Print a row; RMS position errors by robot [m]."""
    how = "none" if on_map else "team"
    true = align(trajectories, read_truth(run.path), run.team.reference, on_floor=True, alignment=how)
    accuracy = evaluate(trajectories, true, on_floor=True, alignment=how)
    errors = np.array([row.translation.rmse for row in accuracy.robots])
    nees = "-" if accuracy.anees is None else f"{accuracy.anees:.1f}"
    heading = np.sqrt(np.mean([row.rotation_deg.rmse**2 for row in accuracy.robots]))
    per_robot = " ".join(f"{100 * one:5.1f}" for one in errors)
    print(f"{label:38s} {per_robot}   {heading:4.1f} deg   NEES {nees:>4s}   {seconds:5.1f} s", flush=True)
    return errors


def truth_steps(path: Path) -> NDArray[np.float64]:
    """Times [s] at which a heading of the motion capture steps: by more than `MIN_STEP` against its rates around."""
    t, yaw = np.loadtxt(path, usecols=(0, 3)).T
    yaw, found = np.unwrap(yaw), []
    for i in np.flatnonzero((np.abs(np.diff(yaw)) > MIN_STEP / 2) & (np.diff(t) < MAX_GAP)):
        before, after = (t > t[i] - AROUND) & (t <= t[i]), (t > t[i]) & (t < t[i + 1] + AROUND)
        if min(before.sum(), after.sum()) < MIN_FRAMES:
            continue
        lines = [np.polyfit(t[part] - at, yaw[part], 1) for part, at in ((before, t[i]), (after, t[i + 1]))]
        expected = (lines[0][0] + lines[1][0]) / 2 * (t[i + 1] - t[i])
        if abs(lines[1][1] - lines[0][1] - expected) > MIN_STEP:
            found.append(t[i])
    return np.array(found)


def report_nees(trajectories: Mapping[str, Trajectory], run: Run, data: Path) -> None:
    """Print NEES of positions and of headings by robot."""
    true = align(trajectories, read_truth(run.path), run.team.reference, on_floor=True, alignment="none")
    rng = np.random.default_rng(0)
    for name, found in trajectories.items():
        there = np.isfinite(true[name]).all(axis=(1, 2))
        T, C, times = se3_inverse(found.T_world_body[there]) @ true[name][there], found.covariances, found.times[there]
        assert C is not None
        C, p = C[there], T[:, :2, 3]
        place = np.einsum("ni,nij,nj->n", p, np.linalg.inv(C[:, 3:5, 3:5]), p) / 2
        heading = np.arctan2(T[:, 1, 0], T[:, 0, 0]) ** 2 / C[:, 2, 2]
        block = ((times - times[0]) // BLOCK).astype(int)
        steps = truth_steps(data / f"Robot{name.removeprefix('R')}_Groundtruth.dat")
        sound = ~np.isin(block, (steps - times[0]) // BLOCK)
        of_places, of_headings = (_by_blocks(one, block, rng) for one in (place, heading))
        of_sound = _by_blocks(heading[sound], block[sound], rng)
        print(
            f"{name}: NEES of positions {of_places}, of headings {of_headings}; "
            f"{len(steps)} steps of the true heading, without their blocks {of_sound}"
        )


def _by_blocks(values: NDArray[np.float64], block: NDArray[np.int64], rng: np.random.Generator) -> str:
    """Mean of values with its 95 % interval by a bootstrap of blocks."""
    numbers = np.unique(block)
    sums, counts = (np.array([part[block == n].sum() for n in numbers]) for part in (values, np.ones(len(values))))
    drawn = rng.integers(0, len(numbers), (DRAWS, len(numbers)))
    low, high = np.quantile(sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1), (0.025, 0.975))
    return f"{values.mean():.2f} ({low:.2f}-{high:.2f})"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", required=True, metavar="DIR")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for map_known in (True, False):
            path = Path(folder) / f"{map_known}.mcap"
            summary = import_mrclam(args.data, path, map_known=map_known)
            run = open_run(path)
            for between_robots in (True, False):
                print(
                    f"\nmap {'known' if map_known else 'unknown'}, {'with' if between_robots else 'without'} robots "
                    f"measuring each other; RMS position by robot [cm], {summary.seconds:.0f} s of data"
                )
                if not map_known and not between_robots:
                    continue  # one team is several worlds then
                started = time.process_time()
                batch = solve(run, SolveOptions(between_robots=between_robots))
                seconds = time.process_time() - started
                of_batch = report("batch", batch.estimate.trajectories, run, map_known, seconds)
                if map_known and between_robots:
                    report_nees(batch.estimate.trajectories, run, Path(args.data))
                started = time.process_time()
                one = solve(run, SolveOptions(incremental=True, between_robots=between_robots))
                of_incremental = time.process_time() - started
                of_one = report("incremental", one.estimate.trajectories, run, map_known, of_incremental)
                report("incremental, at its time", one.online, run, map_known, of_incremental)
                ekf, seconds = filtered(run, between_robots, one.online)
                report("EKF, calibrating", ekf, run, map_known, seconds)
                ekf, seconds = filtered(uncalibrated(run), between_robots, one.online)
                report("EKF", ekf, run, map_known, seconds)
                ratios = of_one / of_batch
                print(
                    f"incremental / batch {ratios.min():.2f}-{ratios.max():.2f}; incremental is "
                    f"{summary.seconds / of_incremental:.1f} times real time; chi2/dof of the batch "
                    f"{batch.estimate.chi2 / batch.estimate.dof:.2f}"
                )
                if not map_known:
                    _report_map(batch.estimate.landmarks, args.data)


def _report_map(landmarks: Mapping[str, StaticPose], data: str) -> None:
    """Errors of the landmarks after one rigid alignment."""
    truth = {f"L{int(row[0])}": row[1:3] for row in np.loadtxt(Path(data) / "Landmark_Groundtruth.dat")}
    p = np.array([one.planar[:2] for one in landmarks.values()])
    q = np.array([truth[name] for name in landmarks])
    p0, q0 = p - p.mean(axis=0), q - q.mean(axis=0)
    angle = np.arctan2((p0[:, 0] * q0[:, 1] - p0[:, 1] * q0[:, 0]).sum(), (p0 * q0).sum())
    c, s = np.cos(angle), np.sin(angle)
    off = np.hypot(*(p0 @ np.array([[c, s], [-s, c]]) - q0).T)
    print(
        f"landmarks, after one alignment: RMS {100 * np.sqrt((off**2).mean()):.1f} cm, at most {100 * off.max():.1f} cm"
    )


if __name__ == "__main__":
    main()
