"""Estimate the offset between two cameras' clocks as the ninth parameter of their homography.

A marker that camera i sees at t by its clock is seen by camera j at t + offset by j's: offset = clock_j - clock_i.
Tracks of j are interpolated at i's instants plus the offset; their velocity there is the offset's Jacobian.

The velocity is noisy, and noise alone would look like information on the offset. Therefore the equations are solved
with a smoothed velocity as instrument, the contribution of noise is estimated by Monte Carlo and subtracted, and the
offset counts as observed only if the rest exceeds what noise can make. A motion whose shift in time is itself a
homography (a straight line or an arc at constant speed) leaves nothing: the offset then stays at its prior, and the
homography's covariance contains its uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.special import chdtrc

from coloc_graph.errors import DegenerateGeometry
from coloc_graph.frontend.homography.fit import (
    INLIER_GATE,
    MAX_VARIANCE_SCALE,
    MEDIAN_CHI2,
    MIN_POINTS,
    HomographyFit,
    fit_homography,
)
from coloc_graph.frontend.homography.refinement import Criterion, PointPairs, projection, squared_residuals
from coloc_graph.frontend.homography.scatter import variance_factor
from coloc_graph.frontend.pairing.correspondence import Correspondences
from coloc_graph.frontend.tracks.paired_tracks import PairedTracks, ShiftedTracks
from coloc_graph.geometry.lie import sl3_exp

Array = NDArray[np.float64]
Used = NDArray[np.bool_]

MAX_CLOCK_SIGMA = 0.25  # s, of clocks whose offset is searched for
NOT_OBSERVABLE = (
    "the clock offset is not observable, since the mover drove at constant speed: let it stop and go "
    "(the offset stays at its prior, `clock_sigma`, which the poses of movers that they sighted contain)"
)
MAX_SIGMA_RATIO = 0.5  # of a clock offset to its prior, above which the offset counts as not observed
SEARCH_SIGMAS = 4.0  # standard deviations of the prior within which the offset is searched
MAX_SEARCH_STEPS = 41  # offsets that are tried at most
MAX_H_STEP = 1.0  # change of a coordinate of a homography in one iteration beyond which the points leave it open
NOISE_SIGMAS = 4.0  # standard deviations of noise that the information on the offset must exceed
DISAGREEMENT = 1e-3  # p-value below which stances are reported to disagree on the offset


@dataclass(frozen=True)
class ClockOffset:
    """Offset clock_j - clock_i with its standard deviation [s]."""

    value: float
    sigma: float

    def is_observed(self, clock_sigma: float) -> bool:
        """Return whether it is known better than from its prior."""
        return self.sigma <= MAX_SIGMA_RATIO * clock_sigma

    def reversed(self) -> "ClockOffset":
        """Return the offset clock_i - clock_j."""
        return ClockOffset(-self.value, self.sigma)


@dataclass(frozen=True, eq=False)
class ClockFit:
    """Homography fitted together with the clock offset.

    Attributes
    ----------
    fit
        Homography; its information has the offset marginalised.
    found
        Correspondences, with camera j's points interpolated at camera i's instants.
    information
        Joint information of H and the offset [s], (9, 9).
    offset
        Clock offset.
    by_offset
        Derivative of the coordinates of H by the offset, (8,) [1/s].
    """

    fit: HomographyFit
    found: Correspondences
    information: Array
    offset: ClockOffset
    by_offset: Array


def find_offset(
    tracks: "PairedTracks", start: Correspondences, prior: ClockOffset
) -> tuple[ClockOffset, ClockOffset | None]:
    """Estimate the clock offset of one stance by maximum likelihood, after a search over its prior.

    Parameters
    ----------
    tracks
        Tracks of both cameras, paired.
    start
        Correspondences whose covariances allow for the prior's standard deviation.
    prior
        Prior of the offset.

    Returns
    -------
    tuple
        The offset with the prior, and the evidence of the tracks alone, None if there is none.

    Raises
    ------
    DegenerateGeometry
        The clocks may differ by more than is searched, or the points do not determine a homography.
    """
    require_searchable(prior)
    guess, H = _search(tracks, fit_homography(start.pairs).H, prior)
    evidence = _evidence(tracks, H, guess, prior)
    return _combined(prior, evidence), evidence


def require_searchable(prior: ClockOffset) -> None:
    """Raise `DegenerateGeometry` if clocks may differ by more than is searched."""
    if prior.sigma > MAX_CLOCK_SIGMA:
        raise DegenerateGeometry(
            f"`clock_sigma` of the team is {prior.sigma:g} s, and clock offsets are estimated up to a sigma of "
            f"{MAX_CLOCK_SIGMA:g} s: synchronise the clocks"
        )


def fit_at_offset(
    tracks: "PairedTracks",
    offset: ClockOffset,
    criterion: Criterion = "reprojection",
    spread: float = 0.0,
) -> ClockFit:
    """Fit the homography at a known clock offset, whose uncertainty its information then contains.

    Parameters
    ----------
    tracks
        Tracks of both cameras, paired.
    offset
        Clock offset with its standard deviation.
    criterion
        "reprojection" or "transfer".
    spread
        As in `fit_homography`.

    Returns
    -------
    ClockFit
        The fit.

    Raises
    ------
    DegenerateGeometry
        The points do not determine a homography.
    """
    at = tracks.at(offset.value)
    valid = np.flatnonzero(at.interpolated.valid)
    found = tracks.correspondences(at, valid)
    fit = fit_homography(found.pairs, criterion, spread)
    kept = valid[fit.inliers]
    system = _System(tracks, at, fit.H, kept)
    H, chi2, iterations = fit.H, fit.chi2, fit.iterations
    if criterion == "reprojection":
        # the robust fit takes points as independent; those interpolated from the same samples are not
        for iterations in range(1, 11):
            step = np.asarray(np.linalg.solve(system.by_H, system.score_H), float)
            if not np.abs(step).max() < MAX_H_STEP:
                raise DegenerateGeometry("the points do not determine a homography: it diverges from their robust fit")
            H = H @ sl3_exp(step)
            system = _System(tracks, at, H, kept, system.moved(step))
            if step @ system.by_H @ step < 1e-12:
                break
        chi2 = system.chi2
        information = system.by_H / variance_factor(chi2, fit.dof, spread)
        by_offset = np.asarray(np.linalg.solve(system.by_H, system.by_H_offset), float)
    else:
        information = fit.information
        A, v = system.A.reshape(-1, 8), system.slope.ravel()
        by_offset = np.asarray(np.linalg.lstsq(A, v, rcond=None)[0], float)
    squared = squared_residuals(H, found.pairs)
    own = np.linalg.inv(information)
    marginal = np.asarray(np.linalg.inv(own + offset.sigma**2 * np.outer(by_offset, by_offset)), float)
    joint = np.zeros((9, 9))
    joint[:8, :8] = information
    joint[:8, 8] = joint[8, :8] = -information @ by_offset
    joint[8, 8] = by_offset @ information @ by_offset + 1 / offset.sigma**2
    whole = HomographyFit(H, marginal, fit.inliers, squared, chi2, fit.dof, iterations)
    return ClockFit(whole, found, joint, offset, by_offset)


def fuse(evidence: Sequence[ClockOffset], prior: ClockOffset) -> tuple[ClockOffset, float]:
    """Fuse the offsets of several stances with a prior.

    Parameters
    ----------
    evidence
        Offset by each stance alone.
    prior
        Prior of the offset.

    Returns
    -------
    tuple
        The fused offset, and the p-value of the stances' disagreement. If they disagree beyond chance, the standard
        deviation is enlarged accordingly.
    """
    if not evidence:
        return prior, 1.0
    values, weights = np.array([e.value for e in evidence]), np.array([e.sigma**-2 for e in evidence])
    mean = float(weights @ values / weights.sum())
    chi2, dof = float(weights @ (values - mean) ** 2), len(evidence) - 1
    chance = float(chdtrc(dof, chi2)) if dof else 1.0
    spread = max(1.0, chi2 / dof) if dof and chance < 0.05 else 1.0
    return _combined(prior, ClockOffset(mean, float(np.sqrt(spread / weights.sum())))), chance


def _combined(prior: ClockOffset, evidence: ClockOffset | None) -> ClockOffset:
    if evidence is None:
        return prior
    a, b = prior.sigma**-2, evidence.sigma**-2
    return ClockOffset((a * prior.value + b * evidence.value) / (a + b), float((a + b) ** -0.5))


class _System:
    """Equations of H and the offset, linearised at k points `which` and their latent positions z (k, 2) in image i.

    Residual = A h - velocity * offset, with a covariance in which points that share samples are correlated.
    """

    def __init__(
        self, tracks: PairedTracks, at: ShiftedTracks, H: Array, which: NDArray[np.int64], z: Array | None = None
    ) -> None:
        self._z = tracks.x_i[which] if z is None else z
        p, self._by_z, self.A = projection(H, self._z)
        self._r_i, self._C_i = tracks.x_i[which] - self._z, tracks.covariance_i[which]
        self.residual = (at.x[which] - p - (self._by_z @ self._r_i[..., None])[..., 0]).ravel()
        from_i = self._by_z @ self._C_i @ self._by_z.swapaxes(1, 2)
        band = tracks.noise_j(at, which)
        band[0] += from_i[:, [0, 1], [0, 1]].ravel()
        band[1, ::2] += from_i[:, 1, 0]
        self._factor = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        self.slope = at.slope[which]
        flat = self.A.reshape(-1, 8)
        self._weighted = self._solve(np.column_stack([flat, self.residual, self.slope.ravel()]))
        self.by_H = flat.T @ self._weighted[:, :8]
        self.score_H = flat.T @ self._weighted[:, 8]
        self.by_H_offset = flat.T @ self._weighted[:, 9]
        self.chi2 = float(self.residual @ self._weighted[:, 8])

    def _solve(self, right: Array) -> Array:
        return np.asarray(cho_solve_banded((self._factor, True), right, check_finite=False))

    def moved(self, step: Array, offset: float = 0.0, speed: Array | None = None) -> Array:
        """Latent positions z (k, 2) after a step of H and of the offset."""
        left = self.residual - self.A.reshape(-1, 8) @ step
        if speed is not None:
            left = left + offset * speed.ravel()
        back = self._by_z.swapaxes(1, 2) @ self._solve(left).reshape(-1, 2, 1)
        return np.asarray(self._z + self._r_i + (self._C_i @ back)[..., 0])

    def offset_equation(self, speed: Array, drawn: tuple[Array, Array, Array]) -> tuple[float, float, float, float]:
        """Score and information of the offset with H eliminated, variance of the score, and noise of the information.

        The mean contribution of noise is subtracted from the first two; the last is its standard deviation.
        """
        flat = self.A.reshape(-1, 8)
        instrument = self.slope.ravel()
        gain = np.linalg.solve(self.by_H, self.by_H_offset)
        across = self._weighted[:, 9] - self._weighted[:, :8] @ gain
        position, derivative, slope = drawn
        weighted = self._solve(slope)
        projected = weighted - self._weighted[:, :8] @ np.linalg.solve(self.by_H, flat.T @ weighted)
        made = (projected * derivative).sum(axis=0)
        information = float(across @ speed.ravel() - made.mean())
        score = float(-(across @ self.residual) + (projected * position).sum(axis=0).mean())
        return score, information, float(instrument @ across), float(made.std())


def _gated(squared: Array, valid: Used, among: Used) -> Used:
    """Mask of points within the gate, which widens with the median residual of the inliers `among` them."""
    agree = among & valid
    scale = np.median(squared[agree]) / MEDIAN_CHI2 if agree.any() else 1.0
    return np.asarray(valid & (squared < INLIER_GATE * np.clip(scale, 1.0, MAX_VARIANCE_SCALE)))


def _evidence(
    tracks: PairedTracks, H: Array, offset: float, prior: ClockOffset, rounds: int = 15
) -> ClockOffset | None:
    """Offset by the tracks alone; None if the information on it does not exceed the noise."""
    used = np.ones(len(tracks), bool)
    z_all, draws = tracks.x_i.copy(), tracks.draws()
    for round_ in range(rounds):
        at = tracks.at(offset)
        if round_ < rounds // 2:
            squared = squared_residuals(H, tracks.pairs(at, np.arange(len(tracks))))
            used = _gated(squared, at.interpolated.valid, used)
        which = np.flatnonzero(used)
        if len(which) < MIN_POINTS:
            return None
        system = _System(tracks, at, H, which, z_all[which])
        speed = tracks.speed(at, which)
        score, information, variance, fluctuation = system.offset_equation(speed, tracks.drawn(at, which, draws))
        if information <= NOISE_SIGMAS * fluctuation:
            return None
        step = float(np.clip(score / information, -prior.sigma, prior.sigma))
        h = np.asarray(np.linalg.solve(system.by_H, system.score_H + system.by_H_offset * step), float)
        if not np.abs(h).max() < MAX_H_STEP:
            return None
        z_all[which] = system.moved(h, step, speed)
        H, offset = H @ sl3_exp(h), offset + step
        if abs(offset - prior.value) > 1.5 * SEARCH_SIGMAS * prior.sigma:
            return None
        sigma = float(np.sqrt(variance) / information)
        if abs(step) < 1e-3 * sigma and round_ >= 2:
            break
    sigma *= np.sqrt(variance_factor(system.chi2, 2 * len(which) - 9, 0.0))
    return ClockOffset(offset, sigma)


def _search(tracks: PairedTracks, H: Array, prior: ClockOffset) -> tuple[float, Array]:
    """Offset within reach of the prior at which one homography explains most points, and that homography."""
    at = tracks.at(prior.value)
    sigma = tracks.pairs(at, np.arange(len(tracks))).sigma
    valid = at.interpolated.valid
    fastest = float(np.quantile(np.hypot(*at.slope[valid].T), 0.9)) if valid.any() else 0.0
    reach = SEARCH_SIGMAS * prior.sigma
    # half a step must not move a point by more than the gate
    places = int(np.clip(2 * np.ceil(reach * fastest / (4 * sigma)) + 1, 3, MAX_SEARCH_STEPS))
    offsets = prior.value + np.linspace(-reach, reach, places)
    candidates = []
    for offset in offsets:
        at = tracks.at(float(offset))
        which = np.flatnonzero(at.interpolated.valid)
        if len(which) >= MIN_POINTS:
            refined, cost = _robust(H, tracks.pairs(at, which))
            candidates.append((float(offset), len(which), cost, refined))
    if not candidates:
        raise DegenerateGeometry(
            "the observers' tracks do not overlap in time: record 10 or more images a second, and check the clocks"
        )
    most = max(n for _, n, _, _ in candidates)
    enough = [c for c in candidates if c[1] >= max(MIN_POINTS, most // 3)]
    best = min(enough, key=lambda c: most * c[2] + ((c[0] - prior.value) / prior.sigma) ** 2)
    return best[0], best[3]


def _robust(H: Array, pairs: PointPairs) -> tuple[Array, float]:
    """Fit H robustly (Geman-McClure, graduated) and return it with the mean cost, bounded at the gate."""
    for gate in (2500.0, 400.0, 80.0, INLIER_GATE, INLIER_GATE):
        p, by_z, A = projection(H, pairs.x_i)
        S = pairs.covariance_j + by_z @ pairs.covariance_i @ by_z.swapaxes(1, 2)
        residual = pairs.x_j - p
        weighted = np.linalg.solve(S, np.concatenate([A, residual[..., None]], axis=2))
        squared = np.einsum("nk,nk->n", residual, weighted[..., 8])
        w = (gate / (gate + squared)) ** 2
        normal = np.einsum("n,nka,nkb->ab", w, A, weighted[..., :8])
        step, *_ = np.linalg.lstsq(normal, np.einsum("n,nka,nk->a", w, A, weighted[..., 8]), rcond=1e-14)
        if not np.abs(step).max() < MAX_H_STEP:
            break
        H = H @ sl3_exp(step)
    squared = squared_residuals(H, pairs)
    return H, float((squared * INLIER_GATE / (squared + INLIER_GATE)).mean())
