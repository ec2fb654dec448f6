"""Known spans of markers on a plane as a measurement of its tilts and distance: the source of the scale.

The residual is three weighted sums over n instants, those most informative of the two tilts and the distance. Their
weights are fixed at a plane that is nearly right, so that the residual is a function of the plane alone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from coloc_graph.measurements import MarkerSpan

Array = NDArray[np.float64]

MIN_SINE = 0.02  # sine of the angle between a ray and the plane below which the ray is not used
CLEARANCE_SIGMAS = 3.0  # the same in standard deviations of the plane's normal
KNOWN_NORMAL = 5e-3  # rad: sigma of the normal below which the noise of a length is told from the normal's error
MIN_INSTANTS = 4  # instants of a span


def spans_on_plane(x_i: Array, n: Array) -> tuple[Array, Array, Array, Array]:
    """Return distances on planes between the ends of pairs of rays.

    Parameters
    ----------
    x_i : (..., k, 2, 2) float
        Pairs of rays (x, y, 1).
    n : (..., 3) float
        Planes n . X = 1, n = N / d [1/m].

    Returns
    -------
    lengths : (..., k) float
        Distances [m]; rays that do not meet the plane are taken to meet it far away.
    by_n : (..., k, 3) float
        Their derivatives by n.
    X : (..., k, 2, 3) float
        Ends of the rays [m].
    u : (..., k, 3) float
        Unit vectors from the first to the second.
    """
    n = n[..., None, None, :]
    nearest = 1e-3 * np.sqrt((n * n).sum(-1))
    depth = 1 / np.maximum(x_i[..., 0] * n[..., 0] + x_i[..., 1] * n[..., 1] + n[..., 2], nearest)
    X = np.empty((*x_i.shape[:-1], 3))
    X[..., :2] = x_i * depth[..., None]
    X[..., 2] = depth
    arm = X[..., 1, :] - X[..., 0, :]
    lengths = np.sqrt(np.einsum("...a,...a->...", arm, arm))
    u = arm / lengths[..., None]
    # dX/dn = -X X^T
    along = np.einsum("...ma,...a->...m", X, u)
    return lengths, along[..., :1] * X[..., 0, :] - along[..., 1:] * X[..., 1, :], X, u


def _at_instants(x_i: Array, n: Array) -> tuple[Array, Array, Array, Array]:
    """`spans_on_plane` of rays x_i (k, 2, 2), each on its own plane (k, 3)."""
    lengths, by_n, X, u = spans_on_plane(x_i[:, None], n)
    return lengths[:, 0], by_n[:, 0], X[:, 0], u[:, 0]


def _widened(shared: Sequence[Array]) -> Array:
    """Roots (k, 2, 2, q) of covariances, one after the other, with columns of zeros after theirs."""
    out = np.zeros((sum(map(len, shared)), *shared[0].shape[1:-1], max(one.shape[-1] for one in shared)))
    begin = 0
    for one in shared:
        out[begin : begin + len(one), ..., : one.shape[-1]] = one
        begin += len(one)
    return out


def _by_rays(X: Array, u: Array, n: Array) -> Array:
    """Derivatives (k, 2, 2) of the distances by x_i, on planes n (k, 3)."""
    along = X @ u[:, :, None]
    by_x = X[..., 2:] * (u[:, None, :2] - along * n[:, None, :2])
    return np.asarray(by_x * np.array([-1.0, 1.0])[:, None])


def _lengthening(X: Array, u: Array, n: Array, covariance: Array) -> Array:
    """Bias (k,) [m] of the distances by noise across their line: (tr S - u^T S u) / 2 length.

    S is the covariance of the line from one marker to the other.
    """
    J = X[..., 2, None, None] * (np.eye(3)[:, :2] - X[..., None] * n[:, None, None, :2])
    S = (J @ covariance @ J.mT).sum(axis=1)
    arm = np.sqrt(((X[:, 1] - X[:, 0]) ** 2).sum(-1))
    return np.asarray((S[:, 0, 0] + S[:, 1, 1] + S[:, 2, 2] - ((S @ u[..., None])[..., 0] * u).sum(axis=1)) / (2 * arm))


@dataclass(frozen=True, eq=False)
class SpanModel:
    """Residual (3,) of covariance 1 of the spans of one mover: a function of the plane, the span and the homography.

    `weights` (3, k) @ (lengths - `noise` - span) + `by_h` (3, 8) @ h, at the k instants whose rays are clear of the
    horizon. `noise` (k,) is the bias of each length by noise, `length` [m] the span as stated. `log_det` is the
    logarithm of the determinant by which errors that samples share make the residual's covariance larger. The rays
    `x_i` are in a frame turned by `R_camera_view` (3, 3).
    """

    mover: str
    length: float
    x_i: Array
    noise: Array
    weights: Array
    by_h: Array
    log_det: float
    R_camera_view: Array

    @classmethod
    def near(
        cls, spans: Sequence[MarkerSpan], n: Array, normal_sigma: Array, lengths: Sequence[float]
    ) -> tuple["SpanModel | None", ...]:
        """Return the models of spans near planes in their cameras, all at once; None of too few usable instants.

        Parameters
        ----------
        spans : sequence of MarkerSpan
            s spans, of any homographies.
        n : (s, 3) float
            Planes n . X = 1 in the cameras [1/m].
        normal_sigma : (s,) float
            Standard deviations of the planes' normals [rad].
        lengths : sequence of float
            Spans as stated [m].
        """
        out: list[SpanModel | None] = [None] * len(spans)
        if not spans:
            return ()
        R = np.array([np.eye(3) if span.R_camera_view is None else span.R_camera_view for span in spans])
        n = (n[:, None] @ R)[:, 0]
        N = n / np.linalg.norm(n, axis=1)[:, None]
        x_i, covariance, by_h = (
            np.concatenate([getattr(one, name) for one in spans]) for name in ("x_i", "covariance", "by_h")
        )
        shared = _widened([span.shared for span in spans])
        uneven = np.concatenate([np.zeros_like(one.x_i) if one.uneven is None else one.uneven for one in spans])
        of = np.repeat(np.arange(len(spans)), [len(span.x_i) for span in spans])
        sine = ((x_i * N[of, None, :2]).sum(-1) + N[of, None, 2]) / np.sqrt(1 + (x_i**2).sum(-1))
        which = (sine > np.maximum(MIN_SINE, CLEARANCE_SIGMAS * normal_sigma)[of, None]).all(axis=1)
        which &= (np.bincount(of[which], minlength=len(spans)) >= MIN_INSTANTS)[of]
        if not which.any():
            return tuple(out)
        x_i, covariance, by_h, shared, uneven, of = (
            each[which] for each in (x_i, covariance, by_h, shared, uneven, of)
        )
        # the instants of all spans, one after the other; `apart` gives them by span, padded with zeros
        some, count = np.unique(of, return_counts=True)
        own = np.arange(count.max()) < count[:, None]

        def apart(each: Array) -> Array:
            """(k, ...) of all instants as (s, k, ...) of each span."""
            padded = np.zeros((*own.shape, *each.shape[1:]))
            padded[own] = each
            return padded

        planes, length = n[of], np.array(lengths)[of]
        found, by_n, X, u = _at_instants(x_i, planes)
        by_x = _by_rays(X, u, planes)
        known = (normal_sigma < KNOWN_NORMAL)[of]
        if known.any():
            # weigh each length at the nearest rays that have it right: noise that makes a length longer would make
            # its weight smaller, which over hundreds of instants is a bias of a tenth of a sigma
            by_noise = (covariance @ by_x[..., None])[..., 0]
            off = np.where(known, (found - length) / (by_x * by_noise).sum(axis=(1, 2)), 0.0)
            _, by_n, X, u = _at_instants(x_i - by_noise * off[:, None, None], planes)
            by_x = _by_rays(X, u, planes)
        variance = (by_x * (covariance @ by_x[..., None])[..., 0]).sum(axis=(1, 2))
        sigma = np.sqrt(variance + (by_x * uneven).sum(axis=(1, 2)) ** 2)
        bases = np.linalg.svd(N[some, None])[2]
        bases[:, 0] = N[some]
        J = apart(by_n / sigma[:, None]) @ bases[:, [1, 2, 0]].mT
        weights = np.linalg.qr(J)[0].mT / np.where(own, apart(sigma), 1.0)[:, None]
        # errors that all rays to one marker share do not average out
        each = apart((by_x[:, :, None] @ shared)[:, :, 0].reshape(len(x_i), -1))
        root = weights @ each
        factor = np.linalg.cholesky(np.eye(3) + root @ root.mT)
        weights = np.linalg.solve(factor, weights)
        log_det = 2 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        by_h = weights @ apart((by_x[:, :, None] @ by_h)[:, :, 0].sum(axis=1))
        noise = _lengthening(X, u, planes, covariance)
        for at, (index, k, end) in enumerate(
            zip(some.tolist(), count.tolist(), np.cumsum(count).tolist(), strict=True)
        ):
            rows = slice(end - k, end)
            out[index] = cls(
                spans[index].mover,
                lengths[index],
                x_i[rows],
                noise[rows],
                weights[at, :, :k],
                by_h[at],
                float(log_det[at]),
                R[index],
            )
        return tuple(out)

    def weighing(self, share: float) -> "SpanModel":
        """Return the model with a share of the information, where other pairs have the rest of it."""
        root = math.sqrt(share)
        return self if share == 1 else replace(self, weights=root * self.weights, by_h=root * self.by_h)


class Spans:
    """Batch of spans of three rows each, evaluated at once; padded instants have no weight."""

    rows = 3

    def __init__(self, models: Sequence[SpanModel]) -> None:
        shape = len(models), max(len(one.x_i) for one in models)
        self._x_i, self._noise = np.zeros((*shape, 2, 2)), np.zeros(shape)
        self._weights: Array = np.zeros((len(models), self.rows, shape[1]))
        for at, one in enumerate(models):
            k = len(one.x_i)
            self._x_i[at, :k], self._noise[at, :k], self._weights[at, :, :k] = one.x_i, one.noise, one.weights
            self._x_i[at, k:] = one.x_i[0]
        self._R = np.array([one.R_camera_view for one in models])
        self._length: Array = np.array([one.length for one in models])
        self._by_longer = -self._length[:, None] * self._weights.sum(axis=2)

    def at(self, n: Array, longer: Array) -> tuple[Array, Array, Array]:
        """Return the residuals (s, 3) without the part of h.

        With their derivatives by the planes n, (s, 3, 3), and by `longer` (s,), the relative errors of the spans,
        (s, 3).
        """
        lengths, by_n, _, _ = spans_on_plane(self._x_i, (n[:, None] @ self._R)[:, 0])
        off = lengths - self._noise - (self._length * (1 + longer))[:, None]
        return (self._weights @ off[..., None])[..., 0], self._weights @ by_n @ self._R.mT, self._by_longer
