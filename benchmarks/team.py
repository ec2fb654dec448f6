"""Teams of many robots, several of which move at once: honesty, what loops are worth, time and memory.

    python benchmarks/team.py [--seeds 24] [--json]     6 robots, 10 stances: NEES; against the best single chain
    python benchmarks/team.py --robots 10 --stances 30  the same of others
    python benchmarks/team.py --table [--large]         time and memory against the number of robots; 50 of 100 stances
    python benchmarks/team.py --size 50 100             that row alone
    python benchmarks/team.py --blink [--clock 0.005]   white markers that blink, against coloured ones

Mounts are wrong by 0.5 deg and 3 mm, the floor by 0.1 deg (one sigma each), 0.3 px, about 100 points a pair. The best
single chain is what the surest way from the reference to each pose makes of the same measurements, one for each pose.
"""

import argparse
import json
import os
import resource
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from unittest.mock import patch

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `coloc` does, before numpy is there

import numpy as np
from monte_carlo import MemoryRun, anees_interval, over_seeds, truth_of

from coloc_graph.backend import Estimate, PoseGraph, joint
from coloc_graph.backend.chain import spanning_tree
from coloc_graph.evaluation import align, nees_of
from coloc_graph.frontend import StanceTracks, Track
from coloc_graph.frontend.images.detection import Blobs
from coloc_graph.frontend.stance_tracks import stance_plane
from coloc_graph.frontend.tracks.marker_pairs import markers_of_movers
from coloc_graph.geometry.lie import se3_inverse, se3_log
from coloc_graph.measurements import RelativePose
from coloc_graph.pipeline import incremental as stance_solver
from coloc_graph.pipeline.batch import SolveOptions, solve
from coloc_graph.simulation import Imperfections, reference_team
from coloc_graph.simulation.blinking import with_codes
from coloc_graph.simulation.scenarios import team_of
from coloc_graph.simulation.teams import build_team_world
from coloc_graph.simulation.tracks import observe
from coloc_graph.simulation.world import World, stream

WRONG = Imperfections(mount_sigma_deg=0.5, height_sigma=0.003, floor_sigma_deg=0.1)
EXCHANGED = 0.1  # share of the homographies that are replaced by those of other robots
FAR_OFF = 5.0  # standard deviations by which such a relative pose is off at least


def world_of(robots: int, stances: int, seed: int, at_once: int | None = None) -> World:
    """Simulate the team of a seed, as `coloc simulate team`."""
    what = team_of(robots, at_once, stances, stream(seed, "formation"))
    return build_team_world(what, seed=seed, imperfections=WRONG)


@dataclass(frozen=True)
class Figures:
    """Figures of a run.

    NEES per degree of freedom of one pose, and of all on average; RMS errors of the team and of the single chain, and
    those predicted by their covariances [m]; chi2 and dof.
    """

    last: float
    anees: float
    ate: float
    ate_chain: float
    promised: float
    promised_chain: float
    chi2: float
    dof: int


def of_seed(seed: int, robots: int, stances: int) -> Figures:
    """One run, solved whole and as a tree."""
    world = world_of(robots, stances, seed)
    solution = solve(MemoryRun(world), SolveOptions())
    graph = solution.estimate.graph
    tied = {id(step.link) for step in spanning_tree(graph, graph.links)}
    alone = joint(replace(graph, measurements=tuple(m for m in graph.measurements if id(m) in tied)), reject=False)
    whole, chained = (_errors(one, world) for one in (solution.estimate, alone))
    # of one robot's last pose at rest, far from the reference
    robot = world.scenario.observers(stances - 1)[-1]
    true = align(solution.estimate.trajectories, truth_of(world), world.team.reference, on_floor=True)
    last = nees_of(solution.estimate.trajectories[robot], true[robot], [2, 3, 4])[-1]
    return Figures(
        float(last), whole[2], whole[0], chained[0], whole[1], chained[1], solution.estimate.chi2, solution.estimate.dof
    )


def _errors(estimate: Estimate, world: World) -> tuple[float, float, float]:
    """RMS position error of all robots that stand, what the covariances say it is [m], and the average NEES."""
    true = align(estimate.trajectories, truth_of(world), world.team.reference, on_floor=True)
    squared, variances, nees = [], [], []
    for robot, trajectory in estimate.trajectories.items():
        assert trajectory.stances is not None
        assert trajectory.covariances is not None
        stood = np.array([robot in world.stances[k].observers for k in trajectory.stances])
        off = trajectory.positions - true[robot][:, :3, 3]
        squared.append((off[stood, :2] ** 2).sum(axis=1))
        variances.append(np.trace(trajectory.covariances[stood, 3:5, 3:5], axis1=1, axis2=2))
        nees.append(nees_of(trajectory, true[robot], [2, 3, 4]))
    rms = (float(np.sqrt(np.concatenate(parts).mean())) for parts in (squared, variances))
    return *rms, float(np.concatenate(nees).mean())


def honesty(seeds: int, robots: int, stances: int) -> dict[str, object]:
    """Over seeds."""
    rows = over_seeds(partial(of_seed, robots=robots, stances=stances), range(seeds))
    low, high = anees_interval(seeds, 3)
    ate, chain = (np.sqrt(np.mean(np.square([getattr(r, n) for r in rows]))) for n in ("ate", "ate_chain"))
    promised, promised_chain = (
        np.sqrt(np.mean(np.square([getattr(r, n) for r in rows]))) for n in ("promised", "promised_chain")
    )
    return {
        "robots": robots,
        "stances": stances,
        "seeds": seeds,
        "nees_of_one_pose": float(np.mean([r.last for r in rows])),
        "interval_95": [low, high],
        "anees_of_all": float(np.mean([r.anees for r in rows])),
        "chi2_per_dof": sum(r.chi2 for r in rows) / sum(r.dof for r in rows),
        "rms_error_cm": 100 * float(ate),
        "promised_cm": 100 * float(promised),
        "rms_error_of_chain_cm": 100 * float(chain),
        "promised_of_chain_cm": 100 * float(promised_chain),
        "better_than_chain": float(chain / ate),
        "promised_better": float(promised_chain / promised),
    }


class Coloured(StanceTracks):
    """Track each mover by a colour of its own, a tracker for each."""

    def _of(self, robot: str, end: float) -> list[Track]:
        tracks: list[Track] = []
        for mover in self.stance.movers:
            tracker = self._tracker(robot, [mover])
            for one in self.run.detections(robot, self.stance.start, end):
                own = np.array([marker.startswith(f"{mover}/") for marker in one.markers], bool)
                tracker.take(one.time, Blobs(one.uv, one.covariance, one.flags, one.peak, one.area)[own])
            spans = [markers.span] if (markers := self.run.team[mover].markers) and markers.span else []
            plane = stance_plane(self.run, self.stance, robot)
            own_tracks = markers_of_movers(tracker.tracks(), self.run.team[robot].camera, [plane], spans, 1)
            bodies = max((track.body for track in tracks), default=-1) + 1
            tracks += [replace(one, mover=mover, body=one.body + bodies * (one.body >= 0)) for one in own_tracks]
        return tracks


def blinking_seed(seed: int, robots: int, stances: int, clock: float) -> list[dict[str, float]]:
    """Of one run: errors, promises and NEES, where the movers have colours and where they are white and blink."""
    what = team_of(robots, 2, stances, stream(seed, "formation"))
    wrong = replace(WRONG, clock_offset=clock, time_jitter=0.002 if clock else 0.0)
    rows = []
    for blinks in (False, True):
        team = reference_team(names=what.names)
        team = with_codes(team) if blinks else team
        world = build_team_world(what, seed=seed, points=2000, imperfections=wrong, team=team)
        run = MemoryRun(world)
        with patch.object(stance_solver, "StanceTracks", StanceTracks if blinks else Coloured):
            solution = solve(run, SolveOptions())
        rms, promised, anees = _errors(solution.estimate, world)
        poses = [m.relative_pose for m in solution.measurements if m.relative_pose is not None]
        row = {"square": rms**2, "promised": promised**2, "anees": anees, "homographies": solution.count.used,
               "points": sum(m.homography.points for m in solution.measurements),
               "spans": sum(len(pose.spans) for pose in poses),
               "chi2": solution.estimate.chi2, "dof": solution.estimate.dof}  # fmt: skip
        rows.append(row | (_whose(run, world) if blinks else {}))
    return rows


def _whose(run: MemoryRun, world: World) -> dict[str, float]:
    """Count samples of tracks of the right robot, of none, and of a wrong one."""
    right = undecided = wrong = 0
    for k, stance in enumerate(run.stances):
        tracks = StanceTracks(run, stance)
        for seen in observe(world, k):
            for track in tracks.of(seen.robot):
                middle = len(track) // 2
                at = seen.uv[np.argmin(np.abs(seen.stamps - track.times[middle]))]
                owner = seen.markers[np.nanargmin(np.abs(at - track.uv[middle]).sum(axis=1))].split("/")[0]
                right += len(track) * (track.mover == owner)
                undecided += len(track) * (not track.mover)
                wrong += len(track) * (track.mover not in ("", owner))
    return {"right": right, "undecided": undecided, "wrong": wrong}


def blink(seeds: int, clock: float, robots: int = 6, stances: int = 10) -> dict[str, dict[str, float]]:
    """Over seeds."""
    rows = over_seeds(partial(blinking_seed, robots=robots, stances=stances, clock=clock), range(seeds), processes=1)
    found = {}
    for n, what in enumerate(("coloured", "blinking")):
        mean = {name: float(np.mean([row[n][name] for row in rows])) for name in rows[0][n]}
        mean["rms_error_cm"], mean["promised_cm"] = (100 * mean.pop(name) ** 0.5 for name in ("square", "promised"))
        mean["chi2_per_dof"] = mean.pop("chi2") / mean.pop("dof")
        found[what] = mean
    return found


def exchanged(graph: PoseGraph, share: float) -> tuple[PoseGraph, set[int]]:
    """Graph in which a share of the relative poses is that of other robots, and their indices in its measurements."""
    rng = np.random.default_rng(0)
    poses = [n for n, one in enumerate(graph.measurements) if isinstance(one, RelativePose)]
    taken, wrong = list(graph.measurements), set[int]()
    for n in rng.permutation(poses).tolist():
        own, other = graph.measurements[n], graph.measurements[int(rng.choice(poses))]
        assert isinstance(own, RelativePose)
        assert isinstance(other, RelativePose)
        off = se3_log(se3_inverse(own.T_i_j) @ other.T_i_j)
        if off @ np.linalg.solve(own.covariance, off) > FAR_OFF**2 and len(wrong) < share * len(poses):
            taken[n] = replace(other, stance=own.stance, robot_i=own.robot_i, robot_j=own.robot_j)
            wrong.add(n)
    return replace(graph, measurements=tuple(taken)), wrong


def sized(robots: int, stances: int) -> dict[str, float]:
    """Time and memory of one run, from detections in memory, in a process of its own."""
    world = world_of(robots, stances, 0)
    run = MemoryRun(world)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.process_time()  # of this process alone, whatever else the machine does
    solution = solve(run, SolveOptions())
    taken = time.process_time() - started
    graph = replace(solution.estimate.graph)  # nothing of it is ready
    started = time.process_time()
    joint(graph)
    graph_s = time.process_time() - started
    spoilt, wrong = exchanged(graph, EXCHANGED)
    started = time.process_time()
    estimate = joint(spoilt)
    spoilt_s = time.process_time() - started
    gone = {id(one.measurement) for one in estimate.rejected}
    rejected = {n for n, one in enumerate(spoilt.measurements) if id(one) in gone}
    accuracy = _errors(solution.estimate, world)
    return {
        "robots": robots,
        "stances": stances,
        "poses": len(solution.estimate.graph.nodes),
        "homographies": solution.count.used,
        "seconds": taken,
        "front_end_s": taken - graph_s,
        "graph_s": graph_s,
        "exchanged_s": spoilt_s,
        "exchanged": len(wrong),
        "found": len(rejected & wrong),
        "right_rejected": len(rejected - wrong),
        "exchanged_ate_cm": 100 * _errors(estimate, world)[0],
        "mib_before": before / 1024,
        "mib_at_most": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "ate_cm": 100 * accuracy[0],
        "anees": accuracy[2],
        "chi2_per_dof": solution.estimate.chi2 / solution.estimate.dof,
    }


def table(sizes: Sequence[tuple[int, int]]) -> list[dict[str, float]]:
    """Rows of `sized`, one process each."""
    rows = []
    for robots, stances in sizes:
        with get_context("spawn").Pool(1) as pool:
            rows.append(pool.apply(sized, (robots, stances)))
        print("  ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--robots", type=int, default=6)
    parser.add_argument("--stances", type=int, default=10)
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--large", action="store_true", help="50 robots, 100 stances, too")
    parser.add_argument("--size", type=int, nargs=2, metavar=("ROBOTS", "STANCES"), help="one row of the table")
    parser.add_argument("--blink", action="store_true")
    parser.add_argument("--clock", type=float, default=0.0, help="offset of the robots' clocks, s")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.size:
        found: object = table([tuple(options.size)])
    elif options.table:
        found = table([(n, 30) for n in (3, 5, 10, 20)] + [(50, 30), (50, 100)][: 1 + options.large])
    elif options.blink:
        found = blink(options.seeds, options.clock)
    else:
        found = honesty(options.seeds, options.robots, options.stances)
    print(json.dumps(found, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
