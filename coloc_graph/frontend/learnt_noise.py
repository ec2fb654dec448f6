"""Learn the noise of each camera's marker centres from the run (`NoiseBelief`).

The team's values (`Camera.centre_noise`, or the defaults) are the prior. All fits of a run update it at once, or stance
by stance.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from coloc_graph.frontend.homography.noise_components import NoiseEvidence, learn_components
from coloc_graph.frontend.homography.refinement import linearise, projection
from coloc_graph.frontend.pairing.correspondence import separated
from coloc_graph.frontend.stance import PairMeasurement
from coloc_graph.team import CentreNoise, Team
from coloc_graph.team.centre_noise import COMPONENTS

Array = NDArray[np.float64]

PARTS = (("stated sigma times", "scale", ""), ("white floor", "floor", "px"), ("saturated spots", "saturated", "px"))


@dataclass(frozen=True)
class NoiseRow:
    """Component of a camera's noise, stated and learnt, each with its factor of uncertainty."""

    robot: str
    what: str
    unit: str
    stated: float
    stated_factor: float
    learnt: float
    learnt_factor: float


@dataclass(frozen=True, eq=False)
class NoiseBelief:
    """Belief on the noise of robots' cameras.

    Attributes
    ----------
    robots
        Names of the r robots with a camera.
    mean, covariance
        Logarithms of the variance components, `COMPONENTS` for each robot, (k,), and their covariance, (k, k).
    points
        Numbers of marker centres that they are learnt from, (r,).
    typical
        Mean stated variance of the centres [px^2] and share of saturated ones, (r, 2).
    """

    robots: tuple[str, ...]
    mean: Array
    covariance: Array
    points: NDArray[np.int64]
    typical: Array

    @classmethod
    def of(cls, team: Team) -> "NoiseBelief":
        """Return the prior that a team states for all robots with a camera."""
        robots = tuple(robot.name for robot in team.robots if robot.camera_if_any is not None)
        logs = [(team[name].camera.centre_noise or CentreNoise()).logs for name in robots]
        means, sigmas = ([value for one in logs for value in one[which]] for which in (0, 1))
        none = np.zeros((len(robots), 2))
        return cls(robots, np.array(means), np.diag(np.square(sigmas)), np.zeros(len(robots), np.int64), none)

    def updated(self, measured: Sequence[PairMeasurement]) -> "NoiseBelief":
        """Return the belief updated by measurements."""
        made = [found for found in map(self._evidence, measured) if found is not None]
        if not made:
            return self
        mean, covariance = learn_components([evidence for evidence, _ in made], self.mean, self.covariance)
        points, typical = np.array(self.points), np.array(self.typical)
        sums = points[:, None] * typical
        for robot, number, mean_of_points in (seen for _, both in made for seen in both):
            points[robot] += number
            sums[robot] += number * mean_of_points
        return NoiseBelief(self.robots, mean, covariance, points, sums / np.maximum(points, 1)[:, None])

    def _evidence(self, measured: PairMeasurement) -> tuple[NoiseEvidence, list[tuple[int, int, Array]]] | None:
        """Evidence of a fit, and for either camera its index, number of points, and their typical values."""
        fit, found, cameras = measured.fit, measured.correspondences, measured.cameras
        if fit is None or found is None or cameras is None:
            return None
        kept = np.flatnonzero(fit.inliers)
        pairs = found.pairs[kept]
        at = linearise(fit.H, pairs.x_i, pairs)
        robots = [self.robots.index(name) for name in (measured.homography.robot_i, measured.homography.robot_j)]
        sides = (pairs.x_i, pairs.covariance_i, found.loads_i), (pairs.x_j, pairs.covariance_j, found.loads_j)
        parts: list[Array] = []
        seen = []
        for robot, camera, (x, C, loads) in zip(robots, cameras, sides, strict=True):
            stated, per_px = separated(C, x, loads[kept], camera)
            own = [stated, *(load[:, None, None] * per_px for load in loads[kept].T)]
            parts += own if parts else [at.by_z @ part @ at.by_z.mT for part in own]
            variance = np.trace(np.linalg.solve(per_px, stated), axis1=1, axis2=2).mean() / 2
            seen.append((robot, len(kept), np.array([variance, loads[kept, 1].mean()])))
        components = np.array([len(COMPONENTS) * robot + n for robot in robots for n in range(len(COMPONENTS))])
        weight = measured.homography.share / fit.persistence
        rows = projection(fit.H, pairs.x_i)[2]
        return NoiseEvidence(at.residual_j, rows, np.array(parts), components, weight), seen

    def _of(self, robot: str) -> tuple[Array, Array]:
        own = slice(begin := len(COMPONENTS) * self.robots.index(robot), begin + len(COMPONENTS))
        return self.mean[own], self.covariance[own, own]

    def noise(self, robot: str) -> CentreNoise:
        """Return the noise of a camera: medians, each with its factor of uncertainty."""
        mean, covariance = self._of(robot)
        return CentreNoise.of_logs(mean.tolist(), np.sqrt(covariance.diagonal()).tolist())

    def sigma(self, robot: str) -> tuple[float, float]:
        """Return the standard deviation of a typical centre [px] and its factor of uncertainty."""
        mean, covariance = self._of(robot)
        stated, saturated = self.typical[self.robots.index(robot)]
        parts = np.exp(mean) * (stated, 1.0, saturated)
        relative = parts / parts.sum()
        return math.sqrt(parts.sum()), math.exp(math.sqrt(relative @ covariance @ relative) / 2)

    def rows(self, team: Team) -> list[NoiseRow]:
        """Return the learnt components beside the stated ones."""
        rows = []
        for robot, points, (variance, saturated) in zip(self.robots, self.points, self.typical, strict=True):
            if not points:
                continue
            stated, learnt = team[robot].camera.centre_noise or CentreNoise(), self.noise(robot)
            rows.append(NoiseRow(robot, "typical centre", "px", math.sqrt(variance), 1.0, *self.sigma(robot)))
            for what, name, unit in PARTS[: 3 if saturated else 2]:
                ends = f"_{unit}" * bool(unit), "_factor"
                values = (getattr(one, f"{name}{end}") for one in (stated, learnt) for end in ends)
                rows.append(NoiseRow(robot, what, unit, *values))
        return rows

    def used(self, team: Team) -> Team:
        """Return a team whose cameras have the expected variances, which are larger than the medians if uncertain.

        The variance of a centre is often known better than its components, which cannot be separated: all are widened
        by the uncertainty of the typical centre.
        """
        noises = {}
        for name in self.robots:
            mean, covariance = self._of(name)
            # half the variance of the logarithm of the variance
            widening = covariance.diagonal() / 2
            if self.points[self.robots.index(name)]:
                widening = np.full(len(mean), 2 * math.log(self.sigma(name)[1]) ** 2)
            noises[name] = CentreNoise.of_logs((mean + widening).tolist(), [0.0] * len(COMPONENTS))
        return with_centre_noise(team, noises)

    def learnt(self, team: Team) -> Team:
        """Return a team that states the learnt noise of its cameras."""
        noises = {name: self.noise(name) for name, n in zip(self.robots, self.points, strict=True) if n}
        return with_centre_noise(team, noises)


def with_centre_noise(team: Team, noises: dict[str, CentreNoise]) -> Team:
    """Return a team with the noise of some robots' cameras replaced."""
    robots = [
        structs.replace(one, camera_if_any=structs.replace(one.camera, centre_noise=noises[one.name]))
        if one.name in noises
        else one
        for one in team.robots
    ]
    return structs.replace(team, robots=tuple(robots))


def measured_again(measured: Iterable[PairMeasurement], team: Team) -> tuple[PairMeasurement, ...]:
    """Measure pairs again from the same points, with the noise of a team's cameras."""
    return tuple(
        one
        if one.with_team is None
        else replace(
            one.with_team(team),
            offset_evidence=one.offset_evidence,
            standing=one.standing,
            landmarks=one.landmarks,
        )
        for one in measured
    )
