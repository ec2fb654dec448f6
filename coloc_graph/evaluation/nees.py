"""NEES: consistency of errors with covariances, with its confidence interval for one trajectory."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from coloc_graph.evaluation.truth import with_truth
from coloc_graph.geometry.lie import floor_pose, se3_inverse, se3_log, yaw
from coloc_graph.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

PLANAR = [2, 3, 4]  # tangent components of a pose on the floor
FREE = [0, 1, 2, 3, 4, 5]  # tangent components of a free pose
MIN_POSE_SIGMA = 1e-5  # m, rad: a pose with smaller sigmas defines the world, and has no error


@dataclass(frozen=True)
class Nees:
    """Mean normalised estimation error squared (NEES) per degree of freedom of one trajectory.

    Parameters
    ----------
    mean : float
        NEES per degree of freedom; 1 is expected of a consistent estimate.
    poses : int
        Number of poses.
    effective : float
        Equivalent number of independent poses, estimated.
    low, high : float
        95 % interval of a chi-square variable with the degrees of freedom of `effective` poses. Of consistent runs 84
        to 96 % were in it (docs/evaluation.md).
    """

    mean: float
    poses: int
    effective: float
    low: float
    high: float

    @property
    def consistent(self) -> bool:
        """True if the mean is in its interval."""
        return self.low <= self.mean <= self.high


def nees(estimated: Trajectory, T_true: Array, components: list[int]) -> Nees | None:
    """Return the NEES of a trajectory.

    Parameters
    ----------
    estimated : Trajectory
        Estimated poses with covariances.
    T_true : (n, 4, 4) float
        True poses in the same world, NaN where there is none.
    components : list of int
        Components of the tangent: `PLANAR` or `FREE`.

    Returns
    -------
    Nees or None
        None where no pose has a covariance.
    """
    z = whitened(estimated, T_true, components)
    if not len(z):
        return None
    count = effective_poses(z)
    dof = count * z.shape[1]
    low, high = chdtri(dof, [0.975, 0.025]) / dof
    return Nees(float((z**2).mean()), len(z), count, float(low), float(high))


def nees_of(estimated: Trajectory, T_true: Array, components: list[int]) -> Array:
    """Return the normalised estimation error squared per degree of freedom of each pose of `whitened`."""
    return np.asarray((whitened(estimated, T_true, components) ** 2).mean(axis=1))


def whitened(estimated: Trajectory, T_true: Array, components: list[int]) -> Array:
    """Return errors (m, d) whitened by their covariances, along the world's axes: unit normal if consistent.

    Of each pose with truth (not NaN) and a covariance: the pose that defines the world has none; a pose held over
    several stances counts once.
    """
    if estimated.covariances is None:
        return np.empty((0, len(components)))
    T_world_body = estimated.T_world_body
    held = (T_world_body[1:] == T_world_body[:-1]).all(axis=(1, 2))
    new = np.concatenate([[True], ~held])
    covariances = estimated.covariances[:, components][:, :, components]
    finite = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    values = np.linalg.eigvalsh(np.where(finite[:, None, None], covariances, 0.0))
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2).clip(min=0)).max(axis=1, initial=0.0)
    kept = new & with_truth(T_true) & finite & (sigmas >= MIN_POSE_SIGMA) & (values[:, 0] > 1e-15 * values[:, -1])
    T_world_body = T_world_body[kept]
    xi = se3_log(se3_inverse(T_world_body) @ T_true[kept])
    # along the world's axes: along those of a turning body, neighbours would seem uncorrelated
    R = T_world_body[:, :3, :3] if components != PLANAR else floor_pose(0, 0, yaw(T_world_body))[:, :3, :3]
    both = np.zeros((len(R), 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = R
    turn = both[:, components][:, :, components]
    xi = (turn @ xi[:, components, None])[..., 0]
    values, vectors = np.linalg.eigh(turn @ covariances[kept] @ turn.mT)
    return np.asarray((vectors @ ((vectors.mT @ xi[..., None]) / np.sqrt(values)[..., None]))[..., 0])


def effective_poses(z: Array) -> float:
    """Return the number of independent poses that determine the mean NEES as well as whitened errors (n, d) do.

    n / (1 + 2 sum (1 - h/n) rho_h^2), rho_h the correlation of errors h poses apart, up to its first zero: the squares
    of two normal variables are correlated by the square of their correlation. The errors' mean is taken as zero, as of
    a consistent estimate; a bias therefore makes the interval wider. Source of the sum: Sokal, "Monte Carlo Methods in
    Statistical Mechanics", 1997, eq. (2.16).
    """
    n = len(z)
    spectrum = np.fft.rfft(z, 2 * n, axis=0)
    products = np.fft.irfft(np.abs(spectrum) ** 2, 2 * n, axis=0)[:n].sum(axis=1)
    lag = np.arange(n)
    if products[0] <= 0:
        return float(n)
    rho = products / products[0] * n / (n - lag)
    lost = np.flatnonzero(rho <= 0)
    end = int(lost[0]) if len(lost) else n
    share = ((n - lag) / n * rho.clip(max=1.0) ** 2)[1:end].sum()
    return float(n / (1 + 2 * share))
