"""Give a graph one wrong measurement: it is rejected with a reason, and the poses stay right."""

import matplotlib.pyplot as plt
import numpy as np

from coloc_graph import PoseGraph, RelativePose, Stance, smooth

SIGMAS = np.array([0.002, 0.002, 0.005, 0.01, 0.01, 0.01])  # rotation [rad] first, then translation [m]
rng = np.random.default_rng(2)
robots = ("A", "B", "C", "D")
stances = [Stance(k, 10.0 * k, 10.0 * k + 5, robots[:3], ("D",), robots[:3] if k else ()) for k in range(4)]
place = {"A": (0.0, 0.0), "B": (1.0, 0.0), "C": (0.5, 0.8)}
measured = []
for k in range(4):
    for i, j in (("A", "B"), ("A", "C"), ("B", "C")):
        T = np.eye(4)
        T[:2, 3] = np.subtract(place[j], place[i])
        T[:3, 3] += SIGMAS[3:] * rng.standard_normal(3)
        if (k, i, j) == (2, "B", "C"):
            T[0, 3] += 0.4  # a reflection taken for the light, say
        measured.append(RelativePose(k, i, j, T, np.diag(SIGMAS**2)))

fig, axes = plt.subplots(1, 2, figsize=(7, 2.8), sharey=True)
for ax, reject in zip(axes, (False, True), strict=True):
    estimate = smooth(PoseGraph("A", robots, tuple(stances), tuple(measured)), reject=reject)
    for one in estimate.rejected:
        m = one.measurement
        print(f"stance {m.stance}, {m.robot_i} and {m.robot_j}: {one.reason}")
    for name, (x, y) in place.items():
        pose = estimate.pose(name, 3)
        ax.plot(x, y, "k+", markersize=12)
        ax.plot(pose.x(), pose.y(), "o", label=name)
    ax.set(title="outliers rejected" if reject else "all believed", xlabel="x [m]", aspect="equal")
axes[0].legend(fontsize=8)
fig.savefig("wrong_measurement.png", dpi=100, bbox_inches="tight")
