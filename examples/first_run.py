"""Simulate a leap-frog, localise its team, and draw the poses with their covariances."""

import matplotlib.pyplot as plt
import numpy as np

from coloc_graph import open_run, simulate, solve

simulate("hallway", "run.mcap", stances=8, seed=1, points=50)
solution = solve(open_run("run.mcap"))

fig, ax = plt.subplots(figsize=(7, 3))
circle = np.array([(np.cos(a), np.sin(a)) for a in np.linspace(0, 2 * np.pi, 40)])
for robot, trajectory in solution.estimate.trajectories.items():
    x, y, _ = trajectory.positions.T
    (line,) = ax.plot(x, y, "o-", label=f"{robot}, estimated", markersize=3)
    R = trajectory.T_world_body[:, :2, :2]
    S = R @ trajectory.covariances[:, 3:5, 3:5] @ R.transpose(0, 2, 1)  # from the body frame to the world's
    for at, covariance in zip(trajectory.positions[:, :2], S, strict=True):
        values, vectors = np.linalg.eigh(covariance)
        ellipse = at + 10 * circle * np.sqrt(np.maximum(values, 0)) @ vectors.T
        ax.plot(*ellipse.T, color=line.get_color(), linewidth=0.7)
ax.set(xlabel="x [m]", ylabel="y [m]", title="Poses with ellipses of 10 sigma", aspect="equal")
ax.legend(fontsize=8)
fig.savefig("first_run.png", dpi=100, bbox_inches="tight")
print(solution.estimate.pose("A", 7))
