"""Pair tracks of two cameras at any clock offset, by interpolating camera j's at the instants of camera i's samples."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from coloc_graph.frontend.homography.refinement import PointPairs
from coloc_graph.frontend.pairing.correspondence import Correspondences, normalised
from coloc_graph.frontend.tracks.interpolation import Interpolated, Samples
from coloc_graph.frontend.tracks.track import Track
from coloc_graph.team import Camera

Array = NDArray[np.float64]

DRAWS = 64  # Monte Carlo draws of the noise


@dataclass(frozen=True, eq=False)
class ShiftedTracks:
    """Camera j's tracks at one clock offset [s], interpolated at camera i's n points.

    `x` and `slope` (n, 2) are positions and smoothed velocities [1/s], normalised; `covariance` (n, 2, 2) is that of
    the positions.
    """

    offset: float
    interpolated: Interpolated
    x: Array
    slope: Array
    covariance: Array


class PairedTracks:
    """Tracks of two cameras that show the same markers, by pairs of indices in `chosen`."""

    def __init__(
        self,
        tracks_i: Sequence[Track],
        tracks_j: Sequence[Track],
        chosen: Sequence[tuple[int, int]],
        camera_i: Camera,
        camera_j: Camera,
    ) -> None:
        of_j = sorted({b for _, b in chosen})
        seen_i = {a: _finite(tracks_i[a], camera_i) for a, _ in chosen}
        seen_j = [_finite(tracks_j[b], camera_j) for b in of_j]
        self._samples = Samples([s[0] for s in seen_j], [s[1] for s in seen_j], [s[2] for s in seen_j])
        self._uv_j, self._loads_j = (np.concatenate([s[part] for s in seen_j]) for part in (3, 4))
        sizes = [len(seen_i[a][0]) for a, _ in chosen]
        track = np.repeat(np.array([of_j.index(b) for _, b in chosen], np.int64), sizes)
        markers = np.repeat(np.array([a for a, _ in chosen], np.int64), sizes)
        times, x_i, covariance_i, uv_i, loads_i = (
            np.concatenate([seen_i[a][part] for a, _ in chosen]) for part in range(5)
        )
        # in camera j's order, so that points that share its samples are neighbours
        order = np.lexsort((times, track))
        self._track, self._markers, self.times = track[order], markers[order], times[order]
        self.x_i, self.covariance_i, self._uv_i = x_i[order], covariance_i[order], uv_i[order]
        self._loads_i = loads_i[order]

    def __len__(self) -> int:
        return len(self.times)

    def at(self, offset: float) -> ShiftedTracks:
        """Interpolate camera j's tracks at camera i's instants plus `offset` (clock_j - clock_i) [s]."""
        between = self._samples.at(self._track, self.times + offset)
        x, slope = between.position @ self._samples.x, between.slope @ self._samples.x
        squares = between.position.multiply(between.position).tocsr()
        covariance = (squares @ self._samples.covariance.reshape(-1, 4)).reshape(-1, 2, 2)
        return ShiftedTracks(offset, between, x, slope, covariance)

    def pairs(self, at: ShiftedTracks, which: NDArray[np.int64]) -> PointPairs:
        """Point pairs of index `which` (k,), camera j's interpolated."""
        return PointPairs(self.x_i[which], at.x[which], self.covariance_i[which], at.covariance[which])

    def correspondences(self, at: ShiftedTracks, which: NDArray[np.int64]) -> Correspondences:
        """Correspondences of index `which` (k,), camera j's interpolated."""
        uv_j = at.interpolated.position[which] @ self._uv_j
        pairs = self.pairs(at, which)
        position = at.interpolated.position[which]
        loads_j = position.multiply(position).tocsr() @ self._loads_j
        columns = self._uv_i[which], uv_j, self.times[which], self._markers[which]
        return Correspondences(*columns, pairs, self._loads_i[which], np.asarray(loads_j))

    def noise_j(self, at: ShiftedTracks, which: NDArray[np.int64]) -> Array:
        """Covariance of camera j's points `which` (k,), correlated by shared samples: LAPACK lower band (w, 2k)."""
        columns, weights = _padded(at.interpolated.position[which])
        C, k = self._samples.covariance[columns], len(which)
        blocks = []
        for apart in range(k):
            same = columns[apart:, :, None] == columns[: k - apart, None, :]
            if not same.any():
                break
            alike = (same * weights[: k - apart, None, :]).sum(axis=2) * weights[apart:]
            blocks.append((alike[:, :, None, None] * C[apart:]).sum(axis=1))
        band = np.zeros((2 * len(blocks), 2 * k))
        for apart, M in enumerate(blocks):
            there = 2 * len(M)
            band[2 * apart, :there] = M[:, [0, 1], [0, 1]].ravel()
            band[2 * apart + 1, :there:2] = M[:, 1, 0]
            if apart:
                band[2 * apart - 1, 1:there:2] = M[:, 0, 1]
        return band

    def speed(self, at: ShiftedTracks, which: NDArray[np.int64]) -> Array:
        """Exact derivative (k, 2) of points `which` by the offset, noise included [1/s]."""
        return np.asarray(at.interpolated.derivative[which] @ self._samples.x)

    def draws(self) -> Array:
        """Draw noise of camera j's n samples, (n, 2 `DRAWS`), from a fixed seed."""
        roots = np.linalg.cholesky(self._samples.covariance)
        standard = np.random.default_rng(0).standard_normal((DRAWS, len(self._samples), 2, 1))
        return np.moveaxis((roots @ standard)[..., 0], 0, -1).reshape(len(self._samples), 2 * DRAWS)

    def drawn(self, at: ShiftedTracks, which: NDArray[np.int64], draws: Array) -> tuple[Array, Array, Array]:
        """Propagate `draws` of the noise to position, derivative and slope of points `which`, (2k, `DRAWS`) each."""
        position, derivative, slope = (
            (matrix[which] @ draws).reshape(2 * len(which), DRAWS)
            for matrix in (at.interpolated.position, at.interpolated.derivative, at.interpolated.slope)
        )
        return position, derivative, slope


def _padded(rows: sparse.csr_array) -> tuple[NDArray[np.int64], Array]:
    """Columns and values (k, w) of sparse rows with up to w entries, padded with zeros."""
    first, count = rows.indptr[:-1, None], np.diff(rows.indptr)[:, None]
    n = np.arange(int(count.max(initial=1)))
    at = first + np.minimum(n, np.maximum(count - 1, 0))
    return rows.indices[at].astype(np.int64), np.where(n < count, rows.data[at], 0.0)


def _finite(track: Track, camera: Camera) -> tuple[Array, Array, Array, Array, Array]:
    """Times, normalised points, covariances, pixels and loads of a track, where all are finite and times ascend."""
    x, covariance = normalised(track, camera)
    good = np.asarray(np.isfinite(x).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
    good[1:] &= np.diff(track.times) > 1e-4
    return track.times[good], x[good], covariance[good], track.uv[good], track.loads[good]
