"""Coverage of the 95 % interval of a robot's NEES in honest runs: drifting, correlated, and real estimates.

    python benchmarks/nees_interval.py [--draws 2000] [--seeds 60] [--json]

By the effective number of poses, and, to compare, by counting all of them. The hallway is solved jointly from tracks
with mounts that are wrong as the team says.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from monte_carlo import over_seeds, solved
from numpy.typing import NDArray
from scipy.stats import chi2

from coloc_graph.evaluation import effective_poses
from coloc_graph.pipeline.batch import SolveOptions
from coloc_graph.simulation import Imperfections, build_world, scenario

Array = NDArray[np.float64]
DOF = 3
#: Mean NEES, poses, effective poses.
Drawn = tuple[float, int, float]


def drift(rng: np.random.Generator, n: int) -> Array:
    """Whitened errors (n, 3) that are a random walk's."""
    steps = np.cumsum(rng.normal(size=(n, DOF)), axis=0)
    return np.asarray(steps / np.sqrt(np.arange(1, n + 1))[:, None])


def fading(rng: np.random.Generator, n: int, keep: float) -> Array:
    """Whitened errors (n, 3) of which each pose keeps this part of the one before."""
    z = rng.normal(size=(n, DOF))
    for k in range(1, n):
        z[k] = keep * z[k - 1] + np.sqrt(1 - keep**2) * z[k]
    return z


def of_errors(draw: Callable[[np.random.Generator, int], Array], n: int, draws: int) -> Iterator[Drawn]:
    """Evaluate whitened errors that were drawn."""
    rng = np.random.default_rng(n)
    for _ in range(draws):
        z = draw(rng, n)
        yield float((z**2).mean()), n, effective_poses(z)


def of_hallway(seed: int, stances: int) -> list[Drawn]:
    """Evaluate the robots of one run."""
    wrong = Imperfections(mount_sigma_deg=0.5, height_sigma=0.003, floor_sigma_deg=0.1)
    _, accuracy = solved(
        build_world(scenario("hallway", stances=stances), seed=seed, imperfections=wrong), SolveOptions()
    )
    return [(row.nees.mean, row.nees.poses, row.nees.effective) for row in accuracy.robots if row.nees is not None]


def row_of(name: str, drawn: list[Drawn]) -> dict[str, object]:
    """Share of the means that are in their intervals [%]."""
    mean, poses, effective = (np.array(part, float) for part in zip(*drawn, strict=True))
    inside = []
    for count in (effective, poses):
        low, high = chi2.ppf([[0.025], [0.975]], DOF * count) / (DOF * count)
        inside.append(100 * float(np.mean((low < mean) & (mean < high))))
    return {
        "errors": name,
        "trajectories": len(drawn),
        "poses": int(np.median(poses)),
        "effective_median": float(np.median(effective)),
        "mean_nees": float(mean.mean()),
        "inside_percent": inside[0],
        "inside_percent_counting_all": inside[1],
    }


def main() -> None:
    """Run it, print it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--seeds", type=int, default=60)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    kinds = {"drift": drift} | {f"keeping {keep:g}": partial(fading, keep=keep) for keep in (0.0, 0.5, 0.9, 0.99)}
    rows = [
        row_of(name, list(of_errors(draw, n, options.draws if n < 1000 else options.draws // 4)))
        for n in (20, 100, 1000)
        for name, draw in kinds.items()
    ]
    runs = over_seeds(partial(of_hallway, stances=20), range(3000, 3000 + options.seeds))
    rows.append(row_of("hallway, 20 stances", [one for run in runs for one in run]))
    if options.json:
        print(json.dumps(rows, indent=1))
        return
    for row in rows:
        print("  ".join(f"{key} {value:.3g}" if isinstance(value, float) else str(value) for key, value in row.items()))


if __name__ == "__main__":
    main()
