"""Check covariances: over many runs the squared errors, in units of their covariance, must follow chi-squared."""

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import chi2

from coloc_graph import PoseGraph, RelativePose, Stance, smooth
from coloc_graph.geometry.lie import se3_exp, se3_inverse, se3_log

RUNS = 120
STANCES = 4
SIGMAS = np.array([0.002, 0.002, 0.005, 0.01, 0.01, 0.01])  # rotation [rad] first, then translation [m]
robots, step = ("A", "B", "C"), np.eye(4)
step[0, 3] = 1.0  # each observer stands 1 m ahead of the other, and the third overtakes both
rng = np.random.default_rng(0)


def nees(stated: float) -> float:
    """Squared error of the last pose over its covariance, with sigmas stated `stated` times as large as they are."""
    stances, measured = [], []
    for k in range(STANCES):
        behind, ahead, driver = (robots[(k + n) % 3] for n in range(3))
        stances.append(Stance(k, 10.0 * k, 10.0 * k + 5, (behind, ahead), (driver,), (behind,) if k else ()))
        T = step @ se3_exp(SIGMAS * rng.standard_normal(6))
        measured.append(RelativePose(k, behind, ahead, T, np.diag((stated * SIGMAS) ** 2)))
    estimate = smooth(PoseGraph("A", robots, tuple(stances), tuple(measured)))
    true = np.linalg.matrix_power(step, STANCES)
    error = se3_log(se3_inverse(estimate.pose(ahead, STANCES - 1).matrix()) @ true)
    return float(error @ np.linalg.solve(estimate.covariance(ahead, STANCES - 1), error))


fig, axes = plt.subplots(1, 2, figsize=(7, 2.8), sharey=True)
for ax, stated in zip(axes, (1.0, 0.5), strict=True):
    values, x = [nees(stated) for _ in range(RUNS)], np.linspace(0, 40, 200)
    ax.hist(values, bins=np.linspace(0, 40, 30), density=True, color="tab:blue", alpha=0.6)
    ax.plot(x, chi2.pdf(x, 6), color="black", linewidth=1, label="chi-squared, 6 dof")
    ax.set(title=f"sigmas x {stated:g}: NEES {np.mean(values) / 6:.2f}", xlabel="squared error / covariance")
axes[0].legend(fontsize=8)
fig.savefig("honest_covariances.png", dpi=100, bbox_inches="tight")
