"""Localise a team from relative poses that you measured yourself, in whatever way.

Three robots leap-frog along a line: in each stance two stand 1 m apart and measure each other while the third drives
past them. Run it by `python examples/own_measurements.py`.
"""

import matplotlib.pyplot as plt
import numpy as np

from coloc_graph import PoseGraph, RelativePose, Stance, smooth

SIGMAS = np.array([0.002, 0.002, 0.005, 0.01, 0.01, 0.01])  # rotation [rad] first, then translation [m]

stances, measurements = [], []
rng = np.random.default_rng(1)
robots = ("A", "B", "C")
for k in range(6):
    behind, ahead, driver = (robots[(k + n) % 3] for n in range(3))
    # who stood ahead in the stance before has stayed where it was
    anchors = (behind,) if k else ()
    stances.append(Stance(k, 10.0 * k, 10.0 * k + 5.0, (behind, ahead), (driver,), anchors))
    T_behind_ahead = np.eye(4)
    T_behind_ahead[:3, 3] = np.array([1.0, 0.0, 0.0]) + SIGMAS[3:] * rng.standard_normal(3)
    measurements.append(RelativePose(k, behind, ahead, T_behind_ahead, np.diag(SIGMAS**2)))

estimate = smooth(PoseGraph("A", robots, tuple(stances), tuple(measurements)))
fig, ax = plt.subplots(figsize=(7, 2.4))
for robot, stance in estimate.graph.nodes:
    pose, sigma = estimate.pose(robot, stance), np.sqrt(estimate.covariance(robot, stance)[3, 3])
    print(f"{robot} at stance {stance}: x {pose.x():.3f} m, y {pose.y():.3f} m, sigma along its heading {sigma:.3f} m")
    ax.errorbar(pose.x(), pose.y(), sigma, sigma, fmt="o", color=f"C{robots.index(robot)}", capsize=3)
ax.set(xlabel="x [m]", ylabel="y [m]", title="Poses with 1 sigma")
fig.savefig("own_measurements.png", dpi=100, bbox_inches="tight")
