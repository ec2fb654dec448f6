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
# # Your own recording, step by step
#
# From images to a pose, with a look at each step in between: lights in an image, tracks, pairs, the homography, the
# pose. The images are rendered here, so that the truth is known; with your own, begin at `open_run`.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

import coloc_graph as cg
from coloc_graph.frontend import FrontendOptions, measure_pair
from coloc_graph.run import read_truth

path = Path(tempfile.mkdtemp()) / "run.mcap"
cg.simulate("hallway", path, depth="images", stances=1, seed=1, points=160)
run = cg.open_run(path)
stance = run.stances[0]
print(stance)

# %% [markdown]
# ## What the cameras saw

# %%
fig, axes = plt.subplots(1, 2, figsize=(9, 3.4))
for ax, robot in zip(axes, stance.observers, strict=True):
    image = next(iter(run.images(robot, stance.start, stance.end)))
    ax.imshow(image.pixels, cmap="gray", vmin=0, vmax=120)
    ax.set(title=f"{robot}, first image", xticks=[], yticks=[])
display(fig)
plt.close(fig)

# %% [markdown]
# Two lights on a dark body; below them their reflections in the floor, and shining specks. The front end detects
# bright blobs, tracks them, and drops what stands still or lies below the floor.
#
# ## The pair is measured
#
# `measure_pair` pairs the tracks of both cameras in time, finds which track of one is which of the other, fits the
# homography by maximum likelihood, and gives the relative pose with its covariance.

# %%
measured = measure_pair(run, stance, *stance.observers, FrontendOptions())
H = measured.homography
print(f"{H.points} points, {H.inliers} inliers, chi2/dof {H.chi2 / H.dof:.2f}")
print(np.round(H.H_j_i, 4))

# %%
pairs = measured.correspondences
fig, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True)
for ax, uv, robot in zip(axes, (pairs.uv_i, pairs.uv_j), stance.observers, strict=True):
    ax.plot(*uv.T, ".", markersize=3)
    ax.set(title=f"points in {robot}", xlim=(0, 320), ylim=(240, 0))
display(fig)
plt.close(fig)

# %% [markdown]
# ## The result, and the truth

# %%
solution = cg.solve(run)
estimated = solution.estimate.pose("B", 0)
sigmas = np.sqrt(np.diag(solution.estimate.covariance("B", 0)))
truth = read_truth(path)
T_A, T_B = (truth[robot].T_world_body[0] for robot in "AB")
true = np.linalg.inv(T_A) @ T_B
print(f"B in A: estimated ({estimated.x():.4f}, {estimated.y():.4f}) m, true ({true[0, 3]:.4f}, {true[1, 3]:.4f}) m")
print(f"sigma {1e3 * sigmas[3]:.2f} and {1e3 * sigmas[4]:.2f} mm")
for warning in solution.warnings:
    print(warning)
