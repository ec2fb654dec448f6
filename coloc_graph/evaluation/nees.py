"""NEES: whether errors are as large as the covariances say, and how surely one trajectory can tell."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from coloc_graph.evaluation.truth import with_truth
from coloc_graph.geometry.lie import floor_pose, se3_inverse, se3_log, yaw
from coloc_graph.geometry.trajectory import Trajectory

Array = NDArray[np.float64]

#: Tangent components of a pose on the floor, and of one that is free.
PLANAR = [2, 3, 4]
FREE = [0, 1, 2, 3, 4, 5]
#: A pose that is known better than this defines the world; its error says nothing [m, rad].
DEFINED = 1e-5


@dataclass(frozen=True)
class Nees:
    """Mean normalised estimation error squared per degree of freedom over `poses`, 1 where covariances are honest.

    `low` and `high` hold 95 % of a chi-square variable of as many degrees of freedom as `effective` poses have that
    know nothing of each other. That number is estimated, too: of honest runs 84 to 96 % were in (docs/evaluation.md).
    """

    mean: float
    poses: int
    effective: float
    low: float
    high: float

    @property
    def consistent(self) -> bool:
        """Whether the mean is in its interval."""
        return self.low <= self.mean <= self.high


def nees(estimated: Trajectory, T_true: Array, components: list[int]) -> Nees | None:
    """The NEES of a trajectory against true poses (n, 4, 4), with its interval; None where no pose has a covariance."""
    z = whitened(estimated, T_true, components)
    if not len(z):
        return None
    count = effective_poses(z)
    dof = count * z.shape[1]
    low, high = chdtri(dof, [0.975, 0.025]) / dof
    return Nees(float((z**2).mean()), len(z), count, float(low), float(high))


def nees_of(estimated: Trajectory, T_true: Array, components: list[int]) -> Array:
    """Normalised estimation error squared per degree of freedom, of each pose of `whitened`."""
    return np.asarray((whitened(estimated, T_true, components) ** 2).mean(axis=1))


def whitened(estimated: Trajectory, T_true: Array, components: list[int]) -> Array:
    """Errors in units of their covariances, (m, d): unit normal, if these are right, along the world's axes.

    Of each pose that has a true one, NaN being none, and a covariance to speak of: the pose that defines the world has
    none and is left out; a pose held over several stances counts once.
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
    kept = new & with_truth(T_true) & finite & (sigmas >= DEFINED) & (values[:, 0] > 1e-15 * values[:, -1])
    T_world_body = T_world_body[kept]
    xi = se3_log(se3_inverse(T_world_body) @ T_true[kept])
    # along the world's axes: in those of a body that turns, neighbours would seem to know nothing of each other
    R = T_world_body[:, :3, :3] if components != PLANAR else floor_pose(0, 0, yaw(T_world_body))[:, :3, :3]
    both = np.zeros((len(R), 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = R
    turn = both[:, components][:, :, components]
    xi = (turn @ xi[:, components, None])[..., 0]
    values, vectors = np.linalg.eigh(turn @ covariances[kept] @ turn.mT)
    return np.asarray((vectors @ ((vectors.mT @ xi[..., None]) / np.sqrt(values)[..., None]))[..., 0])


def effective_poses(z: Array) -> float:
    """How many independent poses say as much of the mean NEES as whitened errors (n, d) in a row do.

    n / (1 + 2 sum (1 - h/n) rho_h^2), rho_h the correlation of errors h poses apart, up to where it is lost: the
    squares of two normal variables are correlated by the square of their correlation. The errors' mean is taken for
    zero, as it is if the estimate is consistent; a bias so makes the interval wider. Source of the sum: Sokal, "Monte
    Carlo Methods in Statistical Mechanics", 1997, eq. (2.16).
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
