"""Measure single steps of two cameras in a messy world: right, unusable, or false.

    python benchmarks/messy.py [--runs 200] [--json]

Rendered images, 250 points at 10 fps: lamps and windows that saturate and flicker at 100 Hz, LEDs mirrored in the floor
at 60 %, a person with shining ankles who walks through. A pose is false where its error is beyond what 1 in 1,000,000
would be by its covariance, and by more than 3 cm or 1 deg. Beside it: the same steps in an orderly world.
"""

import argparse
import json
import tempfile
from collections import Counter
from functools import partial
from pathlib import Path

import gtsam
import numpy as np
from monte_carlo import over_seeds
from scipy.stats import chi2

from coloc_graph.frontend import FrontendOptions, measure_pair
from coloc_graph.geometry.lie import se3_inverse
from coloc_graph.run import open_run, read_truth
from coloc_graph.simulation import simulate

#: An error beyond this, and beyond 3 cm [m] or 1 deg [rad], is a false pose.
IMPROBABLE = float(chi2.ppf(1 - 1e-6, 6))
FAR = 0.03
TURNED = np.deg2rad(1.0)


def step(seed: int, *, messy: bool) -> dict[str, object]:
    """One run: the error of its relative pose, or why there is none."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        simulate("single-step", path, depth="images", seed=seed, messy=messy, l=float(rng.uniform(0.5, 1.0)),
                 theta_deg=float(rng.uniform(20, 40)))  # fmt: skip
        run, truth = open_run(path), read_truth(path)
        measured = measure_pair(run, run.stances[0], "A", "B", FrontendOptions())
        T = {}
        for robot in "AB":
            before = np.searchsorted(truth[robot].times, run.stances[0].start + 1e-6) - 1
            T[robot] = truth[robot].T_world_body[before]
    pose = measured.relative_pose
    if pose is None:
        return {"seed": seed, "why": measured.homography.unusable}
    xi = gtsam.Pose3.Logmap(gtsam.Pose3(pose.T_i_j).between(gtsam.Pose3(se3_inverse(T["A"]) @ T["B"])))
    squared = float(xi @ np.linalg.solve(pose.covariance + 1e-10 * np.eye(6), xi))
    far = np.linalg.norm(xi[3:]) > FAR or np.linalg.norm(xi[:3]) > TURNED
    return {
        "seed": seed,
        "points": measured.homography.points,
        "off_mm": 1e3 * float(np.linalg.norm(xi[3:])),
        "off_deg": float(np.rad2deg(np.linalg.norm(xi[:3]))),
        "nees": squared / 6,
        "false": bool(squared > IMPROBABLE and far),
    }


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = {}
    for name, messy in (("messy", True), ("orderly", False)):
        rows = over_seeds(partial(step, messy=messy), range(options.runs))
        there = [row for row in rows if "off_mm" in row]
        found[name] = {
            "runs": len(rows),
            "poses": len(there),
            "false": [row for row in there if row["false"]],
            "points_median": float(np.median([row["points"] for row in there])),
            "off_mm_rms": float(np.sqrt(np.mean([row["off_mm"] ** 2 for row in there]))),
            "off_mm_worst": max(row["off_mm"] for row in there),
            "off_deg_rms": float(np.sqrt(np.mean([row["off_deg"] ** 2 for row in there]))),
            "anees": float(np.mean([row["nees"] for row in there])),
            "why": Counter(str(row["why"])[:60] for row in rows if "why" in row).most_common(),
        }
    print(json.dumps(found, indent=None if options.json else 2))


if __name__ == "__main__":
    main()
