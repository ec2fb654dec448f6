"""How far poses are from where they should be: ATE over all poses, RPE over stretches of the way."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from coloc_graph.geometry.lie import se3, so3_log

Array = NDArray[np.float64]

#: The distances of the RPE, unless others are asked for [m].
RPE_DISTANCES = (1.0, 2.0, 5.0, 10.0)
#: The ends of a pair are apart by its distance, give or take this part of it.
RPE_TOLERANCE = 0.1
#: Whose path says how far apart the ends of a pair are.
PairsFrom = Literal["estimate", "truth"]


@dataclass(frozen=True)
class Spread:
    """Root mean square, mean, median and greatest of errors."""

    rmse: float
    mean: float
    median: float
    max: float


def spread(errors: Array) -> Spread:
    """The spread of errors (n,), of which there is at least one."""
    return Spread(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        max=float(errors.max()),
    )


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error over a distance travelled [m]: RMS of translation [m] and rotation [deg] over all `pairs`.

    None where no two poses are that far apart.
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
    """Distance [m] and angle [rad] between poses (n, 4, 4) and where they should be, each (n,)."""
    distance = np.linalg.norm(T_estimated[:, :3, 3] - T_true[:, :3, 3], axis=1)
    return np.asarray(distance), _angles(T_true[:, :3, :3].mT @ T_estimated[:, :3, :3])


def relative_errors(
    T_estimated: Array, T_true: Array, distance: float, pairs_from: PairsFrom = "estimate"
) -> tuple[Array, Array]:
    """What two poses (of (n, 4, 4)) that are `distance` [m] apart say wrongly of each other: metres and radians, (m,).

    The pairs are those of evo's `--all_pairs`: for each pose the later one whose path from here is nearest to the
    distance, if it is so by a tenth. Source: Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems",
    2012, eq. (1).
    """
    i, j = pairs_of((T_estimated if pairs_from == "estimate" else T_true)[:, :3, 3], distance)
    true, estimated = (_between(T[i], T[j]) for T in (T_true, T_estimated))
    return absolute_errors(estimated, true)


def pairs_of(positions: Array, distance: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For each pose the later one that is `distance` [m] on along the path of positions (n, 3): indices, each (m,)."""
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    n = len(path)
    i = np.arange(n - 1)
    # the nearest is next to where the distance would be reached; where the robot stands, it is the first pose there
    reached = np.searchsorted(path, path[i] + distance)
    arrived = np.searchsorted(path, path)
    near = arrived[(reached[:, None] + np.arange(-2, 2)).clip(0, n - 1)]
    off = np.abs(path[near] - path[i, None] - distance)
    which = off.argmin(axis=1)
    kept = off[i, which] <= RPE_TOLERANCE * distance
    return i[kept], near[i, which][kept]


def relative_error(distance: float, parts: Sequence[tuple[Array, Array]]) -> RelativeError:
    """The errors of `relative_errors`, of one robot or of several, as one figure."""
    translation, rotation = (np.concatenate(list(part)) for part in zip(*parts, strict=True))
    if not len(translation):
        return RelativeError(distance, 0, None, None)
    rms = (float(np.sqrt(np.mean(errors**2))) for errors in (translation, np.rad2deg(rotation)))
    return RelativeError(distance, len(translation), *rms)


def _between(T_world_i: Array, T_world_j: Array) -> Array:
    """T_i_j; positions are subtracted before they are turned, so that a far origin costs no digits."""
    R_i_world = T_world_i[:, :3, :3].mT
    return se3(R_i_world @ T_world_j[:, :3, :3], (R_i_world @ (T_world_j[:, :3, 3:] - T_world_i[:, :3, 3:]))[..., 0])


def _angles(R: Array) -> Array:
    return np.asarray(np.linalg.norm(so3_log(R), axis=-1))
