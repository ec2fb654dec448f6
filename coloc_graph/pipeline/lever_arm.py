"""Odometry of another point of a robot than its body's origin: found by the poses that cameras measured."""

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from coloc_graph.backend import Estimate, Estimator, PoseGraph, StanceEstimate, joint, smooth
from coloc_graph.backend.blame import EQUAL_CHI2, as_stated
from coloc_graph.backend.outliers import REJECTION_PRICE
from coloc_graph.errors import EstimationError
from coloc_graph.geometry.lie import floor_pose, se3_between, se3_inverse
from coloc_graph.measurements import Measurement, Odometry, Sighting

Array = NDArray[np.float64]

MIN_REJECTED = 2  # odometry and sightings that are rejected before a lever arm is looked for
DOUBTED_P_VALUE = 1e-4  # or an estimate that noise explains less probably than this
MIN_WAYS = 4  # ways that tell a lever arm
MIN_ARM = 0.02  # shorter lever arms do no harm [m]
SIGNIFICANT = 6.0  # a lever arm exceeds its sigma by this factor
POSE_SIGMA = 5e-3  # standard deviation of estimated positions, added to that of odometry [m]
ROBUST = 4.0  # ways that are off by more sigmas count less


@dataclass(frozen=True)
class LeverArm:
    """Position `x`, `y` [m] in the body of the point whose odometry a robot reports, known to `sigma` [m]."""

    robot: str
    x: float
    y: float
    sigma: float

    def __str__(self) -> str:
        ahead = f"{abs(self.x):.2f} m {'ahead of' if self.x > 0 else 'behind'}"
        left = f"{abs(self.y):.2f} m {'left' if self.y > 0 else 'right'} of"
        return (
            f"the odometry of {self.robot} is not that of its body's origin but of a point {ahead} and {left} it "
            f"(sigma {1e3 * self.sigma:.0f} mm, by what the cameras measured): it was moved to the body; record "
            "odometry of the point midway between the wheels"
        )

    def moved(self, one: Odometry) -> Odometry:
        """Return odometry of the body."""
        T = floor_pose(self.x, self.y, 0.0)
        J = np.eye(3)
        J[1, 0], J[2, 0] = self.y, -self.x
        T_body = T @ one.T_before_after @ se3_inverse(T)
        unsure = np.zeros((3, 3))
        unsure[1:, 1:] = self.sigma**2 * np.eye(2)
        return replace(one, T_before_after=T_body, covariance=J @ one.covariance @ J.T + unsure)


def find_lever_arms(estimate: Estimate, solve: Callable[[PoseGraph], Estimate]) -> tuple[dict[str, LeverArm], Estimate]:
    """Find the lever arms that explain what is rejected of an estimate, and the estimate with them.

    Each robot's arm is measured against an estimate without its odometry; the one that explains most is kept if it
    explains more than the rejections, and the next is looked for. Returns {} and the estimate itself where none does.
    """
    arms: dict[str, LeverArm] = {}
    while (best := _best_arm(estimate, solve, arms)) is not None:
        arm, estimate = best
        arms[arm.robot] = arm
    return arms, estimate


def mend_lever_arms(estimator: Estimator) -> tuple[dict[str, LeverArm], StanceEstimate | None]:
    """Find lever arms by all inputs of an incremental estimate, and replace the odometry that has one.

    Returns {} and None where there is none; takes a few batch estimates.
    """
    arms, _ = find_lever_arms(estimator.estimate(), joint if estimator.robot_models else smooth)
    wrong = [one for one in estimator.measurements if isinstance(one, Odometry) and one.robot in arms]
    if not wrong:
        return {}, None
    estimator.revoke(*wrong)
    return arms, estimator.insert(*of_bodies(wrong, arms))


def _best_arm(
    estimate: Estimate, solve: Callable[[PoseGraph], Estimate], known: Container[str]
) -> tuple[LeverArm, Estimate] | None:
    """Most likely lever arm among robots outside `known`, and the estimate with it; None if none explains more."""
    doubted = [one.measurement for one in estimate.rejected if isinstance(one.measurement, Odometry | Sighting)]
    p_value = float(chdtrc(estimate.dof, estimate.chi2)) if estimate.dof > 0 else 1.0
    if len(doubted) < MIN_REJECTED and not estimate.bumped and p_value > DOUBTED_P_VALUE:
        return None
    best: tuple[float, LeverArm, Estimate] | None = None
    for robot in estimate.graph.robots:
        ways = [one for one in estimate.graph.measurements if isinstance(one, Odometry) and one.robot == robot]
        if len(ways) < MIN_WAYS or robot in known:
            continue
        try:
            without = solve(estimate.graph.without(ways))
        except EstimationError:
            continue
        arm = _arm(without, robot, ways)
        if arm is not None:
            # a bump may be the arm's, and one that is not must be found again
            moved = solve(with_lever_arms(as_stated(estimate.graph, estimate.bumped), {robot: arm}))
            cost = _implausibility(moved)
            if best is None or cost < best[0]:
                best = cost, arm, moved
    if best is None or best[0] > _implausibility(estimate) - EQUAL_CHI2:
        return None
    return best[1], best[2]


def _implausibility(estimate: Estimate) -> float:
    """Chi2 above its expected value, and a price for each rejection and bump."""
    return estimate.chi2 - estimate.dof + REJECTION_PRICE * (len(estimate.rejected) + len(estimate.bumped))


def _arm(estimate: Estimate, robot: str, ways: Sequence[Odometry]) -> LeverArm | None:
    rows, right = [], []
    for one in ways:
        try:
            T = se3_between(*(estimate.pose(*end).matrix() for end in one.ends))
        except EstimationError:
            continue
        sigma = np.sqrt(np.trace(one.covariance[1:, 1:]) / 2 + POSE_SIGMA**2)
        # P^-1 T P has the translation t + (R - 1) p
        rows.append((one.T_before_after[:2, :2] - np.eye(2)) / sigma)
        right.append((one.T_before_after[:2, 3] - T[:2, 3]) / sigma)
    if len(rows) < MIN_WAYS:
        return None
    A, b = np.array(rows), np.array(right)
    weights = np.ones(len(A))
    for _ in range(20):
        normal = np.einsum("n,nka,nkb->ab", weights, A, A)
        p = np.linalg.lstsq(normal, np.einsum("n,nka,nk->a", weights, A, b), rcond=1e-9)[0]
        off = np.linalg.norm(b - A @ p, axis=1)
        weights = np.minimum(1.0, ROBUST / np.maximum(off, 1e-9)) ** 2
    kept = weights > 0.5
    if kept.sum() < max(MIN_WAYS, len(A) / 2):
        return None
    after = float(((b - A @ p)[kept] ** 2).sum())
    scale = max(1.0, after / max(2 * int(kept.sum()) - 2, 1))
    covariance = scale * np.linalg.pinv(normal)
    far, sigma = float(np.linalg.norm(p)), float(np.sqrt(np.trace(covariance) / 2))
    if far < max(MIN_ARM, SIGNIFICANT * sigma):
        return None
    return LeverArm(robot, float(p[0]), float(p[1]), sigma)


def with_lever_arms(graph: PoseGraph, arms: Mapping[str, LeverArm]) -> PoseGraph:
    """Return the graph with the odometry of some robots moved to their bodies."""
    return replace(graph, measurements=of_bodies(graph.measurements, arms)) if arms else graph


def of_bodies(measurements: Iterable[Measurement], arms: Mapping[str, LeverArm]) -> tuple[Measurement, ...]:
    """Return measurements with the odometry of some robots moved to their bodies."""
    return tuple(
        arms[one.robot].moved(one) if isinstance(one, Odometry) and one.robot in arms else one for one in measurements
    )
