"""Initial pose of a robot, or position of a landmark, by ranges to known points: `RangeAlignment`."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coloc_graph.backend.sensor_model import Pose
from coloc_graph.geometry.se2 import wrap

Array = NDArray[np.float64]

NEWEST = 160  # newest ranges that are used
MIN_RANGES = 8  # ranges from which on a search begins
MORE = 1.15  # growth of their number at which it begins anew
SCALE = 0.1  # m, noise of a range with what the tracks drift meanwhile, at least
ROBUST = 3.0  # scales: of the robust loss
DIRECTIONS = 8  # headings, and directions of the first point, from which the search begins
ITERATIONS = 40
SAME_COST = 6.0  # half chi2 by which the best fit must be better than another
APART = 0.5  # m, rad, from which on two fits differ
MAX_SIGMAS = (0.15, 0.15, 0.1)  # m, m, rad: uncertainty above which a fit is none
MIN_AGREEMENT = 0.6  # share of the ranges that must agree within the robust loss
#: Reasons for which ranges give no pose.
OPEN = "its ranges leave open where it is: range it from more places, or to more robots or landmarks"
MIRRORED = (
    "its ranges fit two places, as mirrored: drive curves, range it to another robot or landmark, or measure a bearing"
)


class _Fits(NamedTuple):
    """Fits from k starts: x, y, turn (k, 3), half chi2 (k,), whitened residuals (k, n), normal equations (k, 3, 3)."""

    at: Array
    costs: Array
    residuals: Array
    information: Array


class RangeAlignment:
    """Placement of the points of one frame, by their ranges to known points of the world.

    Parameters
    ----------
    turns : bool
        True of a robot's own frame, whose heading is unknown too; False of a landmark, which has none.
    """

    def __init__(self, *, turns: bool) -> None:
        self._turns = turns
        self._rows: list[tuple[float, float, float, float, float, float]] = []
        self._tried = 0
        self._came = 0
        #: Why there is no pose yet.
        self.why = OPEN

    def add(self, own: tuple[float, float], world: tuple[float, float], distance: float, sigma: float) -> None:
        """Add a range [m] of a point in its own frame to one in the world, with its standard deviation [m]."""
        self._rows = [*self._rows, (*own, *world, distance, max(sigma, SCALE))][-NEWEST:]
        self._came += 1

    def pose(self) -> Pose | None:
        """Return the pose of the own frame in the world, of a landmark its position; None while no single one fits."""
        if self._came < max(MIN_RANGES, MORE * self._tried):
            return None
        self._tried = self._came
        rows = np.array(self._rows)
        fits = _fits(rows, self._starts(rows), turns=self._turns)
        order = np.argsort(fits.costs)
        best = int(order[0])
        newest = _placed(fits.at, rows[-1, :2])
        off = np.linalg.norm(newest - newest[best], axis=1)
        if self._turns:
            off = np.maximum(off, np.abs(wrap(fits.at[:, 2] - fits.at[best, 2])))
        rivals = (fits.costs - fits.costs[best] < SAME_COST) & (off > APART)
        free = 3 if self._turns else 2
        # at the newest point: the frame's origin may be far away
        at_newest = np.eye(3)
        at_newest[:2, 2] = newest[best, 1] - fits.at[best, 1], fits.at[best, 0] - newest[best, 0]
        information = (at_newest.T @ fits.information[best] @ at_newest)[:free, :free] + 1e-9 * np.eye(free)
        sigmas = np.sqrt(np.diagonal(np.linalg.inv(information)))
        agree = np.mean(np.abs(fits.residuals[best]) < ROBUST)
        if (sigmas > MAX_SIGMAS[:free]).any() or agree < MIN_AGREEMENT:
            self.why = OPEN
            return None
        if rivals.any():
            self.why = MIRRORED
            return None
        x, y, turn = fits.at[best].tolist()
        return x, y, turn

    def _starts(self, rows: Array) -> Array:
        angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
        grid = np.meshgrid(angles, angles if self._turns else angles[:1], indexing="ij")
        at, turn = grid[0].ravel(), grid[1].ravel()
        qx, qy, wx, wy, distance, _ = rows[len(rows) // 2]
        c, s = np.cos(turn), np.sin(turn)
        x = wx + distance * np.cos(at) - c * qx + s * qy
        return np.stack([x, wy + distance * np.sin(at) - s * qx - c * qy, turn], axis=1)


def _placed(at: Array, point: Array) -> Array:
    """Return a point (2,) of its own frame in the world, by placements (k, 3)."""
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    placed: Array = at[:, :2] + np.stack([c * point[0] - s * point[1], s * point[0] + c * point[1]], axis=1)
    return placed


def _fits(rows: Array, starts: Array, *, turns: bool) -> _Fits:
    """Fit by Levenberg-Marquardt with a robust loss (Cauchy), from all starts at once."""
    q, w, distance, sigma = rows[:, :2], rows[:, 2:4], rows[:, 4], rows[:, 5]

    def evaluated(at: Array) -> tuple[Array, Array, Array, Array]:
        c, s = np.cos(at[:, 2, None]), np.sin(at[:, 2, None])
        px, py = c * q[:, 0] - s * q[:, 1], s * q[:, 0] + c * q[:, 1]
        dx, dy = px + at[:, :1] - w[:, 0], py + at[:, 1:2] - w[:, 1]
        r = np.maximum(np.hypot(dx, dy), 1e-9)
        e = (r - distance) / sigma
        J = np.stack([dx, dy, (dy * px - dx * py) * turns], axis=-1) / (r * sigma)[..., None]
        weight = 1 / (1 + (e / ROBUST) ** 2)
        cost = ROBUST**2 / 2 * np.log1p((e / ROBUST) ** 2).sum(axis=1)
        weighed = weight[..., None] * J
        return cost, e, J.mT @ weighed, (weighed.mT @ e[..., None])[..., 0]

    at, damping = starts.copy(), np.full(len(starts), 1e-2)
    cost, e, H, g = evaluated(at)
    for _ in range(ITERATIONS):
        D = np.eye(3) * (damping[:, None] * np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-6))[:, None, :]
        tried = at - np.linalg.solve(H + D, g[..., None])[..., 0]
        new = evaluated(tried)
        better = new[0] < cost
        done = np.abs(cost - new[0]) < 1e-6 * (1 + cost)
        damping = np.where(better, damping / 5, damping * 5).clip(1e-9, 1e9)
        at = np.where(better[:, None], tried, at)
        cost, e = np.where(better, new[0], cost), np.where(better[:, None], new[1], e)
        H, g = np.where(better[:, None, None], new[2], H), np.where(better[:, None], new[3], g)
        if done.all():
            break
    return _Fits(at, cost, e, H)
