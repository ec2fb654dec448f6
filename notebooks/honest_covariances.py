# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Honest covariances
#
# A covariance is a claim about errors. Simulated runs have a truth, so the claim can be checked: the squared error of
# a pose in units of its covariance, per degree of freedom (NEES), has the mean 1.

# %%
import tempfile
from pathlib import Path

import numpy as np

import coloc_graph as cg
from coloc_graph.run import read_truth
from coloc_graph.simulation import Imperfections

RUNS = 4
folder = Path(tempfile.mkdtemp())


def nees(seed, imperfections, method):
    """NEES per degree of freedom, and chi2/dof, of one simulated run."""
    path = folder / "run.mcap"
    cg.simulate("hallway", path, stances=4, seed=seed, points=60, imperfections=imperfections)
    solution = cg.solve(cg.open_run(path), cg.SolveOptions(method=method))
    estimated = solution.estimate.trajectories
    true = cg.align(estimated, read_truth(path), "A", on_floor=True)
    accuracy = cg.evaluate(estimated, true, on_floor=True, reference="A")
    return accuracy.anees, solution.estimate.chi2 / solution.estimate.dof


# %% [markdown]
# ## Mounts as stated, and mounts that are off by a degree
#
# `smooth` takes the mounts as team.toml states them, but knows their tolerance; `joint` estimates them along.

# %%
worlds = {
    "as stated": Imperfections(),
    "mounts off by 1 deg and 5 mm, floor by 0.1 deg": Imperfections(
        mount_sigma_deg=1.0, height_sigma=0.005, floor_sigma_deg=0.1
    ),
}
for name, imperfections in worlds.items():
    print(name)
    for method in ("smooth", "joint"):
        found = np.array([nees(seed, imperfections, method) for seed in range(RUNS)])
        print(f"  {method}: NEES {found[:, 0].mean():.2f} (single runs {np.round(np.sort(found[:, 0]), 1)}), "
              f"chi2/dof {found[:, 1].mean():.2f}")  # fmt: skip

# %% [markdown]
# Single runs scatter: the poses of one run share their errors, so that one run is not many samples. `coloc evaluate`
# prints the interval in which 95 % of honest runs lie. Judge by many runs: `benchmarks/joint.py --honesty 200` takes
# 200 of 40 stances.
