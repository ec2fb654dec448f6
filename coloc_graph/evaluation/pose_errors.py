"""Errors of poses: ATE over all poses, RPE over distances travelled."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import se3, so3_log

Array = NDArray[np.float64]

RPE_DISTANCES = (1.0, 2.0, 5.0, 10.0)  # m, default distances of the RPE
RPE_TOLERANCE = 0.1  # deviation of a pair's path length from the distance, relative
#: Path along which the distance between the poses of a pair is measured.
PairsFrom = Literal["estimate", "truth"]


@dataclass(frozen=True)
class Spread:
    """Root mean square, mean, median and maximum of errors."""

    rmse: float
    mean: float
    median: float
    max: float


def spread(errors: Array) -> Spread:
    """Return the spread of errors (n,), at least one."""
    return Spread(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        max=float(errors.max()),
    )


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error (RPE) over a distance travelled.

    Parameters
    ----------
    distance : float
        The distance [m].
    pairs : int
        Number of pairs of poses.
    translation, rotation_deg : float or None
        RMS errors [m], [deg]; None without pairs.
    """

    distance: float
    pairs: int
    translation: float | None
    rotation_deg: float | None

    @property
    def translation_percent(self) -> float | None:
        """Translation in % of the distance."""
        return None if self.translation is None else 100 * self.translation / self.distance


def absolute_errors(T_estimated: Array, T_true: Array) -> tuple[Array, Array]:
    """Return distance [m] and angle [rad] between estimated and true poses (n, 4, 4), each (n,)."""
    distance = np.linalg.norm(T_estimated[:, :3, 3] - T_true[:, :3, 3], axis=1)
    return np.asarray(distance), _angles(T_true[:, :3, :3].mT @ T_estimated[:, :3, :3])


def relative_errors(
    T_estimated: Array, T_true: Array, distance: float, pairs_from: PairsFrom = "estimate"
) -> tuple[Array, Array]:
    """Return the errors of relative poses of pairs a distance apart.

    Parameters
    ----------
    T_estimated, T_true : (n, 4, 4) float
        Estimated and true poses.
    distance : float
        Path length between the poses of a pair [m].
    pairs_from : {"estimate", "truth"}
        Path that it is measured along.

    Returns
    -------
    translation, rotation : (m,) float
        Errors of each pair [m], [rad].

    Notes
    -----
    The pairs are those of evo's `--all_pairs`: for each pose the later one with the path length nearest to the
    distance, within `RPE_TOLERANCE`. Source: Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems",
    2012, eq. (1).
    """
    i, j = pairs_of((T_estimated if pairs_from == "estimate" else T_true)[:, :3, 3], distance)
    true, estimated = (_between(T[i], T[j]) for T in (T_true, T_estimated))
    return absolute_errors(estimated, true)


def pairs_of(positions: Array, distance: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return indices (m,) of poses, and of those `distance` [m] later along the path of positions (n, 3)."""
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    n = len(path)
    i = np.arange(n - 1)
    # the nearest is next to the point where the distance is reached; of a standing robot, the first pose there
    reached = np.searchsorted(path, path[i] + distance)
    arrived = np.searchsorted(path, path)
    near = arrived[(reached[:, None] + np.arange(-2, 2)).clip(0, n - 1)]
    off = np.abs(path[near] - path[i, None] - distance)
    which = off.argmin(axis=1)
    kept = off[i, which] <= RPE_TOLERANCE * distance
    return i[kept], near[i, which][kept]


def relative_error(distance: float, parts: Sequence[tuple[Array, Array]]) -> RelativeError:
    """Return the RMS of `relative_errors` of one or several robots."""
    translation, rotation = (np.concatenate(list(part)) for part in zip(*parts, strict=True))
    if not len(translation):
        return RelativeError(distance, 0, None, None)
    rms = (float(np.sqrt(np.mean(errors**2))) for errors in (translation, np.rad2deg(rotation)))
    return RelativeError(distance, len(translation), *rms)


def _between(T_world_i: Array, T_world_j: Array) -> Array:
    """Return T_i_j; positions are subtracted before they are rotated, so that a far origin costs no digits."""
    R_i_world = T_world_i[:, :3, :3].mT
    return se3(R_i_world @ T_world_j[:, :3, :3], (R_i_world @ (T_world_j[:, :3, 3:] - T_world_i[:, :3, 3:]))[..., 0])


def _angles(R: Array) -> Array:
    return np.asarray(np.linalg.norm(so3_log(R), axis=-1))
