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
# # Your own measurements in a graph
#
# No images and no run: stances and relative poses that you measured in your own way. Three robots leap-frog along a
# line.

# %%
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

from coloc_graph import Estimator, Floor, Odometry, PoseGraph, RelativePose, Stance, smooth
from coloc_graph.backend import diagnose

SIGMAS = np.array([0.002, 0.002, 0.005, 0.01, 0.01, 0.01])  # rotation [rad] first, then translation [m]
robots, rng = ("A", "B", "C"), np.random.default_rng(1)


def ahead(metres, sigmas=SIGMAS):
    """Pose this far ahead, with noise."""
    T = np.eye(4)
    T[:3, 3] = np.array([metres, 0.0, 0.0]) + sigmas[3:] * rng.standard_normal(3)
    return T


stances, measured = [], []
for k in range(6):
    behind, front, driver = (robots[(k + n) % 3] for n in range(3))
    stances.append(Stance(k, 10.0 * k, 10.0 * k + 5, (behind, front), (driver,), (behind,) if k else ()))
    measured.append(RelativePose(k, behind, front, ahead(1.0), np.diag(SIGMAS**2)))

# %% [markdown]
# ## Is everything tied together?
#
# `diagnose` answers before anything is solved. Here is the graph without its third measurement:

# %%
for part in diagnose(PoseGraph("A", robots, tuple(stances), (*measured[:2], *measured[3:]))):
    print(part)
print("the whole graph:", diagnose(PoseGraph("A", robots, tuple(stances), tuple(measured))) or "is connected")

# %% [markdown]
# ## The estimate

# %%
estimate = smooth(PoseGraph("A", robots, tuple(stances), tuple(measured), floor=Floor()))
fig, ax = plt.subplots(figsize=(8, 2.6))
for robot, stance in estimate.graph.nodes:
    pose, S = estimate.pose(robot, stance), estimate.covariance(robot, stance)
    ax.errorbar(pose.x(), pose.y(), 2 * S[4, 4] ** 0.5, 2 * S[3, 3] ** 0.5, fmt="o", color=f"C{robots.index(robot)}")
ax.set(xlabel="x [m]", ylabel="y [m]", title="2 sigma: the uncertainty grows along the chain")
display(fig)
plt.close(fig)

# %% [markdown]
# ## Odometry helps
#
# A robot that leaps from behind the team to its front drives three metres. Wheels that are good to 2 cm tie its two
# poses.

# %%
wheels = np.array([0.01, 0.02, 0.01])  # heading [rad], x, y [m]
sigmas = np.array([0.0, 0.0, wheels[0], *wheels[1:], 0.0])
odometry = [Odometry(robots[k % 3], k, k + 2, ahead(3.0, sigmas), np.diag(wheels**2)) for k in range(4)]
better = smooth(PoseGraph("A", robots, tuple(stances), (*measured, *odometry), floor=Floor()))
last = (robots[5 % 3], 5)
for name, one in (("without odometry", estimate), ("with odometry", better)):
    print(f"{name}: sigma of {last[0]} at the end {1e3 * one.covariance(*last)[3, 3] ** 0.5:.1f} mm")

# %% [markdown]
# ## As it happens
#
# `Estimator` takes stance after stance and gives the poses at once; at the end it agrees with the batch.

# %%
estimator = Estimator("A", robots)
for stance, one in zip(stances, measured, strict=True):
    here = estimator.add(stance, (one,))
    print(stance.index, {robot: round(pose.x(), 3) for robot, pose in here.poses.items()})
