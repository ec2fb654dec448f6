"""Our graphs in GTSAM's own optimiser: by how much its poses and sigmas differ from ours.

    python benchmarks/stock_solvers.py [--stances 40] [--only NAME]
    python benchmarks/stock_solvers.py --mrclam DIR     a ranging run instead

Of each run `graph.g2o` is read by GTSAM's readG2o, and `coloc export gtsam` by a program that imports nothing of
coloc-graph; both begin at perturbed poses.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import gtsam
import numpy as np

from coloc_graph import SolveOptions, open_run, solve
from coloc_graph.exchange.g2o_writer import write_g2o
from coloc_graph.exchange.gtsam_files import gtsam_files, unpack_gtsam, write_gtsam
from coloc_graph.exchange.mrclam import import_mrclam
from coloc_graph.exchange.ranging_factors import ranging_gtsam_files
from coloc_graph.simulation import Imperfections, simulate

STARTS = np.array([0.01, 0.01, 0.02, 0.05, 0.05, 0.02])  # rad, m: sigmas of the errors of the initial poses
WRONG = Imperfections(mount_sigma_deg=1.0, height_sigma=5e-3, span_sigma=1e-4, floor_sigma_deg=0.1)

#: Runs in GTSAM's own process: `out.npz` of keys, poses, and covariances, from the files of one folder.
BARE = """
import sys
sys.path.insert(0, sys.argv[1])
import numpy as np
import solve
graph, values, names = solve.load()
found, iterations = solve.solve(graph, solve.perturbed(values, names, 0.05))
keys = [key for key, (kind, _) in names.items() if "pose" in kind]
keys = keys[:: -(-len(keys) // 1000)]
covariances = solve.covariances(graph, found, names, keys)
assert "coloc_graph" not in sys.modules and iterations > 0
at = found.atPose3 if names[keys[0]][0] == "pose" else found.atPose2
np.savez(sys.argv[2], keys=np.array(keys, np.uint64), T=[at(key).matrix() for key in keys],
         C=[covariances[key] for key in keys], of=[names[key][1] for key in keys], iterations=iterations)
"""


def runs(stances: int):
    """Yield names and arguments of `simulate`."""
    yield "hallway, tracks", ("hallway",), {"stances": stances}
    yield "hallway, images", ("hallway",), {"stances": min(stances, 10), "depth": "images"}
    yield "landmarks", ("landmarks",), {"length": max(0.25 * stances, 12.0), "laps": 1}
    yield "team of 6", ("team",), {"robots": 6, "stances": min(stances, 12)}


def of_g2o(estimate, folder: Path) -> tuple[int, float]:
    """Iterations of a stock optimiser on graph.g2o, and the largest distance of its poses from ours [m]."""
    write_g2o(estimate, folder / "graph.g2o")
    factors, values = gtsam.readG2o(str(folder / "graph.g2o"), True)
    factors.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    rng, start, keys = np.random.default_rng(0), gtsam.Values(), list(values.keys())
    for key in keys:
        start.insert(key, values.atPose3(key).retract((key != 0) * STARTS * rng.normal(size=6)))
    optimiser = gtsam.LevenbergMarquardtOptimizer(factors, start)
    found = optimiser.optimize()
    gtsam.Marginals(factors, found)
    off = [np.linalg.norm(found.atPose3(key).translation() - values.atPose3(key).translation()) for key in keys]
    return optimiser.iterations(), max(off)


def of_factors(estimate, folder: Path) -> tuple[int, float, float]:
    """Iterations of the script on the exported factors, and its largest differences in sigmas, and of sigmas."""
    write_gtsam(gtsam_files(estimate), folder / "factors.zip")
    unpack_gtsam(folder / "factors.zip", folder / "factors")
    subprocess.run([sys.executable, "-c", BARE, folder / "factors", folder / "out.npz"], check=True, cwd=folder)
    out = np.load(folder / "out.npz")
    places, off, ratio = {int(key): n for n, key in enumerate(out["keys"])}, 0.0, 0.0
    for robot, one in estimate.trajectories.items():
        for stance, T, C in zip(one.stances, one.T_world_body, one.covariances, strict=True):
            n = places[estimate.graph.key(robot, int(stance))]
            sigmas = np.sqrt(C.diagonal())
            off = max(off, np.abs(gtsam.Pose3(T).localCoordinates(gtsam.Pose3(out["T"][n])) / sigmas).max())
            ratio = max(ratio, np.abs(np.sqrt(out["C"][n].diagonal()) / sigmas - 1).max())
    return int(out["iterations"]), float(off), float(ratio)


def of_mrclam(data: Path, folder: Path) -> None:
    """Print the differences of the script on the factors of a ranging run, in sigmas, and of sigmas."""
    import_mrclam(data, folder / "run.mcap")
    run = open_run(folder / "run.mcap")
    estimate = solve(run).estimate
    write_gtsam(ranging_gtsam_files(estimate, run.team), folder / "factors.zip")
    unpack_gtsam(folder / "factors.zip", folder / "factors")
    subprocess.run([sys.executable, "-c", BARE, folder / "factors", folder / "out.npz"], check=True, cwd=folder)
    out = np.load(folder / "out.npz")
    rows = {of: n for n, of in enumerate(out["of"].tolist())}
    print("| robot | iterations | off by | sigmas differ by |\n|---|---|---|---|")
    for robot, one in estimate.trajectories.items():
        named = [f"{robot}@{number}" for number in estimate.ranging.numbers[robot].tolist()]
        own = [n for n, of in enumerate(named) if of in rows]  # a thousand of all robots' poses
        there = [rows[named[n]] for n in own]
        sigmas = np.sqrt(one.covariances[own][:, [3, 4, 2], [3, 4, 2]])
        theirs = np.sqrt(np.diagonal(out["C"][there], axis1=1, axis2=2))
        T = np.linalg.inv(one.T_world_body[own][:, [0, 1, 3]][:, :, [0, 1, 3]]) @ out["T"][there]
        off = np.column_stack([T[:, 0, 2], T[:, 1, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
        print(
            f"| {robot} | {out['iterations']} | {np.abs(off / sigmas).max():.4f} sigma "
            f"| {100 * np.abs(theirs / sigmas - 1).max():.3f} % |"
        )


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--stances", type=int, default=40, help="number of stances (default: 40)")
    parser.add_argument("--only", metavar="NAME", help="measure this run only, as `landmarks` (default: all)")
    parser.add_argument("--mrclam", type=Path, metavar="DIR", help="folder of a dataset of MR.CLAM")
    args = parser.parse_args()
    if args.mrclam is not None:
        with tempfile.TemporaryDirectory() as folder:
            of_mrclam(args.mrclam, Path(folder))
        return
    print("| run | method | g2o: iterations | off by | factors: iterations | off by | sigmas differ by |")
    print("|---|---|---|---|---|---|---|")
    for name, scenario, more in runs(args.stances):
        if args.only not in (None, name):
            continue
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "run.mcap"
            simulate(*scenario, path, seed=1, imperfections=WRONG, **more)
            for method in ("joint", "smooth"):
                place = Path(folder) / method
                place.mkdir()
                estimate = solve(open_run(path), SolveOptions(method=method)).estimate
                steps, metres = of_g2o(estimate, place)
                iterations, off, ratio = of_factors(estimate, place)
                print(
                    f"| {name} | {method} | {steps} | {1e3 * metres:.4f} mm | {iterations} | {off:.5f} sigma "
                    f"| {100 * ratio:.4f} % |", flush=True,
                )  # fmt: skip


if __name__ == "__main__":
    main()
